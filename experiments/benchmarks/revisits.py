"""Precision and recall of loop closures: which images show ground again, by the true poses."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchdown.sim.api import SensorRig
from touchdown.sim.frames import Pose

Array = NDArray[np.float64]

SHOWS_AGAIN = 0.25
"""share of an image whose ground an earlier one shows, from which a closure is due"""
SHOWS_AT_ALL = 0.1
"""the same from which a closure is right"""
LONG_AGO_S = 10.0
"""age of the earlier image"""


class RevisitFigures(NamedTuple):
    """Counts of images that the estimator looked up."""

    due: int  # show again what was seen long ago
    found: int  # closed a loop
    right: int  # of these, with an image of the same ground
    right_and_due: int

    @property
    def precision(self) -> float:
        """Share of the closures that are right; not a number without any."""
        return self.right / self.found if self.found else float("nan")

    @property
    def recall(self) -> float:
        """Share of the closures due that were made; not a number where none was due."""
        return self.right_and_due / self.due if self.due else float("nan")


class Revisits:
    """Counts the images that an estimator looked up, by ``place_asked_s`` and ``place_found_s`` of
    its diagnostics: the times of the image, and of the earlier one that it was found to match
    (negative: none)."""

    def __init__(self, rig: SensorRig, true_at: Callable[[float], Pose]) -> None:
        """``true_at``: world_from_body at a time in seconds, for judging alone."""
        self._rig, self._true_at = rig, true_at
        self._seen: list[tuple[float, Pose]] = []
        self._counts = np.zeros(4, dtype=np.int64)

    def add(self, diagnostics: Mapping[str, float]) -> None:
        """Takes the diagnostics of an estimate; repeated ones count once."""
        asked_s = diagnostics.get("place_asked_s", -1.0)
        if asked_s < 0.0 or (self._seen and self._seen[-1][0] == asked_s):
            return
        now = self._true_at(asked_s) @ self._rig.body_from_camera
        old = [pose for time_s, pose in self._seen if time_s <= asked_s - LONG_AGO_S]
        due = any(self._overlap(now, pose) >= SHOWS_AGAIN for pose in old)
        found_s, right = diagnostics["place_found_s"], False
        if found_s >= 0.0:
            place = self._true_at(found_s) @ self._rig.body_from_camera
            right = self._overlap(now, place) >= SHOWS_AT_ALL
        self._counts += [due, found_s >= 0.0, right, right and due]
        self._seen.append((asked_s, now))

    def figures(self) -> RevisitFigures:
        """Returns the counts so far."""
        return RevisitFigures(*self._counts.tolist())

    def _overlap(self, now: Pose, then: Pose) -> float:
        """Share of the image of a camera at ``now`` (world_from_camera) whose ground, level at the
        height of the take-off, is in the image of one at ``then``."""
        lens, ground = self._rig.camera, self._rig.world_from_body_start.translation[2]
        width, height = lens.width, lens.height
        u, v = np.meshgrid((np.arange(16) + 0.5) / 16 * width, (np.arange(9) + 0.5) / 9 * height)
        focal, middle = np.array([lens.fx, lens.fy]), np.array([lens.cx, lens.cy])
        slopes = (np.column_stack([u.ravel(), v.ravel()]) - middle) / focal
        rays = np.column_stack([slopes, np.ones(len(slopes))]) @ now.rotation.T
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = (ground - now.translation[2]) / rays[:, 2:]
            points = then.inverse().apply(now.translation + reach * rays)
            pixels = points[:, :2] / points[:, 2:] * focal + middle
        inside = (reach[:, 0] > 0.0) & (points[:, 2] > 0.0) & (pixels >= 0.0).all(axis=1)
        return float((inside & (pixels < [width, height]).all(axis=1)).mean())
