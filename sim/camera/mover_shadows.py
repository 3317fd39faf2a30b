"""Shadows of people, animals and bicycles on whatever the sun would light behind them.

Shadows of what stands still are baked into the ground's texture; these are cast pixel by pixel: a
pixel lies in shadow where the ray from what it shows towards the sun meets a capsule about a geom.
"""

import cv2
import mujoco
import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.scenes.api import Scene
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.camera.degradations import sun_light
from touchdown.sim.camera.gl import InverseDepth, Snapshot
from touchdown.sim.typing import Array, Bytes, Float32, Indices

LEFT = 0.5
"""fraction of the light that a full shadow leaves"""
_STEP = 2
"""pixels between those that are tested along each axis; between them shadows are soft"""
_THIN_M = 0.015
_FAR_M = 60.0
_HIGH_M = 2.2


class MoverShadows:
    """Darkens rasters of ``pinhole`` where walkers of a scene keep the sun away."""

    @staticmethod
    def of(scene: Scene, pinhole: CameraIntrinsics) -> "MoverShadows | None":
        """None where nobody walks, and without a sun."""
        model = scene.model
        walkers: dict[str, list[int]] = {}
        for body in scene.moving:
            if body.walker and scene.light == "day":
                first, count = (
                    model.body(body.body_name).geomadr[0],
                    model.body(body.body_name).geomnum[0],
                )
                walkers.setdefault(body.walker, []).extend(range(first, first + count))
        sun = sun_light(model)
        return (
            MoverShadows(model, list(walkers.values()), sun, pinhole)
            if walkers and sun >= 0
            else None
        )

    def __init__(
        self, model: mujoco.MjModel, walkers: list[list[int]], sun: int, pinhole: CameraIntrinsics
    ) -> None:
        self._pinhole, self._sun = pinhole, sun
        self._walkers = [np.array(geoms, np.int64) for geoms in walkers]
        self._centres = model.geom_aabb[:, :3].copy()
        halves = model.geom_aabb[:, 3:]
        self._axes = np.argmax(halves, axis=1)
        others = halves.sum(axis=1) - halves.max(axis=1)
        self._radii = np.maximum(0.5 * others, _THIN_M)
        self._reach = np.maximum(halves.max(axis=1) - self._radii, 0.0)

    def darken(
        self, drawn: Bytes, depth: InverseDepth, snapshot: Snapshot, camera_id: int, last_row: int
    ) -> None:
        """Darkens ``drawn`` (rows, W, 3) in place; arguments as `DetailTexture.add`."""
        near = [geoms for geoms in self._walkers if self._in_view(geoms, snapshot, camera_id)]
        if not near:
            return
        axes = snapshot.cam_xmat[camera_id].reshape(3, 3)
        k = self._pinhole
        right, down, ahead = axes[:, 0] / k.fx, -axes[:, 1] / k.fy, -axes[:, 2]
        corner = ahead - k.cx * right + (last_row - 1 - k.cy) * down
        rays = np.stack([corner, _STEP * right, -_STEP * down])
        levels = depth.levels[::_STEP, ::_STEP]
        first = np.cumsum([0, *map(len, near)])
        lit = np.ones(levels.shape, np.float32)
        _shade(
            levels, depth.far, depth.per_level, snapshot.cam_xpos[camera_id], rays,
            -snapshot.light_xdir[self._sun], first, *self._capsules(np.concatenate(near), snapshot),
            lit,
        )  # fmt: skip
        if lit.min() < 1.0:
            size = drawn.shape[1], drawn.shape[0]
            full = cv2.resize(lit, size, interpolation=cv2.INTER_LINEAR)
            np.multiply(drawn, full[:, :, None], out=drawn, casting="unsafe")

    def _in_view(self, geoms: Indices, snapshot: Snapshot, camera_id: int) -> bool:
        """Whether a shadow of the walker may be seen."""
        axes, sun = snapshot.cam_xmat[camera_id].reshape(3, 3), snapshot.light_xdir[self._sun]
        middle = snapshot.geom_xpos[geoms].mean(axis=0)
        length = _HIGH_M * float(np.hypot(sun[0], sun[1])) / max(-float(sun[2]), 0.05)
        x, y, z = axes.T @ (middle - snapshot.cam_xpos[camera_id])
        radius, k = _HIGH_M + min(length, 20.0), self._pinhole
        wide = 0.5 * k.width / k.fx, 0.5 * k.height / k.fy
        inside = -z + radius > 0.0 and abs(x) < wide[0] * -z + 2.0 * radius
        return inside and abs(y) < wide[1] * -z + 2.0 * radius and -z < _FAR_M

    def _capsules(self, geoms: Indices, snapshot: Snapshot) -> tuple[Array, Array, Array]:
        """(N, 3) both ends of the middle line and (N,) radius of each geom, world frame."""
        rotations = snapshot.geom_xmat[geoms].reshape(-1, 3, 3)
        middle = snapshot.geom_xpos[geoms] + np.einsum(
            "nij,nj->ni", rotations, self._centres[geoms]
        )
        along = rotations[np.arange(len(geoms)), :, self._axes[geoms]] * self._reach[geoms, None]
        return middle - along, 2.0 * along, self._radii[geoms]


@njit(cache=True, error_model="numpy")
def _shade(
    levels: Float32,
    far: float,
    per_level: float,
    eye: Array,
    rays: Array,
    sun: Array,
    first: Indices,
    starts: Array,
    ways: Array,
    radii: Array,
    lit: NDArray[np.float32],
) -> None:
    """Writes `LEFT` into ``lit`` (h, w) where the ray towards ``sun`` (3,) meets a capsule; those
    of walker w are ``first[w]`` to ``first[w + 1]``."""
    count = len(first) - 1
    middles, sizes = np.zeros((count, 3)), np.zeros(count)
    for w in range(count):
        for i in range(first[w], first[w + 1]):
            middles[w] += (starts[i] + 0.5 * ways[i]) / (first[w + 1] - first[w])
        for i in range(first[w], first[w + 1]):
            for end in (starts[i], starts[i] + ways[i]):
                sizes[w] = max(sizes[w], np.sqrt(((end - middles[w]) ** 2).sum()) + radii[i])
    for row in range(levels.shape[0]):
        for col in range(levels.shape[1]):
            if levels[row, col] <= 0.0:
                continue
            depth = 1.0 / (far + per_level * levels[row, col])
            x = eye[0] + depth * (rays[0, 0] + col * rays[1, 0] + row * rays[2, 0])
            y = eye[1] + depth * (rays[0, 1] + col * rays[1, 1] + row * rays[2, 1])
            z = eye[2] + depth * (rays[0, 2] + col * rays[1, 2] + row * rays[2, 2])
            for w in range(count):
                px, py, pz = middles[w, 0] - x, middles[w, 1] - y, middles[w, 2] - z
                t = px * sun[0] + py * sun[1] + pz * sun[2]
                off = px * px + py * py + pz * pz - t * t
                if t < -sizes[w] or off > sizes[w] * sizes[w]:
                    continue
                for i in range(first[w], first[w + 1]):
                    if _meets(x, y, z, sun, starts[i], ways[i], radii[i]):
                        lit[row, col] = LEFT
                        break


@njit(cache=True, error_model="numpy")
def _meets(
    x: float, y: float, z: float, sun: Array, start: Array, way: Array, radius: float
) -> bool:
    """Whether the ray from a point along ``sun`` comes closer than ``radius`` to the segment from
    ``start`` along ``way``, past the skin of what the point itself lies on."""
    ox, oy, oz = x - start[0], y - start[1], z - start[2]
    ww = way[0] ** 2 + way[1] ** 2 + way[2] ** 2
    sw = sun[0] * way[0] + sun[1] * way[1] + sun[2] * way[2]
    so = sun[0] * ox + sun[1] * oy + sun[2] * oz
    wo = way[0] * ox + way[1] * oy + way[2] * oz
    slant = ww - sw * sw
    t = (sw * wo - ww * so) / slant if slant > 1e-9 else -so
    s = min(max((wo + t * sw) / ww, 0.0), 1.0) if ww > 1e-9 else 0.0
    t = s * sw - so
    dx, dy, dz = (
        ox + t * sun[0] - s * way[0],
        oy + t * sun[1] - s * way[1],
        oz + t * sun[2] - s * way[2],
    )
    return t > 0.5 * radius and dx * dx + dy * dy + dz * dz < 0.95 * radius * radius
