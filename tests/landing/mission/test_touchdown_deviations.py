"""Touchdown and lift-off from rotor telemetry, on a vehicle that is not the nominal one."""

import numpy as np
import pytest

from touchdown.estimator.filtering.inertial_filter import InertialFilter
from touchdown.landing.mission.touchdown import TouchdownDetector
from touchdown.sim.airframe.deviations import SpeedTelemetry
from touchdown.sim.api import GRAVITY_MPS2, SensorRig, VehicleErrorParams
from touchdown.sim.frames import Pose

from support.landing_support import make_estimate, make_imu, make_obs, make_rig

EXTREMES = [(mass, thrust) for mass in (0.95, 1.05) for thrust in (0.95, 1.05)]
"""true over nominal; the bounds of profile `field`"""
_GROUND_EFFECT = 1.03
_POSE = Pose(np.eye(3), np.array([0.0, 0.0, 0.4]))


def speeds(rig: SensorRig, mass: float, thrust: float, fraction: float) -> np.ndarray:
    """(4,) rad/s at which the rotors of the true vehicle carry ``fraction`` of its weight."""
    vehicle = rig.vehicle
    force = fraction * mass * vehicle.mass_kg * GRAVITY_MPS2
    return np.full(4, np.sqrt(force / (4.0 * thrust * vehicle.thrust_coefficient)))


def detected_after(mass: float, thrust: float, fraction: float, sink: float) -> float | None:
    """Seconds until touchdown is detected on a vehicle whose rotors carry ``fraction`` of its
    weight, the ground, if anything, the rest; None: not within ten seconds."""
    rig = make_rig()
    detector = TouchdownDetector(rig)
    telemetry = SpeedTelemetry(
        VehicleErrorParams(telemetry_sigma_radps=1.0, telemetry_step_radps=1.5), 1
    )
    shown = speeds(rig, mass, thrust, fraction)
    for k in range(1, 2001):
        tick = 3 * k
        obs = make_obs(
            tick, imu=(make_imu(tick, GRAVITY_MPS2),), rotor_speed_radps=telemetry.read(shown)
        )
        if detector.update(obs, make_estimate(tick, _POSE, (0.0, 0.0, -sink))):
            return k / 200.0
    return None


@pytest.mark.parametrize(("mass", "thrust"), EXTREMES)
def test_touchdown_is_on_the_ground_and_not_in_the_air(mass: float, thrust: float) -> None:
    """Not in hover near the ground, where the ground effect carries three per cent more."""
    for sink in (0.0, 0.2):
        assert detected_after(mass, thrust, 1.0 / _GROUND_EFFECT, sink) is None
    found = detected_after(mass, thrust, 0.5, sink=0.0)
    assert found is not None and found < 0.6


@pytest.mark.parametrize(("mass", "thrust"), EXTREMES)
def test_hover_counts_as_lifted(mass: float, thrust: float) -> None:
    rig = make_rig()
    hover = speeds(rig, mass, thrust, 1.0)
    assert not InertialFilter(rig, 0.5).is_stationary(hover)
    idle = np.full(4, rig.vehicle.rotor_speed_min)
    assert InertialFilter(rig, 0.5).is_stationary(idle)
