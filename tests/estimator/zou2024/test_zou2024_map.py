"""The visual map of `zou2024`: its keyframes, their bundle adjustment and loop closures."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from touchdown.estimator.filtering.error_state import Frames
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.inertial_filter import InertialFilter
from touchdown.estimator.filtering.landmark_depth import RecentReturns
from touchdown.estimator.zou2024.bundle import reprojection_errors
from touchdown.estimator.zou2024.camera_pose import CameraPositioning
from touchdown.estimator.zou2024.closures import Closures
from touchdown.estimator.zou2024.feature_map import FeatureMap, Seen
from touchdown.estimator.zou2024.place_recognition import MemoryLimits
from touchdown.estimator.zou2024.registration import FeatureMaps
from touchdown.estimator.zou2024.visual_map import LandmarkSet, MapKeyframe, Sightings
from touchdown.sim.frames import Pose, so3_exp

from support.livo_flight import START_Z
from support.zou2024_flight import IMU_FROM_CAMERA, NOTHING, RIG, features_of, image_from, params

NO_EDGES = np.zeros((120, 212), np.float32).copy


def positioning(**changes: Any) -> CameraPositioning:
    """Over level ground that the LIDAR has just seen."""
    inertial, recent = InertialFilter(RIG), RecentReturns()
    side = np.linspace(-20.0, 20.0, 101)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    recent.add(np.column_stack([x, y, np.zeros(len(x))]))
    maps = FeatureMaps(FeatureMap(0.3, 1 << 8), FeatureMap(0.6, 1 << 8))
    return CameraPositioning(RIG, params(**changes), inertial, recent, maps)


def visit(camera: CameraPositioning, number: int, body: Pose, tick: int | None = None) -> None:
    """The image from a pose of the body, where the filter is, too."""
    eskf = camera._filter.eskf
    eskf.state = dataclasses.replace(eskf.state, position=body.apply(RIG.body_from_imu.translation))
    camera.take(image_from(body, 600 * number if tick is None else tick), NO_EDGES)


def level(x: float, y: float) -> Pose:
    return Pose(np.eye(3), np.array([x, y, START_Z]))


def none_of(kind: int) -> LandmarkSet:
    size = 128 if kind == 0 else 64
    empty = np.zeros((0, size), np.uint8)
    return LandmarkSet(NOTHING, np.zeros((0, 2)), empty, np.zeros(0))


def keyframe(number: int, odom: Pose, in_map: Pose) -> MapKeyframe:
    return MapKeyframe(number, odom, in_map, 12.0, (none_of(0), none_of(1)))


def test_a_bundle_refines_landmarks_and_leaves_the_poses_to_the_filter() -> None:
    """Two fixed keyframes host 120 landmarks; two later ones and the image are displaced."""
    rng = np.random.default_rng(4)
    truth = [
        Pose(so3_exp(np.array([0.0, 0.01 * k, 0.02 * k])), np.array([0.8 * k, 0.1 * k, 12.0]))
        for k in range(5)
    ]
    points = np.column_stack([rng.uniform(-5, 7, 120), rng.uniform(-4, 4, 120), np.zeros(120)])
    pixels = [
        -reprojection_errors(np.zeros((120, 2)), points, pose, IMU_FROM_CAMERA, RIG.camera)
        for pose in truth
    ]
    shift = np.array([0.12, -0.08, 0.01])
    start = [Pose(p.rotation, p.translation + (k > 1) * shift) for k, p in enumerate(truth)]
    offset = Pose(so3_exp(np.array([0.0, 0.0, 0.3])), np.array([5.0, 1.0, 0.0]))
    window = [keyframe(k, start[k], offset @ start[k]) for k in range(4)]
    hosts, indices = np.repeat([0, 1], 60), np.tile(np.arange(60), 2)
    errors = []
    for k in (0, 1):
        mine = hosts == k
        inside = (truth[k] @ IMU_FROM_CAMERA).inverse().apply(points[mine])
        depths = inside[:, 2] * (1.0 + 0.003 * rng.standard_normal(60))
        placed = IMU_FROM_CAMERA.apply(inside * (depths / inside[:, 2])[:, None])
        found = LandmarkSet(placed, pixels[k][mine], np.zeros((60, 128), np.uint8), depths)
        window[k].landmarks = (found, none_of(1))
        errors.append(np.abs(depths - inside[:, 2]).mean())

    def seen(k: int) -> Sightings:
        return Sightings(hosts, np.zeros(120, np.int64), indices, pixels[k])

    for k in (2, 3):
        window[k].sightings = seen(k)
    camera = positioning(sift_sigma_px=0.1)
    camera._map.keyframes = window
    state = camera._filter.eskf.state
    camera._filter.eskf.state = dataclasses.replace(
        state, rotation=start[4].rotation, position=start[4].translation
    )
    camera._refine(seen(4))
    for k, before in enumerate(start[:4]):
        assert window[k].odom_from_imu is before
    inside = (truth[0] @ IMU_FROM_CAMERA).inverse().apply(points[:60])
    refined = IMU_FROM_CAMERA.inverse().apply(window[0].landmarks[0].points)
    assert np.abs(refined[:, 2] - inside[:, 2]).mean() < 0.6 * errors[0]


def graph_of(poses: list[Pose], sigmas: list[float]) -> tuple[Closures, list[MapKeyframe]]:
    """Keyframes at ``poses`` that err by ``sigmas`` (m) in the filter, all of them places."""
    closures = Closures(0.1, 0.01, MemoryLimits(1, 9, 1, 0.6))
    blank = features_of(np.zeros((0, 128))), features_of(np.zeros((0, 64)))
    keyframes: list[MapKeyframe] = []
    for k, (pose, sigma) in enumerate(zip(poses, sigmas, strict=True)):
        keyframes.append(keyframe(k, pose, pose))
        covariance = np.diag([0.0, 0.0, 0.0, sigma, sigma, sigma]) ** 2
        closures.add(keyframes[-1], covariance, keyframes[-2] if k else None)
        closures.refresh_odometry(keyframes, 1)
        assert closures.ask(k, blank, 0.11) is None
    return closures, keyframes


def test_a_closure_moves_the_newest_keyframe_by_its_share_of_the_information() -> None:
    """Four hops of 6 mm and a closure of 12 mm, the same variance: half of 2 mm."""
    poses = [Pose(np.eye(3), np.array([5.0 * k, 0.0, 12.0])) for k in range(5)]
    closures, keyframes = graph_of(poses, [0.006 * np.sqrt(k) for k in range(5)])
    seen = Pose(np.eye(3), np.array([20.002, 0.0, 12.0]))
    closures.close(keyframes[0], keyframes[4], seen, 0.012**-2 * np.eye(6))
    assert closures.memory.locations[0].neighbours == {1, 4}
    closures.settle(keyframes)
    moved = [k.map_from_imu.translation[0] - k.odom_from_imu.translation[0] for k in keyframes]
    np.testing.assert_allclose(moved, 0.00025 * np.arange(5), atol=3e-5)
    assert closures.drift_covariance[0, 0] == pytest.approx(0.5 * 0.012**2, rel=0.05)
    at = closures.advance(keyframes[4].odom_from_imu.translation, 1.0)
    np.testing.assert_allclose(at.translation, [moved[4], 0.0, 0.0], atol=1e-5)


@pytest.mark.parametrize("clones", [1, 2, 4])
def test_what_the_filter_still_corrects_bends_no_map(clones: int) -> None:
    """After the take-off the tilt is corrected by half a degree: by itself that is no drift."""
    poses = [Pose(np.eye(3), np.array([0.0, 0.0, 8.0 * k])) for k in range(5)]
    closures, keyframes = graph_of(poses, [0.01 * k for k in range(5)])
    for one in keyframes[-clones - 1 :]:
        moved = Pose(so3_exp(np.array([0.009, -0.004, 0.01])), np.array([0.3, 0.1, 0.05]))
        one.odom_from_imu = one.map_from_imu = one.odom_from_imu @ moved
    closures.refresh_odometry(keyframes, clones)
    closures.settle(keyframes)
    for one in keyframes:
        at, expected = one.map_from_imu, one.odom_from_imu
        np.testing.assert_allclose(at.translation, expected.translation, atol=1e-6)
        np.testing.assert_allclose(at.rotation, expected.rotation, atol=1e-7)


def test_a_closure_is_weighed_in_the_frame_of_its_source() -> None:
    """Information on x in the map is information on -y of a source that looks north."""
    north = Pose(so3_exp(np.array([0.0, 0.0, np.pi / 2])), np.array([1.0, 2.0, 12.0]))
    closures, ends = graph_of([north, north], [0.0, 0.0])
    closures.close(ends[0], ends[1], north, np.diag([1.0, 2.0, 3.0, 40.0, 5.0, 6.0]))
    edge = closures._graph.edges[-1]
    np.testing.assert_allclose(np.diag(edge.information), [1.0, 2.0, 3.0, 5.0, 40.0, 6.0])
    np.testing.assert_allclose(edge.measured.translation, 0.0, atol=1e-12)


def test_a_revisit_closes_the_loop() -> None:
    """Out and back again in four images; the odometry has drifted by 2 cm in the meantime, and
    the filter knows that it may: by 1 cm a hop."""
    camera = positioning(
        recent_keyframes=1, use_camera_pose=False, use_bundle=False, short_term_locations=1,
        loop_threshold=0.05,
    )  # fmt: skip
    eskf = camera._filter.eskf
    places = ((0.0, 0.0), (0.0, 9.0), (6.0, 9.0), (0.0, 0.0))
    for number, xy in enumerate(places):
        body = Pose(np.eye(3), np.array([*xy, START_Z]))
        image = image_from(body, 600 * number)
        odom = body.translation + RIG.body_from_imu.translation + [0.02 * (number == 3), 0.0, 0.0]
        eskf.state = dataclasses.replace(eskf.state, position=odom)
        eskf.covariance[3:5, 3:5] += 0.01**2 * np.eye(2)
        camera.take(image, NO_EDGES)
    # the third image shows a little more than half of what the second does
    assert camera.diagnostics["closures"] == 2.0 and camera.diagnostics["keyframes"] == 4.0
    newest = camera._map.keyframes[-1]
    moved = newest.map_from_imu.translation - newest.odom_from_imu.translation
    # a closure of millimetres against 17 mm
    assert -0.021 < moved[0] < -0.018 and np.abs(moved[1:]).max() < 2e-3
    frame, drift = camera.world_from_odom(1.0)
    assert frame.apply(newest.odom_from_imu.translation)[0] == pytest.approx(
        newest.map_from_imu.translation[0], abs=1e-6
    )
    assert 0.001**2 < drift[0, 0] < 0.006**2


def test_a_place_is_verified_wherever_the_odometry_believes_to_be() -> None:
    """The image of a place, 4 m and 0.4 rad away by the odometry, and that of another place."""
    camera = positioning(use_closures=False, use_camera_pose=False)
    turned = Pose(so3_exp(np.array([0.0, 0.0, 0.9])), np.array([-7.5, -5.0, START_Z]))
    for number, body in enumerate((level(-8.0, -6.0), turned)):
        camera._map.keyframes = camera._map.keyframes[:number]
        camera._filter.eskf.clones.clear()
        visit(camera, number, body)
    hosts = camera._map.keyframes[:1]
    true = turned @ RIG.body_from_imu
    lost = Pose(so3_exp(np.array([0.0, 0.0, 0.4])), np.array([3.0, 2.6, 0.0])) @ true
    features = camera._detector(image_from(turned, 0).rgb[..., 0])
    found = camera._verify(features, hosts, keyframe(9, lost, lost))
    assert found is not None
    np.testing.assert_allclose(found.pose.translation, true.translation, atol=0.08)
    np.testing.assert_allclose(found.pose.rotation, true.rotation, atol=5e-3)
    far = dataclasses.replace(keyframe(9, lost, lost), depth_m=20.0)
    assert camera._verify(features, hosts, far) is None  # of another scale
    other = camera._detector(image_from(level(9.0, 9.0), 0).rgb[..., 0])
    assert camera._verify(other, hosts, keyframe(9, lost, lost)) is None


def ring() -> tuple[np.ndarray, LandmarkSet]:
    """Azimuths (200,) of landmarks straight below, and these."""
    way, lens = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False), RIG.camera
    rays = np.column_stack([0.3 * np.cos(way), 0.3 * np.sin(way), np.ones(200)])
    pixels = rays[:, :2] * [lens.fx, lens.fy] + [lens.cx, lens.cy]
    points, blank = IMU_FROM_CAMERA.apply(12.0 * rays), np.zeros((200, 128), np.uint8)
    return way, LandmarkSet(points, pixels, blank, np.full(200, 12.0))


def test_a_closure_is_as_certain_as_its_landmarks_and_residuals() -> None:
    """A ring of landmarks straight below, with pixel noise in both images: the heading has twice
    the variance of one image, and four times that with residuals twice as large as expected."""
    camera = positioning(sift_sigma_px=0.25, depth_sigma_m=1e-6)
    way, found = ring()
    host = keyframe(0, Pose.identity(), Pose.identity())
    host.landmarks, zero = (found, none_of(1)), np.zeros(200, np.int64)
    for error, variance in ((0.0, 1.0), (1.0, 4.0)):
        apart = error * np.column_stack([np.cos(9 * way), np.sin(9 * way)])
        seen = Sightings(zero, zero, np.arange(200), found.pixels + apart)
        information = camera._verify._information(Pose.identity(), seen, {0: host})
        heading = np.linalg.inv(information)[2, 2]
        one_image = 0.25**2 / (0.3 * 310.0) ** 2 / 200.0
        # Cauchy weights: 1 / (1 + 4 (1 / 6)^2) at 1 px
        expected = 2.0 * one_image * variance * (1.0 + 4.0 * (error / 6.0) ** 2)
        assert heading == pytest.approx(expected, rel=0.02)


def test_a_new_keyframe_continues_the_closed_map() -> None:
    """Where closures have moved the newest keyframe, the next one is moved as far."""
    camera = positioning(use_camera_pose=False, use_bundle=False)
    offset = Pose(so3_exp(np.array([0.0, 0.0, 0.1])), np.array([0.5, -0.2, 0.0]))
    for number, x in enumerate((0.0, 3.0)):
        visit(camera, number, level(x, 0.0))
        last = camera._map.keyframes[-1]
        last.map_from_imu = offset @ last.odom_from_imu if number == 0 else last.map_from_imu
    assert len(camera._map.keyframes) == 2 and camera.diagnostics["landmarks_used"] >= 30
    np.testing.assert_allclose(
        last.map_from_imu.translation, (offset @ last.odom_from_imu).translation, atol=1e-9
    )
    np.testing.assert_allclose(last.map_from_imu.rotation, offset.rotation, atol=1e-9)
    target = camera._closures._target  # of the odometry frame, without a closure too
    np.testing.assert_allclose(target.rotation, offset.rotation, atol=1e-9)
    np.testing.assert_allclose(target.translation, offset.translation, atol=1e-9)
    # its own landmarks are those that the first has not, at the depth of the ground
    own = last.landmarks[0].points
    used = {tuple(pixel) for pixel in last.sightings.pixels}
    assert len(used & {tuple(pixel) for pixel in last.landmarks[0].pixels}) < 0.3 * len(used)
    assert len(own) > 10
    np.testing.assert_allclose(last.odom_from_imu.apply(own)[:, 2], 0.0, atol=0.05)


def test_a_keyframe_keeps_inliers_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = positioning(use_closures=False, use_camera_pose=False)
    localise = camera._localise
    kept, refined = 0, []

    def every_other(features: Any) -> Any:
        nonlocal kept
        sightings, behind, solved = localise(features)
        if solved is not None:
            inliers = solved.inliers & (np.arange(len(sightings)) % 2 == 0)
            solved = dataclasses.replace(solved, inliers=inliers)
            kept = int(inliers.sum())
        return sightings, behind, solved

    monkeypatch.setattr(camera, "_localise", every_other)
    monkeypatch.setattr(camera, "_refine", lambda seen: refined.append(len(seen)))
    for number, x in enumerate((0.0, 3.0)):
        visit(camera, number, level(x, 0.0), 60 * number)
    assert len(camera._map.keyframes[-1].sightings) == kept == refined[0] > 10


def test_keyframes_are_bounded_and_the_newest_stay() -> None:
    camera = positioning(
        recent_keyframes=1, max_keyframes=3, use_camera_pose=False, use_bundle=False
    )
    for number in range(5):
        visit(camera, number, level(0.0, 4.0 * number - 8.0))
    numbers = [k.number for k in camera._map.keyframes]
    assert len(numbers) == 3 and numbers[1:] == [3, 4]
    known = camera._closures
    assert sorted(known._graph.poses) == sorted(known.memory.locations) == numbers


def test_edges_decide_which_returns_a_landmark_takes_its_depth_from() -> None:
    """A boundary with low ground beside it; without Eq. 12 it is none."""
    edges = NO_EDGES()
    edges[:, 100:104] = 1.0
    side = np.linspace(-10.0, 10.0, 21)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))

    def depths(energy: np.ndarray, **changes: Any) -> np.ndarray:
        camera = positioning(**changes)
        camera._recent = RecentReturns()
        camera._recent.add(np.column_stack([x, y, np.where(x > 0.0, -1.0, 0.0)]))
        camera.take(image_from(level(0.0, 0.0), 60), lambda: energy)
        return np.concatenate([part.depths for part in camera._map.keyframes[0].landmarks])

    by_distance = depths(NO_EDGES())
    np.testing.assert_array_equal(depths(edges, use_geodesic_depth=False), by_distance)
    by_edges = depths(edges)
    assert by_edges.shape != by_distance.shape or np.abs(by_edges - by_distance).max() > 0.1


def test_a_keyframe_errs_by_what_its_own_landmarks_share() -> None:
    """A ring of landmarks straight below: one pixel each turns the view by 1 / f sqrt(2 / N)."""
    camera = positioning(sift_sigma_px=1.0, depth_sigma_m=1e-6)
    host = keyframe(0, camera._filter.eskf.state.pose, Pose.identity())
    host.landmarks = (ring()[1], none_of(1))
    own = camera._model.own_covariance(camera._filter.eskf, host)
    heading = 1.0 / (0.3 * 310.0) ** 2 / 200.0
    assert own[2, 2] == pytest.approx(heading, rel=0.02)
    assert own[5, 5] == pytest.approx(12.0**2 * heading, rel=0.05)
    # a tilt looks like a step aside
    assert own[0, 0] > 20.0 * heading and own[4, 4] > 0.8 * 12.0**2 * own[0, 0]
    assert abs(own[0, 4]) > 0.99 * np.sqrt(own[0, 0] * own[4, 4])


def test_landmarks_spread_along_their_rays_and_follow_the_mount() -> None:
    """A LIDAR that is found to lie 0.1 m higher than when the keyframe was made."""
    camera = positioning(depth_sigma_m=0.05)
    state = dataclasses.replace(camera._filter.eskf.state, calibration=np.zeros(38))
    eskf = Eskf(state, np.ones(53))
    ray = np.array([0.3, -0.2, 1.0])
    points = IMU_FROM_CAMERA.apply(12.0 * ray[None])
    pixel, descriptor = np.zeros((1, 2)), np.zeros((1, 128), np.uint8)
    found = LandmarkSet(points, pixel, descriptor, np.full(1, 12.0))
    host = keyframe(0, eskf.state.pose, Pose.identity())
    host.calibration = np.zeros(38)
    eskf.state.calibration[5] = 0.1
    views = camera._model.views(eskf, host, found, np.array([0]), pixel)
    along = IMU_FROM_CAMERA.rotation @ ray
    np.testing.assert_allclose(views.spreads[0], 0.05 * along / np.linalg.norm(along), atol=1e-9)
    # level ground rises by as much, and the landmark along its ray
    np.testing.assert_allclose(views.landmarks[0] - points[0], -0.1 * along, atol=1e-9)


def test_clones_are_the_newest_keyframes_and_the_oldest_hands_its_map_over() -> None:
    """A point of the oldest keyframe moves to the nearest one left, where both now stand."""
    camera = positioning(recent_keyframes=2, use_camera_pose=False, use_closures=False)
    eskf, maps = camera._filter.eskf, camera._maps
    point = np.array([[0.4, 0.2, 0.1]])
    for number in range(3):
        if number == 1:
            seen = Seen(np.zeros(3), 0, Frames.of([Pose.identity()]))
            maps.planes.insert(np.repeat(point, 5, axis=0), seen)
        if number == 2:
            # the filter learns that both stood elsewhere
            for k, metres in enumerate((0.3, 0.1)):
                clone = eskf.clones[k]
                eskf.clones[k] = Pose(clone.rotation, clone.translation + [metres, 0.0, 0.0])
        visit(camera, number, level(4.0 * number - 8.0, 0.0))
    assert [k.number for k in camera._cloned()] == [1, 2] and len(maps.anchors) == 2
    assert camera._cloned()[0].odom_from_imu is eskf.clones[0]
    variances = np.diag(eskf.covariance)
    assert (variances[-6:] > variances[:6]).all()  # its own landmarks err, too
    _, sums, owners = maps.planes._voxels
    slot = int(np.flatnonzero(sums[:, 0])[0])
    assert owners[slot] == 0
    np.testing.assert_allclose(sums[slot, 1:4] / 5.0, point[0] + [0.2, 0.0, 0.0], atol=1e-9)


def test_an_image_is_due_after_a_while_or_a_way() -> None:
    camera = positioning(keyframe_period_s=0.5, keyframe_distance_m=2.0)
    camera._last_tick = 600
    assert not camera.due(840) and camera.due(900)
    eskf = camera._filter.eskf
    for metres, due in ((1.9, False), (2.1, True)):
        there = camera._last_position + [0.0, metres, 0.0]
        eskf.state = dataclasses.replace(eskf.state, position=there)
        assert camera.due(840) is due


def test_landmarks_are_searched_within_three_standard_deviations() -> None:
    camera = positioning()
    eskf = camera._filter.eskf
    eskf.covariance[:6, :6] = np.diag([0.0, 0.0, 0.01, 0.0, 0.09, 0.0]) ** 2
    frames = [keyframe(0, Pose.identity(), Pose.identity())]
    # 0.09 m at 12 m and 0.01 rad
    assert camera._radius(frames) == pytest.approx(6.0 + 3.0 * 0.0175 * RIG.camera.fx)
    eskf.covariance[:6, :6] *= 100.0
    assert camera._radius(frames) == 40.0
    eskf.covariance[:6, :6] = 0.0
    assert camera._radius(frames) == camera._radius([]) == 10.0


def test_an_image_is_kept_where_it_shows_something_new() -> None:
    camera = positioning()
    many, few = (
        Sightings(*np.zeros((3, count), np.int64), np.zeros((count, 2))) for count in (30, 29)
    )
    assert camera._worth_keeping(many)
    here = camera._filter.eskf.state.position
    for metres, kept in ((0.35, False), (0.37, True)):  # of 3 % of 12 m
        pose = Pose(np.eye(3), here + [metres, 0.0, 0.0])
        camera._map.keyframes = [keyframe(0, pose, pose)]
        assert camera._worth_keeping(many) is kept and camera._worth_keeping(few)
