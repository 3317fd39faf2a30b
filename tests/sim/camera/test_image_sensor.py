"""The image sensor's kernels against known answers: places in the drawing, noise of grey levels."""

import math

import cv2
import numpy as np
import pytest

from touchdown.scenes.api import LIGHT_LUX
from touchdown.sim.api import CameraIntrinsics, CameraParams, LampParams
from touchdown.sim.camera import image_sensor
from touchdown.sim.camera.gl import InverseDepth
from touchdown.sim.camera.lamp import LampField, lamp_field, lamp_row, peak_candela, shines
from touchdown.sim.camera.optics import GAMMA, NOISE_MARGIN, intrinsics_of, make_lens
from touchdown.sim.camera.shutter import _RIGID_PX, identity_shifts, sample_row


@pytest.mark.parametrize("gain", [1.0, 2.0])
def test_noise_of_grey_levels_is_that_of_their_electrons(gain: float) -> None:
    """Shot and read noise, carried to grey levels by the display's power law, to 8 %."""
    light = image_sensor.Exposed(electrons=12e3, full_well=25e3, read_noise=6.0, gain=gain)
    tone = image_sensor.quiet_tone(light)
    level = np.arange(20.0, 256.0)
    electrons = 12e3 * (level / 255.0) ** GAMMA
    grey = 255.0 * (electrons * gain / 25e3) ** (1.0 / GAMMA)
    np.testing.assert_allclose(tone.scale * level, grey, rtol=1e-5)
    slope = grey / (GAMMA * electrons)
    spread = tone.floor + sum(
        a * np.minimum(level, b) for a, b in zip(tone.slopes, tone.bends, strict=True)
    )
    np.testing.assert_allclose(spread, slope * np.sqrt(electrons + 36.0), rtol=0.08)
    assert len(tone.slopes) == len(tone.bends) == len(image_sensor._BENDS) + 1


def test_rows_show_the_drawing_between_its_pixels() -> None:
    """Blocks that move as a whole, and blocks whose pixels do not, beside OpenCV's remap."""
    drawn = np.random.default_rng(0).integers(0, 256, (40, 120, 3), dtype=np.uint8)
    bottom_first = np.ascontiguousarray(drawn[::-1])
    x = np.arange(100, dtype=np.float32) + np.float32(7.3)
    y = np.full(100, 20.6, np.float32)
    x[40:] += np.linspace(0.0, 9.0, 60, dtype=np.float32)
    y[70] += np.float32(5.0)
    levels = np.empty(300, np.float32)
    sample_row(bottom_first, x, y, levels)
    smooth = drawn.astype(np.float32)
    shown = cv2.remap(smooth, x[None], y[None], cv2.INTER_LINEAR)[0].ravel()
    np.testing.assert_allclose(levels, shown, atol=256.0 * (1.0 / 32.0))  # OpenCV's own steps
    slightly = x + np.linspace(0.0, 0.9 * _RIGID_PX, 100, dtype=np.float32)
    within = np.empty(300, np.float32)
    sample_row(bottom_first, slightly, y, within)
    assert np.abs(within - levels).max() <= 256.0 * _RIGID_PX


@pytest.mark.parametrize("fraction", [0.6, 3.0])
def test_the_lamp_adds_to_the_ambient_light(fraction: float) -> None:
    """On a grey floor 2 m below, in the middle of the image: ``fraction`` of the ambient light."""
    lens = make_lens(CameraParams(width=64, height=48))
    lamp = LampParams(below_m=12.0)
    light = image_sensor.Exposed(
        electrons=2e3, full_well=25e3, read_noise=6.0, gain=1.0, lamp=lamp_field(lamp, lens.raster),
        electrons_per_lux=2e3 * fraction / (peak_candela(lamp) / 4.0),
    )  # fmt: skip
    depth = InverseDepth(np.full((48, 64), 0.49, np.float32), 0.01, 1.0)
    noise = np.zeros((48 + NOISE_MARGIN, 3 * (64 + NOISE_MARGIN)), np.int8)
    drawn = np.full((48, 64, 3), 150, np.uint8)
    image = image_sensor.ImageSensor(lens).exposed(
        drawn, depth, identity_shifts(48), noise, image_sensor.NoisePlace(0, 0, 1), light
    )  # fmt: skip
    lit = 2e3 * (1.0 + fraction) * (150.0 / 255.0) ** GAMMA / 25e3
    assert image[24, 32] == pytest.approx(255.0 * lit ** (1.0 / GAMMA), abs=1.0)


LAMP = LampParams(below_m=12.0)
RASTER: CameraIntrinsics = intrinsics_of(CameraParams())
FIELD: LampField = lamp_field(LAMP, RASTER)


def plane(depth_m: float, tilt_rad: float = 0.0) -> InverseDepth:
    """Inverse depths of a plane that meets the axis at ``depth_m``, turned about the image's
    columns, bottom row first."""
    x = (np.arange(RASTER.width) - RASTER.cx) / RASTER.fx
    inverse = (1.0 - math.tan(tilt_rad) * x) / depth_m
    rows = np.tile(inverse, (RASTER.height, 1))
    return InverseDepth((rows - 0.0025).astype(np.float32), 0.0025, 1.0)


def lux(depth: InverseDepth, x: float, y: float) -> float:
    row = np.empty(RASTER.width, np.float32)
    lamp_row(depth.levels, depth.far, depth.per_level, FIELD, round(y), row)
    return float(row[round(x)])


def test_the_whole_flux_leaves_the_lamp() -> None:
    angle = np.linspace(0.0, 0.5 * np.pi, 20001)
    exponent = math.log(0.5) / math.log(math.cos(math.radians(30.0)))
    intensity = peak_candela(LAMP) * np.cos(angle) ** exponent
    flux = np.trapezoid(intensity * 2.0 * np.pi * np.sin(angle), angle)
    assert flux == pytest.approx(LAMP.flux_lm, rel=1e-4)


def test_light_falls_off_with_the_square_of_the_distance() -> None:
    middle = (423.0, 239.0)
    near, far = lux(plane(2.0), *middle), lux(plane(8.0), *middle)
    assert near == pytest.approx(peak_candela(LAMP) / 4.0, rel=1e-3)
    assert near / far == pytest.approx(16.0, rel=1e-3)


def test_half_the_intensity_at_half_the_beam() -> None:
    """On a level plane at 30 degrees off the axis: half the intensity, cos^3 from distance and
    incidence."""
    x = RASTER.cx + RASTER.fx * math.tan(math.radians(30.0))
    expected = 0.5 * peak_candela(LAMP) / 25.0 * math.cos(math.radians(30.0)) ** 3
    assert lux(plane(5.0), x, RASTER.cy) == pytest.approx(expected, rel=0.01)


def test_a_slope_gets_the_cosine_of_its_incidence() -> None:
    level, slope = plane(5.0), plane(5.0, 0.6)
    ratio = lux(slope, RASTER.cx, RASTER.cy) / lux(level, RASTER.cx, RASTER.cy)
    assert ratio == pytest.approx(math.cos(0.6), rel=5e-3)


def test_an_edge_does_not_pass_for_a_slope() -> None:
    step = plane(8.0)
    step.levels[:, 400:] = plane(4.0).levels[:, 400:]
    for x, depth in ((398, 8.0), (399, 8.0), (400, 4.0), (401, 4.0)):
        alone = lux(plane(depth), x, 200.0)
        assert lux(step, x, 200.0) == pytest.approx(alone, rel=1e-3)


def test_it_is_on_below_its_height_and_where_it_is_seen() -> None:
    night, day = LIGHT_LUX["night"], LIGHT_LUX["day"]
    assert shines(LAMP, plane(11.9), night)
    assert not shines(LAMP, plane(12.1), night)
    assert not shines(LampParams(), plane(1.0), night)
    assert not shines(LAMP, plane(11.9), day)
    assert shines(LAMP, plane(0.5), day)
