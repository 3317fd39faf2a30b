"""Reference trajectories with continuous acceleration.

A trajectory is a chain of quintic polynomials. A quintic is the curve of least squared jerk between
two states of position, velocity and acceleration (Flash and Hogan 1985; Mueller, Hehn and D'Andrea
2015), so that the acceleration is continuous where two of them meet.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from touchdown.landing.api import SurveyParams
from touchdown.sim.frames import rotation_from_yaw
from touchdown.sim.typing import Array

Sample = tuple[Array, Array, Array]

PEAK_SPEED = 1.875
"""largest speed of a minimum-jerk segment from rest to rest over its mean"""
RAMP_S = 3.0
"""duration of a change of the vertical speed"""
_MANY_LEGS = 20
"""number of legs above which the fractions of the time for a turn shrink with the number of legs"""
_MAX_LEGS = 10_000
_MAX_SURVEY_ACCEL = 6.0
_ZERO = np.zeros(3)
BEGIN_ABOVE_M = 4.0
"""height of the climb above which the vehicle turns"""
_MAX_RATE = math.radians(40.0)
"""rad/s, largest rate of the turn: images blur with it"""
_STEP_S = 0.05


@dataclass(frozen=True, slots=True)
class State:
    """Position, velocity and acceleration, (3,) each, SI."""

    position: Array
    velocity: Array = field(default_factory=lambda: np.zeros(3))
    acceleration: Array = field(default_factory=lambda: np.zeros(3))


class PiecewiseTrajectory:
    """A chain of quintics.

    Before its start it rests at the position of the first state; after its end it continues at the
    velocity of the last state without acceleration.
    """

    def __init__(self, durations_s: Array, coefficients: Array) -> None:
        """``durations_s`` (n,); ``coefficients`` (n, 6, 3), ascending powers of the segment's own
        time in seconds. Raises ValueError when a duration is not positive."""
        if durations_s.size == 0 or not np.all(durations_s > 0.0):
            raise ValueError(f"segment durations must be above 0 s, not {durations_s.tolist()}")
        self._starts = np.concatenate([[0.0], np.cumsum(durations_s)])
        self._coefficients = np.ascontiguousarray(coefficients)

    @property
    def duration_s(self) -> float:
        """Duration, s."""
        return float(self._starts[-1])

    @property
    def breaks_s(self) -> Array:
        """(n + 1,) times at which segments meet, from 0 to ``duration_s``."""
        return self._starts.copy()

    @property
    def coefficients(self) -> Array:
        """(n, 6, 3) ascending powers of each segment's own time, s."""
        return self._coefficients

    def sample(self, t: float) -> Sample:
        """Returns position (3,) m, velocity (3,) m/s, acceleration (3,) m/s^2 at ``t`` seconds."""
        # Here: a configuration is checked by planning its survey, which takes no compiled code.
        from touchdown.landing.mission.quintics import sample_quintics

        return sample_quintics(self._starts, self._coefficients, t)


def through(states: list[State], durations_s: list[float]) -> PiecewiseTrajectory:
    """Returns minimum-jerk quintics from each state to the next; one duration fewer than states."""
    pieces = [
        _quintic(first, second, duration)
        for first, second, duration in zip(states[:-1], states[1:], durations_s, strict=True)
    ]
    return PiecewiseTrajectory(np.array(durations_s), np.stack(pieces))


def _quintic(first: State, second: State, duration: float) -> Array:
    """Returns the coefficients (6, 3) of the quintic between two states."""
    if duration <= 0.0:
        raise ValueError(f"a segment's duration must be above 0 s, not {duration:g}")
    t = duration
    gap = second.position - first.position - first.velocity * t - 0.5 * first.acceleration * t**2
    gap_velocity = second.velocity - first.velocity - first.acceleration * t
    gap_acceleration = second.acceleration - first.acceleration
    return np.stack(
        [
            first.position,
            first.velocity,
            0.5 * first.acceleration,
            (10.0 * gap - 4.0 * gap_velocity * t + 0.5 * gap_acceleration * t**2) / t**3,
            (-15.0 * gap + 7.0 * gap_velocity * t - gap_acceleration * t**2) / t**4,
            (6.0 * gap - 3.0 * gap_velocity * t + 0.5 * gap_acceleration * t**2) / t**5,
        ]
    )


def peaks(trajectory: PiecewiseTrajectory, per_segment: int = 64) -> tuple[float, float]:
    """Returns the largest speed (m/s) and acceleration (m/s^2) of ``per_segment`` samples of each
    segment."""
    starts, coefficients = trajectory.breaks_s, trajectory.coefficients
    times = np.linspace(starts[:-1], starts[1:], per_segment)
    index = np.minimum(np.searchsorted(starts, times, side="right"), len(coefficients)) - 1
    local = (times - starts[index])[..., None]
    position, velocity, acceleration = np.zeros((3, *times.shape, 3))
    for power in range(5, -1, -1):  # Horner's scheme, as in `quintics.sample_quintics`
        acceleration = acceleration * local + 2.0 * velocity
        velocity = velocity * local + position
        position = position * local + coefficients[index, power]
    squares = np.square([velocity, acceleration]).sum(axis=-1)
    speed, acceleration = np.sqrt(squares.max(axis=(1, 2)))
    return float(speed), float(acceleration)


def survey_trajectory(start: Array, yaw: float, params: SurveyParams) -> PiecewiseTrajectory:
    """Returns the serpentine: legs along the heading ``yaw`` (rad) joined by minimum-jerk turns.

    Leg i runs between 0 and ``leg_length_m`` along the heading, ``i * leg_spacing_m`` to the left
    of ``start`` (3,), the first one outward from ``start``. All legs have the same
    constant speed, so that a turn extends beyond the ends of its legs. The vehicle rests at both
    ends. Short turns need large accelerations, long ones leave little time for the legs: the
    fraction of the turns minimises the product of the largest speed and the largest acceleration.
    Raises ValueError where ``duration_s`` needs 6 m/s^2 or more; the message names the duration
    that is needed.
    """
    if params.legs < 1 or min(params.leg_length_m, params.leg_spacing_m, params.duration_s) <= 0.0:
        raise ValueError(
            "the survey needs at least one leg, and leg_length_m, leg_spacing_m and duration_s "
            "above 0"
        )
    if params.legs > _MAX_LEGS:
        raise ValueError(f"survey.legs = {params.legs} must be {_MAX_LEGS} at most")
    fractions = np.linspace(0.02, 0.40, 77) * min(1.0, _MANY_LEGS / params.legs)
    # All legs are alike: the first four of many have the same peaks as all of them.
    rated_legs = params.legs if params.legs <= _MANY_LEGS else 4
    candidates = [
        (fraction, _survey(start, yaw, params, fraction, rated_legs)) for fraction in fractions
    ]
    rated = [(*peaks(c, per_segment=24), fraction) for fraction, c in candidates if c is not None]
    # The smallest fraction leaves legs of any number more than half of the time: one always
    # remains.
    _, acceleration, best = min(rated, key=lambda r: r[0] * r[1])
    if acceleration > _MAX_SURVEY_ACCEL:
        # Flown in k times the time, a path has 1 / k^2 of the acceleration.
        min_s = params.duration_s * math.sqrt(acceleration / _MAX_SURVEY_ACCEL)
        raise ValueError(
            f"a survey of {params.legs} legs of {params.leg_length_m:g} m does not fit into "
            f"{params.duration_s:g} s; raise survey.duration_s to {math.ceil(min_s)} or more"
        )
    path = _survey(start, yaw, params, best, params.legs)
    assert path is not None
    return path


def _survey(
    start: Array, yaw: float, params: SurveyParams, turn_fraction: float, first_legs: int
) -> PiecewiseTrajectory | None:
    """Returns the first legs of a survey whose turns each take the given fraction of the duration,
    and the ramps at start and end half of that; None where no time remains for the legs, or the
    legs are too short for the ramps."""
    total, legs, length = params.duration_s, params.legs, params.leg_length_m
    turn, ramp = turn_fraction * total, 0.5 * turn_fraction * total
    # A ramp between rest and the leg's speed covers half of what the leg's speed would.
    time_at_speed = total - (legs - 1) * turn - ramp
    if time_at_speed <= 0.0:
        return None
    speed = legs * length / time_at_speed
    room = 0.5 * speed * ramp
    if 2.0 * room >= length:
        return None
    world_from_leg = rotation_from_yaw(yaw)

    def state(along: float, leg: int, velocity: float) -> State:
        offset = np.array([along, leg * params.leg_spacing_m, 0.0])
        return State(
            start + world_from_leg @ offset, world_from_leg @ np.array([velocity, 0.0, 0.0])
        )

    states, durations = [state(0.0, 0, 0.0)], []
    for leg in range(first_legs):
        sign = 1.0 if leg % 2 == 0 else -1.0
        origin = 0.0 if leg % 2 == 0 else length
        skip_in = room if leg == 0 else 0.0
        skip_out = room if leg == first_legs - 1 else 0.0
        durations.append(ramp if leg == 0 else turn)
        states.append(state(origin + sign * skip_in, leg, sign * speed))
        durations.append((length - skip_in - skip_out) / speed)
        states.append(state(origin + sign * (length - skip_out), leg, sign * speed))
    durations.append(ramp)
    states.append(state(origin + sign * length, first_legs - 1, 0.0))
    return through(states, durations)


def straight_trajectory(
    position_start: Array,
    velocity_start: Array,
    position_end: Array,
    max_speed: float,
    max_accel: float,
    acceleration_start: Array = _ZERO,
) -> PiecewiseTrajectory:
    """Returns the shortest minimum-jerk segment to rest at ``position_end`` (3,) within the limits.

    The limits (m/s, m/s^2) bound the norms. An initial velocity or acceleration above its limit
    becomes the limit; where no duration meets both, the one of least excess is taken. From rest the
    path is a straight line. Raises ValueError for a limit that is not positive.
    """
    if max_speed <= 0.0 or max_accel <= 0.0:
        raise ValueError("max_speed and max_accel must be above 0")
    first = State(position_start, velocity_start, acceleration_start)
    last = State(position_end)
    distance = float(np.linalg.norm(position_end - position_start))
    initial_speed = float(np.linalg.norm(velocity_start))
    # Peak acceleration of the rest-to-rest quintic: 10/sqrt(3) d/T^2.
    duration = max(
        PEAK_SPEED * distance / max_speed, np.sqrt(10.0 / np.sqrt(3.0) * distance / max_accel), 0.1
    )
    if initial_speed == 0.0 and not np.any(acceleration_start):
        return through([first, last], [duration])
    speed_limit = max(max_speed, initial_speed) * (1.0 + 1e-6)
    accel_limit = max(max_accel, float(np.linalg.norm(acceleration_start))) * (1.0 + 1e-6)
    shortest = max(0.5 * distance / speed_limit, 0.1)
    best: tuple[float, PiecewiseTrajectory] | None = None
    for duration in shortest * 1.05 ** np.arange(120.0):
        trajectory = through([first, last], [float(duration)])
        speed, acceleration = peaks(trajectory, per_segment=33)
        excess = max(speed / speed_limit, acceleration / accel_limit)
        if excess <= 1.0:
            return trajectory
        if best is None or excess < best[0]:
            best = excess, trajectory
    assert best is not None
    return best[1]  # an initial acceleration can make a limit unreachable: least excess


def vertical_move(start: Array, height: float, speed: float) -> PiecewiseTrajectory:
    """Returns a vertical trajectory from rest at ``start`` (3,) to rest at z = ``height``.

    ``speed`` is reached and left in three seconds each; where the distance is too short for that,
    the trajectory is one minimum-jerk segment."""
    distance = abs(height - float(start[2]))
    end = np.array([start[0], start[1], height])
    level = distance - speed * RAMP_S
    if level <= 0.0:
        duration = max(PEAK_SPEED * distance / speed, np.sqrt(6.0 * distance / speed), 0.5)
        return through([State(start), State(end)], [duration])
    velocity = np.array([0.0, 0.0, np.sign(height - start[2]) * speed])
    ramp = 0.5 * RAMP_S * velocity
    states = [State(start), State(start + ramp, velocity), State(end - ramp, velocity), State(end)]
    return through(states, [RAMP_S, level / speed, RAMP_S])


def descent_trajectory(
    position_start: Array,
    height_end: float,
    *,
    cruise_speed: float = 2.0,
    touchdown_speed: float = 0.15,
    max_accel: float = 0.8,
    vertical_speed_start: float = 0.0,
) -> PiecewiseTrajectory:
    """Returns a vertical descent: accelerate, cruise, decelerate to ``touchdown_speed``.

    The touchdown speed is reached at z = ``height_end`` (m, frame of ``position_start`` (3,)),
    where the trajectory ends; beyond its end it continues downward at that speed.
    ``vertical_speed_start``: initial velocity along z, negative when already sinking. A height too
    short for ``cruise_speed`` gives a slower cruise. Raises ValueError when the height is too short
    for the deceleration, or a parameter is not positive."""
    if min(touchdown_speed, max_accel) <= 0.0 or cruise_speed < touchdown_speed:
        raise ValueError("a descent needs touchdown_speed and max_accel above 0, cruise above both")
    height = float(position_start[2]) - height_end
    initial = -vertical_speed_start

    def ramp_s(change: float) -> float:
        return max(1.5 * abs(change) / max_accel, 1e-3)  # peak of the quintic speed change: 3/2

    def room(cruise: float) -> float:
        up = 0.5 * (initial + cruise) * ramp_s(cruise - initial)
        return height - up - 0.5 * (cruise + touchdown_speed) * ramp_s(cruise - touchdown_speed)

    low, high = touchdown_speed, cruise_speed
    if room(low) <= 0.0:
        raise ValueError(
            f"{height:.2f} m are too short for a descent that ends at {touchdown_speed:g} m/s"
        )
    if room(high) <= 0.0:
        for _ in range(50):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if room(middle) > 0.0 else (low, middle)
        high = low
    return _descent(position_start, initial, high, touchdown_speed, room(high), ramp_s)


def _descent(
    position_start: Array,
    initial: float,
    cruise: float,
    touchdown: float,
    level_m: float,
    ramp_s: Callable[[float], float],
) -> PiecewiseTrajectory:
    """Returns a ramp to ``cruise``, ``level_m`` at it, and a ramp to ``touchdown`` (m/s, positive
    downward)."""
    up = np.array([0.0, 0.0, 1.0])
    durations, falls = [ramp_s(cruise - initial)], [0.5 * (initial + cruise)]
    speeds = [initial, cruise]
    if level_m > 1e-6:
        durations.append(level_m / cruise)
        falls.append(cruise)
        speeds.append(cruise)
    durations.append(ramp_s(cruise - touchdown))
    falls.append(0.5 * (cruise + touchdown))
    speeds.append(touchdown)
    depths = np.concatenate([[0.0], np.cumsum(np.array(falls) * np.array(durations))])
    states = [
        State(position_start - depth * up, -speed * up)
        for depth, speed in zip(depths, speeds, strict=True)
    ]
    return through(states, durations)


@dataclass(frozen=True, slots=True)
class HeadingTurn:
    """A minimum-jerk turn of the heading by ``angle_rad`` that begins at ``begin_s``.

    Over level flight at one heading, an accelerometer's bias and an error of roll and pitch look
    alike. Turned by half a circle, the bias points the other way and the error does not
    (Goshen-Meskin and Bar-Itzhack, "Observability analysis of piece-wise constant systems", IEEE
    TAES 28, 1992)."""

    angle_rad: float
    begin_s: float
    duration_s: float

    def sample(self, t: float) -> tuple[float, float]:
        """Returns the angle turned, rad, and the rate, rad/s, at the time ``t`` in seconds."""
        fraction = min(max((t - self.begin_s) / self.duration_s, 0.0), 1.0)
        angle = fraction**3 * (10.0 - 15.0 * fraction + 6.0 * fraction**2)
        rate = 30.0 * fraction**2 * (1.0 - fraction) ** 2 / self.duration_s
        return self.angle_rad * angle, self.angle_rad * rate


def turn_in_climb(climb: PiecewiseTrajectory, now_s: float, angle_deg: float) -> HeadingTurn | None:
    """Returns a turn over the part of a climb that begins now and lies above `BEGIN_ABOVE_M`, or
    longer where it would be too fast; None for an angle of 0."""
    if angle_deg == 0.0:
        return None
    angle = math.radians(angle_deg)
    floor, begin = float(climb.sample(0.0)[0][2]), 0.0
    while begin < climb.duration_s and climb.sample(begin)[0][2] < floor + BEGIN_ABOVE_M:
        begin += _STEP_S
    shortest = PEAK_SPEED * abs(angle) / _MAX_RATE
    return HeadingTurn(angle, now_s + begin, max(climb.duration_s - begin, shortest))
