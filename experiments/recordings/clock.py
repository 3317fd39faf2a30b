"""The clock of a replay: ticks from stamps, the samples of an IMU on an even grid, rest at the
start, true poses at ticks."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from touchdown.experiments.errors import UsageError
from touchdown.experiments.recordings.contract import ImuTable, PoseTable, Stamps
from touchdown.sim.api import GRAVITY_MPS2
from touchdown.sim.frames import Pose, interpolate_pose, matrix_from_quat_wxyz
from touchdown.sim.typing import Array

_TICK_HZ = 600
"""least rate of ticks"""
_EVEN = 0.1
"""of a step: samples that lie no farther from the grid are taken as they are"""
_LONGEST_GAP_S = 0.5
_LONGEST_S = 86_400.0
_SNAP_S = 1e-8
_WINDOW_S = 0.25
_TURNING, _PUSHED = 0.03, 0.3
"""rad/s and m/s^2 between the mean over a window and that over the first one, beyond which the rig
is no longer at rest. Means alone: rotors and engines shake a rig that stands"""
_BLOCK_S = 0.1
_REST_S, _RATE_SIGMA = 2.0, 1e-3
"""longest time whose mean rate is the gyroscope's bias, and the least error of that, rad/s"""
_TRUTH_HZ = 50
BEFORE_IMAGES_S = 0.01
"""step of the grid of a recording without an IMU"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Clock:
    """Ticks since the start of a replay."""

    start_ns: int
    tick_hz: int
    imu_ticks: int

    def seconds(self, stamp_ns: int, offset_s: float = 0.0) -> float:
        """Time of a stamp; that of a tick where it is one to the nanosecond."""
        time_s = (stamp_ns - self.start_ns) * 1e-9 + offset_s
        whole = round(time_s * self.tick_hz) / self.tick_hz
        return whole if abs(whole - time_s) < _SNAP_S else time_s

    def tick(self, time_s: float) -> int:
        """The tick nearest to a time."""
        return round(time_s * self.tick_hz)

    @property
    def step_s(self) -> float:
        """Between two samples of the IMU."""
        return self.imu_ticks / self.tick_hz


@dataclass(frozen=True, kw_only=True, slots=True)
class ImuGrid:
    """Samples on the grid of a clock: that of row k is the mean over the step that ends at tick
    ``(k + 1) imu_ticks``."""

    clock: Clock
    gyro: Array
    """(N, 3)"""
    force: Array
    """(N, 3)"""
    resampled: bool
    """False: each sample is one of the recording"""


def even_grid(imu: ImuTable, start_ns: int | None = None, whole_hz: int | None = None) -> ImuGrid:
    """The samples from ``start_ns`` on, by default all. ``whole_hz``: rate of the ticks, where it
    is given. Raises UsageError for a table that is too short, too long or has a long gap."""
    stamps, gyro, force = imu.stamps_ns, imu.gyro, imu.force
    if start_ns is not None:
        first = max(int(np.searchsorted(stamps, start_ns)) - 1, 0)
        stamps, gyro, force = stamps[first:], gyro[first:], force[first:]
    if len(stamps) < 20:
        raise UsageError(f"the IMU has {len(stamps)} samples, too few for a replay")
    steps = np.diff(stamps)
    imu_hz = round(1e9 / float(np.median(steps)))
    length_s = (stamps[-1] - stamps[0]) * 1e-9
    if not 10 <= imu_hz <= 5000 or length_s > _LONGEST_S:
        raise UsageError(
            f"the IMU has {imu_hz} samples a second over {length_s:.0f} s; 10 to 5000 a second, "
            "and a day at most, can be replayed"
        )
    if steps.max() > _LONGEST_GAP_S * 1e9:
        at = int(np.argmax(steps))
        raise UsageError(
            f"the IMU has a gap of {steps[at] * 1e-9:.2f} s, {(stamps[at] - stamps[0]) * 1e-9:.2f} "
            "s after its start; cut the recording there"
        )
    imu_ticks = -(-_TICK_HZ // imu_hz)
    if whole_hz is not None and whole_hz % imu_hz == 0:
        imu_ticks = whole_hz // imu_hz
    step_ns = 1e9 / imu_hz
    clock = Clock(
        start_ns=int(stamps[0] - round(step_ns)), tick_hz=imu_hz * imu_ticks, imu_ticks=imu_ticks
    )
    count = round(float(stamps[-1] - stamps[0]) / step_ns) + 1
    places = (stamps - stamps[0]) / step_ns
    if count == len(stamps) and np.abs(places - np.arange(count)).max() < _EVEN:
        return ImuGrid(clock=clock, gyro=gyro, force=force, resampled=False)
    grid = np.arange(count, dtype=np.float64)
    return ImuGrid(
        clock=clock, gyro=_means(places, gyro, grid), force=_means(places, force, grid),
        resampled=True,
    )  # fmt: skip


def _means(places: Array, values: Array, grid: Array) -> Array:
    """Means over a step around each place of ``grid`` (M,) of the lines through ``values`` (N, 3)
    at ``places`` (N,), in steps."""
    pieces = 0.5 * (values[1:] + values[:-1]) * np.diff(places)[:, None]
    whole = np.vstack([np.zeros(3), np.cumsum(pieces, axis=0)])
    low, high = (np.clip(grid + half, places[0], places[-1]) for half in (-0.5, 0.5))
    # between two samples the integral is a parabola: the value at the end and the piece's start
    parts = [_integral(places, values, whole, at) for at in (low, high)]
    return (parts[1] - parts[0]) / (high - low)[:, None]


def _integral(places: Array, values: Array, whole: Array, at: Array) -> Array:
    k = np.clip(np.searchsorted(places, at, side="right") - 1, 0, len(places) - 2)
    width = (places[k + 1] - places[k])[:, None]
    away = (at - places[k])[:, None]
    slope = (values[k + 1] - values[k]) / width
    return whole[k] + away * (values[k] + 0.5 * slope * away)


def rest_steps(grid: ImuGrid) -> int:
    """Number of samples from the start during which the rig is at rest; 0: it begins in motion."""
    window = max(round(_WINDOW_S / grid.clock.step_s), 2)
    count = len(grid.gyro) // window
    gyro, force = (
        part[: count * window].reshape(count, window, 3) for part in (grid.gyro, grid.force)
    )
    turning = np.abs(gyro.mean(axis=1) - gyro[0].mean(axis=0)).max(axis=1) > _TURNING
    pushed = np.abs(force.mean(axis=1) - force[0].mean(axis=0)).max(axis=1) > _PUSHED
    moves = turning | pushed
    return window * int(np.argmax(moves)) if moves.any() else len(grid.gyro)


class Rest(NamedTuple):
    """What an IMU shows at rest, shaken by rotors or not."""

    rate: Array
    """(3,) rad/s, mean"""
    rate_sigma: float
    """rad/s, of one axis of it"""
    gyro_density: float
    """rad/s/sqrt(Hz)"""
    accel_density: float
    """m/s^2/sqrt(Hz)"""


def at_rest(imu: ImuTable, until_ns: int) -> Rest:
    """What the last two seconds to ``until_ns`` show. Noise by the differences of means over a
    tenth of a second: what rotors shake is fast, and averages out."""
    stamps = imu.stamps_ns
    last = int(np.searchsorted(stamps, until_ns))
    first = int(np.searchsorted(stamps, until_ns - round(_REST_S * 1e9)))
    seen = slice(first, max(last, first + 2))
    gyro, step_s = imu.gyro[seen], float(np.median(np.diff(stamps))) * 1e-9
    sigma = float(gyro.std(axis=0).max()) / np.sqrt(len(gyro))
    block = max(round(_BLOCK_S / step_s), 1)
    count = len(gyro) // block
    densities = [0.0, 0.0]
    if count > 2:
        blocks = (part[seen][: count * block].reshape(count, block, 3).mean(axis=1)
                  for part in (imu.gyro, imu.force))  # fmt: skip
        densities = [float(np.sqrt(0.5 * block * step_s * np.mean(np.diff(means, axis=0) ** 2)))
                     for means in blocks]  # fmt: skip
    return Rest(gyro.mean(axis=0), max(2.0 * sigma, _RATE_SIGMA), densities[0], densities[1])


def level_pose(force: Array) -> Pose:
    """world_from_body at the origin, of a body at rest that feels ``force`` (3,): the smallest
    rotation that turns it up, so that a level body keeps heading 0. Raises UsageError where the
    force is far from gravity's."""
    size = float(np.linalg.norm(force))
    if not 0.7 * GRAVITY_MPS2 < size < 1.3 * GRAVITY_MPS2:
        raise UsageError(
            f"the mean specific force at the start is {size:.2f} m/s^2, not gravity's: is it in "
            "m/s^2, and does the rig not fall?"
        )
    up = force / size
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return Pose(np.diag([1.0, 1.0, 1.0] if up[2] > 0.0 else [1.0, -1.0, -1.0]), np.zeros(3))
    turn = axis / sine * np.arctan2(sine, up[2])
    return Pose(Rotation.from_rotvec(turn).as_matrix(), np.zeros(3))


def truth_at_ticks(truth: PoseTable, clock: Clock, last_tick: int) -> dict[int, Pose]:
    """True poses, 50 a second at most, each at the first step of the IMU after a stamp. Raises
    UsageError where none lies within the replay."""
    times = (truth.stamps_ns - clock.start_ns) * 1e-9
    poses = [
        Pose(matrix_from_quat_wxyz(quat), position)
        for position, quat in zip(truth.positions, truth.quats_wxyz, strict=True)
    ]
    found: dict[int, Pose] = {}
    apart, before = clock.tick_hz // _TRUTH_HZ, -clock.tick_hz
    for k, time_s in enumerate(times):
        tick = int(np.ceil(time_s / clock.step_s - 1e-6)) * clock.imu_ticks
        if not 0 <= tick <= last_tick or tick - before < apart or len(poses) < 2:
            continue
        first = min(k, len(poses) - 2)
        span = times[first + 1] - times[first]
        fraction = (tick / clock.tick_hz - times[first]) / span
        if not -1e-6 <= fraction <= 2.0:
            continue
        found[tick] = interpolate_pose(poses[first], poses[first + 1], float(fraction))
        before = tick
    if not found:
        raise UsageError(
            f"the truth, from {truth.stamps_ns[0] * 1e-9:.3f} s to "
            f"{truth.stamps_ns[-1] * 1e-9:.3f} s, does not span the recording, which begins at "
            f"{clock.start_ns * 1e-9:.3f} s"
        )
    return found


def poses_of(stamps_ns: Stamps, positions: Array, quats_wxyz: Array) -> PoseTable:
    """A table in the order of time, each time once."""
    stamps, rows = np.unique(stamps_ns, return_index=True)
    return PoseTable(stamps_ns=stamps, positions=positions[rows], quats_wxyz=quats_wxyz[rows])
