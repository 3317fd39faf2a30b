"""Reading of labelled image folders: rendered patches, UC Merced, AID, Places365, plain folders
named as the classes, and photographs from the air."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np

from touchdown.experiments.classification.data_sets import (
    FOLDER_KINDS,
    SPLITS,
    Meaning,
    kind_of_folders,
    meanings,
    split_of_file,
    split_of_ucmerced,
)
from touchdown.experiments.classification.photographs import ALL, KINDS, View, photographs
from touchdown.experiments.classification.render_dataset import COLUMNS, MANIFEST
from touchdown.experiments.errors import UsageError, nearest
from touchdown.experiments.io.images import read_picture, squared
from touchdown.experiments.io.untrusted import inside
from touchdown.landing.api import LabelledImages
from touchdown.landing.classification.labels import SCHEMES

_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")
RENDERED = "rendered"
_WITH_OTHERS = ("ucmerced",)
"""kinds of which images of no class of a scheme show what must not be taken for one"""


@dataclass(frozen=True, slots=True)
class Entry:
    """File and label of one image of a data set."""

    file: Path
    label: int
    """index into the classes of the scheme; ``NO_LABEL`` for what is none of them"""
    split: str
    source: str
    """kind of the data set"""
    scene: str = ""
    """scene of a rendered image"""
    height_m: float = float("nan")
    """of the camera above the ground, of a rendered image"""
    view: View = ALL
    """what is taken of the file"""


@dataclass(frozen=True, slots=True)
class Catalogue:
    """Images of a folder with their labels under one scheme."""

    source: str
    entries: tuple[Entry, ...]
    left_out: int
    """images whose class the scheme leaves out"""


def read_catalogue(argument: str, scheme: str, left_out: Sequence[str] = ()) -> Catalogue:
    """Returns the images of ``[KIND=]DIR``; without KIND it follows from the names of the folders.

    KIND is rendered, ucmerced, aid, places365, d_land, aerial, caliterra or textures. All
    photographs of the sources ``left_out`` are for the test. Raises UsageError for a missing
    folder, one without images, one that is not a class, or a manifest of another kind.
    """
    kinds = (RENDERED, *FOLDER_KINDS, *KINDS)
    kind, _, rest = argument.rpartition("=")
    folder = Path(rest)
    if kind and kind not in kinds:
        raise UsageError(
            f"--data: unknown kind '{kind}'{nearest(kind, kinds)}; known: {', '.join(kinds)}"
        )
    if not folder.is_dir():
        raise UsageError(f"--data: '{folder}' is not a folder")
    if kind == RENDERED or (not kind and _is_rendered(folder)):
        return _rendered(folder, scheme)
    if kind in KINDS:
        return _photographs(kind, folder, scheme, left_out)
    folders = sorted(path.name for path in folder.iterdir() if path.is_dir())
    if not folders:
        raise UsageError(f"--data: '{folder}' is empty: it has no folder for any class")
    try:
        kind = kind or kind_of_folders(folders)
        found = meanings(kind, folders)
    except ValueError as error:
        raise UsageError(f"--data: '{folder}': {error}") from error
    return _of_folders(folder, kind, found, scheme)


def _is_rendered(folder: Path) -> bool:
    manifest = folder / MANIFEST
    if not manifest.is_file():
        return False
    with _open_manifest(manifest) as file:
        return next(csv.reader(file), []) == list(COLUMNS)


@contextmanager
def _open_manifest(manifest: Path) -> Iterator[TextIO]:
    """Raises UsageError where the text is no CSV in UTF-8."""
    try:
        with manifest.open(encoding="utf-8", newline="") as file:
            yield file
    except (csv.Error, UnicodeDecodeError) as error:
        raise UsageError(
            f"--data: '{manifest}' is not a table in CSV and UTF-8: {error}"
        ) from error


def _rendered(folder: Path, scheme: str) -> Catalogue:
    if not _is_rendered(folder):
        raise UsageError(
            f"--data: '{folder}' has no {MANIFEST} of `touchdown dataset render` in it"
        )
    classes = SCHEMES[scheme]
    entries, left_out = [], 0
    with _open_manifest(folder / MANIFEST) as file:
        for number, row in enumerate(csv.DictReader(file), start=2):
            if row[scheme] == "":
                left_out += 1
            elif row[scheme] not in classes or row["split"] not in SPLITS:
                raise UsageError(
                    f"--data: '{folder / MANIFEST}', line {number}: unknown class or split"
                )
            else:
                label = classes.index(row[scheme])
                try:
                    image, split = inside(folder, row["file"]), row["split"]
                    height_m = float(row["height_m"])
                except ValueError as error:
                    raise UsageError(
                        f"--data: '{folder / MANIFEST}', line {number}: {error}"
                    ) from None
                entries.append(Entry(image, label, split, RENDERED, row["scene"], height_m))
    return _checked(Catalogue(RENDERED, tuple(entries), left_out), folder)


def _photographs(kind: str, folder: Path, scheme: str, left_out: Sequence[str]) -> Catalogue:
    found = photographs(kind, folder, left_out)
    entries = [
        Entry(p.file, p.meaning.label(scheme), p.split, p.source, view=p.view)
        for p in found
        if not p.meaning.unclear
    ]
    return _checked(Catalogue(kind, tuple(entries), len(found) - len(entries)), folder)


def _of_folders(folder: Path, kind: str, found: dict[str, Meaning], scheme: str) -> Catalogue:
    entries, left_out = [], 0
    for name, meaning in sorted(found.items()):
        files = sorted(
            path for path in (folder / name).iterdir() if path.suffix.lower() in _SUFFIXES
        )
        label = meaning.label(scheme)
        if label < 0 and kind not in _WITH_OTHERS:
            left_out += len(files)
            continue
        for file in files:
            relative = f"{name}/{file.name}"
            try:
                split = (
                    split_of_ucmerced(file.name) if kind == "ucmerced" else split_of_file(relative)
                )
            except ValueError as error:
                raise UsageError(f"--data: {error}") from error
            entries.append(Entry(file, label, split, kind))
    return _checked(Catalogue(kind, tuple(entries), left_out), folder)


def _checked(catalogue: Catalogue, folder: Path) -> Catalogue:
    if not catalogue.entries:
        raise UsageError(f"--data: '{folder}' is empty: it holds no image of any class")
    return catalogue


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
