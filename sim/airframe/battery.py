"""The energy that a flight draws, and the voltage that is left.

The open-circuit voltage of a cell over its charge is that of Chen and Rincon-Mora, "Accurate
electrical battery model capable of predicting runtime and I-V performance" (IEEE Trans. Energy
Conversion 21, 2006), for a lithium-polymer cell. Behind it is a constant resistance.
"""

import math
from typing import NamedTuple

DRIVE_EFFICIENCY = 0.75
"""Shaft power / battery power of motor, speed controller and wiring."""


class PowerSystem(NamedTuple):
    """What a vehicle carries beside its motors, from its MJCF."""

    cells: float = 6.0
    """in series"""
    avionics_w: float = 12.0 + 20.0 + 3.5 + 4.5
    """LIDAR (Livox Horizon data sheet), onboard computer, camera, flight controller and radio"""


def open_circuit_voltage(charge: float, cells: float = 6.0) -> float:
    """Volts of all cells at ``charge`` from 0 to 1."""
    cell = (
        3.685 - 1.031 * math.exp(-35.0 * charge) + 0.2156 * charge
        - 0.1178 * charge**2 + 0.3201 * charge**3
    )  # fmt: skip
    return cells * cell


class Battery:
    """Counts energy; ``fraction`` is of the usable energy. With ``sag``, the voltage falls with the
    charge and with the load over ``resistance_ohm``, and with it the rotor speed within reach."""

    def __init__(
        self,
        capacity_j: float,
        sag: bool = False,
        resistance_ohm: float = 0.0,
        power: PowerSystem | None = None,
    ) -> None:
        self._power = power = power or PowerSystem()
        self._capacity_j = capacity_j
        self._sag, self._resistance_ohm = sag, resistance_ohm
        self._full_v = open_circuit_voltage(1.0, power.cells)
        self.voltage = self._full_v
        """at the terminals, V"""
        self.energy_used_j = 0.0

    @property
    def fraction(self) -> float:
        """Usable energy left, 1 at take-off, never below 0."""
        return max(0.0, 1.0 - self.energy_used_j / self._capacity_j)

    @property
    def empty(self) -> bool:
        return self.energy_used_j >= self._capacity_j

    @property
    def speed_fraction(self) -> float:
        """Highest rotor speed within reach over that of a full battery without load; 1 without sag.
        A motor's speed at full throttle is proportional to its voltage."""
        return self.voltage / self._full_v if self._sag else 1.0

    def draw(self, shaft_power_w: float, duration_s: float) -> None:
        """Draws the energy of ``duration_s`` at ``shaft_power_w``, the mechanical power of all
        rotors."""
        power = shaft_power_w / DRIVE_EFFICIENCY + self._power.avionics_w
        if self._sag:
            inside = open_circuit_voltage(self.fraction, self._power.cells)
            # Power at the terminals is V (inside - V) / R; half the inside voltage gives the most.
            left = inside * inside - 4.0 * self._resistance_ohm * power
            self.voltage = 0.5 * (inside + math.sqrt(max(left, 0.0)))
            power *= inside / self.voltage
        self.energy_used_j += power * duration_s
