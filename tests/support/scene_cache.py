"""Scenes that are built once a process, for tests in which the building is not the subject."""

import copy
import dataclasses
import functools
from collections.abc import Iterator

import pytest

from touchdown.scenes import compose
from touchdown.scenes.api import Light, LowSun, Scene


@functools.lru_cache(maxsize=3)
def _built(name: str, seed: int, sun: LowSun | None, light: Light) -> Scene:
    return _LOAD_SCENE(name, seed, sun, light)


_LOAD_SCENE = compose.load_scene


def load_scene_once(name: str, seed: int, sun: LowSun | None = None, light: Light = "day") -> Scene:
    """As `scenes.compose.load_scene`; a shipped scene has a compiled model of its own each time, as
    a world sets physics options there, and shares all else."""
    if "/" in name or name.endswith(".xml"):
        return _LOAD_SCENE(name, seed, sun, light)
    scene = _built(name, seed, sun, light)
    return dataclasses.replace(scene, model=copy.copy(scene.model))


@pytest.fixture(autouse=True, scope="package")
def scenes_built_once() -> Iterator[None]:
    """Flights of a folder share the scenes; import it in the folder's ``conftest.py``."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compose, "load_scene", load_scene_once)
        yield
