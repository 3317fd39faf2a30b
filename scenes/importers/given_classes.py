"""Classes of a file's geoms as a user gives them: a table of names in TOML, or a PNG from above."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import (
    CLASS_RGB,
    LAND_CLASSES,
    OTHER_CLASS_ID,
    Array,
    GroundRaster,
    Surface,
)
from touchdown.scenes.importers.class_inference import names_of
from touchdown.scenes.importers.pictures import read_rgb
from touchdown.scenes.importers.top_view import Place
from touchdown.sim.files.opening import check_file, printable

Names = Mapping[str, str]
_MOST_BYTES = 1 << 20
_KNOWN = (*LAND_CLASSES, "other")
_RASTER_CELLS = 640
"""along the longer side of a picture of classes: a quarter of a metre"""
_NEAR = 40.0
"""Largest distance of a colour from that of its class"""


def read_class_table(path: Path) -> Names:
    """Classes by pattern of ``path``, a TOML file ``[classes]`` of lines ``"pattern" = "class"``;
    ``*`` stands for anything, and of several the first that fits a name counts. Raises
    FileNotFoundError, and ValueError for another content."""
    check_file(path, "a file of classes", _MOST_BYTES)
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8")).get("classes")
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{path}: not valid TOML: {' '.join(str(error).split())[:120]}") from error
    if not isinstance(table, dict) or not table:
        raise ValueError(f'{path}: it has no table [classes] with lines such as "roof*" = "path"')
    for name, land_class in table.items():
        if land_class not in _KNOWN:
            raise ValueError(
                f"{path}: '{printable(str(land_class))}' of '{printable(name)}' is none of "
                f"{', '.join(_KNOWN)}"
            )
    return table


def class_in_table(table: Names, *names: str) -> str | None:
    """The class of the first pattern that fits one of ``names``; None for none."""
    for pattern, land_class in table.items():
        if any(fnmatchcase(name, pattern) for name in names):
            return land_class
    return None


def read_class_picture(path: Path) -> NDArray[np.uint8]:
    """Index into LAND_CLASSES, or their number for ``other``, of each pixel of ``path`` (rows,
    cols), row 0 in the south: the class whose colour in `scenes.api.CLASS_RGB` is nearest. Raises
    FileNotFoundError, and ValueError for no picture or a colour of no class."""
    image = read_rgb(path, what="a picture of classes")[::-1].astype(np.float32)
    colours = np.array([CLASS_RGB[name] for name in _KNOWN], np.float32)
    away = np.stack([np.linalg.norm(image - colour, axis=2) for colour in colours])
    worst = np.unravel_index(int(away.min(axis=0).argmax()), image.shape[:2])
    if float(away[:, worst[0], worst[1]].min()) > _NEAR:
        colour = ", ".join(f"{value:.0f}" for value in image[worst])
        raise ValueError(
            f"{path}: the colour {colour} is that of no class; take those of `touchdown scenes "
            "render --view class`, listed in docs/your-own-place.md"
        )
    return np.asarray(away.argmin(axis=0), np.uint8)


@dataclass(frozen=True, kw_only=True, slots=True)
class GivenClasses:
    """Classes that a user gives to a scene."""

    classes: dict[int, str]
    """of geoms"""
    ground: str = ""
    """the widest geom, which a picture of classes lies on"""
    picture: NDArray[np.uint8] | None = None
    """(rows, cols) of indices into LAND_CLASSES, or their number"""
    bounds_xy_m: Array = field(default_factory=lambda: np.zeros((2, 2)))

    def raster(self, surface: Callable[[str], Surface]) -> GroundRaster | None:
        """The picture as the classes of the widest geom."""
        if self.picture is None:
            return None
        size = self.bounds_xy_m[1] - self.bounds_xy_m[0]
        cell = float(size.max()) / _RASTER_CELLS
        cols, rows = np.ceil(size / cell).astype(int)
        own = np.array(self.picture.shape)
        row = np.minimum((np.arange(rows) + 0.5) * cell / size[1] * own[0], own[0] - 1).astype(int)
        col = np.minimum((np.arange(cols) + 0.5) * cell / size[0] * own[1], own[1] - 1).astype(int)
        index = self.picture[np.ix_(row, col)]
        ids = np.array([*range(len(LAND_CLASSES)), OTHER_CLASS_ID], np.uint8)
        shine = np.array([surface(name).reflectivity for name in _KNOWN], np.float32)
        return GroundRaster(
            geom_name=self.ground, origin_xy_m=self.bounds_xy_m[0].copy(), cell_m=cell,
            class_id=ids[index], reflectivity=shine[index],
        )  # fmt: skip


def read_given_classes(file: str, place: Place) -> GivenClasses:
    """The classes of ``file``, a table or a picture, empty for none; of a picture, the most
    frequent one of each geom."""
    path, model, seen = Path(file), place.model, place.seen
    if not file:
        return GivenClasses(classes={})
    if path.suffix.lower() == ".toml":
        table = read_class_table(path)
        named = {geom: class_in_table(table, *names_of(model, geom)) for geom in range(model.ngeom)}
        return GivenClasses(classes={geom: name for geom, name in named.items() if name})
    picture = read_class_picture(path)
    rows, cols = np.indices(seen.geom.shape)
    share = np.array(picture.shape) / np.array(seen.geom.shape)
    cell = ((rows + 0.5) * share[0]).astype(int), ((cols + 0.5) * share[1]).astype(int)
    painted, classes = picture[cell], {}
    for geom in np.unique(seen.geom[seen.geom >= 0]).tolist():
        counts = np.bincount(painted[seen.geom == geom], minlength=len(_KNOWN))
        classes[geom] = _KNOWN[int(counts.argmax())]
    widest = place.name(int(np.bincount(seen.geom[seen.geom >= 0]).argmax()))
    high = seen.origin_xy_m + seen.cell_m * np.array(seen.geom.shape)[::-1]
    bounds = np.stack([seen.origin_xy_m, high])
    return GivenClasses(classes=classes, ground=widest, picture=picture, bounds_xy_m=bounds)
