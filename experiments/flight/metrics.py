"""Metrics of a flight: positioning error, deviation from the path, NEES, touchdown, levelness.

Running statistics: memory does not grow with the duration of a flight.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import GridMap
from touchdown.experiments.io.result_parts import Nees, PositionError
from touchdown.sim.api import Contact, MovingFrame, Truth
from touchdown.sim.frames import Pose, tilt_from_rotation, wrap_angle, yaw_from_rotation
from touchdown.sim.typing import Array

TOUCHDOWN_WINDOW_S = 0.5
"""Speeds and accelerations at touchdown are means over this span before the first contact."""


@dataclass(slots=True)
class PositioningError:
    """|estimate - truth| of the composed causal pose, world frame, no alignment."""

    count: int = 0
    total: float = 0.0
    total_squared: float = 0.0
    largest: float = 0.0
    axes: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    yaw: float = 0.0

    def add(self, estimated: Pose, true: Pose) -> None:
        """Both ``world_from_body`` at the same instant."""
        # Scalars: this runs at every control step, and arrays of three are slow.
        x, y, z = (estimated.translation - true.translation).tolist()
        squared = x * x + y * y + z * z
        distance = math.sqrt(squared)
        self.count += 1
        self.total += distance
        self.total_squared += squared
        self.largest = max(self.largest, distance)
        for axis, error in enumerate((x, y, z)):
            self.axes[axis] += abs(error)
        yaw = yaw_from_rotation(estimated.rotation) - yaw_from_rotation(true.rotation)
        self.yaw += abs(wrap_angle(yaw))

    def summary(self) -> PositionError:
        """Means over the span in metres and degrees; x, y, z and yaw are mean absolute errors."""
        if self.count == 0:
            empty: dict[str, Any] = dict.fromkeys(PositionError.model_fields)
            return PositionError(**empty)
        x, y, z = (total / self.count for total in self.axes)
        return PositionError(
            mean=self.total / self.count,
            rmse=float(np.sqrt(self.total_squared / self.count)),
            max=self.largest,
            x=x,
            y=y,
            z=z,
            yaw_deg=float(np.degrees(self.yaw / self.count)),
        )


@dataclass(slots=True)
class TrajectoryDeviation:
    """E_tra and its variance: |truth - reference| at equal times (the paper's Table 2)."""

    count: int = 0
    mean: float = 0.0
    _m2: float = 0.0
    largest: float = 0.0

    def add(self, truth: Truth, reference_world: Array) -> None:
        distance = math.dist(truth.world_from_body.translation.tolist(), reference_world.tolist())
        self.count += 1
        delta = distance - self.mean
        self.mean += delta / self.count
        self._m2 += delta * (distance - self.mean)
        self.largest = max(self.largest, distance)

    @property
    def variance(self) -> float:
        return self._m2 / self.count if self.count else 0.0


NEES_LIMIT = 14.2
"""A consistent estimator is below it in 99.7 % of samples (chi-square, 3 degrees of freedom)."""
_NEES_LOWEST, _NEES_PER_DECADE, _NEES_BINS = 1e-4, 50, 500


@dataclass(slots=True)
class Consistency:
    """Normalised estimation error squared (NEES) ``e^T P^-1 e`` of the position (Bar-Shalom et al.
    2001, section 5.4); 3 on average for a consistent estimator.

    A histogram over the logarithm, ten decades from 1e-4, gives the median to 5 %. ``variances``
    sums the logarithms of the trace of P and of its last element, m^2, over samples where both are
    positive.
    """

    count: int = 0
    total: float = 0.0
    variances: Array = field(default_factory=lambda: np.zeros(2))
    stated: int = 0
    below_limit: int = 0
    histogram: NDArray[np.int64] = field(
        default_factory=lambda: np.zeros(_NEES_BINS, dtype=np.int64)
    )

    def add(self, estimated: Array, true: Array, covariance: Array) -> None:
        """Adds a sample: positions (3,) m and covariance (3, 3) m^2, world frame. A singular or
        non-finite covariance counts as the largest NEES of the histogram."""
        error = estimated - true
        try:
            value = float(error @ np.linalg.solve(covariance, error))
        except np.linalg.LinAlgError:
            value = math.inf
        if not 0.0 <= value < math.inf:
            value = _NEES_LOWEST * 10.0 ** (_NEES_BINS / _NEES_PER_DECADE)
        variances = np.array([np.trace(covariance), covariance[2, 2]])
        if ((variances > 0.0) & (variances < np.inf)).all():
            self.variances += np.log(variances)
            self.stated += 1
        self.count += 1
        self.total += value
        self.below_limit += value < NEES_LIMIT
        slot = _NEES_PER_DECADE * math.log10(max(value, _NEES_LOWEST) / _NEES_LOWEST)
        self.histogram[min(int(slot), _NEES_BINS - 1)] += 1

    def summary(self) -> Nees:
        """Median, mean and the fraction below ``NEES_LIMIT``; None without a sample."""
        if self.count == 0:
            return Nees(median=None, mean=None, below_14_2=None, samples=0)
        slot = int(np.searchsorted(np.cumsum(self.histogram), 0.5 * self.count))
        sigmas = np.exp(0.5 * self.variances / max(self.stated, 1)).tolist()
        return Nees(
            median=_NEES_LOWEST * 10.0 ** ((slot + 0.5) / _NEES_PER_DECADE),
            mean=self.total / self.count,
            below_14_2=self.below_limit / self.count,
            samples=self.count,
            sigma_m=sigmas[0] if self.stated else None,
            sigma_z_m=sigmas[1] if self.stated else None,
        )


class TouchdownWindow:
    """Truth of the last half second before the first contact and of the time after it; over a deck
    that moves, relative to it."""

    def __init__(self, steps_per_s: float) -> None:
        length = max(1, round(TOUCHDOWN_WINDOW_S * steps_per_s))
        self._vertical_speed: deque[float] = deque(maxlen=length)
        self._horizontal_speed: deque[float] = deque(maxlen=length)
        self._vertical_accel: deque[float] = deque(maxlen=length)
        self.contact_xy: Array | None = None
        self.contact_time_s: float | None = None
        self.tilt_deg = 0.0
        self.impact_peak_mps2 = 0.0
        self.bounce_m = 0.0
        self._lowest = np.inf
        self.contacts: tuple[Contact, ...] = ()

    def add_before(self, truth: Truth) -> None:
        x, y, z = velocity_over_deck(truth).tolist()
        self._vertical_speed.append(abs(z))
        self._horizontal_speed.append(math.hypot(x, y))
        self._vertical_accel.append(abs(float(truth.acceleration_world[2])))

    def first_contact(self, truth: Truth) -> None:
        self.contact_xy = truth.world_from_body.translation[:2].copy()
        self.contact_time_s = truth.time_s
        self.contacts = truth.contacts

    def add_after(self, truth: Truth) -> None:
        pose = truth.world_from_body
        if (deck := deck_below(truth)) is not None:
            pose = deck.world_from_frame.inverse() @ pose
        height = float(pose.translation[2])
        self._lowest = min(self._lowest, height)
        self.bounce_m = max(self.bounce_m, height - self._lowest)
        tilt = float(np.degrees(tilt_from_rotation(pose.rotation)))
        self.tilt_deg = max(self.tilt_deg, tilt)
        self.impact_peak_mps2 = max(self.impact_peak_mps2, truth.peak_contact_accel)

    def summary(self) -> dict[str, float]:
        """The figures of the touchdown so far by their names in `Landing`: means over the last half
        second before the first contact, maxima from it on."""
        return {
            "vertical_speed_mps": float(np.mean(self._vertical_speed)),
            "horizontal_speed_mps": float(np.mean(self._horizontal_speed)),
            "vertical_accel_mps2": float(np.mean(self._vertical_accel)),
            "impact_peak_mps2": self.impact_peak_mps2,
            "bounce_m": self.bounce_m,
            "tilt_deg": self.tilt_deg,
        }


def deck_below(truth: Truth) -> MovingFrame | None:
    """The deck that the vehicle is over or beside; None away from it, as on the way home."""
    deck, place = truth.deck, truth.world_from_body.translation
    if deck is None:
        return None
    away = np.linalg.norm(place - deck.world_from_frame.translation)
    return deck if away < _BESIDE_DECK_M else None


def velocity_over_deck(truth: Truth) -> Array:
    """(3,) m/s of the vehicle relative to the deck below it; in the world where none moves."""
    if (deck := deck_below(truth)) is None:
        return truth.velocity_world
    return truth.velocity_world - deck.velocity_at(truth.world_from_body.translation)


_BESIDE_DECK_M = 20.0
"""from the middle of a vessel of up to 18 m"""


PERSON_M = 3.0
"""least distance to a person at touchdown"""
_PERSON_HIGH_M = 1.8
_APPROACH_S = 10.0


class Nearest:
    """Distance from the vehicle to the nearest person, rider or animal until the first contact,
    each as an upright line of 1.8 m."""

    def __init__(self, steps_per_s: float) -> None:
        self._last: deque[float] = deque(maxlen=max(1, round(_APPROACH_S * steps_per_s)))

    @property
    def now_m(self) -> float | None:
        """The last distance; None where there is nobody."""
        return self._last[-1] if self._last else None

    def add(self, truth: Truth) -> None:
        """Takes one control step with somebody in the world."""
        away = truth.world_from_body.translation - truth.living_world
        away[:, 2] -= np.clip(away[:, 2], 0.0, _PERSON_HIGH_M)
        self._last.append(float(np.sqrt((away**2).sum(axis=1).min())))

    def summary(self) -> dict[str, float | None]:
        """Distances by their names in `Landing`: at the first contact, and the least of the ten
        seconds before."""
        least = min(self._last) if self._last else None
        return {"nearest_person_m": self.now_m, "nearest_person_10s_m": least}


@dataclass(frozen=True, slots=True)
class PlaneFit:
    """Unit upward normal (3,) and largest |residual| in metres of a height patch."""

    normal: Array
    residual_m: float


def fit_plane(points: Array) -> PlaneFit:
    """Least squares z = a x + b y + c of (N, 3) points, N >= 3."""
    centred = points - points.mean(axis=0)
    slope, *_ = np.linalg.lstsq(centred[:, :2], centred[:, 2], rcond=None)
    residual = centred[:, 2] - centred[:, :2] @ slope
    normal = np.array([-slope[0], -slope[1], 1.0])
    return PlaneFit(normal / np.linalg.norm(normal), float(np.abs(residual).max()))


LEVELNESS_PLACES = 10
LEVELNESS_RADIUS_M = 1.0
LEVELNESS_RESIDUAL_M = 0.03
LEVELNESS_MAX_SLOPE_DEG = 15.0
"""steeper planes are roofs and banks, not ground to land on"""


@dataclass(frozen=True, slots=True)
class GroundMap:
    """What the figures of a map are made of: its cells, their returns and the ground's height."""

    origin_xy_m: Array
    cell_m: float
    count: NDArray[np.float32]
    height_m: NDArray[np.float32]

    @classmethod
    def of(cls, grid: GridMap) -> "GroundMap":
        """Returns the ground of ``grid``, in arrays of its own."""
        return cls(grid.origin_xy_m, grid.cell_m, grid.count.copy(), grid.ground().height_m)


def levelness_error_deg(
    grid: GridMap | GroundMap, true_points: Callable[[Array, float], Array], seed: int
) -> Array:
    """Angle between map and true normals at up to ten seeded places where the ground is planar.

    ``true_points(xy (2,), radius)`` gives (N, 3) points of the true surface in that disc. Places
    are drawn from the mapped cells; one counts when the true patch is planar to 3 cm within 1 m
    and slopes by at most 15 degrees.
    Returns (<= 10,) degrees.
    """
    rng = np.random.default_rng([seed, 0x1E7E1])
    rows, cols = np.nonzero(grid.count > 2)
    errors: list[float] = []
    flattest = np.cos(np.radians(LEVELNESS_MAX_SLOPE_DEG))
    if rows.size == 0:
        return np.zeros(0)
    for pick in rng.integers(0, rows.size, size=400):
        centre = grid.origin_xy_m + (np.array([cols[pick], rows[pick]]) + 0.5) * grid.cell_m
        true = true_points(centre, LEVELNESS_RADIUS_M)
        if len(true) < 3:  # beyond the scene's edge
            continue
        truth = fit_plane(true)
        if truth.residual_m > LEVELNESS_RESIDUAL_M or truth.normal[2] < flattest:
            continue
        mapped = _map_points(grid, centre, LEVELNESS_RADIUS_M)
        if mapped.shape[0] < 20:
            continue
        cosine = float(np.clip(fit_plane(mapped).normal @ truth.normal, -1.0, 1.0))
        errors.append(float(np.degrees(np.arccos(cosine))))
        if len(errors) == LEVELNESS_PLACES:
            break
    return np.array(errors)


def _map_points(grid: GridMap | GroundMap, centre_xy: Array, radius: float) -> Array:
    """(N, 3) centres and mean heights of the seen cells within ``radius`` of a point."""
    low = np.floor((centre_xy - radius - grid.origin_xy_m) / grid.cell_m).astype(int)
    high = np.ceil((centre_xy + radius - grid.origin_xy_m) / grid.cell_m).astype(int)
    (c0, r0), (c1, r1) = np.maximum(low, 0), high
    patch = grid.height_m[r0:r1, c0:c1]
    rows, cols = np.nonzero((grid.count[r0:r1, c0:c1] > 0) & np.isfinite(patch))
    xy = grid.origin_xy_m + (np.stack([cols + c0, rows + r0], axis=1) + 0.5) * grid.cell_m
    near = np.linalg.norm(xy - centre_xy, axis=1) <= radius
    return np.column_stack([xy, patch[rows, cols].astype(np.float64)])[near]
