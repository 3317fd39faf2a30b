"""Types of a scene that the other folders use."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from touchdown.sim.api import parameters

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Image = NDArray[np.uint8]
"""(H, W, 3) RGB, top row first"""


def names_function(scene: object) -> bool:
    """True where a scene is MODULE:FUNCTION, not a name or the path of a file."""
    if not isinstance(scene, str) or ":" not in scene:
        return False
    return "/" not in scene and not scene.endswith(".xml")


def short_name(scene: str) -> str:
    """The name of a scene in names of files: that of its file without folder and ending, or
    ``my_lab.places.bowl`` of ``my_lab.places:bowl``."""
    return scene.replace(":", ".") if names_function(scene) else Path(scene).stem


VEHICLE_FOLDER = Path(__file__).parent / "vehicle"
"""MJCF files of the shipped vehicles"""
DEFAULT_VEHICLE = "quadrotor"
VEHICLE_BODY, VEHICLE_GROUP = "vehicle/quadrotor", 4
"""name of the vehicle's body, and group of its geoms, which sensors do not see"""

VEHICLES: Mapping[str, str] = {
    "quadrotor": "4.2 kg, four rotors, Livox Horizon: the default",
    "small_quadrotor": "1.3 kg, four rotors, Livox Mid-360",
    "hexarotor": "6 kg, six rotors, flies on after the loss of one",
    "coaxial_x8": "14 kg, eight rotors on four arms",
}
"""shipped vehicles, and what they are"""


def vehicle_file(name_or_path: str) -> Path:
    """The MJCF file of a vehicle, by the name of a shipped one or a path (with a slash, or ending
    in .xml). Raises ValueError for another name."""
    if name_or_path.endswith(".xml") or "/" in name_or_path:
        return Path(name_or_path)
    if name_or_path not in VEHICLES:
        raise ValueError(
            f"unknown vehicle '{name_or_path[:60]}'; known: {', '.join(VEHICLES)}, or the path of "
            "an MJCF file (docs/vehicles.md)"
        )
    return VEHICLE_FOLDER / f"{name_or_path}.xml"


@dataclass(frozen=True, slots=True)
class Guests:
    """Who comes into a scene, beside its traffic, and how the vehicle's sensors are mounted."""

    vehicle: str = DEFAULT_VEHICLE
    """as for `vehicle_file`"""
    intruders: int = 0
    """that wait for a fault"""
    camera_turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """roll, pitch and yaw of the cameras from their mount on the vehicle"""
    lidar_turns_deg: tuple[tuple[float, float, float] | None, ...] = ((0.0, 0.0, 0.0), None)
    """likewise of the sites ``lidar_0`` and ``lidar_1``; None: as the vehicle has it"""


NO_GUESTS = Guests()
"""the default vehicle alone"""

LAND_CLASSES: tuple[str, ...] = ("lawn", "field", "path", "road", "building", "water", "trees")
"""The paper's seven-class scheme D_Land; a class id is an index into this tuple."""
SAFE_CLASSES: frozenset[str] = frozenset({"lawn", "field", "path"})
RISKY_CLASSES: frozenset[str] = frozenset({"road", "building"})
OTHER_CLASS_ID = 255
"""Objects that belong to no land class (a car, a lamp)."""


CLASS_RGB: Mapping[str, tuple[int, int, int]] = {
    "lawn": (124, 186, 92),
    "field": (205, 180, 110),
    "path": (232, 214, 190),
    "road": (110, 110, 118),
    "building": (196, 84, 70),
    "water": (64, 132, 206),
    "trees": (34, 94, 52),
    "other": (190, 70, 190),
}
"""colours of the classes in pictures"""


Light = Literal["day", "overcast", "dusk", "night"]
LIGHT_LUX: Mapping[str, float] = {"day": 80e3, "overcast": 10e3, "dusk": 400.0, "night": 0.002}
"""Illuminance of level ground: sun and clear sky; a typical overcast noon; sunset on a clear day;
a clear, moonless night with airglow (values commonly tabulated, docs/scenes.md)"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Surface:
    """Optical and semantic properties of a material."""

    land_class: str
    """one of LAND_CLASSES or ``other``"""
    reflectivity: float
    """diffuse, 905 nm, 0..1"""
    porosity: float = 0.0
    """fraction of pulses that pass through (crowns, reeds)"""
    water: bool = False
    spread: float = 0.1
    """relative standard deviation of the reflectivity within the surface"""
    canopy_m: float = 0.0
    """mean height of grass, crops or reeds on it, which pulses partly enter"""
    leaf_area: float = 0.0
    """leaf area index of these plants: one-sided leaf area over ground area"""
    dust: float = 0.0
    """fraction of the dust that dry, bare soil gives off under a downwash"""


@dataclass(frozen=True, kw_only=True, slots=True)
class LowSun:
    """A given position of the sun, in place of the one drawn from a scene's seed."""

    elevation_deg: float
    azimuth_deg: float | None = None
    """of the sun, counter-clockwise from east; None: drawn from the scene's seed"""


@dataclass(frozen=True, kw_only=True, slots=True)
class ImportOptions:
    """How a scene from a file is made flyable (`scenes.importers.import_pass`)."""

    classes: str = ""
    """file of classes (`scenes.importers.classes`) that overrules names and guesses"""


RuggedPreset = Literal["upland", "alpine", "quarry", "lava", "gully", "felled_forest"]
Cover = Literal["", "bare", "scree", "tussocks", "scrub", "snow", "logs"]


@parameters
class RuggedParams:
    """Dials of the scene ``rugged``; what is not set is the preset's (docs/scenes.md)."""

    preset: RuggedPreset = "upland"
    """the kind of place: its look, the spectrum of its relief, and all dials that are not set"""
    slope_deg: Annotated[float, Interval(ge=0, le=25)] | None = None
    """mean slope of the ground over 5 m, without rocks, grooves and cleared pads; none: the
    preset's"""
    relief_m: Annotated[float, Interval(ge=0, le=60)] | None = None
    """height between the lowest and the highest fiftieth of the ground, met as nearly as the slope
    allows by a steeper hillside or without the longest waves; none: what the preset gives"""
    rock_abundance: Annotated[float, Interval(ge=0, le=0.3)] | None = None
    """fraction of the ground that rocks cover, ``k`` of the size-frequency law; none: the
    preset's"""
    cover: Cover = ""
    """what lies on the ground; '': the preset's"""
    groove_fraction: Annotated[float, Interval(ge=0, le=0.1)] | None = None
    """fraction of the ground in ruts and crevices, which are narrower than the footprint; none: the
    preset's"""
    safe_fraction: Annotated[float, Interval(ge=0.003, le=0.3)] | None = None
    """fraction of the ground that is safe to touch down on by the geometric rule; none: the
    preset's"""


@parameters
class DeckParams:
    """Dials of the scene ``deck``."""

    kind: Literal["boat", "truck", "barge"] = "boat"
    """what carries the deck: a boat under way, a truck on a road, a barge at rest"""
    sea_state: Annotated[int, Interval(ge=0, le=6)] = 3
    """of the water under boat and barge (docs/scenes.md)"""
    speed_mps: Annotated[float, Interval(ge=0, le=5)] = 3.0
    """of boat and truck along a straight course"""
    tag_m: Annotated[float, Interval(ge=0, le=2)] = 0.0
    """side of an AprilTag (36h11, number 0) in the middle of the deck; 0: none"""


Dials = RuggedParams | DeckParams

CARRIER, TOUCHED = "/carrier", "/touched"
"""suffixes of the names of a `MovingBody.carries` body and of its geoms"""

DETAILS: tuple[str, ...] = (
    "grass", "meadow", "soil", "litter", "asphalt", "gravel", "concrete", "sand", "dune", "snow",
    "rock",
)  # fmt: skip
"""Kinds of ground with a photograph of their grain; an id is an index into this tuple."""
NO_DETAIL_ID = 255
"""Ground without grain (water)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class GroundRaster:
    """Class and reflectivity of the terrain geom, whose texture shows several materials. Cell
    (row, col) covers ``x in [x0 + col*c, ...), y in [y0 + row*c, ...)``, world frame."""

    geom_name: str
    origin_xy_m: Array
    cell_m: float
    class_id: NDArray[np.uint8]
    reflectivity: NDArray[np.float32]
    material: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 0), np.uint8))
    """indices into ``materials``; empty: all of it is as the terrain's `Surface`"""
    materials: tuple[Surface, ...] = ()
    """spread, plants and dust of each material; reflectivity and class are those of the rasters"""
    detail_id: NDArray[np.uint8] | None = None
    """index into DETAILS or `NO_DETAIL_ID`; None: as the class says"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Limb:
    """How a part of a walker swings about a joint, in the walker's frame (x ahead, z up)."""

    joint_m: Array
    """(3,) from the walker's origin, on the ground; the part's own origin"""
    swing_deg: float = 0.0
    """amplitude about the y axis"""
    stride_m: float = 1.0
    """way of one whole swing: one that stands does not swing"""
    phase_deg: float = 0.0
    bend_deg: float = 0.0
    """constant turn about the y axis"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Sway:
    """Motion of a hull about its course: sums of cosines, of K waves."""

    rates_radps: Array
    """(K,) at which the waves are met"""
    amplitudes: Array
    """(K, 3) of heave, m, of roll to the right and of pitch down, rad: about the body's axes"""
    phases: Array
    """(K, 3) at time 0"""

    def at(self, times_s: Array) -> Array:
        """(M, 3) heave, roll and pitch at (M,) times."""
        angles = np.multiply.outer(times_s, self.rates_radps)[..., None] + self.phases
        return np.asarray((self.amplitudes * np.cos(angles)).sum(axis=1))


@dataclass(frozen=True, kw_only=True, slots=True)
class MovingBody:
    """A mocap body that follows a polyline; its heading follows the path."""

    body_name: str
    path_world: Array
    """(K, 3) vertices; one alone: it stands there"""
    speed_mps: float = 0.0
    """on a path that is closed implicitly, where ``times_s`` is None"""
    start_m: float = 0.0
    """arc length at time 0 on a closed path"""
    times_s: Array | None = None
    """(K,) ascending: when it is at each vertex. It is at the first before, at the last after."""
    yaw: float = 0.0
    """heading of one that stands"""
    limb: Limb | None = None
    """None for what moves as the path says"""
    walker: str = ""
    """name of the first body of what it is a part of; empty for a car"""
    alive: bool = False
    """a person, a rider or an animal, whose distance counts"""
    intruder: bool = False
    """it is out of the world until a fault sends it"""
    sway: Sway | None = None
    """motion about the path"""
    carries: str = ""
    """its geom that can be landed on. A body ``NAME/carrier`` of the same colliding shapes, which
    sensors do not see, moves along: contacts with a mocap body know no velocity"""


@parameters
class TrafficParams:
    """People, animals and vehicles that move through any scene; by default there are none."""

    people: Annotated[int, Interval(ge=0, le=50)] = 0
    """who walk, run, stand or sit"""
    dogs: Annotated[int, Interval(ge=0, le=50)] = 0
    """who trot or stand"""
    bicycles: Annotated[int, Interval(ge=0, le=50)] = 0
    """with their riders"""
    cars: Annotated[int, Interval(ge=0, le=50)] = 0
    """beside those of the scene"""
    radius_m: Annotated[float, Interval(gt=0, le=500)] = 30.0
    """of the disc about the middle of the scene in which paths are drawn"""
    paths: str = ""
    """path of a CSV file of own paths: columns name, t, x, y (s and metres, world frame); a name
    begins with person, dog, bicycle or car"""
    intruder: Literal["any", "walker", "runner", "dog", "bicycle"] = "any"
    """whom the fault ``intruder`` sends; any: drawn from the seed"""
    intruder_from_m: Annotated[float, Interval(ge=3, le=100)] = 15.0
    """distance from the site at which an intruder begins"""
    intruder_stays_s: Annotated[float, Interval(ge=0, le=1000)] = 15.0
    """time on the site, after which it goes on straight ahead"""


@dataclass(frozen=True, kw_only=True, slots=True, weakref_slot=True)
class Scene:
    """A compiled scene with the vehicle in it."""

    name: str
    seed: int
    model: Any
    """mujoco.MjModel, vehicle attached with its free joint first"""
    takeoff_xy_m: Array
    """(2,) world"""
    takeoff_yaw: float
    bounds_xy_m: Array
    """(2, 2) [[x_min, y_min], [x_max, y_max]]"""
    surfaces: Mapping[str, Surface]
    """by geom name; the terrain's entry is a default, its raster takes precedence"""
    ground: GroundRaster | None
    moving: tuple[MovingBody, ...]
    source: str = ""
    """the name or path that it was loaded from"""
    origin_m: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) of the world's origin in the coordinates of that file: add it to get back to them"""
    light: Light = "day"
    """the light that the model is drawn in; its strength is in `LIGHT_LUX`"""
    options: ImportOptions | None = None
    """how the file was made flyable"""
    inferred: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    """of a file: class of geoms whose names say nothing, and what it is inferred from"""
    textured: tuple[str, ...] = ()
    """of a file: geoms of featureless ground that were given texture and relief"""
    dials: Dials | None = None
    """those that it was made with; None for a scene without"""
    vehicle: str = DEFAULT_VEHICLE
    """name or file of the vehicle in it"""
    facts: Mapping[str, float] = field(default_factory=dict)
    """what the dials asked for and what was reached"""
    traffic: TrafficParams = field(default_factory=lambda: TrafficParams())
    """who moves through it beside what the place has"""


@dataclass(frozen=True, kw_only=True, slots=True)
class TruthMaps:
    """Rasters of the true, static scene at time 0, seen from above. Cell (row, col) as in
    GroundRaster."""

    origin_xy_m: Array
    cell_m: float
    height_m: NDArray[np.float32]
    """top surface, objects included"""
    slope_deg: NDArray[np.float32]
    """of the plane fitted within 0.5 m"""
    class_id: NDArray[np.uint8]
    safe_geometry: NDArray[np.bool_]
    """touchdown here satisfies the geometric rule: within 1.0 m slope <= 5 deg, no step
    or object above 0.10 m, no water; from 1.0 to 1.5 m nothing taller than 0.25 m"""
    safe: NDArray[np.bool_]
    """safe_geometry and a safe class"""
