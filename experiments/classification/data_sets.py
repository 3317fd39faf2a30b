"""Public data sets of aerial images: the labels of their classes, and the split of their images.

``class_labels.csv`` maps the classes of each data set to both label schemes: the 21 of UC Merced
(Yang and Newsam 2010), the 30 of AID (Xia et al. 2017), the 365 of Places365 (Zhou et al. 2018), of
squares of photographs from the air and of textures. It was fixed before any network was trained. A
class is mapped by what fills most of its area; a class that two things fill about equally is mapped
to the one that is less safe to land on, or left out where neither is a kind of ground.

A split follows from the origin of an image alone: it is the same in every run and for every copy of
the data.
"""

import csv
import functools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from zlib import crc32

from touchdown.experiments.errors import nearest
from touchdown.landing.classification.labels import D_LAND, NO_LABEL, SCHEMES

FOLDER_KINDS = ("d_land", "ucmerced", "aid", "places365")
"""data sets of a folder for each class; of the first the classes are those of D_Land"""
SPLITS = ("train", "val", "test")
HELD_OUT_SCENES = ("footbridge", "pools", "rugged-gully", "rugged-lava")
"""scenes of which all patches are for the test, and presets of one"""
_SEED_CYCLE = 5
_UC_TEST = range(64, 80)
"""test file numbers of each class of UC Merced"""
_UC_CYCLE = 8
_TEST_FRACTION, _VAL_FRACTION = 0.2, 0.1
_RENDERED = {
    "crossroad": ("commercial", {"road": "viaduct", "lawn": "park", "field": "farmland",
                                 "trees": "park"}),
    "lake": ("resort", {"water": "pond", "lawn": "meadow", "field": "beach", "trees": "forest"}),
    "houses": ("mediumresidential", {}),
    "forest": ("forest", {"lawn": "meadow", "water": "river"}),
    "turf": ("playground", {"trees": "park", "building": "stadium"}),
    "rooftop_parking": ("parking", {"building": "commercial", "trees": "commercial"}),
    "cottage": ("sparseresidential", {"field": "farmland", "trees": "forest"}),
    "footbridge": ("park", {"path": "bridge", "water": "river", "road": "viaduct"}),
    "pools": ("resort", {"field": "playground"}),
    "flat": ("meadow", {"field": "farmland"}),
    "open_water": ("pond", {"path": "port", "building": "port"}),
    "snow": ("bareland", {"water": "pond", "trees": "forest", "building": "sparseresidential"}),
    "dunes": ("desert", {}),
    "rugged": ("mountain", {"lawn": "meadow"}),
}  # fmt: skip
"""by rendered scene: the AID class of the scene, and of the land classes that differ from it"""


@dataclass(frozen=True, slots=True)
class Meaning:
    """Labels of a class of a data set in each scheme; None where the scheme leaves it out."""

    d_land: str | None
    d_scene: str | None
    unclear: bool = False
    """True for a class that may be any of several"""

    def label(self, scheme: str) -> int:
        """Returns the index into ``SCHEMES[scheme]``, or ``NO_LABEL``."""
        name: str | None = getattr(self, scheme)
        return NO_LABEL if name is None else SCHEMES[scheme].index(name)


@functools.cache
def classes_of(data_set: str) -> Mapping[str, Meaning]:
    """Returns the labels of the classes of a data set by their names."""
    if data_set == "d_land":
        return {name: Meaning(name, None) for name in D_LAND}
    with Path(__file__).with_name("class_labels.csv").open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["data_set"] == data_set]
    return {
        row["class"]: Meaning(
            None if row["d_land"] in ("", "?") else row["d_land"],
            row["d_scene"] or None,
            unclear=row["d_land"] == "?",
        )
        for row in rows
    }


def rendered_meaning(scene: str, land_class: str) -> Meaning:
    """Returns the labels of a rendered patch of ``land_class``; an unknown scene has no D_Scene
    class."""
    if (name := scene.partition("-")[0]) not in _RENDERED:
        return Meaning(land_class, None)
    whole, parts = _RENDERED[name]
    return Meaning(land_class, parts.get(land_class, whole))


def _plain_names(data_set: str) -> dict[str, Meaning]:
    return {plain_name(name): meaning for name, meaning in classes_of(data_set).items()}


def plain_name(name: str) -> str:
    """Returns the letters and digits of a folder's or a class's name in lower case."""
    return re.sub(r"[^a-z0-9]", "", name.lower())


def meanings(kind: str, folders: Sequence[str]) -> dict[str, Meaning]:
    """Returns the labels of each folder of a data set of ``kind``, one of ``FOLDER_KINDS``.

    Raises ValueError for a folder that is not a class of it; the message names the nearest one.
    """
    known = _plain_names(kind)
    for folder in folders:
        if plain_name(folder) not in known:
            raise ValueError(
                f"'{folder}' is no class of {kind}{nearest(plain_name(folder), known)}"
            )
    return {folder: known[plain_name(folder)] for folder in folders}


def kind_of_folders(folders: Sequence[str]) -> str:
    """Returns the data set that has the most of ``folders`` as classes; of equals the first in
    ``FOLDER_KINDS``. Raises ValueError where no data set has half of them."""
    names = {plain_name(folder) for folder in folders}
    counts = {kind: len(names & _plain_names(kind).keys()) for kind in FOLDER_KINDS}
    best = max(counts, key=lambda kind: counts[kind])
    if not names or 2 * counts[best] < len(names):
        raise ValueError(
            f"the folders ({', '.join(sorted(folders)[:4])}, ...) are not the classes of any of "
            f"{', '.join(FOLDER_KINDS)}"
        )
    return best


def split_of_layout(scene: str, seed: int) -> str:
    """Returns the split of all patches of one seed of a scene: three seeds of five are for
    training."""
    if scene in HELD_OUT_SCENES or seed % _SEED_CYCLE == _SEED_CYCLE - 1:
        return "test"
    return "val" if seed % _SEED_CYCLE == _SEED_CYCLE - 2 else "train"


def split_of_ucmerced(file: str) -> str:
    """Returns the split by the number in a file's name: 64 to 79 are for the test, every eighth of
    the rest for validation. Raises ValueError for a name without a number."""
    number = re.search(r"(\d+)\.\w+$", file)
    if number is None:
        raise ValueError(f"'{file}' has no number, as the files of UC Merced have")
    if int(number[1]) in _UC_TEST:
        return "test"
    return "val" if int(number[1]) % _UC_CYCLE == _UC_CYCLE - 1 else "train"


def split_of_file(relative: str) -> str:
    """Returns the split by a hash of ``relative``, class folder and file name: a fifth for the
    test, a tenth for validation."""
    position = crc32(relative.encode()) / 2**32
    if position < _TEST_FRACTION:
        return "test"
    return "val" if position < _TEST_FRACTION + _VAL_FRACTION else "train"
