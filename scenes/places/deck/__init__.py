"""`deck`: a boat under way, a truck on a road or a barge at rest, on which a vehicle can land. It
takes off from a pontoon, or beside the road, and the deck comes by in front of it."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from touchdown.scenes.api import Array, DeckParams, Image, MovingBody, Surface, Sway
from touchdown.scenes.authoring import water
from touchdown.scenes.authoring.builder import SceneBuilder, fill_texture, quat_z
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import finish, scene_rng, start_scene
from touchdown.scenes.authoring.meshes import MeshData, box, plaque
from touchdown.scenes.authoring.noise import fractal_noise, tileable_noise
from touchdown.scenes.authoring.plots import SurveyFrame
from touchdown.scenes.authoring.relief import HeightField
from touchdown.scenes.authoring.sea import hull_motion
from touchdown.scenes.authoring.textures import to_texture
from touchdown.scenes.props.pontoon import CONCRETE, place_pontoon

NAME = "deck"
"""of the body that moves"""
HALF_M = 96.0
_TILE_PX = 3072
_TILES = 1
"""copies of the picture of water or meadow on each side of the scene: a deck goes far"""
_AHEAD_M = (14.0, 16.0)
"""distance between the take-off spot and the course"""
_PASSES_S = (17.0, 23.0)
"""when the deck is in front of it"""
_COURSE_S = 300.0
_FREEBOARD_M = 0.45
"""of the pontoon"""

STEEL = Surface(land_class="path", reflectivity=0.30)
TIMBER = Surface(land_class="path", reflectivity=0.36)
PAINTED = Surface(land_class="other", reflectivity=0.45)
MEADOW = Surface(land_class="lawn", reflectivity=0.44)
ASPHALT = Surface(land_class="road", reflectivity=0.14)
_WHITE, _ORANGE = [0.90, 0.90, 0.88, 1.0], [0.86, 0.34, 0.10, 1.0]
_GREY, _BLACK = [0.42, 0.44, 0.47, 1.0], [0.09, 0.09, 0.10, 1.0]


@dataclass(frozen=True, kw_only=True, slots=True)
class Carrier:
    """What carries a deck, in its frame: x ahead, z up from the waterline or the road."""

    hull_m: tuple[float, float]
    """length and width"""
    deck_m: tuple[float, float]
    """the same of the deck that is landed on"""
    deck_x_m: float
    top_m: float
    surface: Surface
    base: tuple[float, float, float]
    """colour of the deck"""


CARRIERS = {
    "boat": Carrier(hull_m=(18.0, 5.6), deck_m=(8.0, 5.6), deck_x_m=-5.0, top_m=1.0, surface=STEEL,
                    base=(74.0, 88.0, 84.0)),
    "barge": Carrier(hull_m=(20.0, 7.0), deck_m=(14.0, 6.6), deck_x_m=-2.8, top_m=1.2,
                     surface=CONCRETE, base=(150.0, 147.0, 140.0)),
    "truck": Carrier(hull_m=(9.0, 2.6), deck_m=(6.4, 2.6), deck_x_m=-1.3, top_m=1.2, surface=TIMBER,
                     base=(136.0, 112.0, 84.0)),
}  # fmt: skip


def generate(seed: int, params: DeckParams) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = scene_rng("deck", seed)
    afloat = params.kind != "truck"
    level = -_FREEBOARD_M if afloat else 0.0
    flat = HeightField(heights_m=np.full((193, 193), level), half_m=HALF_M)
    builder = start_scene("deck", rng, flat)
    yaw = float(rng.uniform(-np.pi, np.pi))
    if afloat:
        place_pontoon(builder)
    side = 1.0 if rng.random() < 0.5 else -1.0
    heading = yaw + side * 0.5 * np.pi
    middle = rng.uniform(*_AHEAD_M) * np.array([np.cos(yaw), np.sin(yaw)])
    speed = 0.0 if params.kind == "barge" else params.speed_mps
    course = _course(np.array([*middle, level]), heading, speed, float(rng.uniform(*_PASSES_S)))
    carrier = CARRIERS[params.kind]
    body = builder.spec.worldbody.add_body(
        name=NAME, mocap=True, pos=course[0], quat=quat_z(heading)
    )
    _add_deck(builder, body, carrier, params.tag_m)
    {"boat": _add_boat, "barge": _add_barge, "truck": _add_truck}[params.kind](builder, body)
    sway = hull_motion(rng, params.sea_state, carrier.hull_m, speed) if afloat else None
    moving = MovingBody(
        body_name=NAME, path_world=course, yaw=heading, carries="deck_plate", sway=sway,
        times_s=np.array([0.0, _COURSE_S]) if speed else None,
    )  # fmt: skip
    if sway is not None:
        trough = _trough_m(sway, carrier)
        if trough:
            _add_draught(builder, body, carrier, trough)
        _spread(builder, "water", Surface(land_class="water", reflectivity=water.WATER_REFLECTIVITY,
                water=True), _water(builder), level - trough)  # fmt: skip
    else:
        _spread(builder, "lawn", MEADOW, _meadow(rng), level)
        _lay_road(builder, middle, heading)
    plan = SurveyFrame(takeoff_xy_m=np.zeros(2), takeoff_yaw=yaw)
    return finish(plan, builder, None, half_m=HALF_M, moving=(moving,))


def _trough_m(sway: Sway, carrier: Carrier) -> float:
    """How far below its mean level the water has to stand still, so that it never covers the deck:
    its waves are not drawn."""
    heave, roll, pitch = sway.at(np.arange(0.0, _COURSE_S, 0.1)).T
    length, width = carrier.deck_m
    reach = 0.5 * length + abs(carrier.deck_x_m)
    lowest = heave - 0.5 * width * np.abs(roll) - reach * np.abs(pitch)
    return max(0.0, -carrier.top_m - float(lowest.min()))


def _add_draught(builder: SceneBuilder, body: Any, carrier: Carrier, trough_m: float) -> None:
    """Adds what hull and pontoon stand on above water that has fallen by ``trough_m``."""
    length, width = carrier.hull_m
    builder.geom("hull", PAINTED, body, box=[0.37 * length, 0.45 * width, trough_m], rgba=_BLACK,
                 pos=[-0.1 * length, 0.0, -0.4 - trough_m], contype=0)  # fmt: skip
    half = 0.5 * trough_m
    builder.geom("pier", CONCRETE, box=[2.6, 2.6, half], pos=[0.0, 0.0, -0.9 - half], rgba=_GREY)


def _course(middle: Array, heading: float, speed_mps: float, passes_s: float) -> Array:
    """(2, 3) ends of the way that leads past ``middle`` at ``passes_s``, (1, 3) of a deck at
    rest."""
    if not speed_mps:
        return middle[None]
    along = speed_mps * np.array([np.cos(heading), np.sin(heading), 0.0])
    return np.stack([middle - passes_s * along, middle + (_COURSE_S - passes_s) * along])


def _add_deck(builder: SceneBuilder, body: Any, carrier: Carrier, tag_m: float) -> None:
    """Adds the plate that is landed on, with a picture, and a kerb around it."""
    x, y = 0.5 * carrier.deck_m[0], 0.5 * carrier.deck_m[1]
    at = np.array([carrier.deck_x_m, 0.0, carrier.top_m])
    builder.geom("plate", carrier.surface, body, name="deck_plate", box=[x, y, 0.1],
                 pos=at - [0.0, 0.0, 0.1], rgba=_GREY)  # fmt: skip
    under = box((x, y, 0.01), (0.0, 0.0, -0.012), 1e3)
    mesh = builder.mesh("deck_top", plaque((x, y), under))
    look = builder.material("deck_top", _picture(builder.rng, carrier, tag_m))
    builder.geom("deck_top", carrier.surface, body, mesh=mesh, material=look, contype=0,
                 pos=at + [0.0, 0.0, 0.003])  # fmt: skip
    for sign in (-1.0, 1.0):
        builder.geom("kerb", PAINTED, body, box=[x, 0.04, 0.06], rgba=_WHITE,
                     pos=at + [0.0, sign * (y - 0.04), 0.06])  # fmt: skip


def _picture(rng: np.random.Generator, carrier: Carrier, tag_m: float) -> Image:
    """Worn paint with seams, a yellow edge, a ring and a cross, and stains; a tag over them."""
    px = 96.0
    width, height = (round(size * px) for size in carrier.deck_m)
    y, x = np.mgrid[0:height, 0:width].astype(np.float32) / px
    tone = 1.0 + 0.07 * fractal_noise(rng, (height, width), 0.7 * px, 5, 0.65)
    tone += 0.05 * rng.standard_normal((height, width), dtype=np.float32)
    tone[((x % 1.6) < 0.03) | ((y % 1.3) < 0.02)] *= 0.7
    image = tone[..., None] * np.array(carrier.base, np.float32)
    rust = np.clip(fractal_noise(rng, (height, width), 0.6 * px, 4, 0.6) - 1.1, 0.0, 0.8)
    image += rust[..., None] * (np.array([120.0, 74.0, 48.0], np.float32) - image)
    edge = np.minimum(np.minimum(x, carrier.deck_m[0] - x), np.minimum(y, carrier.deck_m[1] - y))
    worn = fractal_noise(rng, (height, width), 0.15 * px, 3, 0.6) > -1.2
    image[(edge > 0.12) & (edge < 0.24) & worn] = (206.0, 170.0, 48.0)
    right, up = x - 0.5 * carrier.deck_m[0], y - 0.5 * carrier.deck_m[1]
    ring = np.abs(np.hypot(right, up) - 0.36 * min(carrier.deck_m)) < 0.07
    cross = (np.minimum(np.abs(right), np.abs(up)) < 0.06) & (np.hypot(right, up) < 0.6)
    image[(ring | cross) & worn] = (226.0, 226.0, 220.0)
    picture = to_texture(image)
    if tag_m:
        _print_tag(picture, round(tag_m * px))
    return picture


def _print_tag(image: Image, side_px: int) -> None:
    """Prints a tag with a white margin of one of its eight cells in the middle of ``image``."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    tag = cv2.aruco.generateImageMarker(dictionary, 0, side_px)
    framed = np.pad(tag, side_px // 8, constant_values=255)
    top, left = ((size - len(framed)) // 2 for size in image.shape[:2])
    image[top : top + len(framed), left : left + len(framed)] = 20 + framed[..., None] // 5 * 4


def _rail(builder: SceneBuilder, body: Any, ends: tuple[Array, Array], height_m: float) -> None:
    """Posts and two rails between two feet (3,)."""
    first, last = (np.asarray(end, np.float64) for end in ends)
    up = np.array([0.0, 0.0, height_m])
    for part in np.linspace(0.0, 1.0, 2 + int(np.linalg.norm(last - first) / 1.5)):
        foot = first + part * (last - first)
        builder.geom("rail_post", PAINTED, body, capsule=0.025, rgba=_WHITE, contype=0,
                     fromto=[*foot, *(foot + up)])  # fmt: skip
    for part in (0.5, 1.0):
        builder.geom("rail", PAINTED, body, capsule=0.022, rgba=_WHITE,
                     fromto=[*(first + part * up), *(last + part * up)])  # fmt: skip


def _add_boat(builder: SceneBuilder, body: Any) -> None:
    """A hull with a bow, a raised foredeck, a wheelhouse and a mast."""
    solid = {"rgba": _GREY}
    builder.geom("hull", PAINTED, body, box=[6.8, 2.8, 0.7], pos=[-2.2, 0.0, 0.18], **solid)
    tip, half, low, top = 9.0, 2.8, -0.5, 1.6
    corners = np.array([[4.6, -half, low], [4.6, half, low], [4.6, half, top], [4.6, -half, top],
                        [tip, 0.0, top], [tip - 1.4, 0.0, low]])  # fmt: skip
    faces = np.array([[0, 2, 1], [0, 3, 2], [3, 4, 2], [0, 1, 5], [0, 5, 4], [0, 4, 3], [1, 2, 4],
                      [1, 4, 5]], np.int32)  # fmt: skip
    bow = builder.mesh("bow", MeshData(vertices=corners, faces=faces, uv=np.zeros((6, 2))))
    builder.geom("bow", PAINTED, body, mesh=bow, contype=0, **solid)
    builder.geom("foredeck", PAINTED, body, box=[1.8, 2.8, 0.3], pos=[2.8, 0.0, 1.3], **solid)
    builder.geom("wheelhouse", PAINTED, body, box=[1.7, 2.1, 1.2], pos=[1.2, 0.0, 2.2], rgba=_WHITE)
    builder.geom("window", PAINTED, body, box=[1.72, 2.12, 0.3], pos=[1.2, 0.0, 2.7], contype=0,
                 rgba=_BLACK)  # fmt: skip
    builder.geom("roof", PAINTED, body, box=[1.9, 2.3, 0.06], pos=[1.2, 0.0, 3.46], rgba=_ORANGE)
    builder.geom("mast", PAINTED, body, capsule=0.06, fromto=[1.6, 0.0, 3.4, 1.6, 0.0, 6.2],
                 rgba=_WHITE)  # fmt: skip
    for sign in (-1.0, 1.0):
        ends = np.array([4.6, sign * 2.7, 1.6]), np.array([8.6, sign * 0.25, 1.6])
        _rail(builder, body, ends, 0.9)


def _add_barge(builder: SceneBuilder, body: Any) -> None:
    """A flat hull with a hut and crates at one end."""
    builder.geom("hull", PAINTED, body, box=[10.0, 3.5, 0.8], pos=[0.0, 0.0, 0.28],
                 rgba=[0.30, 0.20, 0.16, 1.0])  # fmt: skip
    builder.geom("hut", PAINTED, body, box=[1.6, 2.0, 1.3], pos=[7.6, 0.6, 2.4], rgba=_WHITE)
    for y in (-2.8, -1.9):
        builder.geom("crate", PAINTED, body, box=[0.5, 0.4, 0.4], pos=[6.2, y, 1.5], rgba=_ORANGE)
    _rail(builder, body, (np.array([9.8, -3.3, 1.1]), np.array([9.8, 3.3, 1.1])), 1.0)


def _add_truck(builder: SceneBuilder, body: Any) -> None:
    """A chassis, a cab and six wheels."""
    builder.geom("chassis", PAINTED, body, box=[4.3, 0.5, 0.15], pos=[0.0, 0.0, 0.85], rgba=_BLACK)
    builder.geom("cab", PAINTED, body, box=[1.1, 1.25, 1.2], pos=[3.3, 0.0, 1.75], rgba=_ORANGE)
    builder.geom("window", PAINTED, body, box=[1.11, 1.15, 0.35], pos=[3.31, 0.0, 2.3], contype=0,
                 rgba=_BLACK)  # fmt: skip
    for x in (-3.2, -2.0, 3.2):
        for y in (-1.05, 1.05):
            builder.geom("wheel", PAINTED, body, cylinder=(0.48, 0.16),
                         pos=[x, y, 0.48], quat=[0.7071068, 0.7071068, 0.0, 0.0], contype=0,
                         rgba=_BLACK)  # fmt: skip


def _spread(
    builder: SceneBuilder, name: str, surface: Surface, image: Image, level_m: float
) -> None:
    """A sheet of 3 x 3 copies of ``image``."""
    copies = 1 + 2 * _TILES
    half = copies * HALF_M
    below = box((half, half, 0.25), (0.0, 0.0, -0.252), 1e3)
    mesh = builder.mesh(name, plaque((half, half), below, copies=copies))
    fill_texture(builder.spec.texture("sheet"), image)
    builder.geom(name, surface, name=name, mesh=mesh, material="sheet", pos=[0.0, 0.0, level_m])


def _water(builder: SceneBuilder) -> Image:
    image = np.zeros((_TILE_PX, _TILE_PX, 3), np.uint8)
    depth = np.full((256, 256), 7.0, np.float32)
    look = water.varied(water.draw_look(builder.rng))
    water.lay_water(builder.rng, image, depth, HALF_M, look, builder.sun)
    return image


def _meadow(rng: np.random.Generator) -> Image:
    tone = tileable_noise(rng, 1024, 1.1, 3.0)
    image = (1.0 + 0.16 * tone[..., None]) * np.array([96.0, 122.0, 62.0], np.float32)
    large = cv2.resize(to_texture(image), (_TILE_PX, _TILE_PX), interpolation=cv2.INTER_CUBIC)
    return np.asarray(large, np.uint8)


def _lay_road(builder: SceneBuilder, middle: Array, heading: float) -> None:
    """A road of 7 m with dashes."""
    tone = tileable_noise(builder.rng, 512, 0.8, 4.0)
    image = (1.0 + 0.14 * tone[..., None]) * np.array([92.0, 92.0, 96.0], np.float32)
    look = builder.material("asphalt", to_texture(image))
    half = (1 + 2 * _TILES) * HALF_M
    strip = builder.mesh("road", box((half, 3.5, 0.01), (0.0, 0.0, 0.0), 7.0))
    place = {"heading": heading, "pos": [*middle, 0.0]}
    builder.geom("road", ASPHALT, mesh=strip, material=look, **place)
    dashes = [box((1.5, 0.07, 0.002), (x, 1.9, 0.011)) for x in np.arange(-half + 3.0, half, 9.0)]
    marking = builder.mesh("dashes", MeshData.join(dashes))
    builder.geom("dashes", Surface(land_class="road", reflectivity=0.60), mesh=marking, contype=0,
                 rgba=_WHITE, **place)  # fmt: skip
