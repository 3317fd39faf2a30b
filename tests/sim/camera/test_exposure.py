"""Exposure: control with a lag, motion blur, photon and read noise, darkness."""

import dataclasses
from contextlib import closing

import numpy as np
import pytest

from touchdown.scenes.api import LIGHT_LUX, Light, Scene
from touchdown.sim.api import CameraParams, LampParams
from touchdown.sim.camera.optics import intrinsics_of
from touchdown.sim.camera.row_exposures import MIDDLE_GREY, AutoExposure
from touchdown.sim.camera.sensor import CameraSensor
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array, Bytes

from support.camera_support import HEIGHT_M, make_scene, posed
from support.shutter_support import Stand

EXPOSED = CameraParams(exposure=True)
STRIPE = '<geom type="box" size="30 0.1 0.001" pos="0 0 0.001" rgba="0.95 0.95 0.95 1"/>'


def linear(image: Bytes) -> Array:
    """Fraction of saturation."""
    fraction: Array = (image / 255.0) ** 2.2
    return fraction


def still(
    scene: Scene, params: CameraParams, light: Light = "day", lamp: LampParams | None = None
) -> Bytes:
    """An image at rest, once the exposure has settled."""
    lit = dataclasses.replace(scene, light=light)
    with closing(CameraSensor(lit, params, 0, lamp=lamp)) as sensor:
        return sensor.render(sensor.snapshot(posed(lit)), 7)


def test_the_control_follows_with_its_time_constant() -> None:
    """A hundredfold drop of the light: after one lag the logarithm of the exposure has done
    1 - 1/e of its way, at steps of any length."""
    params = dataclasses.replace(EXPOSED, exposure_lag_s=0.3, exposure_min_s=1e-6)
    for step_s in (0.3, 0.1, 0.05):
        control = AutoExposure(params)
        before = control.follow(20e3, 0.0)
        for n in range(1, round(0.3 / step_s) + 1):
            after = control.follow(200.0, n * step_s)
        way = np.log(after.time_s * after.gain / (before.time_s * before.gain)) / np.log(100.0)
        assert way == pytest.approx(1.0 - np.exp(-1.0), rel=1e-6)
    assert control.follow(200.0, 60.0) == control.settled(200.0)


def test_time_grows_before_gain_and_both_have_limits() -> None:
    control = AutoExposure(EXPOSED)
    p = EXPOSED
    per_s = p.electrons_per_lux_s / (MIDDLE_GREY * p.full_well_e)
    assert control.settled(1e7) == control.settled(1e9)
    assert control.settled(1e9).time_s == pytest.approx(p.exposure_min_s)
    medium = control.settled(1.0 / (per_s * 0.01))
    assert (medium.time_s, medium.gain) == (pytest.approx(0.01), 1.0)
    dim = control.settled(1.0 / (per_s * 4.0 * p.exposure_max_s))
    assert (dim.time_s, dim.gain) == (p.exposure_max_s, pytest.approx(4.0))
    assert control.settled(1e-9).gain == p.gain_max


def test_a_scene_in_any_light_but_night_becomes_middle_grey() -> None:
    scene = make_scene(floor="0.5 0.5 0.5 1")
    for light in ("day", "overcast", "dusk"):
        assert still(scene, EXPOSED, light).mean() == pytest.approx(110.0, abs=2.0)


def test_flying_onto_dark_ground_is_dark_until_the_control_has_followed() -> None:
    """The floor turns from bright to dark within an image: at first a tenth of middle grey's light,
    after three lags nearly all of it."""
    params = dataclasses.replace(EXPOSED, exposure_lag_s=0.3, exposure_min_s=1e-6)
    sensor = CameraSensor(make_scene(floor="0.9 0.9 0.9 1"), params, 0)
    dark = make_scene(floor="0.2 0.2 0.2 1")
    stand = Stand(dark, lambda _: Pose(np.eye(3), np.array([0.0, 0.0, HEIGHT_M])))
    stand.rows(sensor, 0.0, 0)
    bright = linear(stand.rows(sensor, 0.0, 0, 0.0)).mean()
    sensor._model.geom("floor").rgba[:3] = 0.2
    seen = [linear(stand.rows(sensor, 0.0, n, n / 10.0)).mean() for n in range(1, 13)]
    sensor.close()
    drop = (0.2 / 0.9) ** 2.2
    assert bright == pytest.approx(MIDDLE_GREY, rel=0.02)
    for n in (1, 3, 6, 12):
        expected = MIDDLE_GREY * drop ** np.exp(-n / 10.0 / 0.3)
        assert seen[n - 1] == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize(("speed_mps", "time_s"), [(8.0, 0.02), (15.0, 0.03), (20.0, 0.03)])
def test_blur_is_as_long_as_speed_times_exposure_over_depth(
    speed_mps: float, time_s: float
) -> None:
    """A stripe across the motion: its profile gains the variance L^2 / 12 of a box of the length
    L = f v t / depth."""
    fixed = {"exposure_min_s": time_s, "exposure_max_s": time_s, "gain_max": 1.0}
    params = CameraParams(
        exposure=True, read_noise_e=0.0, full_well_e=1e9, electrons_per_lux_s=1e9 / 80e3 / time_s,
        **fixed,  # type: ignore[arg-type]
    )  # fmt: skip
    scene = make_scene(STRIPE)

    def variance(speed: float) -> float:
        sensor = CameraSensor(scene, params, 0)
        stand = Stand(scene, lambda t: Pose(np.eye(3), np.array([0.0, speed * t, HEIGHT_M])))
        profile = linear(stand.rows(sensor, 0.0)[100:380, :, 0]).mean(axis=0)
        sensor.close()
        places = np.arange(len(profile))
        middle = (profile * places).sum() / profile.sum()
        assert middle == pytest.approx(423.5, abs=0.5)
        return float((profile * (places - middle) ** 2).sum() / profile.sum())

    length = intrinsics_of(params).fx * speed_mps * time_s / HEIGHT_M
    gained = variance(speed_mps) - variance(0.0)
    assert np.sqrt(12.0 * gained) == pytest.approx(length, rel=0.06)


@pytest.mark.parametrize(("gain", "read_noise_e"), [(1.0, 0.0), (1.0, 15.0), (4.0, 0.0)])
def test_shot_noise_has_the_variance_of_the_mean_electrons(
    gain: float, read_noise_e: float
) -> None:
    """Few electrons, so that their noise is far above the steps of grey levels."""
    well = 800.0
    params = CameraParams(
        exposure=True, full_well_e=well, read_noise_e=read_noise_e, exposure_min_s=0.01,
        exposure_max_s=0.01, gain_max=gain,
        electrons_per_lux_s=well / gain / (LIGHT_LUX["day"] * 0.01) * (MIDDLE_GREY * 3.0), gain=1.0,
    )  # fmt: skip
    image = still(make_scene(floor="0.55 0.55 0.55 1"), params)
    electrons = linear(image[60:-60, 60:-60]) * well / gain
    mean = electrons.mean()
    assert 20.0 < mean < 300.0
    assert electrons.var() == pytest.approx(mean + read_noise_e**2, rel=0.06)
    first, second = electrons[..., 0].ravel(), electrons[..., 1].ravel()
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.02
    assert abs(np.corrcoef(first[1:], first[:-1])[0, 1]) < 0.02


def test_an_exposed_image_replaces_the_grey_noise_and_repeats_by_seed_and_tick() -> None:
    scene = make_scene(floor="0.5 0.5 0.5 1")
    loud = dataclasses.replace(EXPOSED, noise_sigma=40.0)
    np.testing.assert_array_equal(still(scene, EXPOSED), still(scene, loud))


@pytest.mark.parametrize(("below_m", "lamp"), [(12.0, 0.0), (25.0, 1.0)])
def test_light_and_lamp_are_noted(below_m: float, lamp: float) -> None:
    """A white floor 20 m below at night: the light of 2 mlx where the lamp does not reach it."""
    scene = dataclasses.replace(make_scene(floor="0.8 0.8 0.8 1"), light="night")
    sensor = CameraSensor(scene, CameraParams(), 0, lamp=LampParams(below_m=below_m))
    sensor.render(sensor.snapshot(posed(scene)), 7)
    sensor.close()
    sensor.effects.end_message()
    sensor.effects.deliver(1)
    noted = sensor.effects.delivered
    assert noted["lamp"].mean_fraction == lamp and ("light_lux" in noted) == (lamp == 0.0)
    if lamp == 0.0:
        assert 2e-4 < noted["light_lux"].mean_amount < 2e-3
        assert noted["gain"].mean_amount == CameraParams().gain_max
