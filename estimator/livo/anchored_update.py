"""Point-to-plane update of the filter by one scan, against planes anchored to its clones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.filtering.deskew import PlacedScan
from touchdown.estimator.filtering.error_state import POSE, POSITION, ROTATION, Frame
from touchdown.estimator.filtering.eskf import Eskf, IteratedUpdate
from touchdown.estimator.filtering.information import lateral_strength
from touchdown.estimator.filtering.plane_map import PlaneMap
from touchdown.estimator.livo.anchors import Anchors
from touchdown.estimator.livo.lidar_update import LidarReport, weak_directions, without_directions
from touchdown.estimator.livo.plane_equations import Returns, ScanNoise, plane_equations

Array = NDArray[np.float64]

_PLANE_FLOOR_M = 0.003
_GATES = (6.0, 4.0)
"""standard deviations, of the first iteration and of the others"""


@dataclass(frozen=True, kw_only=True, slots=True)
class ScanErrors:
    """Error model of a scan."""

    range_sigma_m: float
    """of one return"""
    angle_sigma_rad: float
    """of one beam"""
    floor_sigmas: Array
    """(6,) rad and m: information floor, errors of the scan, and of each clone's part of the map,
    that do not average out (``limit_information``)"""
    weak_sigmas: tuple[float, float] | None = None
    """rad and m: directions known less well than these are left out of the update
    (``weak_directions``); None: none are"""


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

    Planes are looked up in the first and the second iteration. With fewer than ``min_matches``
    matches nothing is changed. ``share``: of the correction that mounts and lens take.
    """
    update = IteratedUpdate(eskf, share)
    returns, shared = Returns(scan.points, scan.beams), eskf.shared
    weak, raw = (np.zeros((3, 0)), np.zeros((3, 0))), np.zeros((6, 6))
    matched, keys, used, rms = None, np.zeros(0, np.int64), 0, 0.0
    for iteration in range(iterations):
        state, fresh = eskf.state, iteration < 2
        if fresh or matched is None:
            matched = plane_map.match(scan.points @ state.rotation.T + state.position)
            keys = np.unique(matched.anchors[matched.found])
            keys = keys[keys >= 0].astype(np.int64)
        noise = ScanNoise(
            errors.range_sigma_m, errors.angle_sigma_rad, _PLANE_FLOOR_M,
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
        raw = found.information[POSE, POSE]
        if errors.weak_sigmas is not None and fresh:
            weak = weak_directions(raw, found.noise_information, *errors.weak_sigmas)
        columns = np.zeros((len(found.vector), weak[0].shape[1] + weak[1].shape[1]))
        columns[ROTATION, : weak[0].shape[1]] = weak[0]
        columns[POSITION, weak[0].shape[1] :] = weak[1]
        information, vector = without_directions(found.information, found.vector, columns)
        # each clone's part of the map has a floor of its own: otherwise the number of points
        # would tie the clones to each other too firmly
        floor = errors.floor_sigmas
        floors = np.concatenate([floor, np.zeros(shared), np.tile(floor, len(keys))])
        update.step(keys.tolist(), information, vector, floors)
    update.finish()
    return LidarReport(
        matched=used,
        rms_m=rms,
        lateral_strength=lateral_strength(raw),
        weak_rotation=weak[0].shape[1],
        weak_translation=weak[1].shape[1],
    )
