"""Point-to-plane update of the filter by one scan, against planes that hang on its clones.

A residual compares the present pose with the clone that the plane belongs to, and both ends of it
with where the LIDAR sits: what all planes of a clone have wrong in common is then the clone's
error, which the filter knows and a revisit takes away, not fresh noise of every scan.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.plane_map import PlaneMap
from touchdown.estimator.livo.anchors import Anchors
from touchdown.estimator.livo.lidar_update import (
    LidarReport,
    lateral_strength,
    limit_information,
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
    planes: tuple[NDArray[np.bool_], Array, Array, Array, Array, NDArray[np.int64]],
    clone_rotations: Array,
    clone_positions: Array,
    mount_changes: Array,
    shared: int,
    range_sigma: float,
    angle_sigma: float,
    plane_floor: float,
    gate: float,
) -> tuple[Array, Array, int, float]:
    """Information (D, D) and vector (D,) of the residuals ``n . (R p + t - c)``.

    ``points`` and ``beams`` (N, 3) in the IMU frame; ``planes``: found (N,), normals, anchor points
    (N, 3), variances (N, 3), sensors (N, 3), all in the odometry frame as now believed, and which
    of the M clones (``clone_*``: odom_from_imu; ``mount_changes`` (M, 6): mount now less mount when
    it was made) they hang on, -1: on none. Error order: rotation (right perturbation), position,
    ``shared`` numbers of calibration whose first six are turn and shift of the LIDAR, then six for
    each clone; D = 6 + shared + 6 M.

    A residual's variance is the beam's (range and angle noise seen along the normal), or the
    plane's thickness if that is larger, plus the plane's uncertainty. Weights are Cauchy's with
    scale ``gate``/2 standard deviations, zero beyond ``gate``. Returns also the number used and
    their rms in metres.
    """
    found, normals, anchors, variances, sensors, slots = planes
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
            height += n[a] * (x[a] - anchors[i, a])
        k = slots[i]
        own[:] = clone_rotations[k] if k >= 0 else rotation
        # normal and beam of the plane in the IMU frame of its clone, then how its height below the
        # return moves with the mount, about which it turns as a whole
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
    return information, vector, used, rms


def update_with_scan(
    eskf: Eskf,
    plane_map: PlaneMap,
    anchors: Anchors,
    points: Array,
    beams: Array,
    *,
    range_sigma_m: float,
    angle_sigma_rad: float,
    floor_sigmas: Array,
    weak_sigmas: tuple[float, float] | None = None,
    iterations: int = 3,
    min_matches: int = 30,
) -> LidarReport:
    """Iterated update by (N, 3) points and beams, IMU frame of the filter's present time.

    Planes are looked up at the first and the second iteration. With fewer than ``min_matches``
    matches nothing is changed. ``floor_sigmas`` (6,): errors of the scan, and of each clone's part
    of the map, as a whole, rad and m, see ``limit_information``. ``weak_sigmas``: rad and m,
    directions known less well than these are left out of the update (``weak_directions``, less what
    the normals' noise feigns); None: none are."""
    prior, clones = eskf.state, eskf.clones
    shared = len(prior.calibration)
    noise = (range_sigma_m, angle_sigma_rad, _PLANE_FLOOR_M)
    raw, information, used, rms = np.zeros((6, 6)), np.zeros((6, 6)), 0, 0.0
    weak = (np.zeros((3, 0)), np.zeros((3, 0)))
    planes = None
    keys: list[int] = []
    touched = eskf.touched(keys)
    for iteration in range(iterations):
        state, gate = eskf.state, 6.0 if iteration == 0 else 4.0
        fresh = iteration < 2 or planes is None
        if fresh or planes is None:
            matched = plane_map.match(points @ state.rotation.T + state.position)
            keys = np.unique(matched[5][matched[0]]).tolist()
            keys = [k for k in keys if k >= 0]
            touched = eskf.touched(keys)
        planes = _as_believed(matched, keys, anchors, eskf)
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
        if weak_sigmas is not None and fresh:
            noise_information = normal_noise_information(
                points, beams, state.rotation, state.position, *planes[:4], *noise, gate
            )
            weak = weak_directions(raw, noise_information, *weak_sigmas)
        columns = np.zeros((len(touched), weak[0].shape[1] + weak[1].shape[1]))
        columns[:3, : weak[0].shape[1]] = weak[0]
        columns[3:6, weak[0].shape[1] :] = weak[1]
        information, vector = without_directions(information, vector, columns)
        # each clone's part of the map has its own: or else a scan would tie clones to each other
        # as firmly as its points are many
        floors = np.concatenate([floor_sigmas, np.zeros(shared), np.tile(floor_sigmas, len(keys))])
        information, vector = limit_information(*eskf.admitted(information, vector), floors)
        offset = eskf.deviation(prior, clones, keys)
        delta = eskf.gain(touched, information, vector + information @ offset)
        eskf.state, eskf.clones = eskf.boxplus(prior, clones, delta)
    eskf.absorb(touched, information)
    return LidarReport(
        matched=used,
        rms_m=rms,
        lateral_strength=lateral_strength(raw),
        weak_rotation=weak[0].shape[1],
        weak_translation=weak[1].shape[1],
    )


def _as_believed(
    matched: tuple[NDArray[np.bool_], Array, Array, Array, Array, NDArray[np.int16]],
    keys: list[int],
    anchors: Anchors,
    eskf: Eskf,
) -> tuple[NDArray[np.bool_], Array, Array, Array, Array, NDArray[np.int64]]:
    """Planes as matched, moved to where the filter now believes their anchors; anchors counted
    by their place in ``keys``."""
    found, normals, middles, variances, sensors, owners = matched
    table = np.full(len(anchors) + 1, -1, dtype=np.int64)
    table[keys] = np.arange(len(keys))
    slots = table[owners]  # -1 looks up the last entry, which is -1
    rotations, positions = anchors.now_from_kept(eskf.clones)
    normals, middles, sensors = _moved(normals, middles, sensors, owners, rotations, positions)
    return found, normals, middles, variances, sensors, slots


@njit(cache=True)
def _moved(
    normals: Array,
    middles: Array,
    sensors: Array,
    owners: NDArray[np.int16],
    rotations: Array,
    translations: Array,
) -> tuple[Array, Array, Array]:
    out_n, out_m, out_s = normals.copy(), middles.copy(), sensors.copy()
    for i in range(owners.shape[0]):
        k = owners[i]
        if k < 0:
            continue
        for a in range(3):
            out_n[i, a], out_m[i, a], out_s[i, a] = 0.0, translations[k, a], translations[k, a]
            for b in range(3):
                out_n[i, a] += rotations[k, a, b] * normals[i, b]
                out_m[i, a] += rotations[k, a, b] * middles[i, b]
                out_s[i, a] += rotations[k, a, b] * sensors[i, b]
    return out_n, out_m, out_s
