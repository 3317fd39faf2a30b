"""Point-to-plane update of the filter by one scan, against planes anchored to its clones.

A residual compares the present pose with the clone that the plane is anchored to, and both with the
LIDAR's mount. The error shared by all planes of a clone is thus the clone's error, which the filter
estimates and a revisit reduces, instead of new noise in every scan.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.estimator.filtering.deskew import PlacedScan
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.information import (
    NormalEquations,
    lateral_strength,
    limit_information,
)
from touchdown.estimator.filtering.plane_map import PlaneMap, PlaneMatches
from touchdown.estimator.livo.anchors import Anchors
from touchdown.estimator.livo.lidar_update import (
    LidarReport,
    normal_noise_information,
    weak_directions,
    without_directions,
)

Array = NDArray[np.float64]

_PLANE_FLOOR_M = 0.003


@njit(cache=True)
def anchored_information(
    points: Array,
    beams: Array,
    rotation: Array,
    position: Array,
    planes: PlaneMatches,
    clone_rotations: Array,
    clone_positions: Array,
    mount_changes: Array,
    shared: int,
    range_sigma: float,
    angle_sigma: float,
    plane_floor: float,
    gate: float,
) -> NormalEquations:
    """Returns the normal equations, (D, D), of the point-to-plane residuals ``n . (R p + t - c)``.

    ``points`` and ``beams`` (N, 3): IMU frame; ``planes``: in the odometry frame at the present
    estimate, anchors as indices into the M clones; ``clone_*``: odom_from_imu of these;
    ``mount_changes`` (M, 6): present mount less the mount when the clone was made. Error order:
    rotation (right perturbation), position, ``shared`` coordinates of calibration
    (``online_calibration``), then six for each clone; D = 6 + shared + 6 M.

    A residual's variance is the larger of the beam's (range and angle noise along the normal) and
    the plane's thickness, plus the plane's uncertainty. Weights are Cauchy's with scale
    ``gate``/2 standard deviations, zero beyond ``gate``.
    """
    found, normals, centres = planes.found, planes.normals, planes.centres
    variances, sensors, anchors = planes.variances, planes.sensors, planes.anchors
    size = 6 + shared + 6 * clone_rotations.shape[0]
    information = np.zeros((size, size))
    vector = np.zeros(size)
    row = np.zeros(18)
    columns = np.zeros(18, dtype=np.int64)
    own, from_map, x = np.zeros((3, 3)), np.zeros(6), np.zeros(3)
    count = 6
    for a in range(6):
        columns[a] = a
    if shared > 0:
        count = 12
        for a in range(6):
            columns[6 + a] = 6 + a
    used, total = 0, 0.0
    for i in range(points.shape[0]):
        if not found[i]:
            continue
        n = normals[i]
        # the normal in the IMU frame
        bx = rotation[0, 0] * n[0] + rotation[1, 0] * n[1] + rotation[2, 0] * n[2]
        by = rotation[0, 1] * n[0] + rotation[1, 1] * n[1] + rotation[2, 1] * n[2]
        bz = rotation[0, 2] * n[0] + rotation[1, 2] * n[1] + rotation[2, 2] * n[2]
        p, beam = points[i], beams[i]
        height = 0.0
        for a in range(3):
            x[a] = position[a]
            for b in range(3):
                x[a] += rotation[a, b] * p[b]
            height += n[a] * (x[a] - centres[i, a])
        k = anchors[i]
        own[:] = clone_rotations[k] if k >= 0 else rotation
        # normal and beam of the plane in the IMU frame of its clone, then the derivative of its
        # height by the mount, about which it rotates as a whole
        mx = own[0, 0] * n[0] + own[1, 0] * n[1] + own[2, 0] * n[2]
        my = own[0, 1] * n[0] + own[1, 1] * n[1] + own[2, 1] * n[2]
        mz = own[0, 2] * n[0] + own[1, 2] * n[1] + own[2, 2] * n[2]
        sx, sy, sz = 0.0, 0.0, 0.0
        for a in range(3):
            reach = x[a] - sensors[i, a]
            sx += own[a, 0] * reach
            sy += own[a, 1] * reach
            sz += own[a, 2] * reach
        from_map[0], from_map[1], from_map[2] = (
            sy * mz - sz * my,
            sz * mx - sx * mz,
            sx * my - sy * mx,
        )
        from_map[3], from_map[4], from_map[5] = mx, my, mz
        if k >= 0:
            for a in range(6):
                height -= from_map[a] * mount_changes[k, a]
        length2 = beam[0] ** 2 + beam[1] ** 2 + beam[2] ** 2
        along = bx * beam[0] + by * beam[1] + bz * beam[2]
        cosine2 = along * along / length2
        noise = range_sigma**2 * cosine2 + angle_sigma**2 * length2 * (1.0 - cosine2)
        variance = max(noise, variances[i, 0]) + variances[i, 1] + plane_floor**2
        scaled2 = height * height / variance
        if scaled2 > gate * gate:
            continue
        weight = 1.0 / ((1.0 + 4.0 * scaled2 / (gate * gate)) * variance)
        # d height / d rotation error = (p x n_imu)
        row[0] = p[1] * bz - p[2] * by
        row[1] = p[2] * bx - p[0] * bz
        row[2] = p[0] * by - p[1] * bx
        row[3], row[4], row[5] = n[0], n[1], n[2]
        if shared > 0:
            row[6] = beam[1] * bz - beam[2] * by - from_map[0]
            row[7] = beam[2] * bx - beam[0] * bz - from_map[1]
            row[8] = beam[0] * by - beam[1] * bx - from_map[2]
            row[9], row[10], row[11] = bx - mx, by - my, bz - mz
        width = count
        if k >= 0:
            # the plane turns and moves with its clone
            yx, yy, yz = 0.0, 0.0, 0.0
            for a in range(3):
                reach = x[a] - clone_positions[k, a]
                yx += own[a, 0] * reach
                yy += own[a, 1] * reach
                yz += own[a, 2] * reach
            row[count] = -(yy * mz - yz * my)
            row[count + 1] = -(yz * mx - yx * mz)
            row[count + 2] = -(yx * my - yy * mx)
            row[count + 3], row[count + 4], row[count + 5] = -n[0], -n[1], -n[2]
            for a in range(6):
                columns[count + a] = 6 + shared + 6 * k + a
            width = count + 6
        for a in range(width):
            u = columns[a]
            vector[u] -= weight * row[a] * height
            for b in range(width):
                information[u, columns[b]] += weight * row[a] * row[b]
        used += 1
        total += height * height
    rms = np.sqrt(total / used) if used > 0 else 0.0
    return NormalEquations(information, vector, used, rms)


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
    iterations: int = 3,
    min_matches: int = 30,
) -> LidarReport:
    """Iterated update by a scan that ends at the filter's present time.

    Planes are looked up in the first and the second iteration. With fewer than ``min_matches``
    matches nothing is changed.
    """
    points, beams = scan.points, scan.beams
    prior, clones = eskf.state, eskf.clones
    shared = eskf.shared
    noise = (errors.range_sigma_m, errors.angle_sigma_rad, _PLANE_FLOOR_M)
    raw, information, used, rms = np.zeros((6, 6)), np.zeros((6, 6)), 0, 0.0
    weak = (np.zeros((3, 0)), np.zeros((3, 0)))
    matched: PlaneMatches | None = None
    keys: list[int] = []
    touched = eskf.touched(keys)
    for iteration in range(iterations):
        state, gate = eskf.state, 6.0 if iteration == 0 else 4.0
        fresh = iteration < 2 or matched is None
        if fresh or matched is None:
            matched = plane_map.match(points @ state.rotation.T + state.position)
            keys = np.unique(matched.anchors[matched.found]).tolist()
            keys = [k for k in keys if k >= 0]
            touched = eskf.touched(keys)
        planes = _at_present_estimate(matched, keys, anchors, eskf)
        information, vector, used, rms = anchored_information(
            points, beams, state.rotation, state.position, planes,
            np.array([eskf.clones[k].rotation for k in keys]).reshape(-1, 3, 3),
            np.array([eskf.clones[k].translation for k in keys]).reshape(-1, 3),
            anchors.mount_changes(state.calibration)[keys], shared, *noise, gate,
        )  # fmt: skip
        if used < min_matches:
            eskf.state, eskf.clones = prior, clones
            return LidarReport(matched=used, rms_m=rms, lateral_strength=np.zeros(3))
        raw = information[:6, :6].copy()
        if errors.weak_sigmas is not None and fresh:
            noise_information = normal_noise_information(
                points, beams, state.rotation, state.position, planes.found, planes.normals,
                planes.centres, planes.variances, *noise, gate,
            )  # fmt: skip
            weak = weak_directions(raw, noise_information, *errors.weak_sigmas)
        columns = np.zeros((len(touched), weak[0].shape[1] + weak[1].shape[1]))
        columns[:3, : weak[0].shape[1]] = weak[0]
        columns[3:6, weak[0].shape[1] :] = weak[1]
        information, vector = without_directions(information, vector, columns)
        # each clone's part of the map has a floor of its own: otherwise the number of points
        # would tie the clones to each other too firmly
        floor = errors.floor_sigmas
        floors = np.concatenate([floor, np.zeros(shared), np.tile(floor, len(keys))])
        information, vector = limit_information(*eskf.coupled(information, vector), floors)
        offset = eskf.deviation(prior, clones, keys)
        delta = eskf.correction(touched, information, vector + information @ offset)
        eskf.state, eskf.clones = eskf.boxplus(prior, clones, delta)
    eskf.update_covariance(touched, information)
    return LidarReport(
        matched=used,
        rms_m=rms,
        lateral_strength=lateral_strength(raw),
        weak_rotation=weak[0].shape[1],
        weak_translation=weak[1].shape[1],
    )


def _at_present_estimate(
    matched: PlaneMatches, keys: list[int], anchors: Anchors, eskf: Eskf
) -> PlaneMatches:
    """Returns the planes moved to the present estimate of their anchors, and the anchors as
    positions in ``keys``."""
    table = np.full(len(anchors) + 1, -1, dtype=np.int64)
    table[keys] = np.arange(len(keys))
    slots = table[matched.anchors]  # -1 looks up the last entry, which is -1
    rotations, positions = anchors.now_from_kept(eskf.clones)
    normals, centres, sensors = _moved(
        matched.normals, matched.centres, matched.sensors, matched.anchors, rotations, positions
    )
    return PlaneMatches(matched.found, normals, centres, matched.variances, sensors, slots)


@njit(cache=True)
def _moved(
    normals: Array,
    centres: Array,
    sensors: Array,
    anchors: NDArray[np.int16],
    rotations: Array,
    translations: Array,
) -> tuple[Array, Array, Array]:
    out_n, out_m, out_s = normals.copy(), centres.copy(), sensors.copy()
    for i in range(anchors.shape[0]):
        k = anchors[i]
        if k < 0:
            continue
        for a in range(3):
            out_n[i, a], out_m[i, a], out_s[i, a] = 0.0, translations[k, a], translations[k, a]
            for b in range(3):
                out_n[i, a] += rotations[k, a, b] * normals[i, b]
                out_m[i, a] += rotations[k, a, b] * centres[i, b]
                out_s[i, a] += rotations[k, a, b] * sensors[i, b]
    return out_n, out_m, out_s
