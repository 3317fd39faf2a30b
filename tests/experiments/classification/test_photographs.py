"""Labelled photographs from the air: which part, which class, which split."""

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest

from touchdown.experiments.classification import photographs
from touchdown.experiments.classification.image_folders import (
    entries_of,
    load_images,
    read_catalogue,
)
from touchdown.experiments.classification.reliability import reliability
from touchdown.experiments.errors import UsageError
from touchdown.landing.classification.labels import D_LAND, NO_LABEL


def test_views_crop_mirror_and_turn_infrared_green() -> None:
    picture = np.zeros((8, 8, 3), np.uint8)
    picture[2:6, 2:6] = (200, 40, 60)
    part = photographs.View(left=2, top=2, side=4).of(picture)
    assert part.shape == (4, 4, 3) and (part == (200, 40, 60)).all()
    # grey 100, of the rest four tenths: 100 + 0.4 (40 - 100), 100 + 0.4 (200 - 100) ...
    green = photographs.View(left=2, top=2, side=4, infrared=True).of(picture)
    assert (green == (76, 140, 84)).all()
    slope = np.tile(np.arange(0, 160, 20, dtype=np.uint8)[None, :, None], (8, 1, 3))
    tiled = photographs.View(tiles=2).of(slope)[0, :, 0].astype(int)
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
    found = photographs.photographs("caliterra", tmp_path)
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
