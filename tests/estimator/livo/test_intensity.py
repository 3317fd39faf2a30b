"""Intensity images and the photometric update, over ground of known reflectivity."""

from dataclasses import replace

import numpy as np
import pytest

from touchdown.estimator.api import LivoParams
from touchdown.estimator.filtering.deskew import PlacedScan
from touchdown.estimator.filtering.error_state import Frame
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.imu_propagation import NavState
from touchdown.estimator.livo.estimator import AnchoredMap
from touchdown.estimator.livo.intensity import (
    ImageView,
    IntensityImage,
    PhotometricUpdate,
    brightness,
    photometry,
)
from touchdown.estimator.livo.scan_update import Returns, ScanErrors
from touchdown.sim.frames import Pose, so3_exp

LEVER = np.array([0.1, 0.0, 0.05])
TRUE = Pose(so3_exp(np.array([-0.04, 0.06, 0.3])), np.array([2.0, 1.0, 30.0]))
DARK = 10_000
"""ticks without an image"""


def reflectivity(places, texture=1.0):
    """Logarithm of the intensity of (N, 3) places."""
    wave = np.sin(1.3 * places[:, 0] + 0.3) + np.cos(0.9 * places[:, 1] - 0.2 * places[:, 0])
    return 3.5 + 0.4 * texture * wave


def ground(count, seed):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-15.0, 18.0, (count, 2)), np.zeros(count)])


def scan_from(pose, places):
    points = pose.inverse().apply(places)
    return PlacedScan(points, points - LEVER, np.arange(len(points)))


def image_of(clone, texture=1.0, seed=0):
    image = IntensityImage.of(clone.rotation, 30.0, np.zeros(0))
    places = ground(300_000, seed)
    image.add(clone.inverse().apply(places), reflectivity(places, texture))
    return image


def levels(places, texture=1.0):
    return np.exp(reflectivity(places, texture)).round().astype(np.uint8)


def filter_at(pose, update, texture=1.0, sigma_m=0.3):
    """A filter whose first clone is exactly at the true pose and carries an image, and whose state
    is at ``pose``."""
    eskf = Eskf(NavState(0, TRUE.rotation, TRUE.translation, *np.zeros((3, 3))), np.full(15, 1e-12))
    eskf.add_clone()
    update.begin(eskf, 30.0, 0)
    places = ground(300_000, 1)
    update.extend(eskf, TRUE.inverse().apply(places), levels(places, texture))
    eskf.state = NavState(0, pose.rotation, pose.translation, *np.zeros((3, 3)))
    eskf.covariance[2, 2] += 0.01**2
    eskf.covariance[3:5, 3:5] += sigma_m**2 * np.eye(2)
    return eskf


def test_image_holds_the_reflectivity_of_places():
    image = image_of(TRUE)
    means, weights = image.smoothed()
    centre = TRUE.inverse().apply(np.array([[3.0, 4.0, 0.0]]))[0]
    at = np.floor(image.axes @ centre / image.cell_m).astype(int) + means.shape[0] // 2
    assert weights[at[1], at[0]] > 5.0
    assert means[at[1], at[0]] == pytest.approx(
        reflectivity(np.array([[3.0, 4.0, 0.0]]))[0], abs=0.06
    )
    assert image.fraction_known(TRUE.inverse().apply(ground(500, 5))) > 0.98
    assert image.fraction_known(TRUE.inverse().apply(ground(500, 5) + [200.0, 0, 0])) == 0.0


HERE = Frame.of(Pose.identity())


def view_of(image, clone_rotation, mount_change=(0.0,) * 6):
    """An image as the kernel takes it."""
    return ImageView(
        *image.smoothed(), image.axes, image.cell_m, clone_rotation, np.array(mount_change[:3]),
        np.array(mount_change[3:]),
    )  # fmt: skip


def test_faint_intensities_count_alike():
    assert brightness(np.array([0, 4, 8], dtype=np.uint8)).tolist() == pytest.approx(
        [np.log(4), np.log(4), np.log(8)]
    )


@pytest.mark.parametrize("coordinate", [*range(5), *range(6, 17)])
def test_derivatives_agree_with_differences(coordinate):
    clone = Pose(so3_exp(np.array([0.05, -0.03, 0.4])), np.array([1.0, 2.0, 28.0]))
    image, places = image_of(clone), ground(4000, 2)
    points = TRUE.inverse().apply(places)

    def at(error):
        now = Pose(TRUE.rotation @ so3_exp(error[:3]), TRUE.translation + error[3:6])
        key = Pose(clone.rotation @ so3_exp(error[12:15]), clone.translation + error[15:])
        turned = so3_exp(error[6:9]) @ (points - LEVER).T
        seen = turned.T + LEVER + error[9:12]
        move = key.inverse() @ now
        return photometry(
            Returns(seen.copy(), points - LEVER), reflectivity(places),
            view_of(image, key.rotation, error[6:12]), Frame.of(move), LEVER, 0.3,
        )  # fmt: skip

    start = at(np.zeros(18))
    error = np.zeros(18)
    error[coordinate] = 2e-2 if coordinate in (3, 4, 9, 10, 11, 15, 16) else 1e-3
    change = at(error).vector - start.vector
    predicted = -start.information @ error
    scale = np.sqrt(np.diag(start.information))
    scale = np.maximum(scale, 0.01 * scale.max())
    assert (
        np.linalg.norm((change - predicted) / scale)
        < 0.06 * np.linalg.norm(predicted / scale) + 0.02 * abs(error[coordinate]) * scale.max()
    )


def test_update_finds_the_true_position_over_flat_ground():
    update = PhotometricUpdate(LEVER)
    eskf = filter_at(Pose(TRUE.rotation, TRUE.translation + [0.25, -0.2, 0.0]), update)
    places = ground(4000, 3)
    figures = update.measure(eskf, scan_from(TRUE, places), levels(places), DARK)
    assert figures["intensity_used"] > 3500
    assert np.abs(eskf.state.position - TRUE.translation).max() < 0.02
    assert np.sqrt(eskf.covariance[3, 3]) < 0.04


def test_an_image_that_does_not_fit_is_not_used():
    """As of water, whose brightness depends on where it is seen from."""
    update, places = PhotometricUpdate(LEVER), ground(4000, 3)
    eskf = filter_at(TRUE, update, texture=2.0)
    moved = levels(places + [0.5, 0.6, 0.0], texture=2.0)
    figures = update.measure(eskf, scan_from(TRUE, places), moved, DARK)
    assert figures["intensity_sigma"] > 0.3 and figures["intensity_images"] == 0.0
    assert np.array_equal(eskf.state.position, TRUE.translation)


def test_a_scan_is_compared_with_the_newest_and_the_best_known_images():
    """Five at most of those that cover 0.12 of it."""
    update, places = PhotometricUpdate(LEVER), ground(4000, 3)
    eskf = filter_at(TRUE, update)
    image = update.images[0]
    for k in range(1, 8):
        eskf.add_clone()
        update.images.append(image)
        at = eskf.clone_indices(k)[3:5]
        eskf.covariance[at, at] = (8.0 - k) ** 2 * 1e-4 + 1.0 * (k == 7)
    points = scan_from(TRUE, places).points
    assert update.choose(eskf, points) == [0, 4, 5, 6, 7]
    for fraction, expected in ((0.10, []), (0.14, [0, 4, 5, 6, 7])):
        beside = points.copy()
        beside[round(fraction * len(points)) :] += [200.0, 0.0, 0.0]
        assert update.choose(eskf, np.random.default_rng(0).permutation(beside)) == expected


def test_scans_measure_in_the_dark_only():
    update = PhotometricUpdate(LEVER, 300, plane_height_m=0.05)
    pose = Pose(TRUE.rotation, TRUE.translation + [0.25, -0.2, 0.0])
    eskf = filter_at(pose, update)
    places = ground(4000, 3)
    assert update.measure(eskf, scan_from(TRUE, places), levels(places), 300) == {}
    assert np.array_equal(eskf.state.position, pose.translation)
    errors = ScanErrors(range_sigma_m=0.02, angle_sigma_rad=1e-3, floor_sigmas=np.full(6, 0.1))
    assert update.errors_of_planes(errors, 300) is errors
    assert update.errors_of_planes(errors, 301).floor_sigmas[:2].max() < 1e-3
    assert update.errors_of_planes(errors, 301).floor_sigmas[2:].tolist() == [0.1, 0.02, 0.02, 0.1]
    sure = replace(errors, floor_sigmas=np.full(6, 0.02))
    assert update.errors_of_planes(sure, 301).floor_sigmas[2:].tolist() == [0.02, 0.02, 0.02, 0.05]
    given = AnchoredMap(LivoParams(dark_height_sigma_m=0.3), LEVER, 300, 600).photometric
    assert given.errors_of_planes(errors, 301).floor_sigmas.max() == 0.3
    off = PhotometricUpdate(LEVER, None)
    off.begin(eskf, 30.0, DARK)
    assert off.images == []


def test_images_follow_the_clones():
    update = PhotometricUpdate(LEVER)
    eskf = filter_at(TRUE, update)
    variance = eskf.covariance[3, 3]
    eskf.add_clone()
    update.begin(eskf, 20.0, DARK)
    first, second = update.images
    assert (first.cell_m, second.cell_m) == pytest.approx((0.18, 0.12))
    assert eskf.covariance[-3, -3] == pytest.approx(variance + 0.05**2)
    update.drop(0)
    assert update.images == [second]


def test_the_brightness_of_a_scan_as_a_whole_does_not_count():
    image, places = image_of(TRUE), ground(2000, 2)
    points = TRUE.inverse().apply(places)
    bright, dark = (
        photometry(
            Returns(points, points - LEVER), reflectivity(places) + more,
            view_of(image, TRUE.rotation), HERE, LEVER, 1e3,
        ).vector
        for more in (0.5, 0.0)
    )  # fmt: skip
    np.testing.assert_allclose(bright, dark, atol=1e-3 * np.abs(dark).max())


def test_heights_of_returns_do_not_show_the_tilt():
    """Over rough ground all returns turn as if at their mean height, and tilt cannot be told from a
    shift."""
    places = ground(4000, 2)
    places[:, 2] = np.random.default_rng(4).uniform(-2.0, 2.0, len(places))
    now, clone = (Pose(so3_exp(np.array([0.0, 0.0, yaw])), TRUE.translation) for yaw in (0.3, 1.9))
    points, move = now.inverse().apply(places), clone.inverse() @ now
    rows = photometry(
        Returns(points, points - LEVER), reflectivity(places),
        view_of(image_of(clone), clone.rotation), Frame.of(move), LEVER, 0.3,
    ).information  # fmt: skip
    height = points[:, 2].mean()
    level = np.array([[0.0, -height], [height, 0.0]])
    turned = now.rotation[:2, :2].T @ rows[3:5]
    np.testing.assert_allclose(rows[:2], level @ turned, atol=1e-6 * rows.max())
    turned = clone.rotation[:2, :2].T @ rows[15:17]
    np.testing.assert_allclose(rows[12:14], level @ turned, atol=1e-6 * rows.max())
    lower = level * (height - LEVER[2]) / height
    np.testing.assert_allclose(rows[6:8], lower @ rows[9:11], atol=1e-6 * rows.max())


def test_noise_of_the_image_is_no_texture():
    update = PhotometricUpdate(LEVER)
    eskf = filter_at(TRUE, update)
    scan, places = scan_from(TRUE, ground(2000, 2)), ground(2000, 2)
    noisy = reflectivity(places) + np.random.default_rng(3).normal(0.0, 0.3, 2000)
    found, *_ = update._accumulate(
        eskf, [0], Returns(scan.points, scan.beams), noisy, np.array([0.25])
    )
    image = view_of(update.images[0], TRUE.rotation)
    part = photometry(Returns(scan.points, scan.beams), noisy, image, HERE, LEVER, 0.25)
    assert 0.02 < part.noise_fraction < 0.7
    np.testing.assert_allclose(
        found[:6, :6], (1.0 - part.noise_fraction) * part.information[:6, :6], atol=1e-6
    )
