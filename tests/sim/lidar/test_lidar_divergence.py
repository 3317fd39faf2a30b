"""Beams with a width: mixed pixels at edges, return modes, and the presets' own figures."""

from dataclasses import replace

import numpy as np
import pytest

from touchdown.scenes.api import Scene, Surface
from touchdown.sim.api import LidarParams, LidarScan
from touchdown.sim.frames import Pose
from touchdown.sim.lidar.patterns import HORIZON, PATTERNS
from touchdown.sim.lidar.sensor import LidarSensor, beam_parts
from touchdown.sim.moving import BodyTrack
from touchdown.sim.typing import Array

from support.lidar_support import BRIGHT, DOWN, PLANE, make_scene

NOISELESS = LidarParams(range_sigma_m=0.0, angle_sigma_deg=0.0)
RAYS = replace(NOISELESS, divergence=False)
DARK = Surface(land_class="other", reflectivity=0.05)


def scan_from(height: float, scene: Scene, params: LidarParams) -> LidarScan:
    above = Pose(np.eye(3), np.array([0.0, 0.0, height]))
    body = BodyTrack.at_rest(above, np.arange(61) / 600.0)
    sensor = LidarSensor(scene, params, 3)
    return sensor.scan(0, 60, 600, body, DOWN, {})


def points(scan: LidarScan, height: float) -> Array:
    """World points of `scan_from`."""
    return DOWN.apply(scan.points.astype(np.float64)) + [0.0, 0.0, height]


def half_plane(top: float) -> str:
    """A block that fills x < 0 up to ``top``; the LIDAR's short axis y runs along -x here, so the
    beam's long side lies across the edge."""
    return f'<geom name="block" type="box" size="20 40 {top / 2}" pos="-20 0 {top / 2}"/>'


def test_low_step_gives_ranges_in_between() -> None:
    """0.3 m are less than the pulse is long: one echo at the mean range, and only where the beam
    reaches over the edge. Its outer parts lie 0.174 degrees off the axis: 9.1 cm at 30 m."""
    scene = make_scene(PLANE + half_plane(0.3), {"plane": BRIGHT, "block": BRIGHT})
    wide, thin = (points(scan_from(30.0, scene, p), 30.0) for p in (NOISELESS, RAYS))
    mixed = (wide[:, 2] > 0.02) & (wide[:, 2] < 0.28)
    assert not ((thin[:, 2] > 0.02) & (thin[:, 2] < 0.28) & (np.abs(thin[:, 0]) > 1e-3)).any()
    assert mixed.sum() > 30
    assert np.abs(thin[mixed, 0]).max() < 0.105 * 1.3
    inside = (np.abs(thin[:, 0]) > 0.2) | (np.abs(thin[:, 1]) > 38.0)
    np.testing.assert_array_equal(wide[inside], thin[inside])
    # The mean follows the fraction of the beam that lies on the block.
    order = np.corrcoef(thin[mixed, 0], wide[mixed, 2])[0, 1]
    assert order < -0.8


def test_high_step_gives_one_of_two_echoes() -> None:
    scene = make_scene(PLANE + half_plane(4.0), {"plane": BRIGHT, "block": DARK})
    first, strongest = (
        points(scan_from(30.0, scene, replace(NOISELESS, return_mode=mode)), 30.0)
        for mode in ("first", "strongest")
    )
    for cloud in (first, strongest):
        beside_wall = np.abs(cloud[:, 0]) > 0.15
        between = (cloud[:, 2] > 0.05) & (cloud[:, 2] < 3.95)
        assert not (between & beside_wall).any()
    differ = np.abs(first[:, 2] - strongest[:, 2]) > 1.0
    assert differ.sum() > 10
    assert (first[differ, 2] > strongest[differ, 2]).all()


def test_wire_is_seen_by_beams_whose_axis_passes_it() -> None:
    wire = '<geom name="wire" type="capsule" size="0.008 20" pos="0 0 18" euler="90 0 0"/>'
    scene = make_scene(PLANE + wire, {"plane": BRIGHT, "wire": BRIGHT})
    wide, thin = (points(scan_from(30.0, scene, p), 30.0)[:, 2] > 17.5 for p in (NOISELESS, RAYS))
    assert thin.sum() > 20
    assert wide.sum() > 1.5 * thin.sum()


def test_level_ground_and_walls_are_untouched() -> None:
    wall = '<geom name="wall" type="box" size="30 0.5 30" pos="0 6 0"/>'
    scene = make_scene(PLANE + wall, {"plane": BRIGHT, "wall": BRIGHT})
    wide, thin = (scan_from(20.0, scene, params) for params in (NOISELESS, RAYS))
    np.testing.assert_allclose(wide.ranges, thin.ranges, atol=0.02)


def test_parts_of_a_beam() -> None:
    """Seven parts of equal power; quantiles of a Gaussian of 0.03 x 0.28 degrees full width at half
    maximum. The outermost quantile of seven, 1 / 14, lies at 1.4652 standard deviations."""
    parts = np.rad2deg(beam_parts(HORIZON)[:, :2])
    assert parts.shape == (6, 2)
    np.testing.assert_allclose(parts.sum(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(parts[:2, 1], 1.4652 * 0.28 / 2.3548 * np.array([-1, 1]), rtol=1e-3)
    assert np.abs(parts[:, 0]).max() == pytest.approx(1.4652 * 0.03 / 2.3548, rel=1e-3)


@pytest.mark.parametrize(("preset", "reflectivity", "limit"), [
    ("horizon", 0.1, 90.0), ("horizon", 0.2, 130.0), ("horizon", 0.8, 260.0), ("avia", 0.1, 190.0),
    ("avia", 0.2, 230.0), ("mid360", 0.1, 40.0), ("mid360", 0.8, 70.0),
])  # fmt: skip
def test_maximum_ranges_of_presets_match_the_data_sheet(
    preset: str, reflectivity: float, limit: float
) -> None:
    """Around the limit, within 5 %, the fraction of returns falls from all to none. A ball around
    the sensor is met at right angles everywhere."""
    surface = Surface(land_class="other", reflectivity=reflectivity)

    def fraction(distance: float) -> float:
        ball = f'<geom name="ball" type="sphere" size="{distance}"/>'
        params = replace(RAYS, preset=preset, max_range_m=1000.0)
        return float(
            np.mean(scan_from(0.0, make_scene(ball, {"ball": surface}), params).ranges > 0.0)
        )

    assert PATTERNS[preset].range_limits_m[0] <= limit
    assert fraction(0.95 * limit) > 0.98
    assert fraction(1.05 * limit) < 0.02
