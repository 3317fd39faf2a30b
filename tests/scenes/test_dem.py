"""Elevation models: heights, units, holes, aerial images and damaged files."""

import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
from affine import Affine

from touchdown.scenes.api import Scene
from touchdown.scenes.compose import load_scene
from touchdown.scenes.importers.dem import import_dem
from touchdown.scenes.importers.geotiff import METRES_PER_DEGREE, read_heights
from touchdown.scenes.truth.maps import judge_touchdown
from touchdown.sim.typing import Array

from support.command import Says
from support.places import height_at


def write_tiff(path: Path, heights: Array, cell_m: float = 1.0, **profile: Any) -> Path:
    """A float32 GeoTIFF, row 0 in the north."""
    rows, cols = heights.shape
    corner = Affine(cell_m, 0.0, 5000.0, 0.0, -cell_m, 9000.0)
    profile = {"transform": corner, "nodata": -9999.0, **profile}
    with rasterio.open(
        path, "w", driver="GTiff", width=cols, height=rows, count=1, dtype="float32", **profile
    ) as dataset:
        dataset.write(heights.astype(np.float32), 1)
    return path


def ramp(rows: int = 121, cols: int = 141) -> Array:
    """0.02 m a cell to the east and 0.05 m to the north, with a knob of 5 m on cell (40, 90)."""
    row, col = np.mgrid[:rows, :cols]
    heights = 300.0 + 0.02 * col + 0.05 * (rows - 1 - row)
    heights[40, 90] += 5.0
    return heights.astype(np.float64)


def load(path: Path) -> Scene:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return load_scene(str(path), 0)


def test_cells_without_a_place_on_earth_are_of_a_metre(tmp_path: Path) -> None:
    with pytest.warns(rasterio.errors.NotGeoreferencedWarning):
        raster = read_heights(
            write_tiff(tmp_path / "bare.tif", ramp(), transform=Affine.identity())
        )
    assert raster.cell_m.tolist() == [1.0, 1.0] and raster.size_m.tolist() == [141.0, 121.0]


def test_heights_equal_the_model_and_are_zero_at_the_takeoff(tmp_path: Path) -> None:
    tif = write_tiff(tmp_path / "hill.tif", ramp())
    scene = load(import_dem(tif, tmp_path / "out", window_m=120.0))
    x, y = scene.takeoff_xy_m
    level = 0.02 * x + 0.05 * y
    assert abs(height_at(scene, x, y)) < 2e-3
    # The window is centred on cell (60, 70): east is +x, north is +y.
    for east, north in ((0.0, 0.0), (-50.3, 20.2), (55.0, -58.0), (-40.0, 50.5)):
        expected = 0.02 * east + 0.05 * north - level
        assert height_at(scene, east, north) == pytest.approx(expected, abs=3e-3)
    assert height_at(scene, 20.0, 20.0) == pytest.approx(0.4 + 1.0 - level + 5.0, abs=0.02)
    assert scene.surfaces["field_terrain"].land_class == "field"
    np.testing.assert_allclose(scene.bounds_xy_m[1] - scene.takeoff_xy_m >= [66.0, 40.0], True)
    judged = judge_touchdown(scene, scene.takeoff_xy_m)
    assert judged.slope_deg == pytest.approx(np.rad2deg(np.arctan(np.hypot(0.02, 0.05))), abs=0.1)
    assert judged.safe


def test_takeoff_is_on_the_flattest_ground(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    heights = rng.normal(0.0, 0.5, (201, 201))
    # Level ground about the cell 20 m west and 14 m south of the middle.
    heights[108:121, 74:87] = 0.0
    scene = load(import_dem(write_tiff(tmp_path / "a.tif", heights), tmp_path / "out"))
    assert np.linalg.norm(scene.takeoff_xy_m - [-20.0, -14.0]) < 5.0
    assert judge_touchdown(scene, scene.takeoff_xy_m).safe


def test_cells_in_feet_and_degrees_become_metres(tmp_path: Path) -> None:
    feet = read_heights(write_tiff(tmp_path / "f.tif", ramp(), 5.0, crs="EPSG:2222"))
    np.testing.assert_allclose(feet.cell_m, 5.0 * 0.3048)
    degree = 1.0 / 36_000.0
    corner = Affine(degree, 0.0, 11.0, 0.0, -degree, 60.0)
    degrees = read_heights(
        write_tiff(tmp_path / "d.tif", ramp(), transform=corner, crs="EPSG:4326")
    )
    latitude = np.deg2rad(60.0 - 0.5 * 121 * degree)
    north = METRES_PER_DEGREE * degree
    np.testing.assert_allclose(degrees.cell_m, [north * np.cos(latitude), north])
    np.testing.assert_array_equal(degrees.heights_m, ramp().astype(np.float32))


@pytest.mark.parametrize("profile", [
    {"compress": "deflate", "predictor": 3, "tiled": True, "blockxsize": 64, "blockysize": 64},
    {"compress": "lzw", "predictor": 2}, {"compress": "zstd", "BIGTIFF": "YES"},
    {"compress": "lerc"},
], ids=lambda profile: profile["compress"])  # fmt: skip
def test_compressed_models_are_read_exactly(tmp_path: Path, profile: dict[str, Any]) -> None:
    heights = ramp()
    heights[3, 5], heights[4, 6] = -5.0, np.nan
    tif = write_tiff(tmp_path / "a.tif", heights, nodata=-5.0, crs="EPSG:32632", **profile)
    raster = read_heights(tif)
    expected = heights.astype(np.float32).astype(np.float64)
    expected[3, 5] = np.nan
    np.testing.assert_array_equal(raster.heights_m, expected)
    np.testing.assert_array_equal(raster.georeference.unit_cell, [1.0, 1.0])
    np.testing.assert_array_equal(raster.georeference.origin, [5000.0, 9000.0])


def test_coarse_models_are_interpolated_smoothly(tmp_path: Path) -> None:
    """A parabola comes back between the cells, which a linear interpolation would miss by 6 cm."""
    heights = np.tile(0.02 * (np.arange(41) - 20.0) ** 2, (41, 1))
    tif = write_tiff(tmp_path / "c.tif", heights, 5.0)
    scene = load(import_dem(tif, tmp_path / "out", window_m=150.0))
    base = height_at(scene, 0.0, 0.0)
    for x in (2.5, 12.5, -37.5):
        rise = height_at(scene, x, 10.0) - base
        assert rise == pytest.approx(0.02 * (x / 5.0) ** 2, abs=5e-3)


def test_holes_are_filled_from_their_rims_with_one_warning(tmp_path: Path) -> None:
    heights = ramp()
    whole = heights.copy()
    heights[50:60, 60:70] = -9999.0
    heights[20, 30] = np.nan
    heights[30, 30] = -3.4e38
    with pytest.warns(UserWarning, match=r"0\.\d+ % of the window are holes") as caught:
        scene = load_scene(
            str(import_dem(write_tiff(tmp_path / "h.tif", heights), tmp_path / "out",
                           window_m=120.0)), 0,
        )  # fmt: skip
    assert len(caught) == 1
    level = whole[60, 70] - height_at(scene, 0.0, 0.0)
    # A plane is harmonic: relaxation puts it back.
    for row, col in ((55, 65), (50, 60), (20, 30), (30, 30)):
        x, y = col - 70.0, 60.0 - row
        assert height_at(scene, x, y) == pytest.approx(whole[row, col] - level, abs=0.05)


def test_aerial_image_is_aligned_with_the_heights(tmp_path: Path) -> None:
    tif = write_tiff(tmp_path / "hill.tif", ramp())
    image = np.zeros((4 * 121, 4 * 141, 3), np.uint8)
    image[: 2 * 121, : 2 * 141] = (0, 0, 255)
    cv2.imwrite(str(tmp_path / "photo.png"), image)
    out = tmp_path / "out"
    import_dem(tif, out, ortho=tmp_path / "photo.png", window_m=100.0)
    texture = cv2.imread(str(out / "assets" / "ground.png"))
    assert texture is not None
    size = len(texture)
    # Red in the north-west alone; OpenCV reads blue first.
    assert texture[size // 4, size // 4].tolist() == [0, 0, 255]
    for row, col in ((1, 3), (3, 1), (3, 3)):
        assert texture[row * size // 4, col * size // 4].tolist() == [0, 0, 0]


def _invalid(tmp_path: Path, kind: str) -> Path:
    path = tmp_path / f"{kind}.tif"
    if kind == "empty":
        path.write_bytes(b"")
    elif kind == "mostly":
        heights = np.full((121, 121), -9999.0)
        heights[::3] = 1.0
        write_tiff(path, heights)
    elif kind == "cut":
        path.write_bytes(write_tiff(path, ramp()).read_bytes()[:5000])
    elif kind == "pixels":
        path.write_bytes(write_tiff(path, ramp(), compress="lzw").read_bytes()[:-5000])
    return path


@pytest.mark.parametrize(("kind", "message"), [
    ("empty", "is not a TIFF file"), ("mostly", "66 % of the window are holes"),
    ("cut", "damaged TIFF file"), ("pixels", "damaged TIFF file"),
])  # fmt: skip
def test_invalid_models_are_one_clear_line(tmp_path: Path, kind: str, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        import_dem(_invalid(tmp_path, kind), tmp_path / "out")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_invalid_images_and_windows_are_one_clear_line(tmp_path: Path) -> None:
    tif = write_tiff(tmp_path / "hill.tif", ramp())
    photo = tmp_path / "photo.png"
    cv2.imwrite(str(photo), np.zeros((100, 400, 3), np.uint8))
    for options, message in (
        ({"ortho": photo}, "must show the same extent"), ({"cell_m": 0.01}, "choose from"),
        ({"land_class": "grass"}, "'grass' is none of"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            import_dem(tif, tmp_path / "out", **options)
    for gone, options in ((tif, {"ortho": tmp_path / "gone.png"}), (tmp_path / "gone.tif", {})):
        with pytest.raises(FileNotFoundError, match=r"gone\.(png|tif)"):
            import_dem(gone, tmp_path / "out", **options)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "a").touch()
    with pytest.raises(ValueError, match="exists already"):
        import_dem(tif, tmp_path / "full")


def test_command_line(tmp_path: Path, says: Says) -> None:
    heights = ramp()
    heights[30:34, 30:34] = -9999.0
    tif = write_tiff(tmp_path / "hill.tif", heights)
    out = tmp_path / "out"
    captured = says(0, "scenes", "import-dem", tif, out, "--window", "100")
    assert captured.out.strip() == str(out / "scene.xml")
    assert "holes" in captured.err and "Traceback" not in captured.err
    assert says(2, "scenes", "import-dem", tif, out).err.count("\n") == 1
