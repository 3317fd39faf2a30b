"""The landing lamp: inverse square, angles, the height at which it goes on."""

import math

import numpy as np
import pytest

from touchdown.scenes.api import LIGHT_LUX
from touchdown.sim.api import CameraIntrinsics, CameraParams, LampParams
from touchdown.sim.camera.gl import InverseDepth
from touchdown.sim.camera.lamp import LampField, lamp_field, lamp_row, peak_candela, shines
from touchdown.sim.camera.optics import intrinsics_of

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
