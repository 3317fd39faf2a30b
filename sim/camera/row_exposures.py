"""Images whose rows are exposed one after the other, for a time, in a given light, which an
automatic exposure follows with a lag."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import LIGHT_LUX
from touchdown.sim.api import CameraParams, LampParams
from touchdown.sim.camera import image_sensor
from touchdown.sim.camera.gl import InverseDepth
from touchdown.sim.camera.lamp import LampField, lamp_field, shines
from touchdown.sim.camera.optics import Lens
from touchdown.sim.camera.shutter import CameraMotion, identity_shifts, longest_shift, row_shifts
from touchdown.sim.effects import Effects
from touchdown.sim.typing import Array, Bytes

_DARK_LIGHTS = ("dusk", "night")
_SHARP_PX = 0.5
"""Shorter blur is not drawn"""
_STEP_PX, _MAX_INSTANTS = 1.5, 12
"""distance of a blur's instants in the image, and their largest number"""


def takes_time(params: CameraParams, light: str) -> bool:
    """True where images are exposed for a time: as configured, and at dusk and night."""
    return params.exposure or light in _DARK_LIGHTS


def exposes_rows(params: CameraParams, light: str) -> bool:
    """True where images come from `RowExposures`."""
    return params.readout_s > 0.0 or takes_time(params, light)


class RowExposures:
    """The rows of rasters of ``lens`` in a scene's ``light``. Where exposures take no time, images
    are `ImageSensor.shown`, with the grey noise of ideal images."""

    def __init__(
        self, lens: Lens, params: CameraParams, lamp: LampParams, light: str, key: list[int]
    ) -> None:
        self._params, self._lamp, self._lens = params, lamp, lens
        self._image_sensor = image_sensor.ImageSensor(lens)
        self._lux = LIGHT_LUX[light]
        self.takes_time = takes_time(params, light)
        height = params.height
        self._row_s = (np.arange(height) / max(height - 1, 1) - 1.0) * params.readout_s
        self._identity = identity_shifts(height)
        self._control = AutoExposure(params)
        if self.takes_time:
            self._noise = image_sensor.sensor_noise(height, params.width, key)
        self.effects: Effects | None = None
        """where light, exposure and lamp of every image are noted"""
        self._field = lamp_field(lamp, lens.raster) if lamp.below_m > 0.0 else None

    def develop(
        self,
        drawn: Bytes,
        depth: InverseDepth,
        motion: CameraMotion | None,
        end_s: float,
        time_s: float,
        grey_noise: NDArray[np.int8],
        place: image_sensor.NoisePlace,
    ) -> tuple[Bytes, float]:
        """(H, W, 3) image of a raster, bottom row first, and the fraction of saturation that white
        gets. ``motion`` about the drawing; ``end_s``: time from it to the last row. None: at rest,
        with an exposure that has settled."""
        if not self.takes_time:
            shifts = self._identity if motion is None else self._at(motion, end_s, 0.0, 1)
            return self._image_sensor.shown(drawn, depth, shifts, grey_noise, place), 1.0
        lamp = self._field if shines(self._lamp, depth, self._lux) else None
        lux = image_sensor.mean_light(drawn, depth, lamp, self._lux)
        shifts = self._identity
        if motion is None:
            exposure = self._control.settled(lux)
        else:
            exposure = self._control.follow(lux, time_s)
            count = self._instants(motion, end_s, exposure, depth)
            shifts = self._at(motion, end_s, exposure.time_s, count)
        self._note(exposure, lux, lit=lamp is not None)
        light = self._exposed(exposure, lamp)
        image = self._image_sensor.exposed(drawn, depth, shifts, self._noise, place, light)
        return image, light.electrons * light.gain / light.full_well

    def _note(self, exposure: "Exposure", lux: float, *, lit: bool) -> None:
        if self.effects is None:
            return
        self.effects.note(("lamp",), float(lit))
        if not lit:
            self.effects.note(("light_lux",), 1.0, lux)
        self.effects.note(("exposure_ms",), 1.0, 1e3 * exposure.time_s)
        self.effects.note(("gain",), 1.0, exposure.gain)
        self.effects.note(("exposure_error_stops",), 1.0, abs(self._control.error_stops))

    def _exposed(self, exposure: "Exposure", lamp: LampField | None) -> image_sensor.Exposed:
        p = self._params
        per_lux = p.electrons_per_lux_s * exposure.time_s
        return image_sensor.Exposed(
            electrons=per_lux * self._lux,
            full_well=p.full_well_e,
            read_noise=p.read_noise_e,
            gain=exposure.gain,
            lamp=lamp,
            electrons_per_lux=per_lux,
        )

    def _at(self, motion: CameraMotion, end_s: float, time_s: float, count: int) -> Array:
        """(H, count, 12) coefficients of the instants of every row's exposure."""
        within = ((np.arange(count) + 0.5) / count - 0.5) * time_s
        return row_shifts(motion, self._lens.raster, end_s + self._row_s[:, None] + within)

    def _instants(
        self, motion: CameraMotion, end_s: float, exposure: "Exposure", depth: InverseDepth
    ) -> int:
        rows = np.linspace(0, len(self._row_s) - 1, 5).astype(int)
        ends = np.array([-0.5, 0.5]) * exposure.time_s
        coefficients = row_shifts(
            motion, self._lens.raster, end_s + self._row_s[rows][:, None] + ends
        )
        near = depth.far + depth.per_level * float(np.quantile(depth.levels[::32, ::32], 0.9))
        longest = float(longest_shift(coefficients, self._lens.raster, near).max())
        if longest < _SHARP_PX:
            return 1
        return min(max(math.ceil(longest / _STEP_PX), 2), _MAX_INSTANTS)


MIDDLE_GREY = (110.0 / 255.0) ** 2.2
"""fraction of saturation to which the mean of an image is brought: a display level of 110"""
_DARK = 1e-12


@dataclass(frozen=True, slots=True)
class Exposure:
    """Time that each row collects light, and amplification of its signal."""

    time_s: float
    gain: float


class AutoExposure:
    """Brings the mean of images to a middle grey: the logarithm of time times gain follows what the
    light asks for as a first-order system. The first image is exposed as it should be."""

    def __init__(self, params: CameraParams) -> None:
        self._params = params
        self._level: float | None = None
        self.error_stops = 0.0
        """of the latest image: by how many factors of two it is over- or underexposed"""
        self._time_s = 0.0

    def settled(self, lux: float) -> Exposure:
        """The exposure of a scene with the mean ``lux`` (illuminance times reflectivity) once it
        has settled."""
        return self._split(self._wanted(lux))

    def follow(self, lux: float, time_s: float) -> Exposure:
        """The exposure of an image at ``time_s``; times ascend."""
        wanted, lag = self._wanted(lux), self._params.exposure_lag_s
        if self._level is None or lag <= 0.0 or time_s < self._time_s:
            self._level = wanted
        else:
            fraction = 1.0 - math.exp(-(time_s - self._time_s) / lag)
            self._level += fraction * (wanted - self._level)
        self._time_s = time_s
        self.error_stops = (self._level - wanted) / math.log(2.0)
        return self._split(self._level)

    def _wanted(self, lux: float) -> float:
        p = self._params
        needed = p.gain * MIDDLE_GREY * p.full_well_e / (p.electrons_per_lux_s * max(lux, _DARK))
        longest = max(p.exposure_max_s, p.exposure_min_s)
        return math.log(min(max(needed, p.exposure_min_s), longest * p.gain_max))

    def _split(self, level: float) -> Exposure:
        """Time first, gain only beyond the longest time: it adds no light."""
        p, product = self._params, math.exp(level)
        time_s = min(max(product, p.exposure_min_s), max(p.exposure_max_s, p.exposure_min_s))
        return Exposure(time_s, min(max(product / time_s, 1.0), p.gain_max))
