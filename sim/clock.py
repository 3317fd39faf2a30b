"""Integer time: compatibility of rates."""

from __future__ import annotations

from touchdown.sim.api import SensorNeeds, SimParams

MIN_TICK_HZ = 500
"""The feet are 30 ms stiff; slower physics would not resolve a touchdown."""


def check_rates(sim: SimParams, needs: SensorNeeds) -> None:
    """Raises ValueError, with the allowed values, unless every rate divides ``tick_hz`` and the
    needed camera rate divides the camera's own clock."""
    if sim.tick_hz < MIN_TICK_HZ:
        raise ValueError(f"sim.tick_hz must be {MIN_TICK_HZ} or more, not {sim.tick_hz}")
    for name in ("control_ticks", "imu_ticks", "camera_ticks", "lidar_scan_ticks"):
        ticks = getattr(sim, name)
        if ticks < 1 or sim.tick_hz % ticks:
            raise ValueError(
                f"sim.{name} is {ticks}, but it must divide sim.tick_hz ({sim.tick_hz}): "
                f"one of {_divisors(sim.tick_hz)}"
            )
    if sim.compute_latency_ticks < 0:
        raise ValueError(
            f"sim.compute_latency_ticks must be 0 or more, not {sim.compute_latency_ticks}"
        )
    needs.check_camera_rate(sim.tick_hz // sim.camera_ticks)


def image_period_ticks(sim: SimParams, needs: SensorNeeds) -> int:
    """Ticks between two images; 0 when none are needed."""
    return sim.tick_hz // needs.camera_hz if needs.camera_hz else 0


def readout_ticks(readout_s: float, sim: SimParams) -> int:
    """Ticks between the first and the last row of a rolling shutter; 0 for a global one.

    Raises ValueError if the readout would last into the next exposure.
    """
    ticks = round(readout_s * sim.tick_hz)
    if ticks >= sim.camera_ticks:
        raise ValueError(
            f"camera.readout_s is {readout_s:g}, but the camera's clock beats every "
            f"{sim.camera_ticks / sim.tick_hz:.4g} s: give less"
        )
    return ticks


def _divisors(number: int) -> str:
    return ", ".join(str(i) for i in range(1, number + 1) if number % i == 0)
