"""Scenes whose ground is given other materials, for training images."""

import numpy as np

from touchdown.scenes.api import LAND_CLASSES
from touchdown.scenes.authoring.ground import Canvas, Ground, dressed_anew, ground_shader

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
    with dressed_anew(np.random.default_rng(5)):
        after = _painted(dressed)
    with dressed_anew(np.random.default_rng(5)):
        assert (_painted(again) == after).all()
    assert (plain.material == _canvas().material).all(), "as built, outside"
    classes = [canvas.raster("terrain").class_id for canvas in (plain, dressed)]
    np.testing.assert_array_equal(*classes)
    changed = (dressed.material != plain.material).mean()
    assert 0.5 < changed < 1.0, "a class of n materials keeps a material once in n"
    road = classes[0] == LAND_CLASSES.index("road")
    assert len(np.unique(plain.raster("terrain").material[road])) == 4
    stripes = (dressed.material != plain.material)[0]
    assert (after[:, stripes] != before[:, stripes]).any(axis=-1).mean() > 0.5
    same = ~stripes
    same[1:] &= ~stripes[:-1]
    same[:-1] &= ~stripes[1:]
    assert (after[:, same] == before[:, same]).mean() > 0.9
