"""The map of `livo`: planes, recent returns and intensity images, anchored to the filter's clones.

A part of the map belongs to the clone that it was seen from and moves with its estimate. It is made
of the scans within a moment after its clone, whose drift against it is nothing beside the noise of
a return, and is never added to: returns registered to it later would bring the drift since then
into the map, and a revisit, compared with it, would confirm that drift.
"""

from __future__ import annotations

from touchdown.estimator.api import LivoParams
from touchdown.estimator.filtering.anchors import Anchors
from touchdown.estimator.filtering.deskew import PlacedScan, moved, thin_out
from touchdown.estimator.filtering.error_state import Frame
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.landmark_depth import RecentReturns
from touchdown.estimator.filtering.plane_map import PlaneMap
from touchdown.estimator.livo.intensity import PhotometricUpdate
from touchdown.estimator.typing import Array, Bytes

_SPREAD = 0.12
"""fraction of a voxel between two points of a scan that are stored: close to the ground a scan
would fill a voxel from one corner of it"""


class AnchoredMap:
    """Part k of ``anchors`` and ``images`` belongs to clone k of the filter."""

    def __init__(
        self, params: LivoParams, lever: Array, dark_ticks: int | None, tick_hz: int
    ) -> None:
        """``lever`` (3,), ``dark_ticks``: see ``PhotometricUpdate``; ``tick_hz``: of ticks."""
        self._voxel_m = params.voxel_m
        self._open_ticks = params.map_open_s * tick_hz, params.image_open_s * tick_hz
        self._begun = 0
        self.planes = PlaneMap(params.voxel_m, params.map_voxels, params.voxel_points)
        self.recent = RecentReturns()
        self.anchors = Anchors()
        self.photometric = PhotometricUpdate(lever, dark_ticks, params.dark_height_sigma_m)

    def extend(self, eskf: Eskf, scan: PlacedScan, intensity: Bytes, lever: Array) -> None:
        """Adds the scan just used, with its ``intensity`` (N,), at the present pose to the newest
        clone's part while that is open. ``lever`` (3,): of the LIDAR in the IMU frame."""
        state, age = eskf.state, eskf.state.tick - self._begun
        pose = Frame(state.rotation, state.position)
        self.recent.add(scan.points, pose)
        if not eskf.clones:
            return
        if age <= self._open_ticks[0]:
            sensor = state.rotation @ lever + state.position
            spread = thin_out(scan.points, _SPREAD * self._voxel_m, 16)
            points = moved(scan.points, spread, pose)
            clone, calibration = eskf.clones[-1], state.calibration
            points = self.anchors.as_kept(points, sensor, clone, calibration, state.rotation)
            self.planes.insert(points, sensor, len(self.anchors) - 1)
        if age <= self._open_ticks[1]:
            self.photometric.extend(eskf, scan.points, intensity)

    def begin(self, eskf: Eskf, height_m: float, dark_ticks: int) -> None:
        """Begins the part of the clone just added, ``height_m`` above the ground."""
        self._begun = eskf.state.tick
        self.photometric.begin(eskf, height_m, dark_ticks)
        self.anchors.add(eskf.clones[-1], eskf.state.calibration)

    def hand_over(self, k: int, eskf: Eskf) -> None:
        """Gives the planes of clone ``k``, which is about to go, to the clone nearest to it."""
        self.photometric.drop(k)
        successor, move = self.anchors.reassignment(k, eskf.clones)
        self.planes.reassign(k, successor, move)
        self.anchors.remove(k)
