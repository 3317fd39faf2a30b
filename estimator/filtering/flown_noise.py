"""Noise of the IMU in flight: rotors shake it, so that a data sheet promises too much."""

from __future__ import annotations

import dataclasses

from touchdown.estimator.api import FlownImuParams
from touchdown.sim.api import SensorRig


def with_flown_noise(rig: SensorRig, params: FlownImuParams) -> SensorRig:
    """The rig with the IMU's noise as it is on the flying vehicle: the larger of both."""
    larger = {
        field.name: max(getattr(rig.imu, field.name), getattr(params, field.name))
        for field in dataclasses.fields(params)
    }
    return dataclasses.replace(rig, imu=dataclasses.replace(rig.imu, **larger))
