"""The LIDAR against hand-computed geometry and against MuJoCo's own ray caster."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from touchdown.scenes.api import LAND_CLASSES, GroundRaster, Scene, Surface
from touchdown.sim.api import LidarParams, LidarScan
from touchdown.sim.frames import Pose, so3_exp
from touchdown.sim.lidar.patterns import HORIZON
from touchdown.sim.lidar.sensor import LidarSensor
from touchdown.sim.moving import BodyTrack

from support.lidar_support import (
    BRIGHT,
    BUDGET,
    DOWN,
    PERFECT,
    PLANE,
    TICK_HZ,
    Array,
    make_scene,
    track,
)

# Boresight along body +x, long axis along body -y, short axis up.
FORWARD = Pose(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))


def take_scan(
    scene: Scene, mount: Pose = DOWN, height: float = 30.0, params: LidarParams = PERFECT,
    seed: int = 1, ticks: tuple[int, int] = (0, 60), turn_rate: Array | None = None, **bodies: Pose,
) -> LidarScan:  # fmt: skip
    """A scan from (0, 0, height), the body level or turning at ``turn_rate`` (3,) rad/s."""
    body = track(ticks, height, turn_rate)
    moving = {name: BodyTrack.at_rest(pose, body.times_s[:1]) for name, pose in bodies.items()}
    return LidarSensor(scene, params, seed).scan(*ticks, TICK_HZ, body, mount, moving)


def returned(scan: LidarScan) -> NDArray[np.bool_]:
    return scan.ranges > 0.0


def test_box_on_a_plane_from_known_height() -> None:
    box = '<geom name="box" type="box" size="2 3 1" pos="0 0 1"/>'
    scan = take_scan(make_scene(PLANE + box, {"plane": BRIGHT, "box": BRIGHT}))
    points = DOWN.apply(scan.points.astype(np.float64)) + np.array([0.0, 0.0, 30.0])
    down = -scan.directions.astype(np.float64) @ DOWN.rotation.T
    crossing = 28.0 * down[:, :2] / -down[:, 2:]
    inside = (np.abs(crossing) < [2.0, 3.0]).all(axis=1)
    assert inside.sum() > 100
    assert returned(scan).all()
    np.testing.assert_allclose(points[inside, 2], 2.0, atol=1e-4)
    on_ground = (np.abs(points[:, :2]) > [2.01, 3.01]).any(axis=1)
    np.testing.assert_allclose(points[on_ground, 2], 0.0, atol=1e-4)


def test_scan_holds_the_pulses_of_its_span() -> None:
    scene = make_scene(PLANE)
    first, second = take_scan(scene), take_scan(scene, ticks=(60, 120))
    assert len(first.ranges) == len(second.ranges) == 24_000
    assert first.time_offsets[0] == pytest.approx(1 / 240_000)
    assert first.time_offsets[-1] == pytest.approx(0.1)
    assert np.all(np.diff(second.time_offsets) > 0.0)
    np.testing.assert_array_equal(second.directions, HORIZON.directions(24_001, 24_000))
    assert not first.ranges.flags.writeable


def test_vehicle_hidden_groups_and_invisible_geoms_are_transparent() -> None:
    clutter = (
        '<geom name="vehicle/leg" type="box" size="9 9 0.1" pos="0 0 20"/>'
        '<body name="vehicle/hull"><geom type="box" size="9 9 0.1" pos="0 0 21"/></body>'
        '<geom name="helper" type="box" size="9 9 0.1" pos="0 0 22" group="3"/>'
        '<geom name="ghost" type="box" size="9 9 0.1" pos="0 0 23" rgba="1 1 1 0"/>'
    )
    scan = take_scan(make_scene(PLANE + clutter, {"plane": BRIGHT}))
    heights = scan.ranges * scan.directions[:, 2]
    np.testing.assert_allclose(heights, 30.0, atol=1e-3)


def wall(distance: float, half_size: float = 200.0) -> str:
    return (
        f'<geom name="wall" type="box" size="0.5 {half_size} {half_size}" '
        f'pos="{distance + 0.5} 0 30"/>'
    )


def test_wall_at_20_m_has_two_centimetres_of_noise() -> None:
    scene = make_scene(wall(20.0, 30.0), {"wall": BRIGHT})
    scan = take_scan(scene, FORWARD, params=LidarParams(divergence=False))
    azimuth = np.rad2deg(np.arctan2(scan.directions[:, 0], scan.directions[:, 2]))
    points = scan.points[np.abs(azimuth) < 10.0].astype(np.float64)
    assert len(points) > 3000
    centred = points - points.mean(axis=0)
    normal = np.linalg.svd(centred, full_matrices=False)[2][2]
    assert np.std(centred @ normal) == pytest.approx(0.02, abs=0.002)
    assert points[:, 2].mean() == pytest.approx(20.0, abs=0.005)


def test_beam_angle_noise() -> None:
    """A beam that deviates by s radians at incidence a changes the range by R s tan(a)."""
    scene = make_scene(wall(20.0, 30.0), {"wall": BRIGHT})
    noisy = take_scan(scene, FORWARD, params=replace(PERFECT, angle_sigma_deg=0.05))
    clean = take_scan(scene, FORWARD)
    tangent = np.hypot(clean.directions[:, 0], clean.directions[:, 1]) / clean.directions[:, 2]
    oblique = tangent > 0.2
    deviation = (noisy.ranges - clean.ranges) / (clean.ranges * tangent)
    assert np.rad2deg(np.std(deviation[oblique])) == pytest.approx(0.05, rel=0.03)


@pytest.mark.parametrize(("reflectivity", "limit"), [(0.1, 90.0), (0.2, 130.0), (0.8, 260.0)])
def test_range_limits(reflectivity: float, limit: float) -> None:
    assert BUDGET.strength_needed(np.array([limit]))[0] == pytest.approx(reflectivity)
    surface = Surface(land_class="other", reflectivity=reflectivity)

    def fraction(distance: float) -> float:
        scene = make_scene(wall(distance), {"wall": surface})
        params = LidarParams(max_range_m=400.0)
        scan = take_scan(scene, FORWARD, params=params)
        ahead = scan.directions[:, 2] > np.cos(np.deg2rad(3.0))
        return float(np.mean(returned(scan)[ahead]))

    assert fraction(0.94 * limit) > 0.95
    assert fraction(1.06 * limit) < 0.05


def test_incidence_shortens_the_range_and_dims_the_return() -> None:
    scene = make_scene(PLANE, {"plane": Surface(land_class="lawn", reflectivity=0.4)})
    scan = take_scan(scene)
    cosine = scan.directions[:, 2]
    np.testing.assert_allclose(scan.intensity, 150.0 * 0.4 * cosine, atol=0.51)


def test_nothing_nearer_than_the_least_range() -> None:
    scene = make_scene(PLANE, {"plane": BRIGHT})
    assert not returned(take_scan(scene, height=0.3)).any()
    assert returned(take_scan(scene, height=0.6)).all()


@pytest.mark.parametrize("by_raster", [False, True])
def test_water_returns_near_nadir_only(by_raster: bool) -> None:
    water = LAND_CLASSES.index("water")
    raster = GroundRaster(
        geom_name="plane", origin_xy_m=np.array([-50.0, -50.0]), cell_m=1.0,
        class_id=np.full((100, 100), water, dtype=np.uint8),
        reflectivity=np.full((100, 100), 0.05, dtype=np.float32),
    )  # fmt: skip
    lake = Surface(land_class="water", reflectivity=0.05, water=True)
    scene = make_scene(PLANE, {} if by_raster else {"plane": lake}, raster if by_raster else None)
    scan = take_scan(scene, params=LidarParams())
    incidence = np.rad2deg(np.arccos(scan.directions[:, 2]))
    assert returned(scan)[incidence < 3.0].mean() > 0.8
    assert 0.05 < returned(scan)[(incidence > 9.0) & (incidence < 11.0)].mean() < 0.7
    assert returned(scan)[incidence > 20.0].sum() == 0


def test_terrain_raster_gives_reflectivity_by_position() -> None:
    reflectivity = np.full((60, 60), 0.2, dtype=np.float32)
    reflectivity[:, 30:] = 0.6
    raster = GroundRaster(
        geom_name="plane", origin_xy_m=np.array([-30.0, -30.0]), cell_m=1.0,
        class_id=np.zeros((60, 60), dtype=np.uint8), reflectivity=reflectivity,
    )  # fmt: skip
    scan = take_scan(make_scene(PLANE, ground=raster))
    world_x = (scan.points.astype(np.float64) @ DOWN.rotation.T)[:, 0]
    expected = np.where(world_x > 0.0, 0.6, 0.2) * scan.directions[:, 2] * 150.0
    np.testing.assert_allclose(scan.intensity, expected, atol=0.51)


def test_porous_crown_lets_its_share_through() -> None:
    crown = '<geom name="crown" type="ellipsoid" size="20 30 2" pos="0 0 10"/>'
    trunk = '<geom name="trunk" type="cylinder" size="1 5" pos="0 0 5"/>'
    leaves = Surface(land_class="trees", reflectivity=0.5, porosity=0.3)
    scene = make_scene(PLANE + crown + trunk, {"plane": BRIGHT, "crown": leaves, "trunk": BRIGHT})
    scan = take_scan(scene)
    points = scan.points.astype(np.float64) @ DOWN.rotation.T + [0.0, 0.0, 30.0]
    from_axis = np.hypot(points[:, 0], points[:, 1])
    crossing = 20.0 * (scan.directions @ DOWN.rotation.T / scan.directions[:, 2:])[:, :2]
    entering = np.hypot(crossing[:, 0] / 20.0, crossing[:, 1] / 30.0) < 0.9
    on_crown = (points[:, 2] > 10.01) & entering
    assert returned(scan).all()
    assert on_crown[entering].mean() == pytest.approx(0.7, abs=0.02)
    on_trunk = entering & ~on_crown & (np.linalg.norm(crossing, axis=1) < 0.9)
    assert on_trunk.sum() > 10
    np.testing.assert_allclose(points[on_trunk, 2], 10.0, atol=2e-3)
    on_ground = entering & ~on_crown & (from_axis > 1.1)
    assert on_ground.sum() > 3000
    np.testing.assert_allclose(points[on_ground, 2], 0.0, atol=2e-3)


def test_turning_vehicle_bends_the_wall_until_deskewed() -> None:
    scene = make_scene(wall(20.0, 60.0), {"wall": BRIGHT})
    rate = np.array([0.0, 0.0, np.deg2rad(60.0)])
    scan = take_scan(scene, FORWARD, turn_rate=rate)
    in_body = scan.points.astype(np.float64) @ FORWARD.rotation.T
    turns = np.array([so3_exp(rate * t) for t in scan.time_offsets[::50]])
    straight = np.einsum("nij,nj->ni", turns, in_body[::50])
    np.testing.assert_allclose(straight[:, 0], 20.0, atol=2e-3)
    assert np.std(in_body[:, 0]) > 0.5


def test_lever_arm_and_translation() -> None:
    """A LIDAR 0.4 m below a body that climbs at 10 m/s sees the ground recede."""
    scene = make_scene(PLANE, {"plane": BRIGHT})
    body = track((0, 60), 20.0)
    body.positions[:, 2] += 10.0 * body.times_s
    mount = Pose(DOWN.rotation, np.array([0.0, 0.0, -0.4]))
    scan = LidarSensor(scene, PERFECT, 0).scan(0, 60, TICK_HZ, body, mount, {})
    heights = scan.ranges * scan.directions[:, 2]
    np.testing.assert_allclose(heights, 19.6 + 10.0 * scan.time_offsets, atol=1e-3)


CAR = (
    '<body name="car" mocap="true" pos="0 0 0.75">'
    '<geom name="car" type="box" size="2 0.9 0.75"/></body>'
)


def roof_points(scan: LidarScan) -> Array:
    points = scan.points.astype(np.float64) @ DOWN.rotation.T + [0.0, 0.0, 20.0]
    roof: Array = points[np.abs(points[:, 2] - 1.5) < 0.01]
    return roof


def test_moving_body_is_hit_where_it_is() -> None:
    scene = make_scene(PLANE + CAR, {"plane": BRIGHT, "car": BRIGHT})
    quarter_turn = Pose(so3_exp(np.array([0.0, 0.0, np.pi / 2])), np.array([1.0, 4.0, 0.75]))
    roof = roof_points(take_scan(scene, height=20.0, car=quarter_turn))
    assert len(roof) > 100
    assert np.all(np.abs(roof[:, :2] - [1.0, 4.0]) < [0.91, 2.01])
    at_rest = roof_points(take_scan(scene, height=20.0))
    assert np.all(np.abs(at_rest[:, :2]) < [2.01, 0.91])


def test_moving_body_moves_within_the_scan() -> None:
    scene = make_scene(PLANE + CAR, {"plane": BRIGHT, "car": BRIGHT})
    body = track((0, 60), 20.0)
    path = np.stack([0.0 * (y := -3.0 + 60.0 * body.times_s), y, 0.75 + 0.0 * y], axis=-1)
    drawn = {"car": replace(body, positions=path)}
    for params, beyond in ((PERFECT, 0.02), (replace(PERFECT, divergence=True), 0.12)):
        scan = LidarSensor(scene, params, 0).scan(0, 60, TICK_HZ, body, DOWN, drawn)
        points = scan.points.astype(np.float64) @ DOWN.rotation.T + [0.0, 0.0, 20.0]
        raised = points[:, 2] > 0.02
        drawn_from = -3.0 + 60.0 * scan.time_offsets.astype(np.float64)
        assert raised.sum() > 100
        assert np.all(np.abs(points[raised, 1] - drawn_from[raised]) < 0.9 + beyond)
