"""The keys that follow from a vehicle's MJCF: gains, limits, battery and the kind of LIDAR.

They stand above profile and preset and below all other sources of a key. Those of the default
vehicle are the defaults of the keys: its design gives them unchanged.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from touchdown.controller.api import ControlParams
from touchdown.experiments.config.keys import base_in
from touchdown.experiments.errors import UsageError
from touchdown.landing.api import LandingParams
from touchdown.scenes.api import DEFAULT_VEHICLE, vehicle_file
from touchdown.sim.api import GRAVITY_MPS2, SimParams, VehicleModel

if TYPE_CHECKING:
    from touchdown.controller.design import LoopMargin

_TILTED_THRUST = 0.65
"""fraction of the rotors' thrust that carries the weight at the largest tilt; the rest is for
gusts and torques"""
_WIND_TILT_DEG = 4.0
"""of the largest tilt, left for the loops"""
_SLOPE_FRACTION = 1.0 / 3.0
"""of the slope on which it tips, that may be landed on: wind, and steps on the slope"""
_J_PER_KG = SimParams().battery_capacity_j / 4.2
"""usable energy of a vehicle that names none, by its mass: that of the default"""


class Examined(NamedTuple):
    """A vehicle that can fly, and what follows from it."""

    vehicle: VehicleModel
    control: ControlParams
    """with the designed gains"""
    margins: tuple[LoopMargin, ...]
    max_tilt_deg: float
    max_descent_mps: float
    """of the vortex ring"""
    max_slope_deg: float
    max_jerk_mps3: float
    battery_j: float
    battery_ohm: float
    lidar: str


def examined(name: str) -> Examined:
    """Reads, checks and designs a vehicle. Raises UsageError, one line: what is wrong with its file
    and what would be right."""
    try:
        file = vehicle_file(name)
        stamp = file.stat().st_mtime_ns if file.is_file() else 0
        return _examined(name, str(Path(file).resolve()), stamp)
    except (ValueError, OSError) as error:
        text = str(error)
        where = "" if name in text else f"vehicle '{name}': "
        raise UsageError(f"{where}{text}") from None


@functools.cache
def _examined(name: str, _path: str, _stamp: int) -> Examined:
    from touchdown.controller.cascade import jerk_limit_mps3
    from touchdown.controller.design import checked_margins, designed
    from touchdown.scenes.compose import vehicle_spec
    from touchdown.sim.airframe.battery import PowerSystem
    from touchdown.sim.airframe.checks import (
        checked_vehicle,
        induced_speed_mps,
        tipping_slope_deg,
    )
    from touchdown.sim.airframe.vehicle import optional_number, power_system

    spec = vehicle_spec(name)
    model = spec.compile()
    vehicle = checked_vehicle(model)
    control = designed(vehicle, ControlParams())
    cells = power_system(model, prefix="").cells / PowerSystem().cells
    usual_j = _J_PER_KG * vehicle.mass_kg
    battery_j = float(
        round(3600.0 * optional_number(model, "battery_wh", 0.0, prefix="") or usual_j)
    )
    usual_ohm = SimParams().battery_resistance_ohm * cells**2 * SimParams().battery_capacity_j
    weight = vehicle.mass_kg * GRAVITY_MPS2
    full = len(vehicle.rotor_spin) * vehicle.thrust_coefficient * vehicle.rotor_speed_max**2
    return Examined(
        vehicle=vehicle,
        control=control,
        margins=tuple(checked_margins(vehicle, control)),
        max_tilt_deg=round(math.degrees(math.acos(min(weight / (_TILTED_THRUST * full), 1.0))), 1),
        max_descent_mps=round(induced_speed_mps(model), 2),
        max_slope_deg=round(_SLOPE_FRACTION * tipping_slope_deg(model), 2),
        max_jerk_mps3=jerk_limit_mps3(control),
        battery_j=battery_j,
        battery_ohm=round(
            optional_number(model, "battery_resistance", usual_ohm / battery_j, prefix=""), 6
        ),
        lidar=next((text.data for text in spec.texts if text.name == "lidar"), "horizon"),
    )


def vehicle_values(values: Mapping[str, Any], lower: Mapping[str, Any]) -> dict[str, Any]:
    """The values by dotted key that the vehicle of ``values`` sets over those of profile and
    preset, ``lower``. Raises UsageError for one that cannot fly."""
    name = base_in(values, "vehicle")
    return {} if name == DEFAULT_VEHICLE else values_of(examined(name), lower)


def values_of(found: Examined, lower: Mapping[str, Any]) -> dict[str, Any]:
    """As `vehicle_values`, without keys that stay as they are."""
    usual, landing, sim = ControlParams(), LandingParams(), SimParams()
    gains = [
        name
        for name in usual.__dataclass_fields__
        if getattr(usual, name) != getattr(found.control, name)
    ]
    before: dict[str, Any] = {
        "control.max_tilt_deg": usual.max_tilt_deg,
        "landing.wind_tilt_deg": landing.wind_tilt_deg,
        "landing.descent_speed_mps": landing.descent_speed_mps,
        "landing.max_slope_deg": landing.max_slope_deg,
        "landing.climb_speed_mps": landing.climb_speed_mps,
        "landing.accel_mps2": landing.accel_mps2,
        "sim.battery_capacity_j": sim.battery_capacity_j,
        "sim.battery_resistance_ohm": sim.battery_resistance_ohm,
        "lidar.preset": "horizon",
        **lower,
    }  # fmt: skip
    up = found.control.velocity_z_radps / usual.velocity_z_radps
    aside = found.control.velocity_xy_radps / usual.velocity_xy_radps
    # References are as much slower as the loops that follow them.
    limits = {
        "landing.climb_speed_mps": up * before["landing.climb_speed_mps"],
        "landing.accel_mps2": aside * before["landing.accel_mps2"],
        "control.max_tilt_deg": found.max_tilt_deg,
        "landing.wind_tilt_deg": found.max_tilt_deg - _WIND_TILT_DEG,
        "landing.descent_speed_mps": min(
            found.max_descent_mps, up * before["landing.descent_speed_mps"]
        ),
        "landing.max_slope_deg": found.max_slope_deg,
    }
    own = {
        **{f"control.{name}": getattr(found.control, name) for name in gains},
        **{key: min(limit, before[key]) for key, limit in limits.items()},
        "sim.battery_capacity_j": found.battery_j,
        "sim.battery_resistance_ohm": found.battery_ohm,
        "lidar.preset": found.lidar,
    }  # fmt: skip
    return {key: value for key, value in own.items() if value != before.get(key)}
