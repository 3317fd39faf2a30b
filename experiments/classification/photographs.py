"""Labelled photographs from the air and textures of ground, read as crops of a few files.

`aerial=DIR` has ``labels.csv`` with a file, a class and the photograph that each was cut from;
`caliterra=DIR` holds photographs of which ``caliterra.csv`` beside this module names squares;
`textures=DIR` holds textures named CLASS__NAME.jpg and swatches with ``swatches.csv``.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from zlib import crc32

import cv2
import numpy as np

from touchdown.experiments.classification.data_sets import Meaning, classes_of
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.images import Picture
from touchdown.experiments.io.untrusted import inside

SQUARES = Path(__file__).with_name("caliterra.csv")
KINDS = ("aerial", "caliterra", "textures")
_VAL_FRACTION = 0.15
_DESATURATED = 0.4
"""share of the colour that is kept of a photograph with near infrared in place of red"""


@dataclass(frozen=True, kw_only=True, slots=True)
class View:
    """What is taken of a file."""

    left: int = 0
    top: int = 0
    side: int = 0
    """of a square, pixels; 0: all"""
    tiles: int = 1
    """times that the square is repeated across, mirrored, so that no edge shows"""
    infrared: bool = False
    """True where red is near infrared"""

    def of(self, picture: Picture) -> Picture:
        """Returns the part (H, W, 3) of ``picture`` (H, W, 3)."""
        if self.side:
            rows, cols = (
                slice(self.top, self.top + self.side),
                slice(self.left, self.left + self.side),
            )
            picture = picture[rows, cols]
        if self.infrared:
            picture = natural_colour(picture)
        if self.tiles > 1:
            picture = mirrored(picture, self.tiles)
        return picture


ALL = View()


@dataclass(frozen=True, slots=True)
class Photograph:
    """A labelled view of a file."""

    file: Path
    view: View
    meaning: Meaning
    split: str
    source: str


def natural_colour(picture: Picture) -> Picture:
    """Returns a photograph whose red is near infrared with vegetation green: red and green change
    places, and colours are paler."""
    swapped = picture[..., [1, 0, 2]].astype(np.float32)
    grey = swapped.mean(axis=2, keepdims=True)
    return np.asarray(np.clip(grey + _DESATURATED * (swapped - grey), 0, 255), np.uint8)


def mirrored(picture: Picture, tiles: int) -> Picture:
    """Returns ``tiles`` by ``tiles`` copies of a picture, every other one mirrored, at its size."""
    side = -(-min(picture.shape[:2]) // tiles)
    small = cv2.resize(picture, (side, side), interpolation=cv2.INTER_AREA)
    row = np.hstack([small[:, :: 1 - 2 * (n % 2)] for n in range(tiles)])
    return np.asarray(np.vstack([row[:: 1 - 2 * (n % 2)] for n in range(tiles)]), np.uint8)


def photographs(kind: str, folder: Path, left_out: Sequence[str] = ()) -> list[Photograph]:
    """Returns the labelled views of a folder of ``kind``.

    Photographs of a source in ``left_out`` are all in the test split. Raises UsageError where a
    table or a file is missing, or a class is unknown."""
    found = list({"aerial": _aerial, "caliterra": _caliterra, "textures": _textures}[kind](folder))
    return [
        Photograph(p.file, p.view, p.meaning, "test", p.source) if p.source in left_out else p
        for p in found
    ]


def _aerial(folder: Path) -> Iterator[Photograph]:
    for row in _table(folder / "labels.csv", ("file", "class", "source")):
        file = inside(folder, row["file"])
        # crops of one photograph are in one split
        split = _split(row["source"].split(" ")[0])
        view = View(infrared="falsecolour" in row["file"])
        yield Photograph(
            file, view, _meaning("aerial", row["class"]), split, file.name.split("_")[0]
        )


def _caliterra(folder: Path) -> Iterator[Photograph]:
    for row in _table(SQUARES, ("photograph", "left_px", "top_px", "side_px", "ground", "split")):
        view = View(left=int(row["left_px"]), top=int(row["top_px"]), side=int(row["side_px"]))
        file = folder / row["photograph"]
        yield Photograph(file, view, _meaning("aerial", row["ground"]), row["split"], "caliterra")


def _textures(folder: Path) -> Iterator[Photograph]:
    for file in sorted(folder.glob("*__*.jpg")):
        meaning = _meaning("textures", file.name.split("__")[0])
        views = [ALL, *(View(tiles=tiles) for tiles in (2, 3, 5))]
        views += [View(left=x, top=y, side=512) for x in (0, 400) for y in (0, 400)]
        for view in views:
            yield Photograph(file, view, meaning, _split(file.name), "textures")
    swatches = folder / "swatches_ambientcg" / "swatches.csv"
    if swatches.is_file():
        for row in _table(swatches, ("file", "category")):
            file = inside(folder, row["file"])
            meaning = _meaning("textures", row["category"].lower())
            yield Photograph(file, ALL, meaning, _split(file.name), "textures")


def _split(origin: str) -> str:
    return "val" if crc32(f"photograph {origin}".encode()) / 2**32 < _VAL_FRACTION else "train"


def _meaning(data_set: str, name: str) -> Meaning:
    table = classes_of(data_set)
    if name not in table:
        raise UsageError(f"--data: unknown class '{name}'; known: {', '.join(table)}")
    return table[name]


def _table(path: Path, columns: Sequence[str]) -> list[dict[str, str]]:
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
    except (OSError, csv.Error, UnicodeDecodeError) as error:
        raise UsageError(f"--data: '{path}' cannot be read as a table: {error}") from error
    if not rows or any(row.get(name) is None for row in rows for name in columns):
        raise UsageError(f"--data: '{path}' lacks rows, or one of {', '.join(columns)}")
    return rows
