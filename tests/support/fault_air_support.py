"""A LIDAR that looks down through fog or rain."""

from typing import Any

from touchdown.sim.api import FaultParams, LidarParams, LidarScan
from touchdown.sim.faults.disturbances import Weather
from touchdown.sim.lidar.sensor import LidarSensor

from support.fault_support import HZ
from support.lidar_support import BRIGHT, DOWN, PERFECT, make_scene, track


def look_down(
    world: str, height: float, *events: str, params: LidarParams = PERFECT, **faults: Any
) -> LidarScan:
    weather = Weather(FaultParams(events=events, **faults), HZ) if events else None
    sensor = LidarSensor(make_scene(world, {"plane": BRIGHT}), params, 1, weather)
    return sensor.scan(0, 60, HZ, track((0, 60), height), DOWN, {})
