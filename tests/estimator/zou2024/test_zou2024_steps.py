"""The paper's positioning step by step, what each repairs of a disturbed state, and as a whole."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from touchdown.estimator.filtering.anchors import Anchors
from touchdown.estimator.filtering.deskew import PlacedScan
from touchdown.estimator.filtering.error_state import Frame, Frames, Pinhole, moved_by
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.inertial_filter import InertialFilter
from touchdown.estimator.filtering.landmark_depth import RecentReturns
from touchdown.estimator.filtering.reprojection import MountedCamera, reprojection_information
from touchdown.estimator.zou2024 import lidar_pose, registration
from touchdown.estimator.zou2024.bundle import (
    CameraPose,
    Observations,
    _reduced_system,
    reprojection_errors,
    solve_pnp,
)
from touchdown.estimator.zou2024.closures import Edge, PoseGraph, edge_residual
from touchdown.estimator.zou2024.depth_field import DepthField, half_size_energy
from touchdown.estimator.zou2024.estimator import Zou2024Estimator
from touchdown.estimator.zou2024.lidar_pose import scan_features
from touchdown.estimator.zou2024.registration import Matches, relative_equations
from touchdown.estimator.zou2024.relative_pose import update_with_scan
from touchdown.estimator.zou2024.structured_edges import GradientEdges
from touchdown.sim.frames import Pose, so3_exp, so3_log

from support.livo_flight import HZ, START_Z, error, position_at
from support.livo_support import state_at
from support.zou2024_flight import (
    FLIGHT,
    IMU_FROM_CAMERA,
    NOTHING,
    PLAIN,
    RIG,
    fly,
    ground_seen,
    image_at,
    image_from,
    make_rig,
    params,
    scan_ending_at,
)


def ground_maps(ground: np.ndarray) -> registration.FeatureMaps:
    planes, edges = registration.FeatureMap(0.5, 1 << 12), registration.FeatureMap(0.3, 1 << 8)
    planes.insert(ground)
    return registration.FeatureMaps(edges, planes)


@pytest.mark.parametrize(("sensor", "shift", "turn"), [
    ("lidar", [0.0, 0.0, 0.1], [0.0, 0.0, 0.0]), ("lidar", [0.0, 0.0, 0.0], [0.03, -0.02, 0.0]),
    ("camera", [0.1, -0.08, 0.0], [0.0, 0.0, 0.0]), ("camera", [0.0, 0.0, 0.0], [0.0, 0.0, 0.02]),
])  # fmt: skip
def test_a_displaced_pose_is_pulled_back(sensor: str, shift: Any, turn: Any) -> None:
    """Algorithm 1 knows height and tilt over level ground, PnP position and heading."""
    alone = {f"use_{name}_pose": name == sensor for name in ("lidar", "camera")}
    estimator = Zou2024Estimator(RIG, params(keyframe_period_s=0.1, **alone))
    inertial = estimator._filter
    for obs in FLIGHT:
        if obs.tick == 393:  # the scan and the image of 360 come next
            state, covariance = inertial.eskf.state, inertial.eskf.covariance
            inertial.eskf.state = dataclasses.replace(
                state,
                position=state.position + shift,
                rotation=state.rotation @ so3_exp(np.array(turn)),
            )
            covariance[3:6, 3:6] += np.diag(np.where(np.array(shift) == 0.0, 0.0, 0.3**2))
            covariance[:3, :3] += np.diag(np.where(np.array(turn) == 0.0, 0.0, 0.1**2))
            inertial.trail.follow(inertial.eskf.state)
            inertial.catch_up()
        estimate = estimator.update(obs)
        if obs.tick == 396:
            state = inertial.eskf.state
            truth = position_at(360 / HZ) + RIG.body_from_imu.translation
            assert np.abs(state.position - truth).max() < 0.02
            assert np.abs(so3_log(state.rotation)).max() < 0.003
        if obs.tick == 699:
            break
    # half a second later the correction has reached what control is given
    assert error(estimate) < 0.03


def test_the_fifth_that_fits_worst_is_left_out_of_each_kind() -> None:
    distances = np.array([0.9, 0.1, 0.2, 0.3, 0.4, 0.01, 0.02, 0.03, 0.05, 0.04])
    is_edge = np.arange(10) < 5
    kept = registration._keep_best(distances, is_edge)
    assert np.flatnonzero(~kept).tolist() == [0, 8]


@pytest.mark.parametrize(("change", "rtol"), [(0.0, 1e-5), (1e-4, 2e-3)])
def test_relative_equations_are_derivatives_by_pose_mount_and_clone(
    change: float, rtol: float
) -> None:
    """Of lines and of planes: minus the gradient of sum 9/2 log(1 + d^2 / 9 s^2). Half of the map
    belongs to a clone; the mount turns beams of the scan and of the map. A change of the mount
    since the clone was made enters to first order."""
    rng = np.random.default_rng(0)
    points, near, axes, sensors = rng.normal(0.0, 2.0, (4, 12, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    is_edge, sigmas, lever = np.arange(12) % 2 == 0, np.array([0.4, 0.7]), np.array([0.1, 0.2, 0.3])
    owners = np.where(np.arange(12) % 4 < 2, 0, -1)
    pose, clone = (Pose(so3_exp(turn), shift) for turn, shift in rng.normal(0.0, 0.5, (2, 2, 3)))
    anchors, calibration = Anchors(), np.zeros(38)
    anchors.add(clone, calibration)
    calibration[:6] = change * rng.normal(0.0, 1.0, 6)
    frames = anchors.frames([clone], calibration, np.array([0]))

    def cost(delta: np.ndarray) -> float:
        now, mount, then = moved_by(pose, delta[:6]), delta[6:12], moved_by(clone, delta[23:])
        seen = points + np.cross(mount[:3], points - lever) + mount[3:]
        total = 0.0
        for p, m, axis, edge, k, sensor in zip(
            seen, near, axes, is_edge, owners, sensors, strict=True
        ):
            home, base, by = (then, clone, mount + calibration[:6]) if k == 0 else (
                pose, pose, mount
            )  # fmt: skip
            # as its home sees it, along its own beam
            arm = (m - sensor) @ base.rotation
            turned = base.inverse().apply(m) + np.cross(by[:3], arm) + by[3:]
            place = home.apply(turned)
            offset = now.apply(p) - place
            along = offset @ (then.rotation @ clone.rotation.T @ axis if k == 0 else axis)
            square = offset @ offset - along**2 if edge else along**2
            total += 4.5 * np.log1p(square / (9.0 * sigmas[int(not edge)] ** 2))
        return float(total)

    near_five = near[:, None] + rng.normal(0.0, 1.0, (12, 5, 3)) * (np.arange(5) > 0)[:, None]
    found = Matches(points, near_five, axes, is_edge, owners, sensors, np.ones(12), np.zeros(12))
    frame = Frame.of(pose)
    information, vector, _ = relative_equations(found, lever, frame, frames, 1, 17, sigmas, False)
    slope = np.array([(cost(e) - cost(-e)) / 2e-6 for e in 1e-6 * np.eye(29)])
    np.testing.assert_allclose(vector, -slope, rtol=rtol, atol=4.0 * rtol)
    np.testing.assert_allclose(information, information.T)
    frames = anchors.frames([clone], calibration, np.zeros(0, np.int64))
    alone, *_ = relative_equations(found, lever, frame, frames, 0, 0, sigmas, False)
    assert np.linalg.eigvalsh(alone)[0] > 0.0
    np.testing.assert_allclose(alone, information[:6, :6])


def noisy_ground(rng: np.random.Generator, count: int, side: float, z: float) -> np.ndarray:
    return np.column_stack([rng.uniform(-side, side, (count, 2)), rng.normal(z, 0.02, count)])


def test_algorithm_1_over_a_plane_stays_at_the_guess_in_unobserved_directions() -> None:
    """Noisy returns of a map and of a scan, half a voxel high; height and tilt are found."""
    rng = np.random.default_rng(4)
    maps = ground_maps(noisy_ground(rng, 20000, 9.0, 0.25))
    seen = registration.ScanFeatures(NOTHING, noisy_ground(rng, 800, 5.0, -9.75))
    guess = Pose(so3_exp(np.array([0.01, 0.0, 0.3])), np.array([0.2, -0.1, 10.05]))
    result = registration.register_scan(
        seen, maps, guess, np.eye(6), edge_sigma_m=0.15, plane_sigma_m=0.04
    )
    assert result is not None and result.weak.shape == (6, 3)
    np.testing.assert_allclose(result.pose.translation, [0.2, -0.1, 10.0], atol=5e-3)
    np.testing.assert_allclose(so3_log(result.pose.rotation), [0.0, 0.0, 0.3], atol=2e-3)
    # nor does the filter take anything from it
    eskf = Eskf(state_at(result.pose.rotation, result.pose.translation), np.full(15, 1e-4))
    update_with_scan(
        eskf, result, np.zeros(3), Anchors(), np.array([0.15, 0.04]), np.full(6, 1e-4), 1.0
    )
    sigma = np.sqrt(np.diag(eskf.covariance))
    np.testing.assert_allclose(sigma[2:5], 0.01, rtol=0.02)
    assert sigma[5] < 2e-3


def test_the_worst_fifth_does_not_enter_the_pose() -> None:
    """Level ground 10 m below with posts of 0.3 m in a tenth of it: the posts go."""
    rng = np.random.default_rng(2)
    maps = ground_maps(np.column_stack([rng.uniform(-8, 8, (30000, 2)), np.zeros(30000)]))
    seen = np.column_stack([rng.uniform(-5, 5, (500, 2)), np.full(500, -10.0)])
    seen[:50, 2] += 0.3
    guess = Pose(np.eye(3), np.array([0.0, 0.0, 10.05]))
    result = registration.register_scan(
        registration.ScanFeatures(NOTHING, seen), maps,
        guess, 1e-2 * np.eye(6), edge_sigma_m=0.05, plane_sigma_m=0.05,
    )  # fmt: skip
    assert result is not None and result.converged
    assert result.planes > 200 and result.edges == 0
    assert result.rms_m < 1e-6
    assert result.pose.translation[2] == pytest.approx(10.0, abs=1e-6)


def test_colour_smoothness_finds_a_painted_edge_on_plain_ground() -> None:
    """Flat ground is white from x = 2 m on: the strongest edges lie on that line."""
    scan = scan_ending_at(60)
    beams = scan.directions.astype(float) * scan.ranges[:, None]
    in_camera = (RIG.body_from_camera.inverse() @ RIG.body_from_lidar).apply(beams)
    white = ground_seen(Pose(np.eye(3), np.array([0.0, 0.0, START_Z])))[..., :1] > 2.0
    rgb = np.where(white, 220, 60).astype(np.uint8).repeat(3, axis=2)
    energy = half_size_energy(rgb, GradientEdges())
    pulses, few = np.arange(len(beams)), params(edge_points=30)
    chosen, f_c = scan_features(beams, beams, in_camera, pulses, energy, RIG.camera, few)
    none, _ = scan_features(beams, beams, in_camera, pulses, None, RIG.camera, few)
    x = RIG.body_from_lidar.apply(beams)[:, 0]
    painted = np.setdiff1d(chosen.edges, none.edges)
    assert len(painted) > 20 and len(chosen.planes) > 400
    assert np.median(np.abs(x[painted] - 2.0)) < 0.3
    across, aside = np.abs(x - 2.0) < 0.1, np.abs(x - 2.0) > 1.0
    assert np.nanmedian(f_c[across]) > 5.0 * np.nanmedian(f_c[aside])


def test_returns_are_projected_to_where_the_image_was_taken(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """0.5 m before the end of the scan."""
    seen: list[np.ndarray] = []
    monkeypatch.setattr(
        lidar_pose, "scan_colour_smoothness",
        lambda energy, points, camera: seen.append(points) or np.zeros(len(points)),
    )  # fmt: skip
    beams = np.random.default_rng(0).uniform([-4, -4, 11], [4, 4, 12], (60, 3))
    body = RIG.body_from_lidar.apply(beams)
    placed = PlacedScan(RIG.body_from_imu.inverse().apply(body), beams, np.arange(60))
    inertial = InertialFilter(RIG)
    lidar = lidar_pose.LidarPositioning(RIG, params(), inertial, RecentReturns())
    before = inertial.eskf.state.pose
    inertial.eskf.state = dataclasses.replace(
        inertial.eskf.state, position=before.translation + [0.5, 0.0, 0.0]
    )
    for pose, moved in ((None, 0.0), (before, 0.5)):
        lidar._features(placed, np.zeros((2, 2), np.float32), pose)
        expected = RIG.body_from_camera.inverse().apply(body + [moved, 0.0, 0.0])
        np.testing.assert_allclose(seen[-1], expected, atol=1e-9)


def test_the_estimator_knows_where_an_earlier_image_was_taken(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Images 20 ticks before the ends of the scans."""
    estimator = Zou2024Estimator(RIG, params(keyframe_period_s=0.1))
    places: list[Any] = []
    monkeypatch.setattr(
        estimator._lidar, "take", lambda scan, energy, seen_from: places.append(seen_from) or True
    )
    for obs in FLIGHT:
        early = tuple(image_at(image.tick - 20) for image in obs.images)
        estimator.update(dataclasses.replace(obs, images=early))
        if obs.tick == 480:
            break
    found = places[-1].translation - RIG.body_from_imu.translation
    np.testing.assert_allclose(found, position_at(400 / HZ), atol=5e-3)


def test_the_estimator_uses_colour_where_the_ground_is_flat() -> None:
    edges = {}
    for use in (True, False):
        estimator = Zou2024Estimator(RIG, params(use_colour_smoothness=use))
        last = [estimator.update(obs) for obs in FLIGHT if obs.tick <= 219][-1]
        edges[use] = last.diagnostics.get("map_edges", 0.0)
    assert edges[True] > 10.0 * edges[False] + 100.0


def test_depth_of_a_pixel_is_that_of_the_nearest_return_there() -> None:
    """A plane that falls away to the right, a second one behind it: 12 m + 0.2 m per metre."""
    recent = RecentReturns(scans=2, per_scan=40000)
    u, v = (axis.ravel() for axis in np.meshgrid(np.arange(1.0, 424, 2), np.arange(1.0, 240, 2)))
    rays = np.column_stack(
        [(u - RIG.camera.cx) / RIG.camera.fx, (v - RIG.camera.cy) / RIG.camera.fy, np.ones(len(u))]
    )
    depth = 12.0 / (1.0 - 0.2 * rays[:, 0])
    camera = Pose(so3_exp(np.array([0.2, -0.1, 0.4])), np.array([3.0, -2.0, 5.0]))
    for factor in (1.5, 1.0):
        recent.add(camera.apply(rays * (factor * depth)[:, None]))
    field = DepthField(np.zeros((120, 212), np.float32), recent, camera.inverse(), RIG.camera)
    assert field.returns > 0.9 * len(u)
    at = np.array([[100.0, 60.0], [300.0, 200.0]])
    found, spread = field.depth(at)
    expected = 12.0 / (1.0 - 0.2 * (at[:, 0] - RIG.camera.cx) / RIG.camera.fx)
    np.testing.assert_allclose(found, expected, rtol=5e-3)
    assert (spread < 0.1).all()


def test_algorithm_1_weighs_its_prior() -> None:
    """As much information in both: half way between them."""
    rng = np.random.default_rng(2)
    maps = ground_maps(np.column_stack([rng.uniform(-8, 8, (30000, 2)), np.zeros(30000)]))
    seen = np.column_stack([rng.uniform(-5, 5, (500, 2)), np.full(500, -10.0)])
    guess = Pose(np.eye(3), np.array([0.0, 0.0, 10.01]))
    height = np.zeros(6)

    def found(information: np.ndarray) -> registration.ScanPose:
        result = registration.register_scan(
            registration.ScanFeatures(NOTHING, seen), maps,
            guess, information, edge_sigma_m=0.05, plane_sigma_m=0.05,
        )  # fmt: skip
        assert result is not None
        return result

    strong = np.diag([1e9, 1e9, 1e9, 1e9, 1e9, 1e-3])
    height[5] = found(strong).planes / 0.05**2
    assert found(strong).pose.translation[2] == pytest.approx(10.0, abs=1e-5)
    half = found(strong + np.diag(height)).pose.translation[2]
    assert half == pytest.approx(10.005, abs=1e-4)


def test_pnp_weighs_its_prior() -> None:
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-5, 5, (60, 2)), rng.uniform(0, 1, 60)])
    truth = Pose(np.eye(3), np.array([0.3, -0.2, 12.0]))
    pixels = -reprojection_errors(np.zeros((60, 2)), points, truth, IMU_FROM_CAMERA, RIG.camera)
    shift = np.array([0.02, -0.01, 0.015])
    guess = Pose(so3_exp(np.array([2e-4, 1e-4, 1e-3])), truth.translation + shift)

    def found(information: np.ndarray) -> CameraPose:
        solved = solve_pnp(
            pixels, points, np.full(60, 0.5), guess, information, IMU_FROM_CAMERA, RIG.camera
        )
        assert solved is not None
        return solved

    free = found(1e-9 * np.eye(6))
    np.testing.assert_allclose(free.pose.translation, truth.translation, atol=1e-6)
    assert free.rms_px < 1e-4
    shown = reprojection_information(
        pixels, points, free.pose, Pose.identity(), MountedCamera(RIG.camera, IMU_FROM_CAMERA),
        sigma_px=0.5, gate_px=3.0,
    )  # fmt: skip
    half = found(shown.information[:6, :6])
    np.testing.assert_allclose(half.pose.translation, truth.translation + 0.5 * shift, atol=5e-4)
    assert so3_log(half.pose.rotation)[2] == pytest.approx(5e-4, abs=5e-5)


def test_equations_of_the_bundle_are_derivatives_of_its_cost() -> None:
    """Gradient anywhere; second derivatives where every residual is zero."""
    rng = np.random.default_rng(7)
    poses = [
        Pose(so3_exp(0.05 * rng.standard_normal(3)), np.array([0.9 * k, -0.4 * k, 12.0]))
        for k in range(3)
    ]
    hosts, camera = np.array([0, 0, 1, 2]), RIG.camera
    rays = np.column_stack([rng.uniform(-0.3, 0.3, (4, 2)), np.ones(4)])
    landmarks, observers = np.array([0, 0, 1, 2, 2, 3]), np.array([1, 2, 1, 0, 2, 0])
    depths, sigmas = rng.uniform(10.0, 13.0, 4), np.full(6, 0.7)

    def residuals(x: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        now = [moved_by(p, x[6 * k : 6 * k + 6]) for k, p in enumerate(poses)]
        out = np.zeros((6, 2))
        for o, (m, k) in enumerate(zip(landmarks, observers, strict=True)):
            seen = IMU_FROM_CAMERA.apply(rays[m : m + 1] * (depths[m] + x[18 + m]))
            out[o] = reprojection_errors(
                pixels[o : o + 1], now[hosts[m]].apply(seen), now[k], IMU_FROM_CAMERA, camera
            )
        return out

    def equations(x: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Matrix and vector before the depths are eliminated, and the cost."""
        now = [moved_by(p, x[6 * k : 6 * k + 6]) for k, p in enumerate(poses)]
        information, vector, coupling, curvature, slope, cost = _reduced_system(
            Frames.of(now), depths + x[18:],
            Observations(hosts, rays, depths, landmarks, observers, pixels, sigmas),
            0.5, Frame.of(IMU_FROM_CAMERA), Pinhole.of(camera), 3.0,
        )  # fmt: skip
        full = np.block([
            [information + coupling.T / curvature @ coupling, coupling.T],
            [coupling, np.diag(curvature)],
        ])  # fmt: skip
        return full, np.concatenate([vector + coupling.T @ (slope / curvature), slope]), cost

    exact = -residuals(np.zeros(22), np.zeros((6, 2)))
    off = exact + rng.normal(0.0, 1.0, exact.shape)
    step = 1e-5 * np.eye(22)
    x = np.concatenate([np.zeros(18), 0.1 * np.ones(4)])

    def cost(at: np.ndarray) -> float:
        square = (residuals(at, off) ** 2).sum(axis=1) / 0.7**2
        return float(4.5 * np.log1p(square / 9.0).sum() + 0.5 * (at[18:] ** 2).sum() / 0.5**2)

    gradient = [(cost(x + e) - cost(x - e)) / 2e-5 for e in step]
    found = equations(x, off)
    np.testing.assert_allclose(found[1], -np.array(gradient), rtol=1e-4, atol=1e-3)
    prior = 0.5 * 4 * 0.1**2 / 0.5**2
    assert 0.5 * found[2] + prior == pytest.approx(cost(x), rel=1e-9)
    second = [(equations(e, exact)[1] - equations(-e, exact)[1]) / 2e-5 for e in step]
    matrix = equations(np.zeros(22), exact)[0]
    np.testing.assert_allclose(matrix, -np.array(second), rtol=1e-4, atol=0.5)


def test_equations_of_the_pose_graph_are_derivatives_of_its_cost() -> None:
    rng = np.random.default_rng(8)
    ends = [Pose(so3_exp(rng.standard_normal(3)), 3.0 * rng.standard_normal(3)) for _ in range(2)]
    graph = PoseGraph(np.full(6, np.inf), np.full(6, np.inf))
    for number, end in enumerate(ends):
        graph.add_node(number, end, end)
    aside = Pose(so3_exp(1e-3 * rng.standard_normal(3)), 0.1 * rng.standard_normal(3))
    root = rng.standard_normal((6, 6))
    measured = ends[0].inverse() @ ends[1] @ aside
    graph.add_edge(Edge(0, 1, measured, root @ root.T + 9.0 * np.eye(6), False))
    edge = graph.edges[0]

    def cost(delta: np.ndarray) -> float:
        moved = [moved_by(end, delta[6 * k :][:6]) for k, end in enumerate(ends)]
        residual = edge_residual(edge, *moved)
        return float(0.5 * residual @ edge.information @ residual)

    slope = [(cost(e) - cost(-e)) / 2e-6 for e in 1e-6 * np.eye(12)]
    np.testing.assert_allclose(graph._system()[1], -np.array(slope), rtol=5e-3, atol=5e-3)


def test_flat_triangles_are_no_lines() -> None:
    line = np.column_stack([np.arange(5.0), np.zeros(5), np.zeros(5)])
    bent = line.copy()
    bent[2, 1] = 1.0
    blunt = line.copy()
    blunt[2, 1] = 0.2  # sine of 0.198 between its sides
    flat = registration._flat_triangles(np.stack([line, bent, blunt]))
    assert flat.tolist() == [False, True, False]


def test_the_estimator_takes_the_lens_out_of_an_image() -> None:
    image = image_from(Pose(np.eye(3), np.array([0.0, 0.0, START_Z])), 60)
    assert Zou2024Estimator(RIG, params())._flat(image).rgb is image.rgb
    bent = Zou2024Estimator(make_rig(-0.2), params())._flat(image)
    assert (bent.rgb[120, 212] == image.rgb[120, 212]).all()
    assert np.abs(bent.rgb[:40].astype(float) - image.rgb[:40]).mean() > 2.0


@pytest.mark.parametrize("part", ["lidar_pose", "camera_pose", "colour_smoothness", "bundle"])
def test_every_part_can_be_left_out(part: str) -> None:
    without: dict[str, Any] = {f"use_{part}": False}
    estimates = fly(FLIGHT, dataclasses.replace(PLAIN, **without))
    assert max(map(error, estimates)) < 0.06
