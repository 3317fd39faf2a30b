"""Named scenes on disk, so that a place is generated once and not by every flight over it.

An entry is a directory with MuJoCo's binary model and the rest of the `Scene`, pickled. Its name
is a hash of what the scene depends on: name, seed, sun, light, the sources and pictures of this
package, and the versions of the libraries that generate it.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import pickle
import shutil
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from importlib.metadata import version
from io import RawIOBase
from mmap import mmap
from pathlib import Path

import mujoco

from touchdown.scenes.api import Light, LowSun, Readying, Scene
from touchdown.scenes.authoring.ground import present_dressing
from touchdown.scenes.compose import load_scene
from touchdown.scenes.registry import scene_names

DIRECTORY_VARIABLE = "TOUCHDOWN_SCENE_CACHE"
"""a directory, or ``off``; without it ``touchdown/scenes`` in the user's directory of caches"""
SIZE_VARIABLE = "TOUCHDOWN_SCENE_CACHE_GB"
DEFAULT_GB = 4.0
"""about 40 scenes of 0.1 GB"""
_PIECE_BYTES = 1 << 20
_MODEL, _REST = "model.mjb", "scene.pickle"
_LIBRARIES = ("mujoco", "numpy", "scipy", "opencv-contrib-python-headless", "numba")


def cached_scene(
    name_or_path: str, seed: int, sun: LowSun | None, light: Light, ready: Readying | None = None
) -> Scene:
    """As `load_scene`, from the disk where the scene was loaded before. A scene from a file is read
    anew each time. Raises as `load_scene`; a cache that cannot be read or written is none."""

    def load() -> Scene:
        return load_scene(name_or_path, seed, sun, light, ready)

    own = name_or_path in scene_names() and seed >= 0 and present_dressing() is None
    folder = _folder() if own else None
    if folder is None:
        return load()
    key = repr((name_or_path, seed, sun, light, _sources()))
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
        _write_model(partial / _MODEL, scene.model)
        (partial / _REST).write_bytes(pickle.dumps(replace(scene, model=None)))
        shutil.rmtree(entry, ignore_errors=True)
        partial.rename(entry)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _write_model(file: Path, model: mujoco.MjModel) -> None:
    """Writes 0.1 GB past the system's cache of files where it can, through a pipe: most scenes are
    flown once, and in a virtual machine fresh pages for a copy, or for that cache, cost up to a
    quarter of a second."""
    try:
        _write_directly(file, model)
    except (AttributeError, OSError):  # not every system and file system has direct writes
        mujoco.mj_saveModel(model, str(file), None)
    if file.stat().st_size != mujoco.mj_sizeModel(model):
        raise OSError("the model was not saved whole")


def _write_directly(file: Path, model: mujoco.MjModel) -> None:
    descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_DIRECT, 0o600)
    piece = memoryview(mmap(-1, _PIECE_BYTES))
    with open(descriptor, "wb", buffering=0) as out:
        source, sink = os.pipe()
        # MuJoCo saves without Python's lock, and ends where the pipe is closed early.
        with ThreadPoolExecutor(1) as pool, open(source, "rb", buffering=0) as pieces:
            saved = pool.submit(_save_to_pipe, model, sink)
            with contextlib.suppress(OSError):  # pipes of this size may not be allowed
                fcntl.fcntl(source, fcntl.F_SETPIPE_SZ, _PIECE_BYTES)
            size, left = 0, mujoco.mj_sizeModel(model)
            while left and (filled := _filled(pieces, piece[: min(left, len(piece))])):
                if out.write(piece) != len(piece):  # whole pages, from the start of a page
                    raise OSError("no space is left")
                size, left = size + filled, left - filled
            saved.result()
        out.truncate(size)


def _save_to_pipe(model: mujoco.MjModel, sink: int) -> None:
    try:
        mujoco.mj_saveModel(model, f"/dev/fd/{sink}", None)
    finally:
        os.close(sink)


def _filled(pieces: RawIOBase, piece: memoryview) -> int:
    """Fills ``piece`` as far as there is something to read; returns how far."""
    filled = 0
    while filled < len(piece) and (count := pieces.readinto(piece[filled:])):
        filled += count
    return filled


def _shrink(folder: Path, most_bytes: float) -> None:
    """Removes the entries that were used least recently until ``most_bytes`` are left."""
    sizes = {
        entry: sum(file.stat().st_size for file in entry.iterdir())
        for entry in sorted(folder.iterdir(), key=lambda entry: entry.stat().st_mtime)
    }
    total = sum(sizes.values())
    for entry, size in sizes.items():
        if total <= most_bytes:
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
    found = hashlib.sha256(repr([version(name) for name in _LIBRARIES]).encode())
    scenes = Path(__file__).parent
    for folder in (scenes, scenes.parent / "sim"):
        for file in sorted(folder.rglob("*")):
            if file.is_file() and "__pycache__" not in file.parts:
                found.update(str(file.relative_to(folder)).encode() + file.read_bytes())
    return found.hexdigest()
