"""Classes of a file's geoms where no name begins with one: as a user gives them, in a table of
names (TOML) or a PNG from above, else by words of their names, by geometry and by appearance."""

import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes import api
from touchdown.scenes.importers.pictures import read_rgb
from touchdown.scenes.importers.top_view import Place, grounds, largest
from touchdown.sim.files.opening import check_file, printable

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

    rgb: api.Array
    """(3,) mean, 0 to 255"""
    plain: bool
    """one colour, a gradient or a regular pattern: nothing that a place could be told by"""
    pattern: bool = False
    """a texture that is plain"""
    even: bool = False
    """a texture of about one colour, as of a street; a pattern is what examples stand on"""


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
    return Look(mean * colour / 255.0, plain, plain, even)


def ground_class(look: Look) -> str:
    """The class of ground that looks like this. Of plain ground only a clear green, brown or white
    counts, and the grey of a texture; it is a lawn else, a green roof on a building, as that is
    what it is dressed as."""
    red, green, blue = look.rgb
    mean = float(look.rgb.mean())
    if green > 1.04 * red and green > 1.08 * blue:
        return "lawn"
    if np.ptp(look.rgb) <= _GREY * max(mean, 1.0) or blue >= red:
        if look.plain and not look.even:
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


Names = Mapping[str, str]
_MAX_BYTES = 1 << 20
_KNOWN = (*api.LAND_CLASSES, "other")
_RASTER_CELLS = 640
"""along the longer side of a picture of classes: a quarter of a metre"""
_NEAR = 40.0
"""Largest distance of a colour from that of its class"""


def read_class_table(path: Path) -> Names:
    """Classes by pattern of ``path``, a TOML file ``[classes]`` of lines ``"pattern" = "class"``;
    ``*`` stands for anything, and of several the first that fits a name counts. Raises
    FileNotFoundError, and ValueError for another content."""
    check_file(path, "a file of classes", _MAX_BYTES)
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
    colours = np.array([api.CLASS_RGB[name] for name in _KNOWN], np.float32)
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
    bounds_xy_m: api.Array = field(default_factory=lambda: np.zeros((2, 2)))

    def raster(self, surface: Callable[[str], api.Surface]) -> api.GroundRaster | None:
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
        ids = np.array([*range(len(api.LAND_CLASSES)), api.OTHER_CLASS_ID], np.uint8)
        shine = np.array([surface(name).reflectivity for name in _KNOWN], np.float32)
        return api.GroundRaster(
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
    fraction = np.array(picture.shape) / np.array(seen.geom.shape)
    cell = ((rows + 0.5) * fraction[0]).astype(int), ((cols + 0.5) * fraction[1]).astype(int)
    painted, classes = picture[cell], {}
    for geom in np.unique(seen.geom[seen.geom >= 0]).tolist():
        counts = np.bincount(painted[seen.geom == geom], minlength=len(_KNOWN))
        classes[geom] = _KNOWN[int(counts.argmax())]
    widest = place.name(int(np.bincount(seen.geom[seen.geom >= 0]).argmax()))
    high = seen.origin_xy_m + seen.cell_m * np.array(seen.geom.shape)[::-1]
    bounds = np.stack([seen.origin_xy_m, high])
    return GivenClasses(classes=classes, ground=widest, picture=picture, bounds_xy_m=bounds)
