"""Bodies that move along a closed path."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import MovingBody, Surface
from touchdown.scenes.authoring.builder import GEOM, SceneBuilder, quat_z

Array = NDArray[np.float64]


def along_path(path: Array, distance_m: float) -> tuple[Array, float]:
    """Point (3,) and heading (radians) on a closed polyline."""
    steps = np.roll(path, -1, axis=0) - path
    lengths = np.linalg.norm(steps, axis=1)
    rest = distance_m % float(lengths.sum())
    index = int(np.searchsorted(np.cumsum(lengths), rest, side="right"))
    into = rest - float(lengths[:index].sum())
    unit = steps[index] / lengths[index]
    return path[index] + into * unit, float(np.arctan2(unit[1], unit[0]))


def path_length(path: Array) -> float:
    """Metres once round a closed polyline, (K, 3)."""
    return float(np.linalg.norm(np.roll(path, -1, axis=0) - path, axis=1).sum())


def add_mover(
    builder: SceneBuilder, moving: MovingBody, looks: tuple[str, str], stem: str, surface: Surface
) -> None:
    """The mocap body that ``moving`` describes, at its start. looks: names of mesh and material;
    stem: of the geom's name."""
    where, heading = along_path(moving.path_world, moving.start_m)
    body = builder.spec.worldbody.add_body(
        name=moving.body_name, mocap=True, pos=where, quat=quat_z(heading)
    )
    builder.geom(
        stem, surface, body=body, type=GEOM.mjGEOM_MESH, meshname=looks[0], material=looks[1]
    )


def send_round(
    builder: SceneBuilder,
    path: Array,
    looks: list[tuple[str, str]],
    surface: Surface,
    speed_mps: float,
) -> tuple[MovingBody, ...]:
    """Adds cars ``moving_car_0``, ... spread over one closed path, all at one speed, so that none
    meets the one ahead. looks: names of mesh and material, one a car."""
    moving = []
    for index, look in enumerate(looks):
        share = (index + float(builder.rng.uniform(0.0, 0.6))) / len(looks)
        car = MovingBody(
            body_name=f"moving_car_{index}",
            path_world=path,
            speed_mps=speed_mps,
            start_m=share * path_length(path),
        )
        add_mover(builder, car, look, "car_moving", surface)
        moving.append(car)
    return tuple(moving)
