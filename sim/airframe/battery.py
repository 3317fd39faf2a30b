"""The energy that a flight draws."""

from __future__ import annotations

DRIVE_EFFICIENCY = 0.75
"""Shaft power / battery power of motor, speed controller and wiring."""

HOTEL_LOAD_W = 12.0 + 20.0 + 3.5 + 4.5
"""LIDAR (Livox Horizon data sheet), onboard computer, camera, flight controller and radio."""


class Battery:
    """Counts energy. Voltage sag is not modelled; ``fraction`` is of the usable energy."""

    def __init__(self, capacity_j: float) -> None:
        if not capacity_j > 0.0:
            raise ValueError(f"sim.battery_capacity_j must be above 0, not {capacity_j}")
        self._capacity_j = capacity_j
        self.energy_used_j = 0.0

    @property
    def fraction(self) -> float:
        """Usable energy left, 1 at take-off, never below 0."""
        return max(0.0, 1.0 - self.energy_used_j / self._capacity_j)

    @property
    def empty(self) -> bool:
        return self.energy_used_j >= self._capacity_j

    def draw(self, shaft_power_w: float, duration_s: float) -> None:
        """Draws the energy of ``duration_s`` at ``shaft_power_w``, the mechanical power of all
        rotors."""
        self.energy_used_j += (shaft_power_w / DRIVE_EFFICIENCY + HOTEL_LOAD_W) * duration_s
