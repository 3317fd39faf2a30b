"""Point-to-plane update of the filter by one scan, against planes anchored to its clones.

A residual compares the present pose with the clone that the plane is anchored to, and both with the
LIDAR's mount. The error shared by all planes of a clone is thus the clone's error, which the filter
estimates and a revisit reduces, instead of new noise in every scan.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from touchdown.estimator.api import LivoParams
from touchdown.estimator.filtering.anchors import (
    ANCHORED_DIM,
    CLONE_AT,
    MOUNT_AT,
    AnchorFrames,
    Anchors,
    Sight,
    derivatives_into,
)
from touchdown.estimator.filtering.deskew import PlacedScan
from touchdown.estimator.filtering.error_state import (
    MOUNT_ROTATION,
    MOUNT_TRANSLATION,
    POSE,
    POSE_DIM,
    POSITION,
    ROTATION,
    Frame,
)
from touchdown.estimator.filtering.eskf import (
    Eskf,
    IteratedUpdate,
    rotations_among,
    weak_columns,
    without_directions,
)
from touchdown.estimator.filtering.plane_map import PlaneMap, PlaneMatches
from touchdown.estimator.filtering.vectors import along, cross, dot, turned, turned_back, xyz
from touchdown.sim.api import SensorRig
from touchdown.sim.typing import Array, Indices


class Returns(NamedTuple):
    """Returns of a scan in the IMU frame, as kernels take them."""

    points: Array  # (N, 3) m
    beams: Array  # (N, 3) m, from the sensor to the point


class ScanNoise(NamedTuple):
    """Noise of the returns, and the gate of their residuals."""

    range_sigma: float  # m
    angle_sigma: float  # rad
    plane_floor: float  # m, of any plane
    gate: float  # standard deviations


class PlaneEquations(NamedTuple):
    """Normal equations of a scan, (D,) coordinates: pose, shared calibration, touched clones."""

    information: Array  # (D, D)
    vector: Array  # (D,)
    used: int
    rms: float  # m
    noise_information: Array
    """(6, 6) part of the pose's information that comes from the noise of the normals alone"""


@njit(cache=True, error_model="numpy")
def plane_equations(
    scan: Returns,
    pose: Frame,
    planes: PlaneMatches,
    anchors: AnchorFrames,
    touched: int,
    shared: int,
    noise: ScanNoise,
) -> PlaneEquations:
    """Returns the normal equations of the point-to-plane residuals ``n . (R p + t - c)``.

    ``pose``: odom_from_imu; ``planes``: as stored, moved to the present estimate of their anchors
    here; ``touched``: number of clones; ``shared``: of calibration parameters; D = 6 + shared + 6
    touched.

    A residual's variance is the larger of the beam's (range and angle noise along the normal) and
    the plane's thickness, plus the plane's uncertainty. Weights are Cauchy's with scale
    ``gate``/2 standard deviations, zero beyond ``gate``.

    The mapped normals of level ground scatter, so that a scan seems to measure lateral motion. A
    normal with an error e, of variance s^2 in the two directions t across it, adds e times the row
    of t to the row of n: in expectation ``w s^2 sum_t h_t^T h_t`` to the information. The sum over
    all three directions does not depend on the normal; that of the normal is taken off.
    """
    count = anchors.slots.shape[0]
    blocks, gradients = (
        np.zeros((count + 1, ANCHORED_DIM, ANCHORED_DIM)),
        np.zeros((count + 1, ANCHORED_DIM)),
    )
    normal_rows = np.zeros((POSE_DIM, POSE_DIM))
    normal_weight, first, second = 0.0, np.zeros(3), np.zeros((3, 3))
    row = np.zeros(ANCHORED_DIM)
    used, total = 0, 0.0
    for i in range(scan.points.shape[0]):
        if not planes.found[i]:
            continue
        p, beam, k = xyz(scan.points[i]), xyz(scan.beams[i]), planes.anchors[i]
        n, c, seen_from = (
            xyz(planes.normals[i]), xyz(planes.centres[i]), xyz(planes.sensors[i])
        )  # fmt: skip
        own = pose
        if k >= 0:
            move, place = anchors.moves.rotations[k], xyz(anchors.moves.translations[k])
            own = Frame(anchors.clones.rotations[k], anchors.clones.translations[k])
            n, seen_from = turned(move, n), along(place, 1.0, turned(move, seen_from))
            c = along(place, 1.0, turned(move, c))
        x = along(xyz(pose.translation), 1.0, turned(pose.rotation, p))
        # the plane in the IMU frame of its clone, where it turns about the sensor with the mount
        in_imu, in_clone = turned_back(pose.rotation, n), turned_back(own.rotation, n)
        arm = turned_back(own.rotation, along(x, -1.0, seen_from))
        reach = turned_back(own.rotation, along(x, -1.0, xyz(own.translation)))
        height = dot(n, along(x, -1.0, c))
        if k >= 0:
            change, moment = anchors.mount_changes[k], cross(arm, in_clone)
            for a in range(3):
                height -= moment[a] * change[MOUNT_ROTATION.start + a]
                height -= in_clone[a] * change[MOUNT_TRANSLATION.start + a]
        towards, length2 = dot(in_imu, beam), dot(beam, beam)
        cosine2 = towards * towards / length2
        own_noise = noise.range_sigma**2 * cosine2
        own_noise += noise.angle_sigma**2 * length2 * (1.0 - cosine2)
        variance = max(own_noise, planes.variances[i, 0]) + planes.variances[i, 1]
        variance += noise.plane_floor**2
        scaled2 = height * height / variance
        if scaled2 > noise.gate * noise.gate:
            continue
        weight = 1.0 / ((1.0 + 4.0 * scaled2 / (noise.gate * noise.gate)) * variance)
        derivatives_into(row, n, in_imu, in_clone, Sight(p, beam, arm, reach), False)
        block, gradient = blocks[k], gradients[k]  # -1 is the last: planes without an anchor
        for a in range(ANCHORED_DIM):
            scaled = weight * row[a]
            gradient[a] -= scaled * height
            for b in range(a + 1):
                block[a, b] += scaled * row[b]
        used += 1
        total += height * height
        fraction = weight * planes.variances[i, 2]
        normal_weight += fraction
        for a in range(POSE_DIM):
            for b in range(a + 1):
                normal_rows[a, b] += fraction * row[a] * row[b]
        for a in range(3):
            first[a] += fraction * p[a]
            for b in range(3):
                second[a, b] += fraction * p[a] * p[b]
    information, vector = _assembled(blocks, gradients, anchors.slots, touched, shared)
    seeming = _all_directions(normal_weight, first, second, pose.rotation)
    for a in range(POSE_DIM):
        for b in range(a + 1):
            seeming[a, b] -= normal_rows[a, b]
            seeming[b, a] = seeming[a, b]
    rms = np.sqrt(total / used) if used > 0 else 0.0
    return PlaneEquations(information, vector, used, rms, seeming)


@njit(cache=True, error_model="numpy")
def _all_directions(weight: float, first: Array, second: Array, rotation: Array) -> Array:
    """Sum over the points and the three axes u of ``h_u^T h_u``, ``h_u = (p x R^T u, u)``, (6, 6):
    from the weighted number of points and their moments."""
    out = np.zeros((POSE_DIM, POSE_DIM))
    square = second[0, 0] + second[1, 1] + second[2, 2]
    for u in range(3):
        out[POSITION.start + u, POSITION.start + u] = weight
        column = cross(xyz(first), xyz(rotation[u]))
        for a in range(3):
            out[ROTATION.start + a, POSITION.start + u] = column[a]
            out[POSITION.start + u, ROTATION.start + a] = column[a]
            out[ROTATION.start + a, ROTATION.start + u] = -second[a, u]
        out[ROTATION.start + u, ROTATION.start + u] += square
    return out


@njit(cache=True, error_model="numpy")
def _assembled(
    blocks: Array, gradients: Array, slots: Indices, touched: int, shared: int
) -> tuple[Array, Array]:
    """Sums the lower halves of the anchors' blocks into one matrix (D, D) and vector (D,)."""
    size = POSE_DIM + shared + POSE_DIM * touched
    information, vector = np.zeros((size, size)), np.zeros(size)
    columns = np.empty(ANCHORED_DIM, np.int64)
    for k in range(blocks.shape[0]):
        slot = slots[k] if k < slots.shape[0] else -1
        first = POSE_DIM + shared + POSE_DIM * slot - CLONE_AT if slot >= 0 else -ANCHORED_DIM
        for a in range(ANCHORED_DIM):
            own = -1 if shared == 0 and a >= MOUNT_AT else a
            columns[a] = own if a < CLONE_AT else first + a
        for a in range(ANCHORED_DIM):
            u = columns[a]
            if u < 0:
                continue
            vector[u] += gradients[k, a]
            for b in range(a + 1):
                v = columns[b]
                if v < 0:
                    continue
                information[u, v] += blocks[k, a, b]
                if u != v:
                    information[v, u] += blocks[k, a, b]
    return information, vector


_SAME_PLANE_M = 0.02
"""displacement of a return up to which its plane is not looked up again"""
_GATES = (6.0, 4.0)
"""standard deviations, of the first iteration and of the others"""


@dataclass(frozen=True, kw_only=True, slots=True)
class LidarReport:
    """Result of an update by one scan, for the recording."""

    matched: int = 0
    rms_m: float = 0.0
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
    fraction: float = 1.0,
    iterations: int = 3,
    min_matches: int = 30,
) -> LidarReport:
    """Iterated update by a scan that ends at the filter's present time.

    Planes are looked up in the first iteration, and in the second if the first has moved the
    returns. With fewer than ``min_matches`` matches nothing is changed. ``fraction``: of the
    correction that mounts and lens take.
    """
    update = IteratedUpdate(eskf, fraction)
    returns, shared = Returns(scan.points, scan.beams), eskf.shared
    weak = np.zeros((POSE_DIM, 0))
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
        if errors.weak_sigmas is not None and fresh:
            pose = found.information[POSE, POSE].copy()
            weak = weak_columns(pose, found.noise_information, errors.weak_sigmas)
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
        "lidar_weak_translation": float(report.weak_translation),
        "lidar_weak_rotation": float(report.weak_rotation),
        "map_voxels": float(voxels),
    }
