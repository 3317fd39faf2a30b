"""Conditions of a flight, measured on the truth, on delivered messages and where the world applies
them: the figures by which `experiments.flight.condition_checks` judges them."""

from __future__ import annotations

import math
from collections.abc import Mapping

from touchdown.experiments.flight.estimator_calibration import calibration_errors
from touchdown.experiments.io.result_parts import Measured
from touchdown.experiments.recording.recorder import StepRecord
from touchdown.sim.api import Observation, SensorRig
from touchdown.sim.effects import Effect, WorldRecord

REFERENCE_HEIGHT_M = 6.1
"""20 ft, at which the mean wind of a configuration is given"""
_AIRBORNE_M = 3.0
"""Height over the take-off spot from which wind and vibration count: below it the profile is steep
and the ground holds the vehicle still."""
_STRIDE = 16
"""step between the rows and columns whose brightness is taken"""
_NOTHING = Effect()


class ConditionsObserver:
    """Follows wind, vibration, brightness and latency; call ``tick`` with every control step."""

    def __init__(self, roughness_length_m: float) -> None:
        self._roughness_m = roughness_length_m
        self._start_z: float | None = None
        self._wind = self._profile = self._largest = 0.0
        self._steps = 0
        self._previous: list[float] | None = None
        self._shaken = self._rate = 0.0
        self._samples = 0
        self._grey: list[float] = [0.0, 0.0]
        self._latency = [0.0, 0.0, 0.0]

    def tick(self, step: StepRecord) -> None:
        """Takes one control step."""
        z = float(step.truth.world_from_body.translation[2])
        if self._start_z is None:
            self._start_z = z
        height = z - self._start_z
        if height > _AIRBORNE_M:
            self._air(step, height)
        else:
            self._previous = None
        self._messages(step.obs)

    def _air(self, step: StepRecord, height_m: float) -> None:
        # Scalars: arrays of three are slow at every control step.
        x, y, z = step.truth.wind_world.tolist()
        speed = math.hypot(x, y)
        self._steps += 1
        self._wind += speed
        self._profile += math.log(height_m / self._roughness_m) / math.log(
            REFERENCE_HEIGHT_M / self._roughness_m
        )
        self._largest = max(self._largest, math.hypot(speed, z))
        self._rate += math.hypot(*step.truth.angular_velocity_body.tolist())
        for sample in step.obs.imu:
            force = sample.specific_force.tolist()
            if self._previous is not None:
                self._shaken += math.dist(force, self._previous) ** 2
                self._samples += 1
            self._previous = force

    def _messages(self, obs: Observation) -> None:
        for image in obs.images:
            self._grey[0] += 1
            self._grey[1] += float(image.rgb[::_STRIDE, ::_STRIDE].mean())
        for scan in obs.scans:
            latency_ms = 1e3 * (obs.time_s - scan.end_time_s)
            for power in range(3):
                self._latency[power] += latency_ms**power

    def measured(self, record: WorldRecord, true: SensorRig, nominal: SensorRig) -> Measured:
        """Returns the figures of the flight. ``true``: the rig as it is, ``nominal``: as the
        estimator knows it."""
        steps, samples, images = (max(n, 1) for n in (self._steps, self._samples, self._grey[0]))
        scans, total, squares = self._latency
        latency = total / max(scans, 1)
        rate = self._rate / steps
        sensors = record.effects
        return Measured(
            wind_mps=self._wind / steps if self._steps else None,
            wind_at_6m_mps=self._wind / self._profile if self._steps else None,
            gust_mps=self._largest if self._steps else None,
            vibration_mps2=math.sqrt(self._shaken / 2.0 / samples) if self._samples else None,
            image_grey=self._grey[1] / images if self._grey[0] else None,
            scan_latency_ms=latency if scans else None,
            scan_latency_sigma_ms=(
                math.sqrt(max(squares / scans - latency**2, 0.0)) if scans else None
            ),
            readout_shear_px=true.camera.fx * true.camera_readout_s * rate if self._steps else None,
            **calibration_errors(true, nominal),
            **record.deviations,
            **_of_sensors(sensors.get("scans", {}), sensors.get("images", {}), sensors["air"]),
        )


def _of_sensors(
    scans: Mapping[str, Effect], images: Mapping[str, Effect], air: Mapping[str, Effect]
) -> dict[str, float | None]:
    def share(effects: Mapping[str, Effect], name: str) -> float | None:
        return effects[name].mean_share if name in effects else None

    def size(effects: Mapping[str, Effect], name: str) -> float | None:
        return effects[name].mean_amount if name in effects else None

    dusty, swayed = scans.get("dust", _NOTHING), scans.get("sway", _NOTHING)
    return {
        "light_lux": size(images, "light_lux"),
        "lamp_share": share(images, "lamp"),
        "exposure_ms": size(images, "exposure_ms"),
        "gain": size(images, "gain"),
        "exposure_error_stops": size(images, "exposure_error_stops"),
        "stamp_error_ms": size(images, "stamp_error_ms"),
        "range_error_m": size(scans, "ranging"),
        "plants_share": share(scans, "vegetation"),
        "sway_m": swayed.amount / swayed.messages if swayed.messages else None,
        "wakes_mps": size(air, "wakes"),
        "air_rotation_degps": size(air, "rotation"),
        "dust_scans": float(dusty.messages),
        "dust_images": float(images.get("dust", _NOTHING).messages),
        "dust_returns_share": dusty.mean_share,
    }
