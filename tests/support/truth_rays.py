"""Single vertical rays of MuJoCo, which truth maps are checked against."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Scene
from touchdown.sim.typing import Array

TOLERANCE_M = 0.01
_BESIDE_M = 2e-3
_START_M = 300.0


class SingleRays:
    """Casts ``mj_ray`` straight down on a scene without the vehicle and the moving bodies."""

    def __init__(self, scene: Scene) -> None:
        self._model = scene.model
        self._data = mujoco.MjData(scene.model)
        self._data.qpos[:3] = [0.0, 0.0, 1e4]
        for moving in scene.moving:
            body = scene.model.body(moving.body_name)
            self._data.mocap_pos[body.mocapid[0]] = [0.0, 0.0, -1e5]
        mujoco.mj_kinematics(scene.model, self._data)
        self._geom = np.full(1, -1, np.int32)

    def cast(self, xy_m: Array) -> tuple[float, int]:
        """Height and geom at (2,) world metres; NaN and -1 where nothing lies below."""
        start, down = np.array([*xy_m, _START_M]), np.array([0.0, 0.0, -1.0])
        distance = mujoco.mj_ray(self._model, self._data, start, down, None, 1, -1, self._geom)
        return (np.nan, -1) if distance < 0.0 else (_START_M - distance, int(self._geom[0]))

    def heights(self, xy_m: Array) -> Array:
        """(N,) heights at (N, 2) points."""
        return np.array([self.cast(point)[0] for point in xy_m])

    def is_edge(self, xy_m: Array) -> bool:
        """True if the surface steps, or another geom begins, within 2 mm of the point."""
        around = [
            self.cast(xy_m + [dx, dy])
            for dx in (-_BESIDE_M, 0.0, _BESIDE_M)
            for dy in (-_BESIDE_M, 0.0, _BESIDE_M)
        ]
        levels = [level for level, _ in around]
        return not np.ptp(levels) < 0.5 * TOLERANCE_M or len({geom for _, geom in around}) > 1

    def disagreements(self, xy_m: Array, heights_m: Array) -> tuple[NDArray[np.int64], int]:
        """Indices of the points (N, 2) whose heights (N,) differ by more than 1 cm although they
        lie at no edge, and the number of those that do at one."""
        true = self.heights(xy_m)
        differ = ~(
            (np.abs(heights_m - true) <= TOLERANCE_M) | (np.isnan(heights_m) & np.isnan(true))
        )
        wrong = [int(i) for i in np.flatnonzero(differ) if not self.is_edge(xy_m[i])]
        return np.array(wrong, np.int64), int(differ.sum()) - len(wrong)
