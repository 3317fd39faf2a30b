"""Random draws of a flight: independent over scenes and seeds, the same for every method."""

from contextlib import closing

import numpy as np
import pytest
from numpy.typing import NDArray

from touchdown.experiments.config.loading import load_config
from touchdown.experiments.config.schema import Config
from touchdown.experiments.flight.estimator_calibration import nominal_rig
from touchdown.experiments.flight.wiring import make_world
from touchdown.sim.api import Command
from touchdown.sim.imu import ImuSensor
from touchdown.sim.wind import Wind

from support.livo_flight import make_rig
from support.places import cached_scene

FLIGHTS = 150
FIELD = load_config(profile_default="field")


def configured(
    scene: str, seed: int = 0, estimator: str = "livo", layout: int | None = None
) -> Config:
    told = {"scene": scene, "seed": seed, "estimator": estimator, "scene_seed": layout}
    return FIELD.model_copy(update=told)


def drawn(scene: str, seed: int) -> list[float]:
    """One number each of the IMU's noise and scale, of the wind and of a mount."""
    config = configured(scene, seed)
    imu, wind = (
        ImuSensor(config.imu, 1000, 5, config.world_seed, 400.0),
        Wind(config.wind, config.world_seed),
    )
    still = imu.sample(0, np.eye(3), np.eye(3), np.zeros(3), np.zeros(3))
    mount = nominal_rig(make_rig(), config).body_from_lidar.rotation
    gust = wind.step(0.001, 10.0, 5.0)[2]
    return [
        still.angular_velocity[0],
        imu.errors.matrix[0, 0],
        wind.mean_direction[0],
        gust,
        mount[0, 1],
    ]


@pytest.mark.parametrize("other", ["lake", "places/crossroad-2.xml"])
def test_two_scenes_share_no_draws(other: str) -> None:
    here, there = (
        np.array([drawn(scene, seed) for seed in range(FLIGHTS)]) for scene in ("crossroad", other)
    )
    assert (np.ptp(here, axis=0) > 0.0).all()
    for one, two in zip(here.T, there.T, strict=True):
        # a correlation by chance has a standard deviation of 1 / sqrt(FLIGHTS)
        assert abs(np.corrcoef(one, two)[0, 1]) < 4.0 / np.sqrt(FLIGHTS)


def readings(config: Config) -> NDArray[np.float64]:
    with closing(make_world(config, cached_scene("flat"))) as world:
        obs = world.step(Command(rotor_speed_radps=np.zeros(4)))
        return np.concatenate(
            [obs.imu[-1].angular_velocity, world.truth().wind_world,
             nominal_rig(world.rig, config).body_from_lidar.rotation.ravel()]
        )  # fmt: skip


def test_methods_over_one_scene_and_seed_are_pairs() -> None:
    livo = readings(configured("crossroad", 3))
    assert (readings(configured("crossroad", 3, "gps")) == livo).all()
    assert (readings(configured("lake", 3)) != livo).all()


def test_a_unit_is_a_scene_and_a_seed_or_a_layout_that_is_kept() -> None:
    units = [
        configured(*place).unit
        for place in (("lake", 1), ("lake", 1, "gps"), ("lake", 2), ("forest", 1))
    ]
    assert units[0] == units[1] and len({*units}) == 3
    assert configured("lake", 1, layout=7).unit == configured("lake", 2, layout=7).unit
