"""Time scaling of the reference: its bounds, its derivatives, and what it makes of wind."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from touchdown.landing.api import LandingParams, Phase, SurveyParams
from touchdown.landing.mission import time_scaling
from touchdown.landing.mission.thrust_need import air_coefficients, rotor_need
from touchdown.landing.mission.trajectory import State, survey_trajectory, through
from touchdown.landing.mission.wind import ROUGHNESS_M, FeltWind
from touchdown.sim.api import GRAVITY_MPS2
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array

from support.landing_support import make_estimate, make_obs
from support.windy_flight import balance, draggy_vehicle, windy_run

STEP_S = 0.005
VEHICLE = draggy_vehicle()
SLOWING = LandingParams(slow_in_wind=True)
SURVEY = survey_trajectory(np.array([0.0, 0.0, 30.0]), 0.4, SurveyParams())


def _need(through_air: Array, acceleration: Array) -> tuple[float, float]:
    """Fraction of the largest rotor speed, and tilt in rad."""
    return rotor_need(through_air, acceleration, air_coefficients(VEHICLE))


def _flown(wind: Array, seconds: float, behind_m: float = 0.0) -> tuple[Array, ...]:
    """Times, rates, their derivatives and the reference along the survey in a steady wind."""
    scaling = time_scaling.TimeScaling(VEHICLE, SLOWING)
    scaling.begin(SURVEY, wind)
    rows = []
    for step in range(round(seconds / STEP_S)):
        now = step * STEP_S
        at_s = now - scaling.lost_s
        if at_s > SURVEY.duration_s:
            break
        rows.append(
            (
                now,
                scaling.rate,
                scaling.change,
                *time_scaling.scaled(SURVEY.sample(at_s), scaling.rate, scaling.change),
            )
        )
        scaling.advance(SURVEY, at_s, STEP_S, wind, behind_m)
    return tuple(np.array(column) for column in zip(*rows, strict=True))


def test_climbing_needs_the_thrust_that_inflow_takes() -> None:
    # k_T w^2 - k_i w v = m g / 4 for v = 3 m/s, with the drag 0.05 * 3 * 3 N of the fuselage.
    fraction, _ = _need(np.array([0.0, 0.0, 3.0]), np.zeros(3))
    force = (VEHICLE.mass_kg * GRAVITY_MPS2 + 0.05 * 9.0) / 4.0
    lost = VEHICLE.rotor_inflow * 3.0
    speed = (lost + np.sqrt(lost**2 + 4 * VEHICLE.thrust_coefficient * force)) / (
        2 * VEHICLE.thrust_coefficient
    )
    assert fraction * VEHICLE.rotor_speed_max == pytest.approx(speed, rel=1e-3)


@pytest.mark.parametrize("speed", [3.0, 8.0, 13.0, 16.0])
def test_need_is_the_balance_of_forces(speed: float) -> None:
    through_air, acceleration = np.array([speed, -2.0, 0.5]), np.array([0.8, 0.3, -0.2])
    solved = balance(VEHICLE, through_air, acceleration)
    fraction, tilt = _need(through_air, acceleration)
    assert fraction * VEHICLE.rotor_speed_max == pytest.approx(solved.speed, rel=2e-3)
    assert tilt == pytest.approx(np.arccos(solved.rotation[2, 2]), abs=2e-3)


@pytest.mark.parametrize("wind", [(4.0, 0.0), (-9.0, 6.0), (2.0, -14.0)])
def test_felt_wind_is_the_wind(wind: tuple[float, float]) -> None:
    blowing, velocity = np.array([*wind, 0.0]), np.array([2.0, -1.0, 1.5])
    acceleration = np.array([0.5, -0.4, 0.2])
    balanced = balance(VEHICLE, velocity - blowing, acceleration)
    felt = FeltWind(VEHICLE)
    for step in range(1500):
        estimate = dataclasses.replace(
            make_estimate(3 * step, Pose(balanced.rotation, np.zeros(3)), velocity),
            acceleration_odom=acceleration,
        )
        felt.update(make_obs(3 * step, rotor_speed_radps=np.full(4, balanced.speed)), estimate)
    np.testing.assert_allclose(felt.wind_odom, blowing, atol=0.05)


def test_friction_on_the_ground_is_no_wind() -> None:
    felt, estimate = FeltWind(VEHICLE), make_estimate(0, Pose.identity())
    leaning = dataclasses.replace(estimate, acceleration_odom=np.array([3.0, 0.0, 0.0]))
    for step in range(100):
        felt.update(make_obs(3 * step, rotor_speed_radps=np.full(4, 100.0)), leaning)
    assert not felt.wind_odom.any()


def test_gentle_wind_leaves_the_trajectory_as_it_was_set() -> None:
    times, rates, changes, positions, *_ = _flown(np.array([3.6, -2.0, 0.0]), 100.0)
    assert (rates == 1.0).all() and (changes == 0.0).all()
    assert times[-1] == pytest.approx(SURVEY.duration_s, abs=2 * STEP_S)
    for time_s, position in zip(times[::50], positions[::50], strict=True):
        assert (position == SURVEY.sample(time_s)[0]).all()


def test_rate_and_its_derivatives_keep_their_bounds() -> None:
    rng, rate, change = np.random.default_rng(4), 1.0, 0.0
    rates, changes = [], []
    for step in range(20_000):
        if step % 150 == 0:
            target = float(rng.choice([0.0, 1.0, rng.uniform()]))
        rate, change = time_scaling.next_rate(rate, change, target, STEP_S)
        rates.append(rate)
        changes.append(change)
    assert min(rates) >= 0.0
    assert max(rates) <= 1.0
    assert min(changes) >= -time_scaling.BRAKE_PER_S - 1e-12
    assert max(changes) <= time_scaling.SPEED_UP_PER_S + 1e-12
    inside = (np.array(rates[1:]) > 0.02) & (np.array(rates[1:]) < 0.98)
    assert np.abs(np.diff(changes))[inside].max() <= time_scaling.JERK_PER_S2 * STEP_S + 1e-12


@pytest.mark.parametrize("target", [0.0, 1.0])
def test_rest_and_full_rate_are_reached_exactly(target: float) -> None:
    rate, change = 0.5, 0.0
    for _ in range(6_000):
        rate, change = time_scaling.next_rate(rate, change, target, STEP_S)
    assert (rate, change) == (target, 0.0)


def test_slowed_velocity_and_acceleration_belong_to_the_positions() -> None:
    _, rates, _, positions, velocities, accelerations = _flown(np.array([-11.0, 5.0, 0.0]), 200.0)
    assert rates.min() < 0.8
    moved = (positions[2:] - positions[:-2]) / (2.0 * STEP_S)
    np.testing.assert_allclose(moved, velocities[1:-1], atol=0.01)
    sped = (velocities[2:] - velocities[:-2]) / (2.0 * STEP_S)
    # The clock's bounded jerk at 8 m/s changes the acceleration by 0.08 m/s^2 over two steps.
    np.testing.assert_allclose(sped, accelerations[1:-1], atol=0.08)


def test_slowed_survey_needs_no_more_than_the_margin() -> None:
    wind, params = np.array([-11.0, 5.0, 0.0]), SLOWING
    _, _, _, _, velocities, accelerations = _flown(wind, 200.0)
    unslowed = max(
        _need(v - wind, a)[0] for _, v, a in (SURVEY.sample(t) for t in np.linspace(0.0, 36.0, 300))
    )
    fractions = [
        _need(v - wind, a)[0] for v, a in zip(velocities[::20], accelerations[::20], strict=True)
    ]
    assert unslowed > 1.0
    assert max(fractions) < params.wind_thrust_fraction + 0.02


def test_clock_waits_for_a_vehicle_that_falls_behind() -> None:
    assert (_flown(np.zeros(3), 10.0, behind_m=0.5)[1] == 1.0).all()
    assert _flown(np.zeros(3), 20.0, behind_m=2.5)[1][-1] == 0.0


def test_weak_rotors_slow_the_clock_earlier() -> None:
    wind = np.array([-7.0, 0.0, 0.0])
    leg = through([State(np.zeros(3)), State(np.array([60.0, 0.0, 0.0]))], [15.0])
    nominal, weak = (
        time_scaling.TimeScaling(VEHICLE, SLOWING),
        time_scaling.TimeScaling(VEHICLE, SLOWING),
    )
    fraction = _need(-wind, np.zeros(3))[0]
    for _ in range(200):
        weak.learn(-wind, np.zeros(3), 1.12 * fraction * VEHICLE.rotor_speed_max, 0.1)
    rates = {}
    for name, scaling in (("nominal", nominal), ("weak", weak)):
        scaling.begin(leg, wind)
        slowest = 1.0
        for _ in range(2000):
            scaling.advance(leg, 7.5, STEP_S, wind, 0.0)
            slowest = min(slowest, scaling.rate)
        rates[name] = slowest
    assert rates["weak"] < rates["nominal"] - 0.1


def test_clock_slows_before_the_path_asks_too_much() -> None:
    """Before the load reaches its limit, by what braking at 0.2 a second leaves."""
    wind = np.array([-7.0, 0.0, 0.0])
    leg = through([State(np.zeros(3)), State(np.array([60.0, 0.0, 0.0]))], [9.0])
    scaling = time_scaling.TimeScaling(VEHICLE, SLOWING)

    def allows_itself(at_s: float) -> bool:
        _, velocity, acceleration = leg.sample(at_s)
        air = velocity - scaling._gusts * wind
        return time_scaling._load(air, acceleration, scaling._coefficients, scaling._limits) < 1.0

    first = next(t for t in np.arange(0.0, 4.5, 0.05) if not allows_itself(t))
    assert allows_itself(first - 0.3)
    assert 0.9 < scaling._look(leg, first - 0.3, wind) < 0.98
    assert scaling._look(leg, 8.95, wind) == 1.0  # nothing is asked beyond the end


def test_strong_wind_slows_the_flight_and_says_so() -> None:
    events: list[str] = []
    notes: set[str] = set()
    slowed_s = 0.0
    for _, view, _ in windy_run(
        lambda t, height: np.array([-11.0, 0.0, 0.0]), 200.0, survey_only=True
    ):
        events += view.events
        notes.add(view.note)
        slowed_s = view.slowed_s
        if view.phase is Phase.DONE:
            break
    assert view.phase is Phase.DONE
    assert not view.aborted
    assert any(
        "SURVEY: slowed to keep a margin of thrust in a wind of 1" in text for text in events
    )
    assert any(note.startswith("slowed to keep") for note in notes)  # said beside the phase
    assert any("instead of 14.0 s" in text for text in events)
    assert slowed_s > 1.0


def _profile(wind_at_10m: float) -> Callable[[float, float], Array]:
    along = wind_at_10m / np.log(10.0 / ROUGHNESS_M)
    return lambda t, height: np.array([along * np.log(max(height, 1.0) / ROUGHNESS_M), 0.0, 0.0])


def test_wind_too_strong_for_the_height_lowers_the_survey() -> None:
    heights, events = [], []
    for _, view, reference in windy_run(_profile(11.5), 120.0):
        events += view.events
        heights.append(reference[2])
        if view.phase is Phase.SURVEY:
            break
    assert any("the survey is flown at 10 m" in text for text in events)
    assert heights[-1] == pytest.approx(10.0 + 0.3, abs=0.4)


def test_wind_too_strong_for_any_height_ends_where_it_began() -> None:
    """It turns back below the height of a survey, and its landing is watched as any other."""
    places, events, phases = [], [], set()
    for _, view, reference in windy_run(_profile(15.0), 120.0):
        events += view.events
        phases.add(view.phase)
        places.append(reference)
        if view.phase is Phase.DESCEND and reference[2] < 1.0:
            break
    assert any("wind_no_go" in text for text in events)
    assert view.aborted and reference[2] < 1.0
    assert Phase.RETURN in phases and Phase.SURVEY not in phases
    assert 6.0 < np.max(places, axis=0)[2] < 10.0  # the lowest survey
    np.testing.assert_allclose(places[-1][:2], 0.0, atol=0.05)
    events.clear()
    survey = windy_run(_profile(15.0), 30.0, survey_only=True)
    assert not any("wind_no_go" in text for _, view, _ in survey for text in view.events)


def test_a_low_survey_is_judged_at_its_own_height() -> None:
    """At its 20 m the wind leaves a margin, at 40 m it would not; below 3 m no wind is known."""
    for min_height_m, wind_at_10m in ((40.0, 10.6), (2.0, 9.0)):
        flown = windy_run(_profile(wind_at_10m), 16.0, min_height_m=min_height_m)
        rules = [text for _, view, _ in flown for text in view.events]
        assert not any("wind_no_go" in text or "wind_aloft" in text for text in rules)


def test_wind_beyond_reach_ends_the_mission_on_the_ground() -> None:
    """A gust front: the survey can no longer be flown, so that the vehicle lands where it is."""

    def front(t: float, height: float) -> Array:
        return np.array([-6.0 if t < 12.0 else -17.5, 0.0, 0.0])

    events: list[str] = []
    for _, view, reached in windy_run(front, 300.0, site_recheck=False):
        events += view.events
        if view.phase is Phase.DESCEND and reached[2] < 1.0:
            break
    assert any("leaves no way to fly this leg" in text for text in events)
    assert any("survey_blocked" in text for text in events)
    assert reached[2] < 1.0
