"""Named scenes on disk, so that a place is generated once and not by every flight over it.

An entry is a directory with MuJoCo's binary model and the rest of the `Scene`, pickled. Its name
is a hash of what the scene depends on: name, seed, dials, sun, light, traffic, the sources and
pictures of this package, and the versions of the libraries that generate it.
"""

import contextlib
import hashlib
import os
import pickle
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import mujoco
import numba
import numpy as np
import scipy

from touchdown.scenes.api import (
    NO_GUESTS,
    VEHICLES,
    Dials,
    Guests,
    ImportOptions,
    Light,
    LowSun,
    Scene,
    TrafficParams,
)
from touchdown.scenes.authoring.variation import present_variation
from touchdown.scenes.registry import dials_of, scene_names

DIRECTORY_VARIABLE = "TOUCHDOWN_SCENE_CACHE"
"""a directory, or ``off``; without it ``touchdown/scenes`` in the user's directory of caches"""
SIZE_VARIABLE = "TOUCHDOWN_SCENE_CACHE_GB"
DEFAULT_GB = 4.0
"""about 40 scenes of 0.1 GB"""
_MODEL, _REST = "model.mjb", "scene.pickle"
_LIBRARIES = (mujoco, np, scipy, cv2, numba)


def cached_scene(
    name_or_path: str,
    seed: int,
    sun: LowSun | None,
    light: Light,
    options: ImportOptions | None = None,
    dials: Dials | None = None,
    traffic: TrafficParams | None = None,
    guests: Guests = NO_GUESTS,
) -> Scene:
    """As `load_scene`, from the disk where the scene was loaded before. A scene from a file is read
    anew each time. Raises as `load_scene`; a cache that cannot be read or written is none."""

    def load() -> Scene:
        from touchdown.scenes.compose import load_scene  # what makes scenes

        return load_scene(name_or_path, seed, sun, light, options, dials, traffic, guests)

    traffic = traffic or TrafficParams()
    own = name_or_path in scene_names() and seed >= 0 and present_variation() is None
    own = own and not traffic.paths and guests.vehicle in VEHICLES
    folder = _folder() if own else None
    if folder is None:
        return load()
    found = dials_of(name_or_path, dials)
    key = repr((name_or_path, seed, sun, light, traffic, guests, _sources(), found))
    return _through(folder / hashlib.sha256(key.encode()).hexdigest()[:32], load)


def _through(entry: Path, load: Callable[[], Scene]) -> Scene:
    # Damaged pickles raise what they like.
    with contextlib.suppress(Exception):
        rest: Scene = pickle.loads((entry / _REST).read_bytes())
        model = mujoco.MjModel.from_binary_path(str(entry / _MODEL))
        os.utime(entry)
        return replace(rest, model=model)
    scene = load()
    with contextlib.suppress(OSError):
        _write(entry, scene)
        _shrink(entry.parent, _limit_bytes())
    return scene


def _write(entry: Path, scene: Scene) -> None:
    """Writes an entry beside its place and moves it there, whole."""
    partial = Path(tempfile.mkdtemp(dir=entry.parent))
    try:
        model = partial / _MODEL
        mujoco.mj_saveModel(scene.model, str(model), None)
        if model.stat().st_size != mujoco.mj_sizeModel(scene.model):
            raise OSError("the model was not saved whole")
        (partial / _REST).write_bytes(pickle.dumps(replace(scene, model=None)))
        shutil.rmtree(entry, ignore_errors=True)
        partial.rename(entry)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _shrink(folder: Path, max_bytes: float) -> None:
    """Removes the entries that were used least recently until ``max_bytes`` are left."""
    sizes = {
        entry: sum(file.stat().st_size for file in entry.iterdir())
        for entry in sorted(folder.iterdir(), key=lambda entry: entry.stat().st_mtime)
    }
    total = sum(sizes.values())
    for entry, size in sizes.items():
        if total <= max_bytes:
            return
        shutil.rmtree(entry, ignore_errors=True)
        total -= size


def _folder() -> Path | None:
    """The directory of entries; None where there is none that belongs to this user alone."""
    named = os.environ.get(DIRECTORY_VARIABLE, "")
    if named == "off":
        return None
    caches = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    folder = Path(named or f"{caches}/touchdown/scenes").expanduser()
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        found = folder.stat()
    except (OSError, RuntimeError):
        return None
    own = found.st_uid == os.getuid() and not found.st_mode & 0o022  # an entry is unpickled
    return folder if own else None


def _limit_bytes() -> float:
    try:
        return max(float(os.environ.get(SIZE_VARIABLE, DEFAULT_GB)), 0.0) * 1e9
    except ValueError:
        return DEFAULT_GB * 1e9


@cache
def _sources() -> str:
    """Hash of the files of this package and of ``sim``, and of the libraries' versions."""
    found = hashlib.sha256(repr([library.__version__ for library in _LIBRARIES]).encode())
    scenes = Path(__file__).parent
    for folder in (scenes, scenes.parent / "sim"):
        for file in sorted(folder.rglob("*")):
            if file.is_file() and "__pycache__" not in file.parts:
                found.update(str(file.relative_to(folder)).encode() + file.read_bytes())
    return found.hexdigest()
