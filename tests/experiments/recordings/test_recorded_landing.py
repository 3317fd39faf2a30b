"""Where it would have landed: the map of a recording and the site on it."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from touchdown.estimator.api import MapperParams
from touchdown.experiments.external.synthetic_stream import synthetic_rig
from touchdown.experiments.recordings.landing_site import LandingSite
from touchdown.landing.api import LandingParams
from touchdown.sim.api import LidarScan
from touchdown.sim.frames import BODY_FROM_DOWNWARD_OPTICAL, Pose

from support.landing_support import make_estimate, make_obs
from support.messages import make_scan

HEIGHT_M = 15.0


def _mapped(site: LandingSite) -> None:
    """Four seconds over level ground, 12 m along x."""
    rng = np.random.default_rng(6)
    for tick in range(3, 2400, 3):
        pose = Pose(np.eye(3), np.array([12.0 * tick / 2400.0, 0.0, HEIGHT_M]))
        scans: tuple[LidarScan, ...] = ()
        if tick % 60 == 0:
            beams = np.column_stack([rng.uniform(-0.9, 0.9, (8000, 2)), np.ones(8000)])
            ranges = (HEIGHT_M - 0.135) * np.linalg.norm(beams, axis=1)
            beams /= np.linalg.norm(beams, axis=1, keepdims=True)
            ranges += rng.normal(0.0, 0.01, 8000)
            scans = (make_scan(tick, beams, ranges, np.sort(rng.uniform(0.0, 0.1, 8000))),)
        obs = make_obs(tick, scans=scans, rotor_speed_radps=np.full(4, 400.0))
        site.take(obs, make_estimate(tick, pose))


@pytest.fixture
def site() -> LandingSite:
    start = Pose(np.eye(3), np.array([0.0, 0.0, HEIGHT_M]))
    rig = dataclasses.replace(synthetic_rig(), world_from_body_start=start)
    return LandingSite(rig, MapperParams(extent_m=60.0), LandingParams())


def test_a_site_on_level_ground_is_told_and_drawn(site: LandingSite, tmp_path: Path) -> None:
    _mapped(site)
    told = site.write(tmp_path)
    x, y = (float(word) for word in told.split() if word.lstrip("-").replace(".", "").isdigit())
    assert told.startswith("it would have landed at") and -20.0 < x < 30.0 and abs(y) < 20.0
    assert {one.name for one in tmp_path.iterdir()} == {"map.ply", "costmap.png"}


def test_without_scans_and_without_a_view_down_nothing_is_chosen(
    site: LandingSite, tmp_path: Path
) -> None:
    assert "no scan reached the map" in site.write(tmp_path)
    mount = Pose(np.diag([1.0, -1.0, -1.0]) @ BODY_FROM_DOWNWARD_OPTICAL, np.zeros(3))
    rig = dataclasses.replace(synthetic_rig(), body_from_lidar=mount)
    above = LandingSite(rig, MapperParams(extent_m=60.0), LandingParams())
    _mapped(above)
    assert "does not look down" in above.write(tmp_path)
    assert not (tmp_path / "costmap.png").exists()
