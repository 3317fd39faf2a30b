"""Simulation of the world: clock, physics, wind, sensors, faults.

`api`, `frames` and `typing` are open to all folders; `world` is the flight, `posed_sensors` views
without a flight. Nothing here estimates, decides or controls.
"""
