"""Labelled images in folders: rendered patches, UC Merced, AID, Places365, folders named as the
classes, photographs from the air, and textures of ground.

`aerial=DIR` has ``labels.csv`` with a file, a class and the photograph that each was cut from;
`caliterra=DIR` holds photographs of which ``caliterra.csv`` beside this module names squares;
`textures=DIR` holds textures named CLASS__NAME.jpg and swatches with ``swatches.csv``.
"""

import csv
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from zlib import crc32

import cv2
import numpy as np

from touchdown.experiments.classification.data_sets import (
    FOLDER_KINDS,
    SPLITS,
    classes_of,
    kind_of_folders,
    meanings,
    split_of_file,
    split_of_ucmerced,
)
from touchdown.experiments.classification.render_dataset import COLUMNS, MANIFEST
from touchdown.experiments.errors import UsageError, nearest
from touchdown.experiments.io.images import Picture, read_picture, squared
from touchdown.experiments.io.untrusted import inside
from touchdown.landing.api import LabelledImages
from touchdown.landing.classification.labels import SCHEMES

SQUARES = Path(__file__).with_name("caliterra.csv")
RENDERED = "rendered"
_READ = COLUMNS[:-1]
"""columns of a manifest that are read; the last one had another name in earlier versions"""
_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")
_WITH_OTHERS = ("ucmerced",)
"""kinds of which images of no class of a scheme show what must not be taken for one"""
_VAL_FRACTION = 0.15
_DESATURATED = 0.4
"""fraction of the colour that is kept of a photograph with near infrared in place of red"""


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
            picture = picture[self.top : self.top + self.side, self.left : self.left + self.side]
        if self.infrared:
            picture = natural_colour(picture)
        if self.tiles > 1:
            picture = mirrored(picture, self.tiles)
        return picture


ALL = View()


@dataclass(frozen=True, slots=True)
class Entry:
    """File and label of one image of a data set."""

    file: Path
    label: int
    """index into the classes of the scheme; ``NO_LABEL`` for what is none of them"""
    split: str
    source: str
    """kind of the data set, or the source of a photograph"""
    view: View = ALL
    """what is taken of the file"""
    scene: str = ""
    """scene of a rendered image"""


Entries = Iterator[Entry | None]
"""None stands for an image whose class the scheme leaves out"""


@dataclass(frozen=True, slots=True)
class Catalogue:
    """Images of a folder with their labels under one scheme."""

    entries: tuple[Entry, ...]
    left_out: int
    """images whose class the scheme leaves out"""


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


def read_catalogue(argument: str, scheme: str, left_out: Sequence[str] = ()) -> Catalogue:
    """Returns the images of ``[KIND=]DIR``; without KIND it follows from the names of the folders.

    KIND is rendered, ucmerced, aid, places365, d_land, aerial, caliterra or textures. All images
    of the sources ``left_out`` are for the test. Raises UsageError for a missing folder, one
    without images, one that is not a class, or a table of another kind.
    """
    kinds = (RENDERED, *FOLDER_KINDS, *_PHOTOGRAPHS)
    kind, _, rest = argument.rpartition("=")
    folder = Path(rest)
    if kind and kind not in kinds:
        raise UsageError(
            f"--data: unknown kind '{kind}'{nearest(kind, kinds)}; known: {', '.join(kinds)}"
        )
    if not folder.is_dir():
        raise UsageError(f"--data: '{folder}' is not a folder")
    if kind == RENDERED or (not kind and _is_rendered(folder)):
        found = _rendered(folder, scheme)
    elif kind in _PHOTOGRAPHS:
        found = _PHOTOGRAPHS[kind](folder, scheme)
    else:
        found = _class_folders(folder, kind, scheme)
    listed = list(found)
    entries = [entry for entry in listed if entry is not None]
    if not entries:
        raise UsageError(f"--data: '{folder}' is empty: it holds no image of any class")
    return Catalogue(
        tuple(replace(e, split="test") if e.source in left_out else e for e in entries),
        len(listed) - len(entries),
    )


def _is_rendered(folder: Path) -> bool:
    manifest = folder / MANIFEST
    if not manifest.is_file():
        return False
    with manifest.open(encoding="utf-8", errors="replace") as file:
        return file.readline(1000).startswith(",".join(_READ))


def _rendered(folder: Path, scheme: str) -> Entries:
    if not _is_rendered(folder):
        raise UsageError(
            f"--data: '{folder}' has no {MANIFEST} of `touchdown dataset render` in it"
        )
    classes, manifest = SCHEMES[scheme], folder / MANIFEST
    for number, row in enumerate(_table(manifest, _READ), start=2):
        name = row[scheme]
        if (name and name not in classes) or row["split"] not in SPLITS:
            raise UsageError(f"--data: '{manifest}', line {number}: unknown class or split")
        try:
            file = inside(folder, row["file"])
        except ValueError as error:
            raise UsageError(f"--data: '{manifest}', line {number}: {error}") from None
        split, scene = row["split"], row["scene"]
        yield Entry(file, classes.index(name), split, RENDERED, scene=scene) if name else None


def _class_folders(folder: Path, kind: str, scheme: str) -> Entries:
    names = sorted(path.name for path in folder.iterdir() if path.is_dir())
    if not names:
        raise UsageError(f"--data: '{folder}' is empty: it has no folder for any class")
    try:
        kind = kind or kind_of_folders(names)
        found = meanings(kind, names)
    except ValueError as error:
        raise UsageError(f"--data: '{folder}': {error}") from error
    for name, meaning in sorted(found.items()):
        label = meaning.label(scheme)
        for file in sorted((folder / name).iterdir()):
            if file.suffix.lower() not in _SUFFIXES:
                continue
            if label < 0 and kind not in _WITH_OTHERS:
                yield None
                continue
            try:
                split = (
                    split_of_ucmerced(file.name)
                    if kind == "ucmerced"
                    else split_of_file(f"{name}/{file.name}")
                )
            except ValueError as error:
                raise UsageError(f"--data: {error}") from error
            yield Entry(file, label, split, kind)


def _aerial(folder: Path, scheme: str) -> Entries:
    for row in _table(folder / "labels.csv", ("file", "class", "source")):
        file = inside(folder, row["file"])
        # crops of one photograph are in one split
        split = _split(row["source"].split(" ")[0])
        view = View(infrared="falsecolour" in row["file"])
        source = file.name.split("_")[0]
        yield _labelled("aerial", row["class"], scheme, Entry(file, 0, split, source, view))


def _caliterra(folder: Path, scheme: str) -> Entries:
    for row in _table(SQUARES, ("photograph", "left_px", "top_px", "side_px", "ground", "split")):
        view = View(left=int(row["left_px"]), top=int(row["top_px"]), side=int(row["side_px"]))
        entry = Entry(folder / row["photograph"], 0, row["split"], "caliterra", view)
        yield _labelled("aerial", row["ground"], scheme, entry)


def _textures(folder: Path, scheme: str) -> Entries:
    views = [ALL, *(View(tiles=tiles) for tiles in (2, 3, 5))]
    views += [View(left=x, top=y, side=512) for x in (0, 400) for y in (0, 400)]
    for file in sorted(folder.glob("*__*.jpg")):
        for view in views:
            entry = Entry(file, 0, _split(file.name), "textures", view)
            yield _labelled("textures", file.name.split("__")[0], scheme, entry)
    swatches = folder / "swatches_ambientcg" / "swatches.csv"
    for row in _table(swatches, ("file", "category")) if swatches.is_file() else ():
        file = inside(folder, row["file"])
        entry = Entry(file, 0, _split(file.name), "textures")
        yield _labelled("textures", row["category"].lower(), scheme, entry)


_PHOTOGRAPHS: dict[str, Callable[[Path, str], Entries]] = {
    "aerial": _aerial,
    "caliterra": _caliterra,
    "textures": _textures,
}


def _split(origin: str) -> str:
    return "val" if crc32(f"photograph {origin}".encode()) / 2**32 < _VAL_FRACTION else "train"


def _labelled(data_set: str, name: str, scheme: str, entry: Entry) -> Entry | None:
    """Returns ``entry`` with the label of the class ``name``; None for an unclear class."""
    table = classes_of(data_set)
    if name not in table:
        raise UsageError(f"--data: unknown class '{name}'; known: {', '.join(table)}")
    meaning = table[name]
    return None if meaning.unclear else replace(entry, label=meaning.label(scheme))


def _table(path: Path, columns: Sequence[str]) -> list[dict[str, str]]:
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
    except (OSError, csv.Error, UnicodeDecodeError) as error:
        raise UsageError(f"--data: '{path}' is not a table in CSV and UTF-8: {error}") from error
    if not rows or any(row.get(name) is None for row in rows for name in columns):
        raise UsageError(f"--data: '{path}' lacks rows, or one of {', '.join(columns)}")
    return rows


def load_images(
    catalogues: Sequence[Catalogue],
    split: str,
    scheme: str,
    pixels: int,
    progress: Callable[[int, int, str], None] = lambda done, total, note: None,
    *,
    others: bool = False,
) -> LabelledImages:
    """Returns all images of a split, scaled to ``pixels``, in the order of the catalogues; with
    ``others`` those of no class too, with the label ``NO_LABEL``.

    Raises UsageError as ``read_picture``, and where the split has no image.
    """
    entries = entries_of(catalogues, split, others=others)
    if not entries:
        raise UsageError(f"--data: no image is in the split '{split}': give more data")
    images = np.empty((len(entries), pixels, pixels, 3), np.uint8)
    for number, entry in enumerate(entries):
        images[number] = squared(entry.view.of(read_picture(entry.file)), pixels)
        progress(number + 1, len(entries), f"reading ({split})")
    sources = tuple(dict.fromkeys(entry.source for entry in entries))
    return LabelledImages(
        images=images,
        labels=np.array([entry.label for entry in entries], np.int64),
        classes=SCHEMES[scheme],
        source=np.array([sources.index(entry.source) for entry in entries], np.int64),
        sources=sources,
    )


def entries_of(catalogues: Sequence[Catalogue], split: str, *, others: bool = False) -> list[Entry]:
    """Returns the entries of one split, in the order of ``load_images``."""
    return [
        entry
        for catalogue in catalogues
        for entry in catalogue.entries
        if entry.split == split and (others or entry.label >= 0)
    ]


def of_classes(images: LabelledImages) -> LabelledImages:
    """Returns those of ``images`` that are of a class."""
    known = images.labels >= 0
    return replace(
        images,
        images=images.images[known],
        labels=images.labels[known],
        source=images.source[known],
    )
