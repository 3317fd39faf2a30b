"""The image sensor's kernels against known answers: places in the drawing, noise of grey levels."""

import cv2
import numpy as np
import pytest

from touchdown.sim.api import CameraParams, LampParams
from touchdown.sim.camera.gl import InverseDepth
from touchdown.sim.camera.image_sensor import (
    _BENDS,
    GAMMA,
    Exposed,
    ImageSensor,
    NoisePlace,
    quiet_tone,
)
from touchdown.sim.camera.lamp import lamp_field, peak_candela
from touchdown.sim.camera.optics import NOISE_MARGIN, make_lens
from touchdown.sim.camera.shutter import _RIGID_PX, identity_shifts, sample_row


@pytest.mark.parametrize("gain", [1.0, 2.0])
def test_noise_of_grey_levels_is_that_of_their_electrons(gain: float) -> None:
    """Shot and read noise, carried to grey levels by the display's power law, to 8 %."""
    light = Exposed(electrons=12e3, full_well=25e3, read_noise=6.0, gain=gain)
    tone = quiet_tone(light)
    level = np.arange(20.0, 256.0)
    electrons = 12e3 * (level / 255.0) ** GAMMA
    grey = 255.0 * (electrons * gain / 25e3) ** (1.0 / GAMMA)
    np.testing.assert_allclose(tone.scale * level, grey, rtol=1e-5)
    slope = grey / (GAMMA * electrons)
    spread = tone.floor + sum(
        a * np.minimum(level, b) for a, b in zip(tone.slopes, tone.bends, strict=True)
    )
    np.testing.assert_allclose(spread, slope * np.sqrt(electrons + 36.0), rtol=0.08)
    assert len(tone.slopes) == len(tone.bends) == len(_BENDS) + 1


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


@pytest.mark.parametrize("share", [0.6, 3.0])
def test_the_lamp_adds_to_the_ambient_light(share: float) -> None:
    """On a grey floor 2 m below, in the middle of the image: ``share`` of the ambient light."""
    lens = make_lens(CameraParams(width=64, height=48))
    lamp = LampParams(below_m=12.0)
    light = Exposed(
        electrons=2e3, full_well=25e3, read_noise=6.0, gain=1.0, lamp=lamp_field(lamp, lens.raster),
        electrons_per_lux=2e3 * share / (peak_candela(lamp) / 4.0),
    )  # fmt: skip
    depth = InverseDepth(np.full((48, 64), 0.49, np.float32), 0.01, 1.0)
    noise = np.zeros((48 + NOISE_MARGIN, 3 * (64 + NOISE_MARGIN)), np.int8)
    drawn = np.full((48, 64, 3), 150, np.uint8)
    image = ImageSensor(lens).exposed(
        drawn, depth, identity_shifts(48), noise, NoisePlace(0, 0, 1), light
    )  # fmt: skip
    lit = 2e3 * (1.0 + share) * (150.0 / 255.0) ** GAMMA / 25e3
    assert image[24, 32] == pytest.approx(255.0 * lit ** (1.0 / GAMMA), abs=1.0)
