"""Haze: the veil by hand, estimation in a climb, removal from an image."""

import numpy as np
import pytest

from touchdown.landing.classification.haze import Haze, darkest_light, estimate_haze
from touchdown.landing.classification.survey_images import SurveyImages
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array

from support.ground_class_support import photograph, small_rig
from support.landing_support import make_estimate, make_obs

FOG = Haze(0.02, 0.5)
CLIMB = 3.0 * 1.2 ** np.arange(13)
"""3 to 27 m"""


def test_the_veil_at_a_known_distance() -> None:
    """Over ln 2 / e half of the light is left, and half of the airlight added."""
    half = np.log(2.0) / FOG.extinction
    np.testing.assert_allclose(FOG.veil(np.array([0.0, half, 1e9])), [0.0, 0.25, 0.5])


def test_haze_is_removed() -> None:
    rng = np.random.default_rng(1)
    clear = rng.integers(0, 256, (40, 60, 3)).astype(np.uint8)
    away = rng.uniform(5.0, 40.0, (40, 60))
    light = (clear / 255.0) ** 2.2 * np.exp(-0.02 * away)[..., None] + FOG.veil(away)[..., None]
    hazy = np.rint(255.0 * light ** (1.0 / 2.2)).astype(np.uint8)
    found = FOG.removed(hazy, away)
    # half a level of rounding is up to 3 where light is strong, more where hardly any is left
    bright = clear > 60
    assert np.abs(found[bright].astype(float) - clear[bright]).max() <= 3.0
    assert found[~bright].max() < 75
    np.testing.assert_array_equal(Haze().removed(hazy, away), hazy)


def test_noise_is_not_amplified_where_no_light_comes_through() -> None:
    """At 300 m 0.2 % is left: a level of noise would be 400 levels."""
    noisy = np.full((2, 2, 3), 186, np.uint8)  # the airlight
    noisy[0, 0] = 187
    found = FOG.removed(noisy, np.full((2, 2), 300.0)).astype(float)
    assert np.ptp(found) < 60


def test_darkest_light_is_that_of_a_few_pixels_in_one_colour() -> None:
    rgb = np.full((200, 200, 3), 200, np.uint8)
    assert darkest_light(rgb) == pytest.approx((200 / 255) ** 2.2)
    rgb[:40, :40, 2] = 51
    assert darkest_light(rgb) == pytest.approx(0.2**2.2)


@pytest.mark.parametrize("ground", [0.0, 0.02])
def test_extinction_and_airlight_are_found_in_a_climb(ground: float) -> None:
    """With most images from one height, and treetops in a third of these."""
    heights = np.concatenate([CLIMB, np.full(30, 30.0)])
    away = heights.copy()
    away[-10:] = 22.0
    seen = FOG.veil(away) + ground * np.exp(-FOG.extinction * away)
    haze = estimate_haze(heights, seen)
    assert haze.extinction == pytest.approx(FOG.extinction, rel=0.02)
    assert haze.airlight == pytest.approx(FOG.airlight, rel=0.02)


@pytest.mark.parametrize(
    "lights",
    [
        np.full(43, 0.005),  # shadows everywhere
        np.full(43, 0.4),  # concrete everywhere
        np.linspace(0.4, 0.01, 43),  # up from a bright pad
        np.where(np.arange(43) % 4 == 0, 0.01, np.linspace(0.01, 0.3, 43)),  # from lawn over roofs
    ],
)
def test_bright_and_dark_ground_is_not_taken_for_haze(lights: Array) -> None:
    heights = np.concatenate([CLIMB, np.full(30, 30.0)])
    assert estimate_haze(heights, lights) == Haze()


def test_images_from_one_height_do_not_determine_haze() -> None:
    heights = np.linspace(28.0, 32.0, 40)
    assert estimate_haze(heights, FOG.veil(heights)) == Haze()
    assert estimate_haze(np.zeros(0), np.zeros(0)) == Haze()


def _ground(x: Array, y: Array) -> Array:
    """Squares of a metre: red, green and black."""
    which = (np.floor(x) + np.floor(y)).astype(int) % 3
    return np.array([[200.0, 30.0, 10.0], [40.0, 160.0, 20.0], [5.0, 5.0, 5.0]])[which]


def _climbed(haze: Haze) -> SurveyImages:
    rig = small_rig()
    survey_images = SurveyImages(rig, 40)
    for step, height in enumerate(CLIMB):
        pose = Pose(np.eye(3), np.array([0.0, 0.0, height]))

        def hazy(x: Array, y: Array, lens: Pose = pose @ rig.body_from_camera) -> Array:
            away = np.linalg.norm(
                np.stack([x, y, np.zeros_like(x)], -1) - lens.translation, axis=-1
            )
            light = (_ground(x, y) / 255.0) ** 2.2 * np.exp(-haze.extinction * away)[..., None]
            return 255.0 * (light + haze.veil(away)[..., None]) ** (1.0 / 2.2)

        image = photograph(rig, pose, hazy, float(step), noise=0.0)
        survey_images.update(make_obs(600 * step, images=(image,)), make_estimate(600 * step, pose))
    return survey_images


def test_patches_are_as_in_clear_air() -> None:
    """But for where a pixel shows two colours, which mix in light and are interpolated in levels:
    the true haze leaves as much."""
    site = np.array([0.5, 0.5, 0.0])
    clear, hazy = _climbed(Haze()), _climbed(FOG)
    assert clear.haze == Haze() and hazy.haze.extinction == pytest.approx(0.02, rel=0.15)
    wanted = np.asarray(clear.patch(site, 3.2, 48, since_s=12.0), float)
    found = np.asarray(hazy.patch(site, 3.2, 48, since_s=12.0), float)
    hazy._haze = Haze()
    left = np.asarray(hazy.patch(site, 3.2, 48, since_s=12.0), float)
    assert np.abs(left - wanted).mean() > 80.0 and np.abs(found - wanted).mean() < 8.0
