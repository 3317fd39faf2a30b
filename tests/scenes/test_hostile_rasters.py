"""Untrusted elevation models and aerial images: read in parts, limited, or refused."""

import struct
import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
from affine import Affine
from numpy.typing import NDArray
from PIL import Image
from rasterio.windows import Window

from touchdown.scenes.importers import geotiff, pictures
from touchdown.scenes.importers.dem import import_dem
from touchdown.scenes.importers.geotiff import read_heights
from touchdown.scenes.importers.pictures import opened_picture, read_rgb
from touchdown.sim.typing import Array

from support.command import Says
from support.hostile_files import limited, pipe, png

NORTH_UP = Affine(1.0, 0.0, 5000.0, 0.0, -1.0, 9000.0)
SIDE = 100_000


def slope(rows: int = 130, cols: int = 140) -> Array:
    row, col = np.mgrid[:rows, :cols]
    return np.asarray(300.0 + 0.02 * col + 0.05 * (rows - 1 - row), np.float64)


def write(path: Path, values: NDArray[Any], **profile: Any) -> Path:
    bands = values if values.ndim == 3 else values[None]
    profile = {"transform": NORTH_UP, **profile}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with rasterio.open(
            path, "w", driver="GTiff", count=len(bands), height=bands.shape[1],
            width=bands.shape[2], dtype=values.dtype.name, **profile,
        ) as dataset:  # fmt: skip
            dataset.write(bands)
    return path


def wide(path: Path, side: int, **profile: Any) -> Path:
    """A square file that takes no room but for 512 cells of `slope` around its middle."""
    profile = {"transform": NORTH_UP, "tiled": True, **profile}
    with rasterio.open(
        path, "w", driver="GTiff", width=side, height=side, count=1, dtype="float32",
        SPARSE_OK="TRUE", BIGTIFF="YES", **profile,
    ) as dataset:  # fmt: skip
        first = side // 2 - 256
        patch = slope(512, 512).astype(np.float32)
        dataset.write(patch, 1, window=Window(first, first, 512, 512))
    return path


def refused(tif: Path, message: str, **options: Any) -> None:
    out = tif.parent / "out"
    with pytest.raises(ValueError, match=message) as caught:
        import_dem(tif, out, **options)
    assert "\n" not in str(caught.value) and not out.exists()


@pytest.mark.parametrize("side", [25_000, SIDE])
def test_of_a_large_file_a_part_is_read(tmp_path: Path, side: int) -> None:
    tif = wide(tmp_path / "wide.tif", side, compress="deflate")
    raster = read_heights(tif)
    assert raster.heights_m.shape == (geotiff.PART_CELLS, geotiff.PART_CELLS)
    np.testing.assert_array_equal(raster.size_m, [side, side])
    np.testing.assert_array_equal(raster.corner_m, (side - geotiff.PART_CELLS) / 2)
    middle = geotiff.PART_CELLS // 2
    patch = raster.heights_m[middle - 256 : middle + 256, middle - 256 : middle + 256]
    np.testing.assert_allclose(patch, slope(512, 512), rtol=1e-6)


def test_a_part_is_the_same_place_as_in_the_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cut around a centre, of a file read whole and of the same file read in part."""
    rng = np.random.default_rng(0)
    rough = cv2.GaussianBlur(rng.normal(0.0, 30.0, (400, 500)), (0, 0), 8.0)
    tif = write(tmp_path / "hill.tif", rough.astype(np.float32))
    photo = tmp_path / "photo.png"
    cv2.imwrite(str(photo), rng.integers(0, 255, (800, 1000, 3)).astype(np.uint8))
    options: dict[str, Any] = {"centre_m": (310.0, 150.0), "window_m": 100.0, "ortho": photo}
    import_dem(tif, tmp_path / "whole", **options)
    monkeypatch.setattr(geotiff, "PART_CELLS", 150)
    assert read_heights(tif, (310.0, 150.0), 100.0).heights_m.shape == (150, 150)
    import_dem(tif, tmp_path / "part", **options)
    for name in ("terrain.bin", "ground.png"):
        whole, part = (tmp_path / kind / "assets" / name for kind in ("whole", "part"))
        assert whole.read_bytes() == part.read_bytes()


def test_cells_of_a_large_window_are_averaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(geotiff, "FINE_CELLS", 100)
    heights = slope(200, 200)
    heights[10:14, 10:14] = -9999.0
    raster = read_heights(write(tmp_path / "h.tif", heights.astype(np.float32)))
    assert raster.heights_m.shape == (100, 100) and raster.cell_m.tolist() == [2.0, 2.0]
    assert np.isnan(raster.heights_m[5:7, 5:7]).all() and np.isnan(raster.heights_m).sum() == 4
    plane = slope(200, 200).reshape(100, 2, 100, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(np.where(np.isnan(raster.heights_m), plane, raster.heights_m),
                               plane, rtol=1e-6)  # fmt: skip


def test_a_window_beyond_the_limit_names_it(tmp_path: Path) -> None:
    tif = wide(tmp_path / "wide.tif", SIDE)
    refused(tif, "90016 x 90016 cells, more than 268435456; choose a smaller --window",
            window_m=90_000.0)  # fmt: skip
    refused(tif, "leaves .*, which covers 100000 x 100000 m", centre_m=(1.0, 1.0))


def test_holes_around_the_middle_of_a_large_file(tmp_path: Path) -> None:
    with rasterio.open(
        tmp_path / "holes.tif", "w", driver="GTiff", width=SIDE, height=SIDE, count=1, nodata=-1.0,
        dtype="float32", SPARSE_OK="TRUE", BIGTIFF="YES", tiled=True, transform=NORTH_UP,
    ):  # fmt: skip
        pass
    refused(tmp_path / "holes.tif", "hole around its middle; choose another with --centre")


def test_a_block_that_fills_the_memory_is_not_read(tmp_path: Path) -> None:
    tif = tmp_path / "strip.tif"
    with rasterio.open(
        tif, "w", driver="GTiff", width=25_000, height=25_000, count=1, dtype="float32",
        SPARSE_OK="TRUE", blockysize=25_000, compress="deflate", transform=NORTH_UP,
    ):  # fmt: skip
        pass
    refused(tif, "blocks of 2384 MiB, more than 512 MiB; rewrite it in tiles")


@pytest.mark.parametrize(("values", "profile", "message"), [
    (np.stack([slope(), slope()]), {}, "has 2 bands"),
    (slope(), {"transform": NORTH_UP @ Affine.rotation(10.0)}, "turned against north"),
    (slope() * np.nan, {}, "every cell is a hole"),
    (slope() * np.inf, {}, "every cell is a hole"),
    (slope() * 1e300, {}, "every cell is a hole"),
    (np.full((130, 140), -9999.0), {"nodata": -9999.0}, "every cell is a hole"),
    (slope().astype(np.complex64), {}, "complex64 values"),
    (slope(), {"transform": Affine(1e300, 0, 0, 0, -1e300, 0)}, "at most 1000 m"),
    (slope(), {"transform": Affine(1e-300, 0, 0, 0, -1e-300, 0)}, "at least 30 m"),
    (slope(), {"transform": Affine(1e-5, 0, 8, 0, -1e-5, 500), "crs": "EPSG:4326"},
     "must be above 0"),
])  # fmt: skip
def test_odd_rasters_are_one_line(
    tmp_path: Path, values: NDArray[Any], profile: dict[str, Any], message: str
) -> None:
    refused(write(tmp_path / "h.tif", values, **profile), message)


VRT = """<VRTDataset rasterXSize="140" rasterYSize="130"><VRTRasterBand dataType="Float32" band="1">
<SimpleSource><SourceFilename>/vsicurl/http://127.0.0.1:9/x.tif</SourceFilename></SimpleSource>
</VRTRasterBand></VRTDataset>"""


def test_nothing_leads_to_other_files_or_addresses(tmp_path: Path) -> None:
    for name in ("hill.vrt", "hill.tif"):
        (tmp_path / name).write_text(VRT)
        refused(tmp_path / name, "is not a TIFF file")
    tif = write(tmp_path / "model.tif", slope())
    (tmp_path / "model.tif.msk").write_text(VRT)
    refused(tif, "model.tif.msk is not a TIFF file; remove it")
    for name in ("/vsicurl/http://127.0.0.1:9/x.tif", "/vsizip/a.zip/x.tif", "http://127.0.0.1/x",
                 "zip://a.zip!x.tif", "s3://a/x.tif"):  # fmt: skip
        with pytest.raises(ValueError, match="is no file of this machine: download or unpack"):
            import_dem(Path(name), tmp_path / "out")
    (tmp_path / "model.tif.msk").unlink()
    refused(pipe(tmp_path / "pipe.tif"), "is a named pipe; give a file")
    refused(tif, "is a named pipe; give a file", ortho=pipe(tmp_path / "pipe.png"))


def _photo() -> NDArray[np.uint8]:
    return np.random.default_rng(1).integers(0, 255, (130, 140, 3)).astype(np.uint8)


def test_images_that_declare_too_much_are_not_decoded(tmp_path: Path) -> None:
    path = tmp_path / "bomb.png"
    for side, shown in ((30_000, "900000000"), (12_000, "12000 x 12000"), (2**31 - 1, "46116860")):
        path.write_bytes(png(side, side))
        with pytest.raises(ValueError, match=f"has {shown}.* pixels, more than 134217728; scale"):
            read_rgb(path)
    tif = write(tmp_path / "h.tif", slope())
    refused(tif, "12000 x 12000 pixels|pixels, more than", ortho=path)


@pytest.mark.parametrize(("kind", "message"), [
    ("half.jpg", "is a damaged image, copy or export it anew"), ("short.png", "is a damaged image"),
    ("zero.png", "is not an image"), ("text.png", "is not an image"),
    ("deep.png", "has 16 bits a channel: convert it to 8-bit RGB"),
    ("deepgrey.png", "has 16 bits a channel"),
    ("print.jpg", "colours of print .CMYK.: convert"),
])  # fmt: skip
def test_images_that_are_refused(tmp_path: Path, kind: str, message: str) -> None:
    path = tmp_path / kind
    if kind == "half.jpg":
        data = cv2.imencode(".jpg", _photo())[1].tobytes()
        path.write_bytes(data[: len(data) // 2])
    elif kind == "text.png":
        path.write_text("no image")
    elif kind in ("short.png", "zero.png"):
        path.write_bytes(png(*((140, 130) if kind == "short.png" else (0, 0))))
    elif kind == "print.jpg":
        Image.fromarray(_photo()).convert("CMYK").save(path)
    else:
        deep = _photo().astype(np.uint16) * 256
        cv2.imwrite(str(path), deep if kind == "deep.png" else deep[..., 0])
    with pytest.raises(ValueError, match=message) as caught:
        read_rgb(path)
    assert "\n" not in str(caught.value)
    refused(write(tmp_path / "h.tif", slope()), message, ortho=path)


def test_a_tile_larger_than_any_image_is_not_decoded(tmp_path: Path) -> None:
    """A TIFF of 8 x 8 pixels in a tile of 32 GiB, compressed."""
    profile = {"tiled": True, "blockxsize": 256, "blockysize": 256}
    image = write(tmp_path / "tile.tif", _photo()[..., 0], **profile)
    data = bytearray(image.read_bytes())
    for tag in (322, 323):
        at = data.index(struct.pack("<HHI", tag, 3, 1))
        data[at : at + 12] = struct.pack("<HHII", tag, 4, 1, 1 << 17)
    image.write_bytes(bytes(data))
    with pytest.raises(ValueError, match="has tiles of 17179869184 pixels, more than 134217728"):
        read_rgb(image)


def test_a_jpeg_of_many_scans_is_not_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each scan of a progressive JPEG takes the time of a whole image, and may have few bytes."""
    data = cv2.imencode(".jpg", _photo(), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    scans, last = data.count(b"\xff\xda"), data.rfind(b"\xff\xda")
    path = tmp_path / "scans.jpg"
    monkeypatch.setattr(pictures, "MAX_SCANNED_PIXELS", 20 * 130 * 140)
    path.write_bytes(data[:-2] + (20 - scans) * data[last:-2] + data[-2:])
    assert read_rgb(path).shape == (130, 140, 3)
    path.write_bytes(data[:-2] + (21 - scans) * data[last:-2] + data[-2:])
    with pytest.raises(ValueError, match="has 21 scans of 18200 pixels, more than 364000 pixels"):
        read_rgb(path)


def test_decoders_print_nothing_of_damage(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    image = write(tmp_path / "short.tif", _photo()[..., 0], compress="deflate")
    image.write_bytes(image.read_bytes()[:-9000])
    with pytest.raises(ValueError, match="is a damaged image"):
        read_rgb(image)
    assert not capfd.readouterr().err


def test_palettes_grey_and_turned_images_are_read(tmp_path: Path) -> None:
    photo = Image.fromarray(_photo())
    few = photo.quantize(16)
    few.save(tmp_path / "few.png")
    np.testing.assert_array_equal(read_rgb(tmp_path / "few.png"), np.asarray(few.convert("RGB")))
    photo.convert("L").save(tmp_path / "grey.png")
    assert read_rgb(tmp_path / "grey.png").shape == (130, 140, 3)
    with pytest.raises(ValueError, match="is grey"):
        read_rgb(tmp_path / "grey.png", grey=False)
    exif = photo.getexif()
    exif[0x0112] = 6  # the camera was held upright
    photo.transpose(Image.Transpose.ROTATE_90).save(tmp_path / "turned.png", exif=exif)
    np.testing.assert_array_equal(read_rgb(tmp_path / "turned.png"), _photo())
    with opened_picture(tmp_path / "turned.png") as picture:
        assert picture.size.tolist() == [140, 130]


def test_of_a_large_geotiff_the_window_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pictures, "MAX_PIXELS", 1)  # nothing is decoded whole
    tif = write(tmp_path / "h.tif", slope().astype(np.float32))
    photo = np.zeros((3, 1300, 1400), np.uint8)
    photo[0, :650, :700] = 255
    ortho = write(tmp_path / "photo.tif", photo, transform=NORTH_UP @ Affine.scale(0.1, 0.1))
    import_dem(tif, tmp_path / "place", ortho=ortho, window_m=100.0)
    texture = cv2.imread(str(tmp_path / "place" / "assets" / "ground.png"))
    assert texture is not None
    size = len(texture)
    assert texture[size // 4, size // 4].tolist() == [0, 0, 255]
    assert texture[3 * size // 4, 3 * size // 4].tolist() == [0, 0, 0]
    few = write(tmp_path / "deep.tif", photo.astype(np.uint16))
    refused(tif, "uint16 values; convert it to 8-bit RGB", ortho=few)


def test_a_whole_command_ends_in_one_line(tmp_path: Path, says: Says) -> None:
    wide(tmp_path / "wide.tif", SIDE, compress="deflate")
    (tmp_path / "bomb.png").write_bytes(png(30_000, 30_000))
    line = ("scenes", "import-dem", "wide.tif", "out")
    done = limited(*line, "--ortho", "bomb.png", folder=tmp_path)
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert not (tmp_path / "out").exists()
    far = "/vsicurl/http://127.0.0.1:9/x.tif"
    assert says(2, "scenes", "import-dem", far, "out").err.count("\n") == 1


@pytest.mark.slow
def test_a_scene_of_a_wide_file_fits_into_4_gib(tmp_path: Path) -> None:
    wide(tmp_path / "wide.tif", SIDE, compress="deflate")
    done = limited("scenes", "import-dem", "wide.tif", "out", folder=tmp_path)
    assert done.returncode == 0, done.stderr
