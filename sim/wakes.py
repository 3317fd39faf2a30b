"""Wakes of buildings and trees: slower and more turbulent air downstream of obstacles.

The mean flow behind a cuboid of height H, of width W across the wind and length L along it, after
Roeckle (1990) in the form of Kaplan and Dinar (1996), as fast urban wind models use it. With x the
distance from the lee face, y from the middle and z over the ground:

    L_r / H = 1.8 (W / H) / ((L / H)^0.3 (1 + 0.24 W / H)),    0.3 <= L / H <= 3
    d = L_r sqrt((1 - (z / H)^2) (1 - (2 y / W)^2))
    u = -U(H) (1 - x / d)^2                 in the cavity, x < d
    u = U(z) (1 - (d / x)^1.5)              in the wake, d <= x < 3 d

The cavity's (1 - x / d)^2, with U(H), and the wake's local U(z) are as in the sources of QUIC-URB
and QES-Winds; the manual of QES-Winds prints -(1 - (x / d)^2) and U(H) instead.

A crown lets part of the flow through: its wake is 1 - porosity of that of a cuboid, and no flow
turns back. Where wakes overlap, the slowest flow holds. What is not modelled: the displaced flow
in front of obstacles, above and beside them. The added turbulence is a third of the deficit, with
the obstacle's height as its length (assumed; wind tunnels find intensities of 0.2 to 0.4 there).
"""

from collections.abc import Mapping
from typing import Any, NamedTuple
from zlib import crc32

import mujoco
import numpy as np
from numba import njit

from touchdown.scenes.api import Scene, Surface
from touchdown.sim.typing import Array

CROWN_POROSITY = 0.5
"""porosity for the flow, not for the pulses of a LIDAR: a crown in leaf (assumed)"""
_LOWEST_M, _THINNEST_M = 2.0, 1.0
"""obstacles below this height, or thinner in any direction, leave no wake worth its cost"""
_TURBULENCE_FRACTION = 1.0 / 3.0
_MIN_SPEED_MPS = 1.0


class Obstacles(NamedTuple):
    """Cuboids on the ground, N of them."""

    centres_xy_m: Array
    """(N, 2) world frame"""
    axes_xy: Array
    """(N, 2, 2) half extents in metres as two horizontal vectors, one a row"""
    tops_m: Array
    """(N,) world z of the top"""
    solidity: Array
    """(N,) 1 for walls, less for crowns"""


def obstacles(scene: Scene) -> Obstacles:
    """The obstacles of a scene that do not move, from the bounding boxes of its geoms."""
    model = scene.model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    found = []
    for geom in range(model.ngeom):
        surface = _surface(scene.surfaces, model, geom)
        if surface is None or model.body_weldid[model.geom_bodyid[geom]] != 0:
            continue
        box = model.geom_aabb[geom]
        rotation = data.geom_xmat[geom].reshape(3, 3)
        centre = data.geom_xpos[geom] + rotation @ box[:3]
        edges = rotation.T * box[3:, None]  # rows: half edges in world axes
        upright = int(np.argmax(np.abs(rotation[2])))
        across = np.delete(edges, upright, axis=0)[:, :2]
        height = float(np.abs(edges[:, 2]).sum())
        thin = 2.0 * min(height, *np.linalg.norm(across, axis=1)) < _THINNEST_M
        if thin:
            continue
        solid = 1.0 - CROWN_POROSITY if surface.land_class == "trees" else 1.0
        found.append((centre[:2], across, centre[2] + height, solid))
    return Obstacles(
        np.array([f[0] for f in found]).reshape(-1, 2),
        np.array([f[1] for f in found]).reshape(-1, 2, 2),
        np.array([f[2] for f in found]).reshape(-1),
        np.array([f[3] for f in found]).reshape(-1),
    )


def _surface(surfaces: Mapping[str, Surface], model: Any, geom: int) -> Surface | None:
    """The surface of a geom that may be an obstacle; None for terrain, planes and the vehicle."""
    kinds = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
    if model.geom_type[geom] in kinds:
        return None
    surface = surfaces.get(model.geom(geom).name)
    return None if surface is None or surface.water else surface


class Wakes:
    """The fraction of wakes in the wind. ``direction`` (3,) is that of the mean wind, which must
    not change; ``ground_m`` is the world z that heights count from."""

    def __init__(self, found: Obstacles, direction: Array, ground_m: float, seed: int) -> None:
        self._direction = direction
        self._ground_m = ground_m
        self._table = _table(found, direction, ground_m)
        self._rng = np.random.default_rng([seed, crc32(b"wind.wakes")])
        self._state = self._rng.standard_normal(3)
        self._noise = np.empty(3)

    def __len__(self) -> int:
        """Number of obstacles."""
        return len(self._table)

    def add(
        self, wind: Array, position: Array, dt_s: float, friction: float, roughness_m: float
    ) -> None:
        """Changes ``wind`` (3,) m/s in place, for a vehicle at ``position`` (3,), world frame.

        ``friction``: the mean wind's speed at a height is this times ln(height / roughness)."""
        if not len(self._table) or friction <= 0.0:
            return
        self._rng.standard_normal(out=self._noise)
        _add(
            self._table,
            self._direction,
            position,
            position[2] - self._ground_m,
            friction,
            roughness_m,
            dt_s,
            self._noise,
            self._state,
            wind,
        )


_X, _Y, _HALF_WIDTH, _HALF_LENGTH, _HEIGHT, _CAVITY, _SOLID = range(7)


def _table(found: Obstacles, direction: Array, ground_m: float) -> Array:
    """(N, 7) obstacles in axes along and left of the wind, from their sizes in these axes."""
    along, left = direction[:2], np.array([-direction[1], direction[0]])
    length = np.abs(found.axes_xy @ along).sum(axis=1)
    width = np.abs(found.axes_xy @ left).sum(axis=1)
    height = found.tops_m - ground_m
    tall = height >= _LOWEST_M
    safe = np.where(tall, height, 1.0)
    stretch = np.clip(2.0 * length / safe, 0.3, 3.0) ** 0.3
    slender = 2.0 * width / safe
    cavity = safe * 1.8 * slender / (stretch * (1.0 + 0.24 * slender))
    table = np.column_stack(
        [
            found.centres_xy_m @ along,
            found.centres_xy_m @ left,
            width,
            length,
            height,
            cavity,
            found.solidity,
        ]
    )
    return np.ascontiguousarray(table[tall])


@njit(cache=True, error_model="numpy")
def mean_in_wake(
    table: Array, along: float, left: float, height: float, friction: float, roughness: float
) -> tuple[float, float]:
    """Mean speed along the wind at a point in the wind's axes, and the height of the obstacle that
    slows it (0: none)."""
    free = friction * np.log(max(height, roughness) / roughness)
    slowest, behind = free, 0.0
    for i in range(table.shape[0]):
        top = table[i, _HEIGHT]
        if height >= top:
            continue
        x = along - table[i, _X] - table[i, _HALF_LENGTH]
        if x <= 0.0 or x >= 3.0 * table[i, _CAVITY]:
            continue
        aside = left - table[i, _Y]
        if abs(aside) >= table[i, _HALF_WIDTH]:
            continue
        y, z = aside / table[i, _HALF_WIDTH], max(height, 0.0) / top
        reach = table[i, _CAVITY] * np.sqrt((1.0 - z * z) * (1.0 - y * y))
        if x >= 3.0 * reach:
            continue
        solid = table[i, _SOLID]
        if x >= reach:
            speed = free * (1.0 - solid * (reach / x) ** 1.5)
        elif solid < 1.0:
            speed = free * (1.0 - solid)
        else:
            speed = -friction * np.log(top / roughness) * (1.0 - x / reach) ** 2
        if speed < slowest:
            slowest, behind = speed, top
    return slowest, behind


@njit(cache=True, error_model="numpy")
def _add(
    table: Array,
    direction: Array,
    position: Array,
    height: float,
    friction: float,
    roughness: float,
    dt: float,
    noise: Array,
    state: Array,
    wind: Array,
) -> None:
    along = position[0] * direction[0] + position[1] * direction[1]
    left = position[1] * direction[0] - position[0] * direction[1]
    speed, behind = mean_in_wake(table, along, left, height, friction, roughness)
    free = friction * np.log(max(height, roughness) / roughness)
    # The turbulence's state runs on outside wakes too: it must not start from the same draw.
    length = behind if behind > 0.0 else 5.0
    decay = np.exp(-dt * max(free, _MIN_SPEED_MPS) / length)
    spread = np.sqrt(1.0 - decay * decay)
    for i in range(3):
        state[i] = decay * state[i] + spread * noise[i]
    deficit = free - speed
    for i in range(3):
        wind[i] += _TURBULENCE_FRACTION * deficit * state[i] - deficit * direction[i]
