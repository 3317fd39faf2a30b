"""Scenes whose ground is given other materials, for training images."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from touchdown.scenes.api import LAND_CLASSES
from touchdown.scenes.authoring import generation
from touchdown.scenes.authoring.ground import (
    HELD_OUT,
    Canvas,
    Ground,
    ground_shader,
    varied_materials,
)
from touchdown.scenes.authoring.water import WaterLook, varied

CELLS = 4 * len(Ground)


def _canvas() -> Canvas:
    """A stripe of each material."""
    canvas = Canvas.of_size(10.0, CELLS)
    canvas.material[:] = np.repeat(np.arange(len(Ground), dtype=np.uint8), 4)
    return canvas


def _painted(canvas: Canvas) -> np.ndarray:
    image = np.empty((CELLS, CELLS, 3), np.uint8)
    light = np.ones((CELLS, CELLS), np.float32)
    ground_shader(np.random.default_rng(2), canvas, light, {})(image)
    return image


def test_ground_gets_other_materials_of_its_class() -> None:
    plain, dressed, again = _canvas(), _canvas(), _canvas()
    before = _painted(plain)
    with varied_materials(np.random.default_rng(5)):
        after = _painted(dressed)
    with varied_materials(np.random.default_rng(5)):
        assert (_painted(again) == after).all()
    assert (plain.material == _canvas().material).all(), "as built, outside"
    classes = [canvas.raster("terrain").class_id for canvas in (plain, dressed)]
    np.testing.assert_array_equal(*classes)
    changed = (dressed.material != plain.material).mean()
    assert 0.5 < changed < 1.0, "a class of n materials keeps a material once in n"
    held = np.isin(plain.material, HELD_OUT)
    assert (dressed.material == plain.material)[held].all()
    assert not np.isin(dressed.material[~held], HELD_OUT).any()
    road = classes[0] == LAND_CLASSES.index("road")
    assert len(np.unique(plain.raster("terrain").material[road])) == 4
    stripes = (dressed.material != plain.material)[0]
    assert (after[:, stripes] != before[:, stripes]).any(axis=-1).mean() > 0.5
    same = ~stripes
    same[1:] &= ~stripes[:-1]
    same[:-1] &= ~stripes[1:]
    assert (after[:, same] == before[:, same]).mean() > 0.9


def test_water_is_between_silt_and_a_pale_bed() -> None:
    look = WaterLook(body=(1.0, 2.0, 3.0), clarity_m=(1.0, 1.0, 1.0), wave_m=0.3)
    assert varied(look) == look
    found = []
    for seed in range(40):
        with varied_materials(np.random.default_rng(seed)):
            found.append(varied(look))
    assert all(one.wave_m == 0.3 and 0.1 <= one.ripple <= 0.7 for one in found)
    bodies = np.array([one.body for one in found])
    assert (bodies > [24.0, 58.0, 48.0]).all() and (bodies < [118.0, 175.0, 195.0]).all()
    assert (np.ptp(bodies, axis=0) > 60.0).all()
    green = np.array([one.clarity_m[1] for one in found])
    assert 0.2 < green.min() < 0.25 and 0.65 < green.max() < 0.75


def test_a_flood_has_that_water(monkeypatch: pytest.MonkeyPatch) -> None:
    looks: list[WaterLook] = []
    monkeypatch.setattr(generation, "ground_texture", lambda *_: lambda image: None)
    monkeypatch.setattr(generation, "lay_water", lambda *given: looks.append(given[4]))
    builder: Any = SimpleNamespace(
        rng=np.random.default_rng(1), sun=np.zeros(3), picture=lambda *_: None
    )
    planned = WaterLook(body=(1.0, 2.0, 3.0), clarity_m=(1.0, 1.0, 1.0))
    cells = CELLS // 4
    flood = generation.Flood(
        depth_m=np.ones((cells, cells), np.float32), draw_look=lambda _: planned
    )
    generation.paint_terrain(builder, _canvas(), {}, flood=flood)
    with varied_materials(np.random.default_rng(5)):
        generation.paint_terrain(builder, _canvas(), {}, flood=flood)
        assert looks == [planned, varied(planned)] and looks[0] != looks[1]


@pytest.mark.parametrize("material", Ground, ids=lambda material: material.name.lower())
def test_ground_has_the_mean_colour_of_its_material(material: Ground) -> None:
    """Patterns and spots vary it by a tenth of it at most; between rows of crops is soil."""
    canvas = Canvas.of_size(10.0, 128)
    canvas.material[:] = int(material)
    image = np.empty((128, 128, 3), np.uint8)
    light = np.ones((128, 128), np.float32)
    ground_shader(np.random.default_rng(2), canvas, light, {})(image)
    off = 0.2 if material is Ground.CROPS else 0.1
    np.testing.assert_allclose(image.reshape(-1, 3).mean(axis=0), material.look.rgb, rtol=off)
