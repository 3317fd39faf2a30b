"""Comparison of ray casters: agreement of their ranges, and the reported figures."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from touchdown.experiments.benchmarks.lidar import ReferenceCasters
from touchdown.experiments.cli.main import cli
from touchdown.sim.api import LidarParams

from support.places import cached_scene


def test_casters_agree_on_the_ranges() -> None:
    """MuJoCo's casters agree to the last digits, Embree within its single precision, except on
    moving cars, which its merged scene omits; the noiseless sensor where it returns."""
    scene = cached_scene("crossroad")
    params = LidarParams(range_sigma_m=0.0, angle_sigma_deg=0.0, divergence=False)
    references = ReferenceCasters(scene, params, 0)
    casters = references.casters(np.array([*scene.takeoff_xy_m, 30.0]), 4)
    distances = {name: np.array(cast()) for name, cast in casters.items()}
    multi = distances["mj_multiRay"]
    assert (multi > 0.0).mean() > 0.99
    assert np.mean(np.abs(distances["embree"] - multi) < 1e-3) > 0.98
    returned = distances["sensor"] > 0.0
    assert returned.mean() > 0.9
    assert np.mean(np.abs(distances["sensor"] - multi)[returned] < 2e-3) > 0.9
    if "mujoco_lidar" in distances:
        np.testing.assert_allclose(distances["mujoco_lidar"], multi, atol=1e-4)


def test_figures_of_the_command() -> None:
    done = CliRunner().invoke(cli, ["bench", "lidar", "--rounds", "1", "--json"])
    assert done.exit_code == 0, done.output
    figures = json.loads(done.stdout)
    assert figures["rays_per_scan"] == 24_000 and {"embree", "mj_multiRay"} <= set(figures["ratio"])
    for name, ratio in figures["ratio"].items():
        expected = figures["rays_per_s"]["sensor"] / figures["rays_per_s"][name]
        assert ratio == pytest.approx(expected)
