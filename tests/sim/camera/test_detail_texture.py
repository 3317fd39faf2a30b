"""Grain of the ground: where it lies, what it leaves as it is, and where it comes from."""

import csv
import dataclasses

import cv2
import mujoco
import numpy as np
import pytest

from touchdown.scenes.api import DETAILS, NO_DETAIL_ID, Scene
from touchdown.sim.api import CameraParams
from touchdown.sim.camera import detail_texture
from touchdown.sim.camera.sensor import CameraSensor

from support.places import cached_scene, scene_of

SIZE = (200, 120)
PLACE = """<mujoco><worldbody>
  <geom name="field_floor" type="plane" size="0 0 1" rgba="0.5 0.5 0.5 1"/>
  <geom name="path_slab" type="box" pos="5 0 0.5" size="1 1 0.5" rgba="0.5 0.5 0.5 1"/>
  <geom name="car" type="box" pos="-5 0 0.5" size="1 1 0.5" rgba="0.5 0.5 0.5 1"/>
  <geom name="water_pond" type="box" pos="0 6 0.01" size="1 1 0.01" rgba="0.5 0.5 0.5 1"/>
</worldbody></mujoco>"""


def params(**changes: object) -> CameraParams:
    plain = CameraParams(width=SIZE[0], height=SIZE[1], noise_sigma=0.0)
    return dataclasses.replace(plain, **changes)  # type: ignore[arg-type]


@pytest.fixture
def place() -> Scene:
    return scene_of(PLACE)


def picture(
    scene: Scene, xy_m: tuple[float, float], height_m: float, **changes: object
) -> np.ndarray:
    """The camera's image with the vehicle level, its nose to the east, and the lens so high."""
    camera = CameraSensor(scene, params(**changes), 0)
    data = mujoco.MjData(scene.model)
    data.qpos[:3] = 0.0, 0.0, 0.0
    data.qpos[3:7] = 1.0, 0.0, 0.0, 0.0
    mujoco.mj_forward(scene.model, data)
    lens = data.cam("vehicle/camera").xpos.copy()
    data.qpos[:3] = [xy_m[0] - lens[0], xy_m[1] - lens[1], height_m - lens[2]]
    mujoco.mj_forward(scene.model, data)
    image = camera.render(camera.snapshot(data), 0)
    camera.close()
    return image


def fine(image: np.ndarray) -> float:
    """Standard deviation of what is finer than four pixels."""
    grey = image.mean(axis=2).astype(np.float32)
    return float((grey - cv2.GaussianBlur(grey, (0, 0), 2.0)).std())


def test_every_photograph_is_free_and_listed() -> None:
    with (detail_texture.PHOTOGRAPHS / "manifest.csv").open(encoding="utf-8", newline="") as file:
        rows = {row["file"]: row for row in csv.DictReader(file)}
    pictures = sorted(detail_texture.PHOTOGRAPHS.glob("*.jpg"))
    assert {path.name for path in pictures} == set(rows) == {f"{name}.jpg" for name in DETAILS}
    for name, row in rows.items():
        assert row["licence"] == "CC0 1.0" and row["licence_evidence"] and row["source"], name
        assert float(row["side_m"]) == detail_texture.LOOKS[name.removesuffix(".jpg")].side_m, name
    assert sum(path.stat().st_size for path in pictures) < 10e6


@pytest.mark.parametrize("name", DETAILS)
def test_grain_keeps_the_colour_and_has_no_large_structures(name: str) -> None:
    ratio = detail_texture.texture(name).astype(float) / 128.0
    np.testing.assert_allclose(ratio.mean(axis=(0, 1)), 1.0, atol=0.02)
    assert 0.02 < ratio.mean(axis=2).std() < 0.4
    # A tile's quarters look alike: what differs would be seen to repeat.
    quarters = cv2.resize(ratio, (4, 4), interpolation=cv2.INTER_AREA)
    assert np.abs(quarters - 1.0).max() < 0.03


def test_pyramid_halves_the_photographs() -> None:
    pyramid = detail_texture.pyramid(("sand", "snow"))
    side = detail_texture.SIDE_PX
    sand, snow = pyramid.starts
    first = pyramid.texels[snow[0] : snow[0] + side**2].reshape(side, side)
    np.testing.assert_array_equal(first & 255, detail_texture.texture("snow")[..., 0])
    np.testing.assert_array_equal(first >> 16, detail_texture.texture("snow")[..., 2])
    half = pyramid.texels[sand[1] : sand[1] + (side // 2) ** 2]
    red = (
        detail_texture.texture("sand")[..., 0].reshape(side // 2, 2, side // 2, 2).mean(axis=(1, 3))
    )
    np.testing.assert_allclose((half & 255).reshape(side // 2, -1), red, atol=0.51)


def multiplied(
    ratio: int, depth_m: float, height_m: float = 0.0, kind: int = 0, thing_m: float = 0.0
) -> np.ndarray:
    """A grey image of 100 seen from 2 m straight above, with a texture of ``ratio`` / 128."""
    side = detail_texture.SIDE_PX
    texels = np.full(sum((side >> k) ** 2 for k in range(6)), ratio * 0x010101, np.uint32)
    starts = np.cumsum([0] + [(side >> k) ** 2 for k in range(5)])[None]
    image = np.full((4, 6, 3), 100, np.uint8)
    far, per_level = np.float32(1.0 / 600.0), np.float32(20.0)
    levels = np.full((4, 6), (1.0 / depth_m - float(far)) / float(per_level), np.float32)
    levels[:, 2] = (1.0 / (depth_m - thing_m) - float(far)) / float(per_level)
    rays = np.array([[0.0, 0.0, -1.0], [0.01, 0.0, 0.0], [0.0, 0.01, 0.0]], np.float32)
    detail_texture.multiply_texture(
        image, levels, far, per_level, np.array([2.0, 2.0, depth_m]), rays,
        np.array([0.0, 0.0, 4.0, 10.0, 9.0]), np.full((16, 16), height_m, np.float32),
        np.full((40, 40), kind, np.uint8), texels, starts, np.array([700.0], np.float32),
        detail_texture.blend_noise(), np.float32(0.0016),
    )  # fmt: skip
    return image


def test_grain_multiplies_near_ground_alone() -> None:
    np.testing.assert_array_equal(multiplied(192, 2.0), 150)
    np.testing.assert_array_equal(multiplied(64, 2.0), 50)
    np.testing.assert_array_equal(multiplied(192, 8.0), 125)  # half way through the fade
    np.testing.assert_array_equal(multiplied(192, 10.5), 100)
    np.testing.assert_array_equal(multiplied(192, 2.0, height_m=0.3), 100)  # something else
    beside = multiplied(192, 2.0, thing_m=0.3)[0, :, 0]  # within a run of pixels
    assert beside.tolist() == [150, 150, 100, 150, 150, 150]
    np.testing.assert_array_equal(multiplied(192, 2.0, kind=NO_DETAIL_ID), 100)


def test_lookup_knows_ground_by_its_class(place: Scene) -> None:
    ground = detail_texture.ground_lookup(place)

    def at(x: float, y: float) -> tuple[float, str]:
        cells = [
            np.floor((np.array([x, y]) - ground.origin_xy_m) / cell).astype(int)[::-1]
            for cell in (ground.height_cell_m, ground.kind_cell_m)
        ]
        kind = ground.kind[tuple(cells[1])]
        names = (*ground.names, "none")
        return float(ground.height_m[tuple(cells[0])]), names[min(kind, len(ground.names))]

    assert at(0.0, 0.0) == (pytest.approx(0.0, abs=1e-3), "soil")
    assert at(5.0, 0.0) == (pytest.approx(1.0, abs=1e-3), "concrete")
    # The ground goes on below what is none: a car's roof is off its height.
    assert at(0.0, 6.0)[1] == "none"
    assert at(-5.0, 0.0) == (pytest.approx(0.0, abs=1e-3), "soil")


def test_raster_says_what_the_ground_is() -> None:
    scene = cached_scene("snow")
    assert scene.ground is not None and scene.ground.detail_id is not None
    water = scene.ground.class_id == 5
    assert (scene.ground.detail_id[water] == NO_DETAIL_ID).all()
    assert (scene.ground.detail_id[~water] == DETAILS.index("snow")).mean() > 0.99
    names = detail_texture.ground_lookup(scene).names
    assert "snow" in names and "grass" not in names


def test_grain_is_off_by_default_and_absent_from_above() -> None:
    assert CameraParams().detail is False
    scene = cached_scene("flat")
    xy = tuple(scene.takeoff_xy_m)
    np.testing.assert_array_equal(picture(scene, xy, 11.0), picture(scene, xy, 11.0, detail=True))


def test_grain_is_seen_and_keeps_the_colour() -> None:
    scene = cached_scene("flat")
    xy = tuple(scene.takeoff_xy_m)
    plain, grained = picture(scene, xy, 0.4), picture(scene, xy, 0.4, detail=True)
    assert fine(grained) > 3.0 * fine(plain)
    np.testing.assert_allclose(grained.mean(axis=(0, 1)), plain.mean(axis=(0, 1)), rtol=0.06)


def _grain(place: Scene, xy: tuple[float, float], height: float) -> np.ndarray:
    """What the texture alone adds to a picture."""
    return picture(place, xy, height, detail=True) - picture(place, xy, height)


def test_grain_lies_still_on_the_ground(place: Scene) -> None:
    """A camera that moves by whole pixels sees the same, shifted; also on top of a slab."""
    for middle, level in (((0.0, 0.0), 0.0), ((5.0, 0.0), 1.0)):
        here = _grain(place, middle, level + 1.5)
        step = 1.5 * 2.0 * np.tan(np.deg2rad(0.5 * 69.0)) / SIZE[0]
        moved = _grain(place, (middle[0], middle[1] - 10 * step), level + 1.5)
        shifted = [
            np.corrcoef(here[10:-10, a : a + 180].ravel(), moved[10:-10, b : b + 180].ravel())[0, 1]
            for a, b in ((10, 0), (0, 10), (0, 0))
        ]
        assert max(shifted) > 0.9 and shifted[2] < 0.5, (middle, shifted)


def test_things_and_water_have_no_grain(place: Scene) -> None:
    for xy, level in (((-5.0, 0.0), 1.0), ((0.0, 6.0), 0.02)):
        # So near that nothing else is in view.
        plain = picture(place, xy, level + 0.9)
        np.testing.assert_array_equal(plain, picture(place, xy, level + 0.9, detail=True))
