"""Checks of what a sensor log holds: a damaged one must not reach an estimator."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.experiments.errors import UsageError
from touchdown.sim.api import CameraImage, Observation, SensorRig

MAX_PIXELS = 1 << 26
_MAX_TICK = 1 << 53


class DamagedError(ValueError):
    """Content that no log of a flight has."""


@contextlib.contextmanager
def damage_reported(path: Path) -> Iterator[None]:
    """Turns errors of inconsistent content into a UsageError that says what is wrong with
    ``path``."""
    from rosbags.serde import SerdeError

    faults = {
        (struct.error, SerdeError): "a message is cut short",
        (LookupError,): "a message or a value is missing",
        (MemoryError,): "a part claims an absurd size",
        (TypeError, ArithmeticError, RecursionError, AttributeError, ValueError): (
            "a value is not of its kind"
        ),
    }
    try:
        yield
    except UsageError:
        raise
    except tuple(kind for kinds in faults for kind in kinds) as error:
        why = next(text for kinds, text in faults.items() if isinstance(error, kinds))
        why = str(error) if isinstance(error, DamagedError) else why
        raise UsageError(f"'{path}' is damaged: {why}; fly again with --log-sensors") from error


def check_rig(rig: SensorRig) -> None:
    """Raises DamagedError for a rig that no flight has."""
    positive = {
        "tick_hz": rig.tick_hz,
        "imu_ticks": rig.imu_ticks,
        "camera_ticks": rig.camera_ticks,
        "lidar_scan_ticks": rig.lidar_scan_ticks,
        "camera.width": rig.camera.width,
        "camera.height": rig.camera.height,
        "camera.fx": rig.camera.fx,
        "camera.fy": rig.camera.fy,
        "vehicle.mass_kg": rig.vehicle.mass_kg,
        "vehicle.thrust_coefficient": rig.vehicle.thrust_coefficient,
    }
    for name, value in positive.items():
        if not 0 < value < math.inf:
            raise DamagedError(f"{name} of the rig is not positive")
    if rig.tick_hz > 10**6 or rig.camera.width * rig.camera.height > MAX_PIXELS:
        raise DamagedError("rates or image size of the rig are absurd")
    if rig.camera_ticks > rig.tick_hz:
        raise DamagedError("the camera of the rig has no rate")
    if name := _without_number(rig, "rig"):
        raise DamagedError(f"{name} is not a number")


def check_order(obs: Observation, rig: SensorRig, before: int) -> None:
    """Raises DamagedError unless the observation is one of ``rig`` and follows that of the tick
    ``before``. Its messages may say anything: faults change them."""
    if not before < obs.tick < _MAX_TICK:
        raise DamagedError(f"the observation of tick {obs.tick} is out of order")
    if abs(obs.time_s - obs.tick / rig.tick_hz) > 1e-6 * max(1.0, obs.time_s):
        raise DamagedError(f"the time of tick {obs.tick} is another")
    if obs.rotor_speed_radps.shape != (4,):
        raise DamagedError("there are not four rotor speeds")
    for name in ("imu", "gps", "barometer", "magnetometer", "rangefinder"):
        for message in getattr(obs, name):
            for field in dataclasses.fields(message):
                value = getattr(message, field.name)
                if isinstance(value, np.ndarray) and value.shape != (3,):
                    raise DamagedError(f"{field.name} of {name} is no vector")
    for scan in obs.scans:
        if len(scan.intensity) != len(scan.ranges):
            raise DamagedError("a scan has not one intensity for each range")


def check_images(images: Iterable[CameraImage], rig: SensorRig) -> None:
    """Raises DamagedError unless images have the size of the rig's camera."""
    size = (rig.camera.height, rig.camera.width, 3)
    for image in images:
        if any(eye is not None and eye.shape != size for eye in (image.rgb, image.right_rgb)):
            raise DamagedError("an image is not of the camera's size")


def _without_number(value: Any, name: str) -> str:
    """The name of the first value in a dataclass that is not a number; "" if all are."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            found = _without_number(getattr(value, field.name), f"{name}.{field.name}")
            if found:
                return found
    floats = isinstance(value, float | np.ndarray) and np.asarray(value).dtype.kind == "f"
    return name if floats and bool(np.isnan(value).any()) else ""
