"""The two label schemes, and the mapping of the classes of public data sets into them.

The mappings were fixed before any network was trained. A class is mapped by what fills most of its
area; a class that two things fill about equally is mapped to the one that is less safe to land on,
or left out where neither is a kind of ground.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from touchdown.landing.classification import places365 as places
from touchdown.scenes.api import LAND_CLASSES

D_LAND: tuple[str, ...] = LAND_CLASSES
"""the paper's seven classes by landing difficulty"""

D_SCENE: tuple[str, ...] = (
    "airport", "bareland", "baseballfield", "beach", "bridge", "center", "church", "commercial",
    "denseresidential", "desert", "farmland", "forest", "industrial", "meadow",
    "mediumresidential", "mountain", "park", "parking", "playground", "pond", "port",
    "railwaystation", "resort", "river", "school", "sparseresidential", "square", "stadium",
    "storagetanks", "viaduct",
)  # fmt: skip
"""the thirty classes of AID (Xia et al., IEEE TGRS 2017)"""

SCHEMES: dict[str, tuple[str, ...]] = {"d_land": D_LAND, "d_scene": D_SCENE}
NO_LABEL = -1
"""label of an image whose class is not part of a scheme"""


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


def _table(text: str) -> dict[str, Meaning]:
    """Parses rows of class, D_Land, D_Scene; ``-`` is no class of the scheme, ``?`` leaves the
    images out."""
    rows = [line.split() for line in text.strip().splitlines()]
    return {
        name: Meaning(
            None if land in "-?" else land, None if scene == "-" else scene, unclear=land == "?"
        )
        for name, land, scene in rows
    }


UC_MERCED = _table("""
agricultural        field     farmland
airplane            -         airport
baseballdiamond     field     baseballfield
beach               water     beach
buildings           building  commercial
chaparral           trees     bareland
denseresidential    building  denseresidential
forest              trees     forest
freeway             road      viaduct
golfcourse          lawn      park
harbor              water     port
intersection        road      viaduct
mediumresidential   building  mediumresidential
mobilehomepark      building  denseresidential
overpass            road      viaduct
parkinglot          road      parking
river               water     river
runway              road      airport
sparseresidential   building  sparseresidential
storagetanks        building  storagetanks
tenniscourt         -         playground
""")
"""Yang and Newsam (2010), 21 classes. An apron full of aircraft and a fenced court among gardens
are no kind of ground. Surf fills most of the beaches; chaparral is shrubs. AID's only roads are
viaducts."""

AID = _table("""
airport             road      airport
bareland            field     bareland
baseballfield       field     baseballfield
beach               water     beach
bridge              water     bridge
center              building  center
church              building  church
commercial          building  commercial
denseresidential    building  denseresidential
desert              field     desert
farmland            field     farmland
forest              trees     forest
industrial          building  industrial
meadow              lawn      meadow
mediumresidential   building  mediumresidential
mountain            -         mountain
park                -         park
parking             road      parking
playground          field     playground
pond                water     pond
port                water     port
railwaystation      building  railwaystation
resort              building  resort
river               water     river
school              building  school
sparseresidential   building  sparseresidential
square              path      square
stadium             building  stadium
storagetanks        building  storagetanks
viaduct             road      viaduct
""")
"""A park is lawn, trees and ponds in equal parts; mountains are rock, snow or forest."""

PLACES365 = _table(places.OUTDOOR) | dict.fromkeys(places.INDOOR.split(), Meaning(None, None))
"""Zhou et al. (2018), 365 classes. Everything indoors is left out, by the data set's own list, and
so are outdoor scenes that show no one kind of ground."""

AIR = _table("""
grass               lawn      -
sparse_grass        field     -
sparse_grass_soil   field     -
bare_soil           field     -
field_soil          field     -
field_green         field     -
field_stubble_dry   field     -
crop_green          field     -
road_asphalt        road      -
building_roof       building  -
water               water     -
trees               trees     -
shrubs              trees     -
gravel_track        ?         -
pipes               -         -
machine             -         -
vehicle             -         -
""")
"""Squares of photographs from the air. A haul road of gravel is a road to who builds there and bare
soil to a camera: it is left out. Things on the ground are no kind of ground."""

TEXTURES = _table("""
grass               lawn      -
moss                lawn      -
soil                field     -
ground              field     -
sand_gravel         field     -
snow                field     -
forest_floor        field     -
scatteredleaves     field     -
woodchips           field     -
concrete            path      -
paving              path      -
gravel              path      -
asphalt             road      -
road                road      -
roof                building  -
roofingtiles        building  -
thatchedroof        building  -
rock                ?         -
rocks               ?         -
rock_grass          ?         -
""")
"""Textures of ground. Rock is safe where it is flat, which a texture does not show."""

LAND_FOLDERS = {name: Meaning(name, None) for name in D_LAND}
"""plain folders named as the classes of D_Land"""

SOURCES: dict[str, Mapping[str, Meaning]] = {
    "d_land": LAND_FOLDERS,
    "ucmerced": UC_MERCED,
    "aid": AID,
    "places365": PLACES365,
}
"""classes by kind of data set; names are compared by letters and digits alone"""

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
}  # fmt: skip
"""by rendered scene: the AID class of the scene, and of the land classes that differ from it"""


def rendered_meaning(scene: str, land_class: str) -> Meaning:
    """Returns the labels of a rendered patch of ``land_class``; an unknown scene has no D_Scene
    class."""
    if scene not in _RENDERED:
        return Meaning(land_class, None)
    whole, parts = _RENDERED[scene]
    return Meaning(land_class, parts.get(land_class, whole))


def plain_name(name: str) -> str:
    """Returns the letters and digits of a folder's or a class's name in lower case."""
    return re.sub(r"[^a-z0-9]", "", name.lower())


def meanings(kind: str, folders: Sequence[str]) -> dict[str, Meaning]:
    """Returns the labels of each folder of a data set of ``kind`` (a key of ``SOURCES``).

    Raises ValueError for a folder that is not a class of it; the message names the nearest one.
    """
    known = {plain_name(name): meaning for name, meaning in SOURCES[kind].items()}
    for folder in folders:
        if plain_name(folder) not in known:
            near = difflib.get_close_matches(plain_name(folder), known, n=1, cutoff=0.5)
            hint = f"; did you mean '{near[0]}'?" if near else ""
            raise ValueError(f"'{folder}' is no class of {kind}{hint}")
    return {folder: known[plain_name(folder)] for folder in folders}


def kind_of_folders(folders: Sequence[str]) -> str:
    """Returns the data set that has the most of ``folders`` as classes; of equals the first in
    ``SOURCES``. Raises ValueError where no data set has half of them."""
    names = {plain_name(folder) for folder in folders}
    counts = {
        kind: len(names & {plain_name(name) for name in table}) for kind, table in SOURCES.items()
    }
    best = max(counts, key=lambda kind: counts[kind])
    if not names or 2 * counts[best] < len(names):
        raise ValueError(
            f"the folders ({', '.join(sorted(folders)[:4])}, ...) are not the classes of any of "
            f"{', '.join(SOURCES)}"
        )
    return best
