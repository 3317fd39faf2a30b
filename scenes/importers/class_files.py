"""Classes of a file's geoms as a user gives them: a table of names in TOML, or a PNG from above."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import CLASS_RGB, LAND_CLASSES
from touchdown.scenes.importers.pictures import read_rgb
from touchdown.sim.files.opening import check_file, printable

Names = Mapping[str, str]
_MOST_BYTES = 1 << 20
_KNOWN = (*LAND_CLASSES, "other")
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
