"""Survey images and ground patches extracted from them."""

import dataclasses
from typing import Any

import cv2
import numpy as np
import pytest

from touchdown.landing.classification.survey_images import SurveyImages, _ground_points, brightened
from touchdown.sim.api import CameraImage
from touchdown.sim.frames import Pose, rotation_from_yaw, so3_exp
from touchdown.sim.geometry.lens import project
from touchdown.sim.typing import Array

from support.ground_class_support import photograph, plain, small_rig
from support.landing_support import make_estimate, make_obs


def _by_place(x: Array, y: Array) -> Array:
    """Red is east, green north: 4 levels a metre about 128."""
    return np.stack([128.0 + 4.0 * x, 128.0 + 4.0 * y, np.zeros_like(x)], -1)


def _kept(pose: Pose, paint: Any = _by_place, rig: Any = None, **more: Any) -> SurveyImages:
    rig = rig or small_rig()
    survey_images = SurveyImages(rig, more.get("limit", 8))
    obs = make_obs(600, images=(photograph(rig, pose, paint, 1.0),))
    survey_images.update(obs, make_estimate(600, pose))
    return survey_images


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.5])
def test_patch_shows_the_ground_around_a_site(yaw: float) -> None:
    """Tilted by 4 degrees, 20 m up, 2 m aside: the square is level, centred, and not mirrored."""
    tilt = so3_exp(np.radians([4.0, -2.0, 0.0]))
    pose = Pose(rotation_from_yaw(yaw) @ tilt, np.array([1.0, -2.0, 20.0]))
    site = np.array([3.0, -1.0, 0.0])
    patch = _kept(pose).patch(site, 6.4, 64)
    assert patch is not None and patch.shape == (64, 64, 3)
    place = (patch[..., :2].astype(float) - 128.0) / 4.0
    assert place.mean(axis=(0, 1)) == pytest.approx(site[:2], abs=0.05)
    right = (place[:, -8:] - place[:, :8]).mean(axis=(0, 1)) / (56 / 64)
    down = (place[-8:] - place[:8]).mean(axis=(0, 1)) / (56 / 64)
    assert np.linalg.norm(right) == pytest.approx(6.4, abs=0.2)
    assert np.linalg.norm(down) == pytest.approx(6.4, abs=0.2)
    assert right @ down == pytest.approx(0.0, abs=1.0)
    assert right[0] * down[1] - right[1] * down[0] < 0.0  # seen from above


def test_lens_distortion_is_removed() -> None:
    """OpenCV's own projection, with all five coefficients."""
    camera = dataclasses.replace(
        small_rig().camera, distortion=np.array([-0.2, 0.05, 0.001, -0.002, 0.01])
    )
    points = np.random.default_rng([7, 1]).uniform([-3, -2, 4], [3, 2, 9], (20, 3))
    own, ahead = project(camera, points)
    theirs, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), camera.matrix(), camera.distortion
    )
    np.testing.assert_allclose(own, theirs[:, 0], atol=1e-9)
    assert ahead.all() and not project(camera, -points)[1].any()


def test_smaller_patch_where_no_image_shows_the_whole_one() -> None:
    """At 5 m the image shows 3.9 m the short way: half of 6.4 m fits, nothing of a site aside."""
    survey_images = _kept(Pose(np.eye(3), np.array([0.0, 0.0, 5.0])))
    patch = survey_images.patch(np.zeros(3), 6.4, 32)
    width = (float(patch[:, -1, :2].mean()) - float(patch[:, 0, :2].mean())) / 2.0
    assert abs(width) == pytest.approx(0.5 * 6.4 * 31 / 32, abs=0.4)
    assert survey_images.patch(np.array([0.0, 9.0, 0.0]), 6.4, 32) is None
    assert survey_images.patch(np.zeros(3), 6.4, 32, since_s=1.5) is None


def test_kept_images_are_few_and_apart() -> None:
    rig = small_rig()
    survey_images = SurveyImages(rig, 5)
    rng = np.random.default_rng(7)
    sources = [
        rng.integers(0, 255, (rig.camera.height, rig.camera.width, 3)).astype(np.uint8)
        for _ in range(60)
    ]
    for step, source in enumerate(sources):  # 1 m a step at 20 m: one in four is kept
        pose = Pose(np.eye(3), np.array([float(step), 0.0, 20.0]))
        image = photograph(rig, pose, plain("lawn"), step / 10.0)
        obs = make_obs(60 * step, images=(dataclasses.replace(image, rgb=source),))
        estimate = make_estimate(60 * step, pose)
        survey_images.update(obs, dataclasses.replace(estimate, healthy=step != 16))
    assert 4 <= len(survey_images) <= 5
    places = sorted(kept.odom_from_camera.translation[0] for kept in survey_images._kept)
    assert places[0] == 0.0 and 16.0 not in places
    assert np.diff(places).min() >= 8.0 and places[-1] >= 40.0
    for kept in survey_images._kept:
        assert np.abs(kept.pixels() - 1.0 * sources[round(10 * kept.time_s)]).mean() < 1.0


def test_black_frozen_and_swapped_images_are_not_used() -> None:
    """5 m a step at 20 m; at odd steps something is wrong."""
    rig = small_rig()
    survey_images = SurveyImages(rig, 8)
    images = []
    for step in range(10):
        pose = Pose(np.eye(3), np.array([5.0 * step, 0.0, 20.0]))
        images.append(photograph(rig, pose, plain("lawn"), 1.0 + step / 10.0))
    images[1] = dataclasses.replace(images[1], rgb=np.zeros_like(images[1].rgb))
    images[3] = dataclasses.replace(images[3], rgb=images[2].rgb)
    images[5] = dataclasses.replace(images[5], time_s=images[4].time_s)
    for step in range(6):
        pose = Pose(np.eye(3), np.array([5.0 * step, 0.0, 20.0]))
        estimate = make_estimate(600 + 60 * step, pose)
        survey_images.update(make_obs(600 + 60 * step, images=(images[step],)), estimate)
    assert [kept.time_s for kept in survey_images._kept] == [1.0, 1.2, 1.4]
    swapped = (images[7], images[6])
    survey_images.update(make_obs(1080, images=swapped), make_estimate(1080, pose))
    assert len(survey_images) == 3
    survey_images.update(make_obs(1140, images=(images[8],)), make_estimate(1140, pose))
    assert survey_images._newest is not None and survey_images._newest.time_s == 1.8


def test_pose_of_an_image_is_that_of_its_exposure() -> None:
    """The image arrives 60 ms after its exposure, 0.3 m further on."""
    rig = small_rig()
    survey_images = SurveyImages(rig, 4)
    for step in range(13):
        pose = Pose(np.eye(3), np.array([0.025 * step, 0.0, 20.0]))
        images: tuple[CameraImage, ...] = ()
        if step == 12:
            there = Pose(np.eye(3), np.array([0.0125, 0.0, 20.0]))
            images = (photograph(rig, there, _by_place, 0.0025),)
        survey_images.update(make_obs(3 * step, images=images), make_estimate(3 * step, pose))
    assert survey_images._kept[0].odom_from_camera.translation[0] == pytest.approx(0.0125)


def _dim_grass(x: Array, y: Array) -> Array:
    """20 levels, as under the lamp at 10 m; mottled by a quarter."""
    level = 20.0 + 5.0 * np.sin(2.1 * x + 1.7 * y)
    return np.stack([0.6 * level, level, 0.4 * level], -1)


def test_images_of_a_dark_night_show_nothing() -> None:
    """Noise about a black level, without structure; under the lamp the ground shows through it."""
    rig, pose = small_rig(), Pose(np.eye(3), np.array([0.0, 0.0, 10.0]))
    survey_images = SurveyImages(rig, 8)

    def see(paint: Any, time_s: float) -> None:
        tick = round(600 * time_s)
        image = photograph(rig, pose, paint, time_s, noise=10.0)
        survey_images.update(make_obs(tick, images=(image,)), make_estimate(tick, pose))

    see(lambda x, y: np.zeros((*x.shape, 3)), 1.0)
    assert survey_images.dark and len(survey_images) == 0
    assert survey_images.patch(np.zeros(3), 6.4, 32) is None
    see(_dim_grass, 2.0)
    assert not survey_images.dark and survey_images.patch(np.zeros(3), 6.4, 32) is not None
    see(lambda x, y: np.zeros((*x.shape, 3)), 3.0)
    assert survey_images.dark


def test_a_dim_patch_is_as_bright_as_by_day_and_keeps_its_hue() -> None:
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 10.0]))
    patch = _kept(pose, _dim_grass).patch(np.zeros(3), 6.4, 32)
    assert 90.0 < patch.mean() < 125.0
    red, green, blue = patch.mean(axis=(0, 1))
    assert red / green == pytest.approx(0.6, abs=0.05)
    assert blue / green == pytest.approx(0.4, abs=0.05)
    bright = _kept(pose, lambda x, y: 4.0 * _dim_grass(x, y)).patch(np.zeros(3), 6.4, 32)
    assert bright is not None and bright.mean() == pytest.approx(80.0 * 2.0 / 3.0, abs=2.0)
    noisy = np.random.default_rng(3).integers(0, 30, (64, 64, 3)).astype(np.uint8)
    ratio = brightened(noisy).std() / brightened(noisy).mean()
    assert ratio < 0.6 * noisy.std() / noisy.mean()


def test_the_square_on_the_ground_has_its_side_however_the_camera_leans() -> None:
    lean = Pose(
        so3_exp(np.array([0.0, 0.9, 0.0])) @ so3_exp(np.array([np.pi, 0.0, 0.0])), np.zeros(3)
    )
    points = _ground_points(lean, np.array([3.0, -1.0, 0.5]), 6.0, np.array([-0.5, 0.0, 0.5]))
    np.testing.assert_allclose(points[1, 1], [3.0, -1.0, 0.5], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(points[1, 2] - points[1, 0]), 6.0)
    np.testing.assert_allclose(np.linalg.norm(points[2, 1] - points[0, 1]), 6.0)
