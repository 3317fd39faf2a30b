"""What sensors measured with a seed, they measure again.

``seeds.json`` holds a few numbers of all messages of some seconds: carried along a path by every
sensor of three profiles, with other sensors, and hovering in gusts. After a wanted change
``PYTHONPATH=tests python tests/sim/test_seeds_stay.py`` writes them anew.
"""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.config.loading import load_config
from touchdown.experiments.flight.wiring import build_scene, world_params
from touchdown.sim.api import Command, SensorNeeds
from touchdown.sim.carried import CarriedWorld, FlownPath
from touchdown.sim.world import MujocoWorld

from support.marks import check, write

FILE = Path(__file__).with_name("seeds.json")
MESSAGES = ("imu", "scans", "images", "gps", "barometer", "magnetometer", "rangefinder")
LOOSE = {"pixels": 2e-3, "scans": 1e-4}
"""drawn by what the processor has; returns at an edge may be of either side"""
NEEDS = SensorNeeds(
    camera_hz=2, stereo=True, lidar=True, gps=True, barometer=True, magnetometer=True,
    rangefinder=True,
)  # fmt: skip
SETTINGS: Mapping[str, tuple[str, ...]] = {
    "ideal": ("scene=flat", "profile=ideal"),
    "field": ("scene=crossroad", "profile=field"),
    "harsh": ("scene=houses", "profile=harsh"),
    "dusk": (
        "scene=pools", "profile=field", "light=dusk", "lidar.preset=avia", "gps.preset=ublox-m8",
        "lidar.return_mode=strongest", "camera.auto_exposure=true",
    ),
    "all round": (
        "scene=flat", "profile=field", "lidar.preset=mid360", "camera.lens=fisheye",
        "camera.mount_deg=[0, -30, 0]", "gps.preset=rtk", "sim.latency_by_load=true",
        "imu.warm_up_k=10",
    ),
    "gusts": (
        "scene=dunes", "profile=harsh", "wind.mean_kmh=30", "sim.battery_sag=true",
        "vehicle_error.drag_fraction=0.2", "lidar.preset=os1_16", "camera.width=212",
        "camera.height=120",
    ),
}  # fmt: skip


def path() -> FlownPath:
    """Three seconds up from the ground, along an arc, rolling."""
    times = np.linspace(0.0, 3.0, 301)
    angle = 0.5 * times
    positions = np.column_stack([4.0 * np.sin(angle), 4.0 - 4.0 * np.cos(angle), 2.0 * times])
    half = 0.5 * 0.1 * np.sin(2.0 * times)
    quats = np.column_stack([np.cos(half), np.sin(half), 0.0 * half, 0.0 * half])
    return FlownPath(times, positions, quats)


def measured(what: str) -> dict[str, Any]:
    """All messages of a flight, and where the vehicle is in the end."""
    config = load_config(overrides=(*SETTINGS[what], "seed=7"))
    scene, params = build_scene(config), world_params(config)
    if what == "gusts":
        world: Any = MujocoWorld(scene, params, config.world_seed, NEEDS)
    else:
        world = CarriedWorld(scene, params, config.world_seed, path(), 6.0)
        world.require(NEEDS)
    world.reset()
    vehicle = world.rig.vehicle
    hover = np.sqrt(9.81 * vehicle.mass_kg / 4.0 / vehicle.thrust_coefficient)
    command = Command(rotor_speed_radps=np.full(4, 1.1 * hover))
    found: dict[str, Any] = defaultdict(list)
    seconds = 0.0
    while seconds < 3.5:
        obs = world.step(command)
        seconds = obs.time_s
        found["power"] += [obs.rotor_speed_radps, obs.battery_fraction]
        for name in MESSAGES:
            for message in getattr(obs, name):
                for field in fields(message):
                    group = "pixels" if field.name.endswith("rgb") else name
                    found[f"{group}, {field.name}"].append(getattr(message, field.name))
    pose = world.truth().world_from_body
    found["truth"] = [pose.translation, pose.rotation]
    found["rig"] = world.rig
    for group, effects in world.record().effects.items():
        group = group.replace("images", "pixels")
        found |= {f"{group}, {name}": effect for name, effect in effects.items()}
    world.close()
    return dict(found)


@pytest.mark.parametrize("what", SETTINGS)
def test_sensors_measure_what_they_measured(what: str) -> None:
    check(FILE, what, measured(what), LOOSE)


if __name__ == "__main__":
    write(FILE, {what: measured(what) for what in SETTINGS})
