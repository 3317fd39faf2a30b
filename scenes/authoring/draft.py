"""Output of a scene generator, before the vehicle is added and the model compiled."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import GroundRaster, MovingBody, Surface

Array = NDArray[np.float64]


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
    guessed: dict[str, tuple[str, str]] = field(default_factory=dict)
    """class of geoms whose names say nothing, and what it is guessed by"""
    dressed: tuple[str, ...] = ()
    """geoms of featureless ground that were given texture and relief"""
