"""Point-to-plane update of the filter by one scan, against planes anchored to its clones."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from touchdown.estimator.api import LivoParams
from touchdown.estimator.filtering.anchors import Anchors
from touchdown.estimator.filtering.deskew import PlacedScan
from touchdown.estimator.filtering.error_state import POSE, POSE_DIM, Frame
from touchdown.estimator.filtering.eskf import Eskf, IteratedUpdate
from touchdown.estimator.filtering.information import (
    lateral_strength,
    rotations_among,
    weak_columns,
    without_directions,
)
from touchdown.estimator.filtering.plane_map import PlaneMap
from touchdown.estimator.livo.plane_equations import Returns, ScanNoise, plane_equations
from touchdown.estimator.typing import Array
from touchdown.sim.api import SensorRig

_SAME_PLANE_M = 0.02
"""displacement of a return up to which its plane is not looked up again"""
_GATES = (6.0, 4.0)
"""standard deviations, of the first iteration and of the others"""


@dataclass(frozen=True, kw_only=True, slots=True)
class LidarReport:
    """Result of an update by one scan, for the recording."""

    matched: int = 0
    rms_m: float = 0.0
    lateral_strength: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) eigenvalues, ascending, of the lateral information after the Schur complement"""
    weak_translation: int = 0
    """number of degenerate directions of translation"""
    weak_rotation: int = 0
    """number of degenerate axes of rotation"""


@dataclass(frozen=True, kw_only=True, slots=True)
class ScanErrors:
    """Error model of a scan."""

    range_sigma_m: float
    """standard deviation of the range of one return"""
    angle_sigma_rad: float
    """standard deviation of the direction of one beam"""
    floor_sigmas: Array
    """(6,) rad and m: information floor, errors of the scan, and of each clone's part of the map,
    that do not average out (``limit_information``)"""
    plane_sigma_m: float = 0.003
    """standard deviation of any plane, beside the scatter of its returns"""
    weak_sigmas: tuple[float, float] | None = None
    """rad and m: directions known less well than these are left out of the update
    (``weak_columns``); None: none are"""


def update_with_scan(
    eskf: Eskf,
    plane_map: PlaneMap,
    anchors: Anchors,
    scan: PlacedScan,
    errors: ScanErrors,
    *,
    share: float = 1.0,
    iterations: int = 3,
    min_matches: int = 30,
) -> LidarReport:
    """Iterated update by a scan that ends at the filter's present time.

    Planes are looked up in the first iteration, and in the second if the first has moved the
    returns. With fewer than ``min_matches`` matches nothing is changed. ``share``: of the
    correction that mounts and lens take.
    """
    update = IteratedUpdate(eskf, share)
    returns, shared = Returns(scan.points, scan.beams), eskf.shared
    weak, raw = np.zeros((POSE_DIM, 0)), np.zeros((POSE_DIM, POSE_DIM))
    matched, keys, used, rms = None, np.zeros(0, np.int64), 0, 0.0
    looked_up = np.full_like(scan.points, np.inf)
    for iteration in range(iterations):
        state = eskf.state
        placed = scan.points @ state.rotation.T + state.position
        fresh = iteration < 2 and np.abs(placed - looked_up).max() > _SAME_PLANE_M
        if fresh or matched is None:
            matched, looked_up = plane_map.match(placed), placed
            keys = np.unique(matched.anchors[matched.found])
            keys = keys[keys >= 0].astype(np.int64)
        noise = ScanNoise(
            errors.range_sigma_m, errors.angle_sigma_rad, errors.plane_sigma_m,
            _GATES[min(iteration, len(_GATES) - 1)],
        )  # fmt: skip
        found = plane_equations(
            returns, Frame(state.rotation, state.position), matched,
            anchors.frames(eskf.clones, state.calibration, keys), len(keys), shared, noise,
        )  # fmt: skip
        used, rms = found.used, found.rms
        if used < min_matches:
            update.abandon()
            return LidarReport(matched=used, rms_m=rms)
        raw = found.information[POSE, POSE].copy()
        if errors.weak_sigmas is not None and fresh:
            weak = weak_columns(raw, found.noise_information, errors.weak_sigmas)
        information, vector = without_directions(found.information, found.vector, weak)
        # each clone's part of the map has a floor of its own: otherwise the number of points
        # would tie the clones to each other too firmly
        floor = errors.floor_sigmas
        floors = np.concatenate([floor, np.zeros(shared), np.tile(floor, len(keys))])
        if update.step(keys.tolist(), information, vector, floors) and iteration > 0:
            break
    update.finish()
    return LidarReport(
        matched=used,
        rms_m=rms,
        lateral_strength=lateral_strength(raw),
        weak_rotation=rotations_among(weak),
        weak_translation=weak.shape[1] - rotations_among(weak),
    )


class DegeneracyWatch:
    """Reports when scans become degenerate and when they cease to be. A change must last for
    ``patience`` scans."""

    def __init__(self, patience: int = 10) -> None:
        self._patience = patience
        self._degenerate = False
        self._against = 0

    def events(self, report: LidarReport) -> list[str]:
        """Returns the messages caused by the newest scan."""
        weak = report.weak_translation + report.weak_rotation > 0
        self._against = self._against + 1 if weak != self._degenerate else 0
        if self._against < self._patience:
            return []
        self._degenerate, self._against = weak, 0
        if not weak:
            return ["the LIDAR measures the whole pose again"]
        counts = {
            "translation along": report.weak_translation,
            "rotation about": report.weak_rotation,
        }
        lost = [f"{what} {n} {'axis' if n == 1 else 'axes'}" for what, n in counts.items() if n]
        return [f"the LIDAR does not measure {' and '.join(lost)}"]


def scan_errors(rig: SensorRig, params: LivoParams) -> ScanErrors:
    """The errors of a scan by the LIDAR's data and the parameters."""
    tilt, yaw = np.radians([params.scan_tilt_sigma_deg, params.scan_yaw_sigma_deg])
    aside, height = params.scan_lateral_sigma_m, params.scan_height_sigma_m
    weak = float(np.radians(params.weak_sigma_deg)), params.weak_sigma_m
    return ScanErrors(
        range_sigma_m=rig.lidar.range_sigma_m,
        angle_sigma_rad=float(np.radians(rig.lidar.angle_sigma_deg)),
        plane_sigma_m=params.plane_sigma_m,
        floor_sigmas=np.array([tilt, tilt, yaw, aside, aside, height]),
        weak_sigmas=weak if params.use_degeneracy else None,
    )


def scan_diagnostics(report: LidarReport, returns: int, voxels: int) -> dict[str, float]:
    """Figures of an update by one scan, by the name of their plot."""
    return {
        "scan_returns": float(returns),
        "lidar_matched": float(report.matched),
        "lidar_rms_m": report.rms_m,
        "lidar_lateral_weakest": float(report.lateral_strength[0]),
        "lidar_lateral_middle": float(report.lateral_strength[1]),
        "lidar_weak_translation": float(report.weak_translation),
        "lidar_weak_rotation": float(report.weak_rotation),
        "map_voxels": float(voxels),
    }
