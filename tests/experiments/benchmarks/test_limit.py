"""`touchdown bench limit`: bounds with known answers, and derivatives against differences."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from touchdown.experiments.benchmarks.limit import imaging, ranging, survey
from touchdown.experiments.benchmarks.limit.information import (
    CLOCK,
    CONSTANTS,
    EYE_MOUNT,
    GROUPS,
    IMU_CONSTANTS,
    LANDMARK,
    LENS,
    MOUNT,
    RANGE,
    STATE,
    Densities,
    Rows,
    bound,
    constant_sigmas,
    imu_motion,
    landmark_informations,
    motion_information,
)
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.errors import UsageError
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose, so3_exp
from touchdown.sim.geometry.ray_target import Hits

LENS_OF = CameraIntrinsics(width=848, height=480, fx=617.0, fy=625.0, cx=423.5, cy=239.5)
SIGMA, REPEATS, HEIGHT = 0.03, 9, 30.0


def _heights(state, landmark, weight=1.0):
    """``REPEATS`` measurements of the height of ``landmark`` below ``state``."""
    n, unit = REPEATS, np.zeros((REPEATS, LANDMARK))
    unit[:, 2] = -1.0
    pose = np.tile([0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (n, 1))
    ids = np.full(n, state), np.full(n, landmark)
    return Rows(
        *ids, pose, np.zeros((n, CONSTANTS)), unit, np.full(n, weight / SIGMA**2), np.ones(n)
    )


def _chain(steps, accel=0.02, hertz=50):
    """Information of an IMU alone at rest over so many seconds, the start and constants known."""
    still = np.zeros((hertz, 3))
    still_force = np.tile([0.0, 0.0, 9.81], (hertz, 1))
    densities = Densities(1e-9, accel, 1e-9, 1e-9)
    turned = np.tile(np.eye(3), (hertz, 1, 1))
    motion = imu_motion(turned, still, still_force, 1.0 / hertz, densities)
    total = motion_information([motion] * steps, CONSTANTS)
    total[np.arange(STATE), np.arange(STATE)] += 1e14
    count = STATE * (steps + 1)
    total[np.arange(count, len(total)), np.arange(count, len(total))] += 1e14
    return total


def test_n_measurements_of_a_known_height_leave_sigma_over_root_n():
    total = next(landmark_informations(_heights(0, 7), [1], CONSTANTS)) + np.diag(
        [1e-3] * STATE + [1.0] * CONSTANTS
    )
    total[2, 2] += 1e12  # the state's height is known: nothing is left to learn of it
    both = Rows.joined([_heights(0, 7), _heights(1, 7)])
    two = next(landmark_informations(both, [2], CONSTANTS)) + 1e-3 * np.eye(2 * STATE + CONSTANTS)
    two[2, 2] += 1e12
    height = bound(two, [STATE + 2])[0, 0]
    # the landmark by the first state, then the second by the landmark
    assert height == pytest.approx(2.0 * SIGMA**2 / REPEATS, rel=1e-4)
    assert bound(total, [2])[0, 0] == pytest.approx(1e-12, rel=1e-3)


@pytest.mark.parametrize("seconds", [1, 10])
def test_white_noise_of_acceleration_gives_q_t_cubed_over_3(seconds):
    total = _chain(seconds, accel=0.02)
    at = STATE * seconds + np.arange(3)
    expected = 0.02**2 * seconds**3 / 3.0
    assert np.diag(bound(total, at)) == pytest.approx(np.full(3, expected), rel=1e-3)


def test_a_landmark_seen_again_ends_the_drift_and_a_sensor_never_hurts():
    seconds = 20
    alone = _chain(seconds)
    seen = Rows.joined([_heights(0, 3), _heights(seconds, 3)])
    more = alone + next(landmark_informations(seen, [seconds + 1], CONSTANTS))
    at = STATE * seconds + np.arange(3)
    before, after = bound(alone, at), bound(more, at)
    assert before[2, 2] > 1.0
    assert after[2, 2] == pytest.approx(2.0 * SIGMA**2 / REPEATS, rel=2e-3)
    assert after[0, 0] == pytest.approx(before[0, 0], rel=1e-6)
    assert np.linalg.eigvalsh(before - after).min() > -1e-6
    added = next(landmark_informations(seen, [seconds + 1], CONSTANTS))
    assert np.linalg.eigvalsh(added).min() > -1e-6 * added.max()


def test_an_error_that_measurements_share_does_not_average_out():
    rows = Rows.joined([_heights(0, 3), _heights(1, 3)]).with_common_error(0.05)
    assert np.bincount(rows.state, rows.weight) == pytest.approx(
        np.full(2, 1.0 / (SIGMA**2 / REPEATS + 0.05**2))
    )


def test_the_imu_s_constants_act_as_the_model_says():
    rotation, rate, force = so3_exp(np.array([0.3, -0.2, 0.5])), np.array([0.1, 0.2, 0.3]), 9.0
    forces = np.array([[0.5, -0.3, force]])
    motion = imu_motion(rotation[None], rate[None], forces, 1e-3, Densities(1, 1, 1, 1))
    gyro, accel = np.zeros(IMU_CONSTANTS), np.zeros(IMU_CONSTANTS)
    matrix = np.arange(9.0).reshape(3, 3)
    gyro[:9], accel[18:] = matrix.ravel(), matrix.ravel()
    turned, pushed = motion.by_constant @ gyro, motion.by_constant @ accel
    assert turned[6:9] == pytest.approx(-1e-3 * rotation @ matrix @ rate, rel=1e-6)
    assert pushed[3:6] == pytest.approx(-1e-3 * rotation @ matrix @ forces[0], rel=1e-6)
    lean = np.array([1e-3, 2e-3, -1e-3])
    moved = motion.transition[3:6, 6:9] @ lean
    assert moved == pytest.approx(1e-3 * np.cross(lean, rotation @ forces[0]), rel=1e-3)


BODY = Pose(so3_exp(np.array([0.05, -0.1, 0.7])), np.array([3.0, -2.0, HEIGHT]))
RATES = np.array([1.0, 2.0, -0.5, 0.1, -0.2, 0.3])
NONE = np.zeros(6)
DOWN = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
MOUNTS = SimpleNamespace(
    camera=Pose(so3_exp(np.array([0.02, 0.01, 0.0])) @ DOWN, np.array([0.1, 0.02, -0.05])),
    lidar=Pose(DOWN, np.array([0.05, 0.0, -0.08])),
)


def _flight():
    where = np.array([BODY.translation]), np.array([BODY.rotation])
    path = SimpleNamespace(
        at=lambda t: [np.repeat(part, len(t), axis=0) for part in where],
        times_s=np.arange(2.0),
        positions=np.array([BODY.translation, BODY.translation + RATES[:3]]),
        attitudes=Rotation.from_matrix([BODY.rotation, so3_exp(RATES[3:]) @ BODY.rotation]),
    )
    return ranging.Flight(None, SimpleNamespace(mounts=MOUNTS), path, 0.5)


def _moved(shift):
    """The body with an error (6,) of position and rotation in world axes."""
    return Pose(so3_exp(shift[3:]) @ BODY.rotation, BODY.translation + shift[:3])


def test_pixels_move_as_their_rows_say():
    points = np.array([[2.0, -1.0, 0.3], [8.0, -6.0, -0.2]])
    normals = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]])
    seen = imaging.Features(points, normals, np.zeros(2, np.int64), np.arange(2))
    rows = imaging.image_rows(_flight(), LENS_OF, seen, images=5.0)
    assert rows.weight == pytest.approx(np.full(4, 5.0 / imaging.PIXEL_SIGMA**2))
    frame = np.concatenate([ranging.tangents(normals), normals[:, None]], axis=1)

    def pixel(pose=NONE, mount=NONE, local=NONE[:3]):
        body = _moved(pose)
        turned = MOUNTS.camera.rotation @ so3_exp(mount[:3])
        center = MOUNTS.camera.translation + MOUNTS.camera.rotation @ mount[3:]
        eye = Pose(body.rotation @ turned, body.apply(center))
        return imaging.pixels(LENS_OF, eye, points + local @ frame)[0].ravel()

    for k in range(6):
        step = 1e-6 * np.eye(6)[k]
        slope = (pixel(pose=step) - pixel(pose=-step)) / 2e-6
        assert rows.pose[:, k] == pytest.approx(slope, abs=1e-3)
        slope = (pixel(mount=step) - pixel(mount=-step)) / 2e-6
        assert rows.constant[:, EYE_MOUNT][:, k] == pytest.approx(slope, abs=1e-3)
    for k in range(3):
        step = 1e-6 * np.eye(3)[k]
        slope = (pixel(local=step) - pixel(local=-step)) / 2e-6
        assert rows.local[:, k] == pytest.approx(slope, abs=1e-3)
    assert rows.constant[:, CLOCK][:, 0] == pytest.approx(rows.pose @ RATES)
    x, y = (pixel().reshape(2, 2).T - [[423.5], [239.5]]) / [[617.0], [625.0]]
    assert rows.constant[::2, LENS][:, [0, 2, 4]] == pytest.approx(
        np.column_stack([np.ones(2), 617.0 * x, 617.0 * x * (x * x + y * y)])
    )


def test_ranges_move_as_their_rows_say():
    normal = np.array([[0.0, 0.6, 0.8]])
    ray = np.array([[0.2, -0.3, -1.0]]) / np.linalg.norm([0.2, -0.3, -1.0])
    origin = BODY.apply(MOUNTS.lidar.translation)
    points = origin + 31.0 * ray
    pulses = ranging.Pulses(np.zeros(1), origin[None], ray, np.full(1, 31.0), np.full(1, 40.0))
    struck = SimpleNamespace(distance=np.full(1, 31.0), normal=normal, hits=Hits.none(1))
    found = ranging.Places(pulses, struck, points, -(ray * normal).sum(axis=1))
    center = points - [[0.1, 0.08, -0.06]]
    patches = ranging.Patches(np.zeros(1, np.int64), np.ones(1), center, normal, np.array([4]))
    rows = ranging._plane_rows(_flight(), found, patches, np.ones(1))
    assert rows.landmark.tolist() == [4]

    def off(pose=NONE, mount=NONE):
        beam = BODY.rotation.T @ (points[0] - origin)
        body = _moved(pose)
        place = MOUNTS.lidar.translation + mount[3:] + so3_exp(mount[:3]) @ beam
        return float(normal[0] @ (body.apply(place) - points[0]))

    for k in range(6):
        step = 1e-6 * np.eye(6)[k]
        assert rows.pose[0, k] == pytest.approx((off(step) - off(-step)) / 2e-6, abs=1e-6)
        slope = (off(mount=step) - off(mount=-step)) / 2e-6
        assert rows.constant[0, MOUNT][k] == pytest.approx(slope, abs=1e-6)
    across = ranging.tangents(normal)[0] @ (points - center)[0]
    assert rows.local[0] == pytest.approx([0.0, 0.0, -1.0, *-across])


def test_bounds_and_errors_are_printed_side_by_side(tmp_path):
    run = {
        "scene": "lake",
        "revision": "abc",
        "bound_m": {title: {"mean": 0.004} for title in survey.SETS},
        "changed_m": {title: {"features to 3 px": 0.0051} for title in survey.SETS},
        "reached_m": dict.fromkeys(survey.REPLAYED, 0.1),
    }
    printed = survey.table([run]).splitlines()
    assert "| camera, LIDAR, IMU | 0.0040 |" in printed
    assert "| camera, LIDAR, IMU | 0.100 (25) |" in printed
    assert "| features to 3 px | 0.0051 |" in printed
    with pytest.raises(UsageError, match="no run directory"):
        survey.measure(tmp_path, False, print)


def test_what_is_known_of_the_constants_is_what_the_profile_draws():
    sigmas = constant_sigmas(load_config(None, ()), LENS_OF)
    assert sigmas[[0, 1, 9, 18]] == pytest.approx([0.003, np.deg2rad(0.1), 1.8e-4, 0.003])
    assert sigmas[MOUNT] == pytest.approx([np.deg2rad(0.1)] * 3 + [0.005] * 3)
    assert sigmas[RANGE][0] == pytest.approx(0.3 * 0.02 / np.sqrt(3.0))
    covered = np.concatenate([np.r_[part] for parts in GROUPS.values() for part in parts])
    assert sorted(covered) == list(range(CONSTANTS))
