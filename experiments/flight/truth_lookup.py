"""The true ground of a scene, for the referee and the metrics."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Scene
from touchdown.sim.api import Contact

Array = NDArray[np.float64]

STANDING_TOLERANCE_M = 0.05
"""Largest difference in height between a touching leg and the truth map: half of the step of 0.10 m
that the geometric rule allows, as a map that is further off cannot vouch for it. Feet sink in by
millimetres."""
_AROUND_M = 0.02 * np.stack(np.meshgrid(*2 * [np.arange(-1, 2)]), axis=-1).reshape(-1, 2)
"""(9, 2) offsets around a touching point: it may lie on an edge, or on the side of something"""


@dataclass(frozen=True)
class TruthLookup:
    """Looks up the true ground of a scene."""

    scene: Scene

    def judge(self, xy: Array) -> Any:
        """``scenes.truth.maps.TouchdownJudgement`` of the point ``xy`` (2,), world frame."""
        from touchdown.scenes.truth.maps import judge_touchdown

        return judge_touchdown(self.scene, xy)

    def surface_points(self, xy: Array, radius_m: float) -> Array:
        """(N, 3) points of the true surface on a grid of 5 cm in the disc around ``xy``."""
        from touchdown.scenes.truth.static_surface import cast_down

        cell = 0.05
        cells = int(radius_m / cell)
        side = 2 * cells + 1
        origin = xy - (cells + 0.5) * cell
        heights, _ = cast_down(self.scene, origin, cell, (side, side))
        rows, cols = np.mgrid[:side, :side]
        offsets = (np.stack([cols, rows], axis=-1) - cells) * cell
        near = (np.hypot(offsets[..., 0], offsets[..., 1]) <= radius_m) & np.isfinite(heights)
        return np.column_stack([xy + offsets[near], heights[near]])

    def height_gap_m(self, contacts: tuple[Contact, ...]) -> float | None:
        """The largest difference in height, in size, between the legs' contact points and the true
        surface around them, moving bodies left out; positive above it, infinite where the truth map
        has no surface, None without such a contact. A point between the lowest and the highest
        surface within 2 cm has none."""
        from touchdown.scenes.truth.static_surface import cast_points

        points = [
            contact.point_world
            for contact in contacts
            if contact.part == "leg"
            and contact.point_world is not None
            and contact.other not in self.moving_geoms
        ]
        if not points:
            return None
        touching = np.array(points)
        around = (touching[:, None, :2] + _AROUND_M).reshape(-1, 2)
        heights = cast_points(self.scene, around)[0].reshape(len(points), -1)
        known = np.isfinite(heights)
        highest = np.where(known, heights, -np.inf).max(axis=1)
        lowest = np.where(known, heights, np.inf).min(axis=1)
        above, below = touching[:, 2] - highest, lowest - touching[:, 2]
        gaps = np.where(above > 0.0, above, -np.maximum(below, 0.0))
        return float(gaps[np.argmax(np.abs(gaps))]) + 0.0  # no negative zero

    @cached_property
    def moving_geoms(self) -> frozenset[str]:
        """Names of the geoms of moving bodies and of all that hangs on them."""
        model = self.scene.model
        roots = {int(model.body(m.body_name).rootid[0]) for m in self.scene.moving}
        root_of_geom = model.body_rootid[model.geom_bodyid]
        return frozenset(
            model.geom(i).name for i in range(model.ngeom) if int(root_of_geom[i]) in roots
        )


def stands_on_truth(height_gap_m: float | None) -> bool | None:
    """False where a vehicle stands on something that the truth map does not have, or has at another
    height; None where it is not known."""
    return None if height_gap_m is None else abs(height_gap_m) <= STANDING_TOLERANCE_M
