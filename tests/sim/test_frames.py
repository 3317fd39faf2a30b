"""Identities on random rotations and poses."""

import numpy as np
import pytest

from touchdown.sim import frames


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def random_pose(rng: np.random.Generator) -> frames.Pose:
    return frames.Pose(frames.so3_exp(rng.normal(size=3)), rng.normal(size=3))


def test_cross_is_numpys_to_the_bit(rng: np.random.Generator) -> None:
    for scale in 10.0 ** rng.uniform(-8.0, 8.0, size=200):
        first, second = rng.normal(size=3), scale * rng.normal(size=3)
        assert np.array_equal(frames.cross(first, second), np.cross(first, second))


def test_exp_log_round_trip_including_half_turns(rng: np.random.Generator) -> None:
    for scale in (1e-12, 1e-6, 1.0, np.pi - 1e-7):
        axis = rng.normal(size=3)
        vector = scale * axis / np.linalg.norm(axis)
        np.testing.assert_allclose(frames.so3_log(frames.so3_exp(vector)), vector, atol=1e-8)


def test_quaternion_round_trip_up_to_sign(rng: np.random.Generator) -> None:
    for _ in range(200):
        quat = rng.normal(size=4)
        quat /= np.linalg.norm(quat)
        again = frames.quat_wxyz_from_matrix(frames.matrix_from_quat_wxyz(quat))
        np.testing.assert_allclose(again, quat if quat[0] >= 0 else -quat, atol=1e-12)


def test_batch_conversion_equals_single(rng: np.random.Generator) -> None:
    quats = rng.normal(size=(20, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    single = np.stack([frames.matrix_from_quat_wxyz(quat) for quat in quats])
    np.testing.assert_allclose(frames.matrices_from_quats_wxyz(quats), single, atol=1e-15)


def test_inverse_and_associativity(rng: np.random.Generator) -> None:
    a, b, c = (random_pose(rng) for _ in range(3))
    np.testing.assert_allclose((a @ a.inverse()).matrix(), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(((a @ b) @ c).matrix(), (a @ (b @ c)).matrix(), atol=1e-12)
    points = rng.normal(size=(5, 3))
    np.testing.assert_allclose((a @ b).apply(points), a.apply(b.apply(points)), atol=1e-12)


def test_right_jacobian_against_finite_differences(rng: np.random.Generator) -> None:
    vector, step = rng.normal(size=3), 1e-6
    numeric = np.stack(
        [
            frames.so3_log(frames.so3_exp(vector).T @ frames.so3_exp(vector + step * axis)) / step
            for axis in np.eye(3)
        ],
        axis=1,
    )
    np.testing.assert_allclose(frames.so3_right_jacobian(vector), numeric, atol=1e-5)


def test_yaw_tilt_and_wrapping() -> None:
    rotation = frames.rotation_from_yaw(0.7) @ frames.so3_exp(np.array([0.2, 0.0, 0.0]))
    assert frames.yaw_from_rotation(rotation) == pytest.approx(0.7)
    assert frames.tilt_from_rotation(rotation) == pytest.approx(0.2)
    assert frames.wrap_angle(3 * np.pi) == pytest.approx(np.pi)
    assert frames.wrap_angle(-0.5 - 2 * np.pi) == pytest.approx(-0.5)


def test_interpolation_ends_and_middle(rng: np.random.Generator) -> None:
    a, b = random_pose(rng), random_pose(rng)
    np.testing.assert_allclose(frames.interpolate_pose(a, b, 0.0).matrix(), a.matrix(), atol=1e-12)
    np.testing.assert_allclose(frames.interpolate_pose(a, b, 1.0).matrix(), b.matrix(), atol=1e-9)
    middle = frames.interpolate_pose(a, b, 0.5)
    np.testing.assert_allclose(
        frames.so3_log(a.rotation.T @ middle.rotation),
        frames.so3_log(middle.rotation.T @ b.rotation),
        atol=1e-9,
    )


def test_a_history_interpolates_and_spans_what_it_has() -> None:
    """Poses at 0.0, 0.1, ... 0.9 s that move by 1 m each, of which the last five are kept."""
    history = frames.PoseHistory(5)
    assert history.at(0.0) is None and history.around(0.0, 1.0) == []
    for k in range(10):
        history.add(0.1 * k, frames.Pose(np.eye(3), np.array([float(k), 0.0, 0.0])))
    history.add(0.9, frames.Pose(np.eye(3), np.full(3, 7.0)))  # no newer than the last
    history.add(1.0, frames.Pose(np.eye(3), np.full(3, np.nan)))
    places = {time_s: history.at(time_s) for time_s in (0.45, 0.5, 0.75, 2.0)}
    assert places[0.45] is None
    for time_s, x in ((0.5, 5.0), (0.75, 7.5), (2.0, 9.0)):
        found = places[time_s]
        assert found is not None and found.translation[0] == pytest.approx(x)
    spans = {(0.62, 0.78): [6, 7, 8], (0.5, 0.5): [5, 6], (0.1, 0.2): [5, 6], (0.85, 2.0): [8, 9]}
    for (start_s, end_s), expected in spans.items():
        entries = history.around(start_s, end_s)
        assert [round(entry.pose.translation[0]) for entry in entries] == expected
