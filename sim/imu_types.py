"""Parameters of the IMU; part of `sim.api`: import them from there."""

from __future__ import annotations

from dataclasses import dataclass

from touchdown.sim.ranges import FORBID_EXTRA, Fraction, NotNegative


@dataclass(frozen=True, kw_only=True, slots=True)
class ImuSheet:
    """What data sheet and calibration say of an IMU: noise densities, in-run bias walk, spread of
    the turn-on errors, ranges. Defaults: Bosch BMI088 (data sheet)."""

    __pydantic_config__ = FORBID_EXTRA

    gyro_density: NotNegative = 2.44e-4
    """rad/s/sqrt(Hz)"""
    accel_density: NotNegative = 1.72e-3
    """m/s^2/sqrt(Hz)"""
    gyro_bias_walk: NotNegative = 1.0e-5
    """rad/s^2/sqrt(Hz)"""
    accel_bias_walk: NotNegative = 1.0e-4
    """m/s^3/sqrt(Hz)"""
    gyro_bias_sigma: NotNegative = 3.0e-3
    """rad/s, turn-on"""
    accel_bias_sigma: NotNegative = 3.0e-2
    """m/s^2, turn-on"""
    scale_sigma: NotNegative = 0.0
    """relative error of scale of each axis of gyroscope and accelerometer, standard deviation"""
    misalignment_sigma_deg: NotNegative = 0.0
    """standard deviation of the angle of every sensing axis towards each of the two others"""
    gyro_g_sensitivity: NotNegative = 0.0
    """rad/s per m/s^2: response of each gyroscope axis to each axis of specific force, standard
    deviation"""
    gyro_range: NotNegative = 0.0
    """rad/s at which a gyroscope sample saturates; 0: never"""
    accel_range: NotNegative = 0.0
    """m/s^2 at which an accelerometer sample saturates; 0: never"""


@dataclass(frozen=True, kw_only=True, slots=True)
class ImuParams(ImuSheet):
    """Bosch BMI088 (data sheet), its place on the body and the propellers' vibration there. Turn-on
    errors are drawn once a flight."""

    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """distance from the MJCF's site ``imu`` to the sensor, body axes (forward, left, up);
    estimators know it"""
    vibration_gyro_density: NotNegative = 0.0
    """rad/s/sqrt(Hz) that the propellers shake into the sensor in hover, broad band; grows with the
    square of the rotor speed. 0: a perfectly isolated mount; 4e-3 is the median of unisolated
    sensors on a DJI Phantom 4 (flights of Hurwitz and Klein 2023), a damped mount a tenth of it"""
    vibration_accel_density: NotNegative = 0.0
    """m/s^2/sqrt(Hz), likewise; 0.12 on the same flights (three times that along the rotor axes)"""
    vibration_harmonics: NotNegative = 0.0
    """lines at one and two times each rotor's speed; 1: as strong as on the airframe of a DJI
    Phantom 4 (same flights), 0: none"""
    vibration_broadband: NotNegative = 0.0
    """resonances of the airframe that the propellers excite, likewise"""
    vibration_isolation: Fraction = 1.0
    """share of harmonics and resonances that a damped mount passes above its corner of 40 Hz"""
