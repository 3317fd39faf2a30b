"""Label mappings, splits, rendered patches, and folders of images of people's own."""

import csv
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from touchdown.experiments.classification import data_sets, patches, render_dataset
from touchdown.experiments.classification.data_sets import split_of_layout, split_of_ucmerced
from touchdown.experiments.classification.evaluate import reliability
from touchdown.experiments.classification.image_folders import (
    View,
    entries_of,
    load_images,
    read_catalogue,
)
from touchdown.experiments.classification.render_dataset import DatasetParams
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.images import read_picture, squared
from touchdown.landing.classification.labels import D_LAND, NO_LABEL
from touchdown.scenes.api import LAND_CLASSES, OTHER_CLASS_ID
from touchdown.scenes.authoring.variation import present_variation

from support.command import Says


def test_folders_tell_the_kind_of_data() -> None:
    assert data_sets.kind_of_folders(["lawn", "water", "trees"]) == "d_land"
    assert data_sets.kind_of_folders(["agricultural", "harbor", "forest"]) == "ucmerced"
    assert data_sets.kind_of_folders(["BareLand", "Viaduct", "Forest"]) == "aid"
    assert data_sets.kind_of_folders(["lake-natural", "bathroom"]) == "places365"
    with pytest.raises(ValueError, match=r"\(cats, dogs, \.\.\.\) are not the classes"):
        data_sets.kind_of_folders(["cats", "dogs"])
    with pytest.raises(
        ValueError, match=r"'habor' is no class of ucmerced \(did you mean 'harbor'"
    ):
        data_sets.meanings("ucmerced", ["river", "habor"])


def test_uc_merced_is_split_by_number() -> None:
    splits = Counter(split_of_ucmerced(f"river{n:02d}.jpg") for n in range(80))
    assert splits == {"train": 56, "val": 8, "test": 16}
    assert all(split_of_ucmerced(f"river{n}.jpg") == "test" for n in range(64, 80))
    with pytest.raises(ValueError, match="has no number"):
        split_of_ucmerced("river.jpg")


def test_majority_of_a_square() -> None:
    picture = np.full((10, 10), patches.LAND_CLASSES.index("road"), np.int32)
    picture[2:8, 2:8] = LAND_CLASSES.index("water")
    picture[9, 9], picture[0, 0] = 255, -1
    sums = patches._integral(picture)
    assert patches._majority(sums, 2, 2, 6) == (LAND_CLASSES.index("water"), 1.0)
    assert patches._majority(sums, 0, 0, 10) == (LAND_CLASSES.index("road"), 0.62)
    assert patches._counts(sums, 0, 0, 2)[-1] == 1 and patches._counts(sums, 1, 1, 9)[-1] == 0


def test_rare_classes_come_first_and_squares_stay_apart() -> None:
    squares = [
        patches._Square(0, 0, 10, 0, 1.0, 5.0), patches._Square(0, 2, 10, 1, 1.0, 5.0),
        patches._Square(0, 40, 10, 0, 1.0, 5.0), patches._Square(40, 0, 10, 3, 1.0, 5.0),
    ]  # fmt: skip
    taken = np.array([2, 1, 0, -1, 0, 0, 0])
    assert patches._rarest(squares, taken, 4) == [squares[1], squares[2]]


_PLACE = """
<mujoco>
  <worldbody>
    <light pos="0 0 50" dir="0 0 -1" directional="true"/>
    <geom name="lawn_a" type="box" size="40 40 0.5" pos="0 0 -0.5" rgba="0.2 0.5 0.2 1"/>
    <geom name="water_a" type="box" size="16 40 0.01" pos="24 0 0.01" rgba="0.1 0.2 0.4 1"/>
  </worldbody>
</mujoco>
"""


def test_patches_of_a_place(tmp_path: Path) -> None:
    """Half lawn, half water: both are found, and look as they are painted."""
    place = tmp_path / "place.xml"
    place.write_text(_PLACE, encoding="utf-8")
    found, again = (patches.scene_patches(str(place), 7, 12, 40, 0) for _ in range(2))
    assert {patch.land_class for patch in found} == {"lawn", "water"}
    for patch, same in zip(found, again, strict=True):
        assert (patch.rgb == same.rgb).all() and patch.rgb.shape == (40, 40, 3)
        middle = patch.rgb[15:25, 15:25].astype(float).mean(axis=(0, 1))
        assert (middle[2] > middle[1]) == (patch.land_class == "water")
        assert patch.fraction >= 0.6 and 4.0 < patch.height_m < 75.0 and 3.0 < patch.side_m < 26.0
    other = patches.scene_patches(str(place), 7, 1, 40, 1)[0]
    assert (other.rgb != found[0].rgb).any()


def test_a_share_of_seeds_is_of_other_materials(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a scene is built in, by seed; it is not built."""
    found: list[bool] = []
    presets: list[str] = []

    class BuiltError(Exception):
        pass

    def build(config: Any) -> None:
        found.append(present_variation() is not None)
        presets.append(config.rugged.preset)
        raise BuiltError

    monkeypatch.setattr(patches, "build_scene", build)
    for fraction in (0.0, 0.5, 1.0):
        for seed in range(40):
            with pytest.raises(BuiltError):
                patches.scene_patches("turf", seed, 1, 40, 0, patches.NewLooks(0.0, fraction))
    looks, dials = patches.NewLooks(0.0, 1.0), ("rugged.preset=quarry",)
    with pytest.raises(BuiltError):
        patches.scene_patches("rugged", 1, 1, 40, 0, looks, dials)
    assert presets[-1] == "quarry"
    assert not any(found[:40]) and all(found[80:]) and 10 <= sum(found[40:80]) <= 30
    assert present_variation() is None


def test_a_material_has_one_colour() -> None:
    """Two materials in a grey image: what each shows is multiplied, in linear light."""
    grey = np.full((4, 8, 3), 96, np.uint8)
    road = LAND_CLASSES.index("road")
    materials = np.full((2, 4), road + 1, np.int32)
    materials[:, 2:] += OTHER_CLASS_ID + 2
    found = patches.recoloured(grey, materials, np.random.default_rng(3))
    left, right = found[:, :4].reshape(-1, 3), found[:, 4:].reshape(-1, 3)
    assert (left == left[0]).all() and (right == right[0]).all() and (left[0] != right[0]).any()
    light, warm, green = np.random.default_rng(3).normal(0.0, patches._SPREAD["road"])
    gains = np.exp([light + abs(warm), light + green, light - abs(warm)])
    linear = np.minimum((96 / 255) ** 2.2 * gains, 1.0)
    np.testing.assert_array_equal(left[0], np.round(255 * linear ** (1 / 2.2)))


def _painted(
    name: str, seed: int, count: int, pixels: int, variation: int, looks: patches.NewLooks,
    settings: tuple[str, ...],
) -> list[patches.Patch]:  # fmt: skip
    """At most two patches a place, in the colour of its seed."""
    rgb = np.full((pixels, pixels, 3), seed % 256, np.uint8)
    land_class = "water" if name == "pools" else "lawn"
    return [patches.Patch(rgb, land_class, 0.9, 20.0, 6.4)] * min(count, 2)


@pytest.mark.parametrize(
    ("preset", "split"), [("lava", "test"), ("gully", "test"), ("quarry", "train")]
)
def test_presets_kept_for_a_verdict_are_for_the_test(
    preset: str, split: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(render_dataset, "scene_patches", _painted)
    dial = f"rugged.preset={preset}"
    params = DatasetParams(images=1, scenes=["rugged"], pixels=48, settings=(dial,))
    assert render_dataset.render_dataset(tmp_path / "new", params)["splits"][split] == 1
    assert f",lawn,meadow,rugged-{preset},1000," in (tmp_path / "new/manifest.csv").read_text()


def test_classes_share_the_first_images() -> None:
    ground = SimpleNamespace(class_id=np.array([[0, 5], [OTHER_CLASS_ID, 5]], np.uint8))
    scene: Any = SimpleNamespace(ground=ground)
    assert patches._kinds(scene, np.array([0, 3], np.int32)) == 3
    assert [patches._quota(40, *at) for at in ((0, 3), (0, 7), (40, 7))] == [13, 8, 40]


def test_a_dataset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten patches of two scenes at four a place; places give two, so that more are needed."""
    monkeypatch.setattr(render_dataset, "scene_patches", _painted)
    out = tmp_path / "patches"
    done = render_dataset.render_dataset(
        out, DatasetParams(images=10, scenes=["lake", "pools"], pixels=48, per_seed=4)
    )
    assert done["images"] == 10 and done["splits"]["test"] >= 4
    with (out / "manifest.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len({row["file"] for row in rows}) == 10
    assert tuple(rows[0]) == render_dataset.COLUMNS
    assert rows[0] == {
        "file": "lake-1000/0000.png", "d_land": "lawn", "d_scene": "meadow", "scene": "lake",
        "seed": "1000", "split": "train", "height_m": "20.00", "side_m": "6.40",
        "fraction": "0.900",
    }  # fmt: skip
    for row in rows:
        assert (read_picture(out / row["file"]) == int(row["seed"]) % 256).all()
        assert row["split"] == split_of_layout(row["scene"], int(row["seed"]))
    assert read_picture(out / "contact_sheet.png").shape[0] == 7 * 100 + 4
    pictures = load_images([read_catalogue(str(out), "d_scene")], "test", "d_scene", 32)
    expected = [row["d_scene"] for row in rows if row["split"] == "test"]
    assert [pictures.classes[label] for label in pictures.labels] == expected
    assert pictures.images.shape == (len(expected), 32, 32, 3) and pictures.sources == ("rendered",)


@pytest.fixture
def folder(tmp_path: Path) -> Any:
    """Makes class folders with small coloured images."""

    def make(files: dict[str, int]) -> Path:
        for name, count in files.items():
            (tmp_path / name).mkdir()
            for number in range(count):
                picture = np.full((20, 30, 3), number, np.uint8)
                cv2.imwrite(str(tmp_path / name / f"{name}{number:02d}.png"), picture)
        return tmp_path

    return make


def test_a_folder_of_uc_merced(folder: Any) -> None:
    data = folder({"river": 70, "airplane": 3})
    catalogue = read_catalogue(str(data), "d_land")
    assert (len(catalogue.entries), catalogue.left_out) == (73, 0)
    assert {entry.source for entry in catalogue.entries} == {"ucmerced"}
    test = load_images([catalogue], "test", "d_land", 16)
    assert list(test.images[:, 0, 0, 0]) == list(range(64, 70))
    assert {test.classes[label] for label in test.labels} == {"water"}


@pytest.mark.parametrize(("files", "argument", "message"), [
    ({}, "{}", "is empty"),
    ({"river": 0}, "{}", "is empty: it holds no image of any class"),
    ({"river": 1, "habor": 1}, "{}", r"'habor' is no class of ucmerced \(did you mean 'harbor'"),
    ({"cats": 1}, "{}", "are not the classes of any"),
    ({"lawn": 1}, "rendered={}", "has no manifest.csv"),
    ({"lawn": 1}, "ucmercy={}", r"unknown kind 'ucmercy' \(did you mean 'ucmerced'\?\)"),
    ({}, "{}/nowhere", "is not a folder"),
])  # fmt: skip
def test_folders_that_cannot_be_used(
    folder: Any, files: dict[str, int], argument: str, message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        read_catalogue(argument.format(folder(files)), "d_land")


@pytest.mark.parametrize(("text", "message"), [
    ("{columns}\n/etc/hostname,lawn,lawn,flat,1,train,9,9,1\n", "is no name of a file in"),
    (
        "{columns}\nlawn/../../x.png,lawn,lawn,flat,1,train,9,9,1\n",
        "line 2: .* is no name of a file in",
    ),
    ("{columns}\nlawn/a.png\n", "lacks rows, or one of file, d_land"),
    ("{columns}\n" + "x" * 200_000, "is not a table in CSV and UTF-8"),
    ("{columns}\n\udcff", "is not a table in CSV and UTF-8"),
])  # fmt: skip
def test_manifests_that_cannot_be_used(folder: Any, text: str, message: str) -> None:
    data = folder({"lawn": 1})
    columns = "file,d_land,d_scene,scene,seed,split,height_m,side_m,fraction"
    content = text.format(columns=columns).encode("utf-8", "surrogateescape")
    (data / "manifest.csv").write_bytes(content)
    with pytest.raises(UsageError, match=message):
        read_catalogue(f"rendered={data}", "d_land")


def test_no_picture_in_a_split(folder: Any) -> None:
    catalogue = read_catalogue(str(folder({"river": 3})), "d_land")
    with pytest.raises(UsageError, match="no image is in the split 'test'"):
        load_images([catalogue], "test", "d_land", 16)


def test_the_middle_square_is_taken() -> None:
    wide = np.zeros((10, 30, 3), np.uint8)
    wide[:, 10:20] = 200
    assert (squared(wide, 5) == 200).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--scene", "pond"], "unknown scene 'pond'"),
        (["--images", "0"], "--images"),
        (["--scene", "lake", "--set", "rugged.slope_deg=3"], "rugged.slope_deg"),
    ],
)
def test_command_refuses(arguments: list[str], message: str, tmp_path: Path, says: Says) -> None:
    printed = says(2, "dataset", "render", "--out", tmp_path / "new", *arguments).err
    assert message in printed and printed.count("\n") == 1


def test_command_keeps_what_is_there(tmp_path: Path, says: Says) -> None:
    (tmp_path / "note.txt").write_text("mine")
    assert "or not empty" in says(2, "dataset", "render", "--out", tmp_path, "--images", "1").err
    assert [path.name for path in tmp_path.iterdir()] == ["note.txt"]


def test_a_streak_smears_along_its_direction() -> None:
    kernel = patches._streak(4.0, 0.0)
    assert kernel.sum() == pytest.approx(1.0)
    assert kernel.sum(axis=1).argmax() == 2 and (kernel[2] > 0).all() and kernel[0].sum() == 0


def test_views_crop_mirror_and_turn_infrared_green() -> None:
    picture = np.zeros((8, 8, 3), np.uint8)
    picture[2:6, 2:6] = (200, 40, 60)
    part = View(left=2, top=2, side=4).of(picture)
    assert part.shape == (4, 4, 3) and (part == (200, 40, 60)).all()
    # grey 100, of the rest four tenths: 100 + 0.4 (40 - 100), 100 + 0.4 (200 - 100) ...
    green = View(left=2, top=2, side=4, infrared=True).of(picture)
    assert (green == (76, 140, 84)).all()
    slope = np.tile(np.arange(0, 160, 20, dtype=np.uint8)[None, :, None], (8, 1, 3))
    tiled = View(tiles=2).of(slope)[0, :, 0].astype(int)
    assert tiled.tolist() == [10, 50, 90, 130, 130, 90, 50, 10]


def _aerial(home: Path) -> Path:
    rows = [("a.png", "grass", "one crop"), ("b.png", "gravel_track", "one crop"),
            ("c.png", "vehicle", "two x"), ("falsecolour/d.png", "water", "two x")]  # fmt: skip
    (home / "falsecolour").mkdir(parents=True)
    for file, _, _ in rows:
        cv2.imwrite(str(home / file), np.full((16, 16, 3), (60, 40, 200), np.uint8))
    with (home / "labels.csv").open("w", newline="") as table:
        csv.writer(table).writerows([("file", "class", "source"), *rows])
    return home


def test_photographs_are_labelled_and_a_source_may_be_left_out(tmp_path: Path) -> None:
    """A gravel track is of no clear class and left out; a vehicle is of none, and shown."""
    folder = _aerial(tmp_path / "aerial")
    catalogue = read_catalogue(f"aerial={folder}", "d_land", ("a.png", "c.png", "d.png"))
    assert catalogue.left_out == 1 and {e.split for e in catalogue.entries} == {"test"}
    labels = [entry.label for entry in entries_of([catalogue], "test", others=True)]
    assert labels == [D_LAND.index("lawn"), NO_LABEL, D_LAND.index("water")]
    assert len(entries_of([catalogue], "test")) == 2
    shown = load_images([catalogue], "test", "d_land", 8, others=True)
    assert shown.images[0, 0, 0].tolist() == [200, 40, 60]
    assert shown.images[2, 0, 0].tolist() == [76, 140, 84]
    kept = read_catalogue(f"aerial={folder}", "d_land")
    assert {entry.split for entry in kept.entries} <= {"train", "val"}
    (folder / "labels.csv").write_text("file,class,source\na.png,lava,one\n")
    with pytest.raises(UsageError, match="unknown class 'lava'; known: grass"):
        read_catalogue(f"aerial={folder}", "d_land")
    (folder / "labels.csv").write_text("file,class\na.png,grass\n")
    with pytest.raises(UsageError, match="lacks rows, or one of file, class, source"):
        read_catalogue(f"aerial={folder}", "d_land")


def test_squares_of_caliterra_lie_in_one_split_by_photograph(tmp_path: Path) -> None:
    found = read_catalogue(f"caliterra={tmp_path}", "d_land").entries
    assert len(found) >= 200
    splits: dict[Path, set[str]] = {}
    for one in found:
        splits.setdefault(one.file, set()).add(one.split)
        assert 0 <= one.view.left <= 1600 - one.view.side
        assert 0 <= one.view.top <= 1200 - one.view.side
    assert all(len(of) == 1 for of in splits.values())
    assert set.union(*splits.values()) == {"train", "val", "test"}


def test_textures_are_cut_and_tiled(tmp_path: Path) -> None:
    for name in ("grass__a.jpg", "roof__b.jpg", "rock__c.jpg"):
        cv2.imwrite(str(tmp_path / name), np.full((1024, 1024, 3), 90, np.uint8))
    found = read_catalogue(f"textures={tmp_path}", "d_land")
    assert found.left_out == 8 and len(found.entries) == 16
    assert {D_LAND[entry.label] for entry in found.entries} == {"lawn", "building"}
    by_file = {entry.file: set[str]() for entry in found.entries}
    for entry in found.entries:
        by_file[entry.file].add(entry.split)
    assert all(len(splits) == 1 for splits in by_file.values())


def test_reliability_compares_what_is_claimed_with_what_is_right() -> None:
    """Of four images claimed with 0.75, three are right."""
    others = 0.25 / (len(D_LAND) - 1)
    chance = np.full((4, len(D_LAND)), others)
    chance[:, 0] = 0.75
    (row,) = reliability(np.log(chance).astype(np.float32), np.array([0, 0, 0, 1]))
    assert row["mean"] == pytest.approx(0.75) and row["right"] == 0.75 and row["pictures"] == 4
    assert row["interval"][0] < 0.4 and row["interval"][1] > 0.9
