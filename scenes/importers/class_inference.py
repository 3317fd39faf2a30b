"""Classes of a file's geoms by words of their names, by geometry and by appearance, where no name
begins with a class."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

import mujoco
import numpy as np

from touchdown.scenes.api import Array
from touchdown.scenes.importers.top_view import Place, grounds, largest

WORDS: Mapping[str, str] = {
    word: land_class
    for land_class, words in {
        "water": "water pond lake river stream pool sea ocean canal fountain",
        "trees": "tree bush hedge shrub forest foliage canopy crown leaf leaves palm pine oak",
        "road": "road street asphalt tarmac highway runway parking lane driveway crossing",
        "building": "building house roof wall brick shed garage tower fence facade barn hall",
        "path": "path pavement paving paver sidewalk concrete patio terrace deck gravel tile",
        "lawn": "lawn grass turf meadow pasture",
        "field": "field soil dirt sand earth mud snow beach dune clay",
    }.items()
    for word in words.split()
}
"""Words of names, in the singular, and the class that they mean."""
GROUND_M2 = 12.0
"""Least area of a surface that counts as ground or as a roof."""
_DARK = 95.0
"""Grey below which a surface looks like asphalt, of 255."""
_GREY = 0.08
"""Largest difference of colours, of their mean, that counts as grey."""
_REGULAR = 6
"""A texture of no more colours is a pattern, not a picture."""
_EVEN = 3.0
"""Standard deviation of the grey values, of 255, below which a picture shows nothing"""


class Look(NamedTuple):
    """Appearance of a geom."""

    rgb: Array
    """(3,) mean, 0 to 255"""
    plain: bool
    """one colour, a gradient or a regular pattern: nothing that a place could be told by"""
    pattern: bool = False
    """a texture that is plain"""


class Inferred(NamedTuple):
    """Class of a geom and what it is inferred from."""

    land_class: str
    why: str


def class_of_words(*names: str) -> str | None:
    """The class that a word of the names means, the first name first; None for none."""
    for name in names:
        for word in re.findall(r"[a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower()):
            for form in (word, word.removesuffix("s")):
                if form in WORDS:
                    return WORDS[form]
    return None


def names_of(model: Any, geom: int) -> tuple[str, str, str]:
    """Names of a geom's material, of the geom and of its body; empty for none."""
    material = int(model.geom_matid[geom])
    own = model.material(material).name if material >= 0 else ""
    return own, model.geom(geom).name, model.body(model.geom_bodyid[geom]).name


def look_of(model: Any, geom: int) -> Look:
    """Mean colour of a geom, and whether anything is seen on it."""
    material = int(model.geom_matid[geom])
    rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
    colour = 255.0 * np.asarray(rgba[:3], np.float64)
    textures = model.mat_texid[material] if material >= 0 else np.full(1, -1)
    texture = int(textures[min(int(mujoco.mjtTextureRole.mjTEXROLE_RGB), len(textures) - 1)])
    if texture < 0:
        return Look(colour, True)
    start, channels = int(model.tex_adr[texture]), int(model.tex_nchannel[texture])
    pixels = int(model.tex_height[texture]) * int(model.tex_width[texture])
    data = np.asarray(model.tex_data[start : start + pixels * channels])
    image = data.reshape(pixels, channels)[:, [0, 1, 2] if channels >= 3 else [0, 0, 0]]
    mean = image.mean(axis=0, dtype=np.float64)
    packed = image[:: max(pixels // 200_000, 1)].astype(np.uint32) @ np.array([65536, 256, 1])
    even = float(image.mean(axis=1).std()) < _EVEN
    plain = even or len(np.unique(packed)) <= _REGULAR
    return Look(mean * colour / 255.0, plain, plain)


def ground_class(look: Look) -> str:
    """The class of ground that looks like this. Of plain ground only a clear green, brown or white
    counts; it is a lawn else, a green roof on a building, as that is what it is dressed as."""
    red, green, blue = look.rgb
    mean = float(look.rgb.mean())
    if green > 1.04 * red and green > 1.08 * blue:
        return "lawn"
    if np.ptp(look.rgb) <= _GREY * max(mean, 1.0) or blue >= red:
        if look.plain:
            return "lawn"
        if mean > 200.0:
            return "field"  # snow
        return "road" if mean < _DARK else "path"
    return "field" if red > 1.15 * blue else "lawn" if look.plain else "path"


def is_blue(look: Look) -> bool:
    """True for the blue that water is drawn in; the usual floor of MuJoCo's examples is a blue
    pattern."""
    red, green, blue = look.rgb
    return bool(not look.pattern and blue > max(1.5 * red, 1.12 * green, 80.0))


def infer_classes(place: Place, unknown: list[int], takeoff_geom: int) -> dict[int, Inferred]:
    """The class of each geom in ``unknown``. What the vehicle takes off from is ground, whatever
    it is called, if it is wide enough."""
    label = grounds(place.seen)
    area, on_main = place.seen_m2(), place.seen_m2(label == largest(label))
    found = {}
    for geom in unknown:
        word, look = class_of_words(*names_of(place.model, geom)), look_of(place.model, geom)
        wide = area[geom] >= GROUND_M2
        if geom == takeoff_geom and wide and word in (None, "building"):
            found[geom] = Inferred(ground_class(look), "what the vehicle takes off from")
        elif word is not None:
            found[geom] = Inferred(word, "a word of its name")
        elif place.is_kind(geom, "PLANE", "HFIELD") or (
            on_main[geom] >= max(GROUND_M2, 0.5 * area[geom])
        ):
            blue, plain = ("water", "a blue surface"), (ground_class(look), "wide ground")
            found[geom] = Inferred(*(blue if is_blue(look) else plain))
        else:
            found[geom] = _raised(place, geom, look, wide)
    return found


def _raised(place: Place, geom: int, look: Look, wide: bool) -> Inferred:
    red, green, blue = look.rgb
    rounded = place.is_kind(geom, "SPHERE", "ELLIPSOID", "CAPSULE", "MESH")
    if rounded and green > 1.15 * red and green > 1.15 * blue:
        return Inferred("trees", "green and round")
    if wide and place.is_kind(geom, "BOX"):
        return Inferred("building", "a raised box")
    return Inferred("other", "a thing on the ground")
