"""Interface of the estimators: estimates, maps, protocols and parameters.

Loads with numpy alone, so that an external estimator can be written against it.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.parameters import HEIGHT_BIN_M as HEIGHT_BIN_M
from touchdown.estimator.parameters import HEIGHT_BINS as HEIGHT_BINS
from touchdown.estimator.parameters import CalibratedParams as CalibratedParams
from touchdown.estimator.parameters import CalibrationPriors as CalibrationPriors
from touchdown.estimator.parameters import FlownImuParams as FlownImuParams
from touchdown.estimator.parameters import GpsEstimatorParams as GpsEstimatorParams
from touchdown.estimator.parameters import HybridFlowParams as HybridFlowParams
from touchdown.estimator.parameters import LivoParams as LivoParams
from touchdown.estimator.parameters import MapperParams as MapperParams
from touchdown.estimator.parameters import OpticalFlowParams as OpticalFlowParams
from touchdown.estimator.parameters import StereoParams as StereoParams
from touchdown.estimator.parameters import Zou2024Params as Zou2024Params
from touchdown.sim.api import GRAVITY_MPS2, CameraImage, Observation, SensorNeeds, SensorRig
from touchdown.sim.frames import Pose

Array = NDArray[np.float64]

MIN_CONTRAST = 2.5
"""standard deviation of each channel's levels below which an image holds noise only"""


def some_pixels(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Returns a subsample of an image (H, W, 3) for `image_defect`, a copy."""
    return np.ascontiguousarray(rgb[::8, ::8])


def image_defect(pixels: NDArray[np.uint8], before: NDArray[np.uint8]) -> str:
    """Returns the defect of an image, from its pixels (h, w, 3) and those of the image ``before``;
    "" if there is none. Noise makes identical images impossible."""
    channels = np.ascontiguousarray(pixels.reshape(-1, 3).T)  # in a row each, a third of the time
    if float(channels.std(axis=1).max()) < MIN_CONTRAST:
        return "no contrast"
    return "the same as the one before" if np.array_equal(pixels, before) else ""


class ImageThinning:
    """Keeps one image of every ``pulses`` of the camera's clock, as a camera at that rate takes
    them; 0: none. Images that lie on the clock's ticks are kept by their tick; others, of a camera
    with a clock or delay of its own, by the ticks since the last one that was kept."""

    def __init__(self, rig: SensorRig, pulses: int) -> None:
        self._hz, self._pulse = rig.tick_hz, rig.camera_ticks
        self._period = pulses * rig.camera_ticks
        self._kept: int | None = None

    def keeps(self, image: CameraImage) -> bool:
        """True for an image to keep; images are given in order, each once."""
        if not self._period:
            return False
        if image.time_s == image.tick / self._hz and image.tick % self._pulse == 0:
            return image.tick % self._period == 0
        since = image.tick - (0 if self._kept is None else self._kept)
        slack = 0 if self._kept is None else self._pulse // 2
        if since < self._period - slack:
            return False
        self._kept = image.tick
        return True


@dataclass(frozen=True, kw_only=True, slots=True)
class PoseTrack:
    """Odometry poses over a span of time, for deskewing a scan."""

    times_s: Array
    """(N,) strictly ascending"""
    positions_odom: Array
    """(N, 3) of the body origin, odom frame"""
    quats_wxyz: Array
    """(N, 4) odom_from_body"""


SWAY: Array = np.array([[0.0, 1.0], [-(1.2**2), -2.0 * 0.15 * 1.2]])
"""Dynamics (2, 2) of heave or tilt and its rate: an oscillation of 1.2 rad/s, damped by 0.15, as
that of a small hull in a sea of 7 s"""


def swayed(state: Array, ahead_s: float) -> Array:
    """(2,) heave or tilt and its rate, ``ahead_s`` after ``state`` (2,), as `SWAY` says."""
    damping, square = -0.5 * SWAY[1, 1], -SWAY[1, 0]
    rate = math.sqrt(square - damping**2)
    cosine, sine = math.cos(rate * ahead_s), math.sin(rate * ahead_s) / rate
    moved = cosine * state + sine * (SWAY @ state + damping * state)
    return np.asarray(math.exp(-damping * ahead_s) * moved)


@dataclass(frozen=True, kw_only=True, slots=True)
class DeckTrack:
    """A deck that moves, as measured relative to the vehicle: in the odom frame, whose drift it
    shares."""

    site_odom: Array
    """(3,) the middle of the deck, on it"""
    velocity_odom: Array
    """(3,) m/s of the site"""
    acceleration_odom: Array
    """(3,) m/s^2: up, what heave brings back; across, what a tilted odom frame lends to all"""
    heave: Array
    """(2,) m and m/s about the mean level"""
    slopes: Array
    """(2, 2) slopes along x and y, each with its rate"""
    seen_s: float
    """when a scan last measured it"""
    sigma_m: float
    """standard deviation of the horizontal place"""
    sigma_mps: float
    """and of the horizontal velocity"""

    def ahead(self, ahead_s: float) -> tuple[float, float]:
        """Speed of the heave, m/s, and tilt against the horizon, rad, that are expected ``ahead_s``
        from now."""
        lean = self.acceleration_odom[:2] / GRAVITY_MPS2
        slopes = [
            swayed(one + [low, 0.0], ahead_s)[0] for one, low in zip(self.slopes, lean, strict=True)
        ]
        return float(swayed(self.heave, ahead_s)[1]), math.atan(math.hypot(*slopes))


@dataclass(frozen=True, kw_only=True, slots=True)
class Estimate:
    """State estimate at ``time_s``: the time of the newest observation, reached by IMU propagation
    from the newest scan or image.

    Control uses ``odom_from_body``, which never jumps; ``world_from_odom`` moves at a bounded rate
    when loop closures correct the past. ``world_from_body`` composes both.
    """

    tick: int
    time_s: float
    odom_from_body: Pose
    world_from_odom: Pose
    velocity_odom: Array
    """(3,) m/s"""
    angular_velocity_body: Array
    """(3,) rad/s, bias removed"""
    acceleration_odom: Array
    """(3,) m/s^2, gravity removed"""
    position_covariance: Array
    """(3, 3) m^2, world frame"""
    rotation_covariance: Array
    """(3, 3) rad^2, body frame"""
    healthy: bool = True
    scan_track: PoseTrack | None = None
    """Best poses that span the scans used in this update, if the estimator provides them; an
    estimator may use a scan later than it arrives. The mapper waits 0.3 s for them, otherwise it
    interpolates the causal estimates."""
    diagnostics: Mapping[str, float] = field(default_factory=dict)
    """Named scalars for the recording (features tracked, residuals, degenerate directions...)."""
    events: tuple[str, ...] = ()
    """Messages about the time since the last update: a rejected message and the reason, a sensor
    dropout, a degenerate direction."""
    deck: DeckTrack | None = None
    """the deck that is to be landed on; None where none is followed"""

    @property
    def world_from_body(self) -> Pose:
        """Pose of the body in the world frame."""
        return self.world_from_odom @ self.odom_from_body


class Estimator(Protocol):
    """``update`` is called once a control step with the arrived messages; it must be deterministic
    and must not modify its input."""

    needs: SensorNeeds

    def update(self, obs: Observation) -> Estimate: ...


def spare_sensors(estimator: Estimator) -> tuple[str, ...]:
    """The sensors, fields of `SensorNeeds`, that ``estimator`` names in its attribute
    ``spare_sensors``, if it has one: a replay may run it on a log without them."""
    return tuple(getattr(estimator, "spare_sensors", ()))


class Ground(NamedTuple):
    """The ground of a map's cells, (rows, cols) float32, NaN where nothing of it was seen."""

    height_m: NDArray[np.float32]
    std_m: NDArray[np.float32]
    """standard deviation of the height: it grows as fewer returns come from the ground"""


@dataclass(frozen=True, kw_only=True, slots=True)
class GridMap:
    """A square-celled elevation map in the ODOM frame. Cell (row, col) covers
    ``x in [x0 + col*c, x0 + (col+1)*c), y in [y0 + row*c, y0 + (row+1)*c)``. Unseen cells: count 0
    and NaN heights. All arrays (rows, cols[, 3]); they are the mapper's own: read, never write.
    """

    origin_xy_m: Array
    """(2,) lower left corner x0, y0"""
    cell_m: float
    count: NDArray[np.float32]
    """returns that fell into the cell (recent ones weigh more)"""
    height_m: NDArray[np.float32]
    """mean height of the returns"""
    height_std_m: NDArray[np.float32]
    min_height_m: NDArray[np.float32]
    max_height_m: NDArray[np.float32]
    rgb: NDArray[np.float32]
    """0..255; NaN where no image ever covered a return"""
    intensity: NDArray[np.float32]
    """mean LIDAR intensity 0..255"""
    missing: NDArray[np.float32]
    """pulses without return that were expected to hit this cell, at the height of its
    surroundings"""
    last_seen_s: NDArray[np.float32]
    histogram: NDArray[np.uint8] | None = None
    """(rows, cols, HEIGHT_BINS) returns by their height above ``histogram_base_m`` in bins of
    ``HEIGHT_BIN_M``, the last one with all that are higher; halved where a bin would overflow. For
    the ground; a mapper may leave it out"""
    histogram_base_m: NDArray[np.float32] | None = None

    def ground(
        self, box: tuple[slice, slice] | None = None, where: NDArray[np.bool_] | None = None
    ) -> Ground:
        """Returns the ground of the cells ``box`` (rows, cols), by default of all, under plants and
        traffic; the mean height of the returns where the map has no histograms. It takes
        microseconds a cell: with ``where``, a mask of the box, others keep the mean too."""
        from touchdown.estimator.ground import ground_of

        rows, cols = box if box is not None else (slice(None), slice(None))
        layers = (self.count, self.height_m, self.height_std_m, self.missing)
        return Ground(*ground_of(layers, self.histogram, self.histogram_base_m, self.cell_m,
                                 (rows, cols), where))  # fmt: skip


@dataclass(frozen=True, kw_only=True, slots=True)
class MapView:
    """The mapper's state as views without copies. ``version`` increases with every scan integrated.
    ``fine`` covers a window below the vehicle at low height; None above it."""

    version: int
    coarse: GridMap
    fine: GridMap | None


@dataclass(frozen=True, kw_only=True, slots=True)
class MapperRig:
    """What a mapper knows before the flight."""

    sensors: SensorRig
    """calibration and data sheets, as an estimator knows them"""
    mapper: MapperParams
    """keys ``mapper.*``: cells and extents of both maps, and below which height the fine one is
    wanted"""


class Mapper(Protocol):
    """``update`` is called once a control step with the arrived messages and the estimate. Scans
    and images arrive ``compute_latency_ticks`` late; the map that is returned is used at once. It
    must be deterministic, must not modify its input, and must not change a map that it has
    returned before but for filling it further."""

    needs: SensorNeeds

    def update(self, obs: Observation, estimate: Estimate) -> MapView: ...
