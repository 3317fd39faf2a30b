"""Messages of the small sensors of a recording."""

from collections.abc import Callable
from typing import Any

import numpy as np

from touchdown.experiments.recordings.clock import Clock
from touchdown.experiments.recordings.contract import NavTable
from touchdown.sim.api import BarometerSample, GpsFix, MagnetometerSample

_STANDARD_PA, _LAPSE, _EXPONENT = 101_325.0, 44_330.77, 0.190263
"""of the standard atmosphere: height = lapse (1 - (p / p0) ** exponent)"""


def small_messages(table: NavTable | None, clock: Clock) -> Callable[[int], dict[str, Any]]:
    """A function of the ticks of observations, in order, that gives their messages by field: each
    sample once, at the first observation after it."""
    if table is None:
        return lambda _tick: {}
    heights = _LAPSE * (1.0 - (table.pressures_pa / _STANDARD_PA) ** _EXPONENT)
    heights = heights - heights[:1]

    def fix(tick: int, time_s: float, row: int) -> GpsFix:
        values = table.fixes[row]
        return GpsFix(
            tick=tick, time_s=time_s, position_world=values[:3], velocity_world=values[3:6],
            sigma_position_m=values[6:9], sigma_velocity_mps=float(values[9]),
        )  # fmt: skip

    def pressure(tick: int, time_s: float, row: int) -> BarometerSample:
        return BarometerSample(
            tick=tick, time_s=time_s, pressure_pa=float(table.pressures_pa[row]),
            altitude_m=float(heights[row]),
        )  # fmt: skip

    def field(tick: int, time_s: float, row: int) -> MagnetometerSample:
        return MagnetometerSample(tick=tick, time_s=time_s, field_body_ut=table.fields_ut[row])

    makers = {"gps": (table.fix_ns, fix), "barometer": (table.pressure_ns, pressure),
              "magnetometer": (table.field_ns, field)}  # fmt: skip
    ticks = {
        name: np.rint((stamps - clock.start_ns) * (clock.tick_hz * 1e-9)).astype(np.int64)
        for name, (stamps, _) in makers.items()
    }
    given = {name: int(np.searchsorted(at, 1)) for name, at in ticks.items()}

    def messages(tick: int) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name, (_, make) in makers.items():
            first, last = given[name], int(np.searchsorted(ticks[name], tick, side="right"))
            given[name] = last
            found[name] = tuple(
                make(int(ticks[name][row]), float(ticks[name][row] / clock.tick_hz), row)
                for row in range(first, last)
            )
        return found

    return messages
