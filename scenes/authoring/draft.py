"""Output of a scene generator, before the vehicle is added and the model compiled."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Array, GroundRaster, MovingBody, Surface


class Picture(NamedTuple):
    """A large image, (H, W, 3) uint8, top row first, which is drawn where it is to be kept."""

    shape: tuple[int, ...]
    draw: Callable[[NDArray[np.uint8]], object]
    """fills an image of ``shape``"""


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneDraft:
    """An uncompiled scene."""

    spec: Any
    """mujoco.MjSpec"""
    takeoff_xy_m: Array
    """(2,) world"""
    takeoff_yaw: float
    bounds_xy_m: Array
    """(2, 2) [[x_min, y_min], [x_max, y_max]]"""
    surfaces: dict[str, Surface]
    """by geom name"""
    ground: GroundRaster | None
    moving: tuple[MovingBody, ...] = field(default=())
    origin_m: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) of the world's origin in the coordinates of the file that the scene was read from"""
    inferred: dict[str, tuple[str, str]] = field(default_factory=dict)
    """class of geoms whose names say nothing, and what it is inferred from"""
    textured: tuple[str, ...] = ()
    """geoms of featureless ground that were given texture and relief"""
    facts: dict[str, float] = field(default_factory=dict)
    """as `Scene.facts`"""
    pictures: dict[str, Picture] = field(default_factory=dict)
    """of textures that are flat in the spec: `SceneDraft.fill` them there, or `fill_model` the
    compiled model, to which MuJoCo would take them by four copies"""

    def fill(self) -> None:
        """Draws the pictures into the spec."""
        for name, picture in self.pictures.items():
            image = np.empty(picture.shape, np.uint8)
            picture.draw(image)
            fill_texture(self.spec.texture(name), image)

    def fill_model(self, model: Any) -> None:
        """Draws the pictures into the compiled ``model``."""
        for name, (shape, draw) in self.pictures.items():
            start = int(model.tex_adr[model.texture(name).id])
            draw(model.tex_data[start : start + math.prod(shape)].reshape(shape))


def size_texture(texture: Any, shape: tuple[int, ...]) -> None:
    """Makes an MjSpec texture a flat one of the size of an image of ``shape`` (H, W, 3)."""
    import mujoco  # here alone: a replay needs no simulator

    texture.builtin = mujoco.mjtBuiltin.mjBUILTIN_FLAT
    texture.height, texture.width = shape[:2]
    texture.nchannel = 3


def fill_texture(texture: Any, image: NDArray[np.uint8]) -> None:
    """Copies an image, (H, W, 3) uint8, top row first, into an MjSpec texture."""
    import mujoco

    size_texture(texture, image.shape)
    texture.builtin = mujoco.mjtBuiltin.mjBUILTIN_NONE
    texture.data = np.ascontiguousarray(image).tobytes()
