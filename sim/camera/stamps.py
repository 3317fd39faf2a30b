"""When a camera exposes, and the stamps that its driver writes."""

from __future__ import annotations

import math
from typing import NamedTuple
from zlib import crc32

import numpy as np

from touchdown.sim.api import CameraParams, SimParams
from touchdown.sim.clock import readout_ticks


class Stamp(NamedTuple):
    """A time in seconds and the tick nearest to it."""

    tick: int
    time_s: float


class ShutterClock:
    """Ticks of a camera. A pulse is the middle of the last row's exposure, on a whole tick.

    phase_ticks: of the pulses after those of the LIDAR's clock. before_ticks: from the tick that is
    drawn to the pulse. after_ticks: from the pulse to the end of its exposure. span_ticks: from the
    beginning of the first row's exposure to the end of the last.
    """

    def __init__(self, params: CameraParams, sim: SimParams, seed: int, takes_time: bool) -> None:
        self._params, self._hz, self._seed = params, sim.tick_hz, seed
        readout = readout_ticks(params.readout_s, sim)
        longest = max(params.exposure_max_s, params.exposure_min_s) if takes_time else 0.0
        self.after_ticks = math.ceil(0.5 * longest * sim.tick_hz)
        self.before_ticks = readout // 2
        self.span_ticks = math.ceil(params.readout_s * sim.tick_hz) + 2 * self.after_ticks
        most = round(params.phase_s * sim.tick_hz)
        if most >= sim.camera_ticks:
            raise ValueError(
                f"camera.phase_s is {params.phase_s:g}, but the camera's clock beats every "
                f"{sim.camera_ticks / sim.tick_hz:.4g} s: give less"
            )
        draw = np.random.default_rng([seed, crc32(b"camera clock")])
        self.phase_ticks = int(draw.integers(0, most + 1)) if most else 0

    def stamp(self, pulse: int) -> Stamp:
        """The stamp of the image of a pulse."""
        p = self._params
        if p.stamp_delay_s == 0.0 and p.stamp_jitter_s == 0.0:
            return Stamp(pulse, pulse / self._hz)
        error = p.stamp_delay_s
        if p.stamp_jitter_s > 0.0:
            draw = np.random.default_rng([self._seed, crc32(b"camera stamps"), pulse])
            error += p.stamp_jitter_s * float(draw.standard_normal())
        time_s = max(pulse / self._hz + error, 0.0)
        return Stamp(round(time_s * self._hz), time_s)
