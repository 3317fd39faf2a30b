"""The true ground of a scene, for the referee and the metrics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Scene

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class TruthLookup:
    """Looks up the true ground of a scene."""

    scene: Scene

    def judge(self, xy: Array) -> Any:
        """``scenes.truth.maps.TouchdownJudgement`` of the point ``xy`` (2,), world frame."""
        from touchdown.scenes.truth.maps import judge_touchdown

        return judge_touchdown(self.scene, xy)

    def surface_points(self, xy: Array, radius_m: float) -> Array:
        """(N, 3) points of the true surface on a grid of 5 cm in the disc around ``xy``."""
        from touchdown.scenes.truth.raycast import cast_down

        cell = 0.05
        cells = int(radius_m / cell)
        side = 2 * cells + 1
        origin = xy - (cells + 0.5) * cell
        heights, _ = cast_down(self.scene, origin, cell, (side, side))
        rows, cols = np.mgrid[:side, :side]
        offsets = (np.stack([cols, rows], axis=-1) - cells) * cell
        near = (np.hypot(offsets[..., 0], offsets[..., 1]) <= radius_m) & np.isfinite(heights)
        return np.column_stack([xy + offsets[near], heights[near]])

    @property
    def moving_geoms(self) -> frozenset[str]:
        """Names of the geoms of moving bodies."""
        model = self.scene.model
        bodies = {model.body(moving.body_name).id for moving in self.scene.moving}
        return frozenset(
            model.geom(i).name for i in range(model.ngeom) if int(model.geom_bodyid[i]) in bodies
        )
