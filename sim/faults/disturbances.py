"""Scheduled disturbances of vehicle and air, and the weather, as functions of the tick alone.

- motor: a motor that has lost the fraction g of its efficiency turns its rotor at sqrt(1 - g) of
the
  demanded speed, so that thrust and drag torque both fall to 1 - g: the loss of effectiveness
  u' = (1 - g) u of the literature on faulty actuators (Zhang and Jiang, "Bibliographical review on
  reconfigurable fault-tolerant control systems", Annual Reviews in Control 32, 2008);
- gust: the discrete gust of MIL-F-8785C, V = Vm / 2 (1 - cos(pi x / d)), x the distance into it.
  A hovering vehicle is swept by it: x / d is time over the time of rise. Past its peak it falls
  as it rose, and a fault is a row of such gusts (they may be used singly or in multiples);
- miscalibration: the LIDAR sits rotated and displaced on the body, by stated amounts, about an axis
  and in a direction drawn from the seed;
- fog weakens light by exp(-e d) over the distance d (Beer and Lambert), e = 3.912 / V with the
  visibility V (Koschmieder, 1924: contrast falls to 2 % there), times (wavelength / 550 nm)^-q; q
  is 0 below V = 500 m, where droplets are larger than any wavelength used (Kim, McArthur and
  Korevaar, Proc. SPIE 4214, 2001);
- rain: 1.076 R^0.67 dB/km at R mm/h (Carbonneau; Recommendation ITU-R P.1814).
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from touchdown.sim.api import Fault, FaultParams
from touchdown.sim.faults.marks import Marks
from touchdown.sim.faults.types import MAX_MOTOR_LOSS
from touchdown.sim.frames import Pose, so3_exp
from touchdown.sim.noise import random_stream
from touchdown.sim.typing import Array


class Happening:
    """Times of all faults of one kind."""

    def __init__(
        self, params: FaultParams, kind: str, tick_hz: int, marks: Marks | None = None
    ) -> None:
        self.faults = [fault for fault in params.schedule() if fault.kind == kind]
        self._marks = marks or Marks(self.faults, tick_hz)

    def since(self, tick: int) -> int | None:
        """Ticks since the beginning of the first fault that is active at ``tick``, or None. A fault
        is no longer active at its end."""
        for fault in self.faults:
            start, end = self._marks.span(fault)
            if start <= tick < end:
                return tick - int(start)
        return None


class Disturbances:
    """Disturbances of rotors, air and mounts at a tick; none without a schedule.

    ``mean_wind_kmh`` is part of the speed that gusts blow up to.
    """

    def __init__(
        self,
        params: FaultParams,
        tick_hz: int,
        mean_wind_kmh: float,
        seed: int,
        marks: Marks | None = None,
        rotors: int = 4,
    ) -> None:
        if params.motor >= rotors:
            raise ValueError(
                f"faults.motor = {params.motor} is none of the vehicle's rotors, 0 to {rotors - 1}"
            )
        if rotors <= 4 and params.motor_loss_fraction > MAX_MOTOR_LOSS:
            raise ValueError(
                f"faults.motor_loss_fraction = {params.motor_loss_fraction:g} leaves four rotors "
                f"without a level hover: at most {MAX_MOTOR_LOSS:g}, or a vehicle with more rotors"
            )
        self._params, self._tick_hz = params, tick_hz
        self._marks = marks or Marks(params.schedule(), tick_hz)
        self._motor = Happening(params, "motor_loss", tick_hz, self._marks)
        self._mount = Happening(params, "miscalibration", tick_hz)
        self._gusts = [fault for fault in params.schedule() if fault.kind == "gust"]
        self._peak_mps = (params.gust_kmh - mean_wind_kmh) / 3.6
        self._speed_fraction = np.ones(rotors)
        self._speed_fraction[params.motor] = math.sqrt(1.0 - params.motor_loss_fraction)
        self._knock = _knock(params, seed) if self._mount.faults else None
        self._acted = {"motor_loss": 0, "gust": 0}
        self._largest_gust_mps = 0.0

    def rotor_speed_fraction(self, tick: int) -> Array | None:
        """(R,) fraction of the demanded rotor speeds that is reached, None: all of it."""
        if not self._motor.faults or self._motor.since(tick) is None:
            return None
        self._acted["motor_loss"] += 1
        return self._speed_fraction

    def add_gust(self, tick: int, mean_direction: Array, wind: Array) -> None:
        """Adds a gust to ``wind`` (3,) m/s, world frame, where there is one. ``mean_direction``
        (3,) is that of the mean wind."""
        if not self._gusts:
            return
        rise_s = self._params.gust_rise_s
        speed = 0.0
        for fault in self._gusts:
            phase = (tick - self._marks.span(fault)[0]) / self._tick_hz / rise_s
            if 0.0 < phase < 2.0 * gust_count(fault, rise_s):
                speed += gust_speed(phase, self._peak_mps)
        if speed == 0.0:
            return
        self._acted["gust"] += 1
        self._largest_gust_mps = max(self._largest_gust_mps, speed)
        degrees = self._params.gust_direction_deg
        if degrees is None:
            wind += speed * mean_direction
        else:
            wind[0] += speed * math.cos(math.radians(degrees))
            wind[1] += speed * math.sin(math.radians(degrees))

    def lidar_mount(self, tick: int, nominal: Pose) -> Pose:
        """The true ``body_from_lidar`` of a scan that ends at ``tick``, where the undisturbed one
        is ``nominal``. Safe in any thread."""
        if self._knock is None or self._mount.since(tick) is None:
            return nominal
        return Pose(
            nominal.rotation @ self._knock.rotation, nominal.translation + self._knock.translation
        )

    def summary(self, step_s: float) -> list[dict[str, Any]]:
        """Records of the faults of rotors and air: ``acted_s``, the time for which they acted in
        steps of ``step_s``, and ``gust_mps``, the largest speed of a gust."""
        acted_s = {kind: step_s * steps for kind, steps in self._acted.items()}
        found: list[dict[str, Any]] = []
        for kind, faults, more in (
            ("motor_loss", self._motor.faults, {}),
            ("gust", self._gusts, {"gust_mps": self._largest_gust_mps}),
        ):
            if faults:
                text = ", ".join(fault.text for fault in faults)
                began_s = self._marks.began_s(faults[0])
                found.append({"fault": text, "acted_s": acted_s[kind], "began_s": began_s, **more})
        return found


def gust_speed(phase: float, peak_mps: float) -> float:
    """Speed of the discrete gust, ``phase`` in times of rise: 0 at 0, ``peak_mps`` at 1, 0 at 2."""
    return 0.5 * peak_mps * (1.0 - math.cos(math.pi * phase))


def gust_count(fault: Fault, rise_s: float) -> float:
    """Gusts of two times of rise: as many as a fault names, or as fit into its duration, at least
    one; without either they end with the flight."""
    if fault.count is not None:
        return fault.count
    if fault.duration_s is None:
        return math.inf
    return max(1, math.floor(fault.duration_s / (2.0 * rise_s) + 1e-9))


def _knock(params: FaultParams, seed: int) -> Pose:
    """Rotation (LIDAR axes) and translation (body axes) of exactly the stated sizes."""
    axis, way = random_stream(seed, "miscalibration").standard_normal((2, 3))
    rotation = math.radians(params.miscalibration_deg) * axis / np.linalg.norm(axis)
    return Pose(so3_exp(rotation), params.miscalibration_m * way / np.linalg.norm(way))


KOSCHMIEDER = 3.912
REFERENCE_NM = 550.0


def fog_extinction(visibility_m: float, wavelength_nm: float = REFERENCE_NM) -> float:
    """1/m at a meteorological optical range in metres, by Koschmieder and Kim."""
    km = visibility_m / 1000.0
    if km < 0.5:
        q = 0.0
    elif km < 1.0:
        q = km - 0.5
    elif km < 6.0:
        q = 0.16 * km + 0.34
    else:
        q = 1.3 if km < 50.0 else 1.6
    return KOSCHMIEDER / visibility_m * (wavelength_nm / REFERENCE_NM) ** -q


def rain_extinction(rate_mmph: float) -> float:
    """1/m at a rain rate in mm/h, for all wavelengths of light."""
    decibel_per_km = 1.076 * rate_mmph**0.67
    return decibel_per_km / (10.0 * math.log10(math.e) * 1000.0)


@dataclass(frozen=True)
class Air:
    """Fog and rain at an instant; ``visibility_m`` None: no fog."""

    visibility_m: float | None = None
    rain_mmph: float = 0.0

    @property
    def faults(self) -> tuple[str, ...]:
        """Kinds of faults that it consists of."""
        kinds = ("fog", self.visibility_m is not None), ("rain", self.rain_mmph > 0.0)
        return tuple(kind for kind, there in kinds if there)

    def extinction(self, wavelength_nm: float = REFERENCE_NM) -> float:
        """1/m, fog and rain together."""
        fog = 0.0
        if self.visibility_m is not None:
            fog = fog_extinction(self.visibility_m, wavelength_nm)
        return fog + rain_extinction(self.rain_mmph)


class Weather:
    """The air at every tick; ``at`` gives None for clear air."""

    def __init__(self, params: FaultParams, tick_hz: int) -> None:
        self._params = params
        self._fog = Happening(params, "fog", tick_hz)
        self._rain = Happening(params, "rain", tick_hz)

    @property
    def ever(self) -> bool:
        """True if the schedule contains fog or rain."""
        return bool(self._fog.faults or self._rain.faults)

    def at(self, tick: int) -> Air | None:
        foggy = self._fog.since(tick) is not None
        wet = self._rain.since(tick) is not None and self._params.rain_mmph > 0.0
        if not foggy and not wet:
            return None
        return Air(
            visibility_m=self._params.fog_visibility_m if foggy else None,
            rain_mmph=self._params.rain_mmph if wet else 0.0,
        )
