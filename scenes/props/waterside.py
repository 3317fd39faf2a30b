"""Reeds, decks on piles, boats, buoys and objects of a shore."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Array, Image, Surface
from touchdown.scenes.authoring.builder import SceneBuilder, quat_z, turned
from touchdown.scenes.authoring.meshes import MeshData, blob, box, plaque, polygon
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plane import draw_heading, left_of, pick, unit_circle
from touchdown.scenes.authoring.plots import Plot
from touchdown.scenes.authoring.textures import Colour, to_texture

REED = Surface(land_class="trees", reflectivity=0.40, porosity=0.45, spread=0.25)
DECK = Surface(land_class="path", reflectivity=0.38)
PILE = Surface(land_class="other", reflectivity=0.30)
NET = Surface(land_class="other", reflectivity=0.35, porosity=0.75)
EARTH = Surface(land_class="field", reflectivity=0.22)
SIGN = Surface(land_class="other", reflectivity=0.45)


@dataclass(frozen=True, kw_only=True, slots=True)
class ReedBed:
    """Shared tufts of reed."""

    material: str
    tufts: list[tuple[str, float, float]]
    """(mesh name, radius, height in metres)"""


def grow_reeds(builder: SceneBuilder) -> ReedBed:
    """Adds the materials and meshes that all reeds of a scene share."""
    rng = builder.rng
    green = rng.uniform(0.0, 1.0)
    foot = (84.0 + 20.0 * green, 104.0 + 16.0 * green, 56.0)
    head = (176.0 - 40.0 * green, 160.0 - 12.0 * green, 96.0)
    material = builder.material("trees_reed", reed_texture(rng, foot, head))
    tufts = []
    for index, (radius, height) in enumerate(((0.55, 1.5), (0.75, 1.9), (0.95, 2.2), (0.65, 2.0))):
        mesh = builder.mesh(f"reed_{index}", tuft_mesh(rng, radius, height))
        tufts.append((mesh, radius, height))
    return ReedBed(material=material, tufts=tufts)


def reed_texture(rng: np.random.Generator, foot: Colour, head: Colour) -> Image:
    """(256, 256, 3): stalks side by side, ``foot`` at the bottom, ``head`` (RGB) at the top, brown
    panicles above."""
    rows = np.linspace(0.0, 1.0, 256, dtype=np.float32)[:, None, None]
    stalk = rng.normal(0.0, 0.18, (1, 256, 1)) + rng.normal(0.0, 0.05, (1, 256, 3))
    colour = np.array(head) * (1.0 - rows) + np.array(foot) * rows
    image = colour * (1.0 + stalk) * (1.12 - 0.5 * rows)
    panicle = (rows[:, 0] < 0.13) & (rng.random((1, 256)) < 0.4)
    image[panicle] = np.array([116.0, 84.0, 62.0]) * rng.uniform(0.8, 1.2, (panicle.sum(), 1))
    return to_texture(image.astype(np.float32))


def tuft_mesh(rng: np.random.Generator, radius_m: float, height_m: float) -> MeshData:
    """Returns a dense core with stalks that lean outwards; the foot is at z = 0."""
    half = np.array([0.50 * radius_m, 0.50 * radius_m, 0.33 * height_m])
    core = blob(rng, half, 2.2, 0.22, 6, 1.0)
    points = core.vertices + [0.0, 0.0, 0.30 * height_m]
    fraction = np.clip(points[:, 2] / height_m, 0.0, 1.0)
    uv = np.column_stack([1.9 * points[:, 0] + 2.7 * points[:, 1], 0.97 - 0.75 * fraction])
    parts = [MeshData(vertices=points, faces=core.faces, uv=uv)]
    for _ in range(int(240 * radius_m)):
        angle, reach = rng.uniform(0.0, 2.0 * np.pi), radius_m * np.sqrt(rng.uniform(0.05, 1.0))
        way = np.array([np.cos(angle), np.sin(angle), 0.0])
        foot = 0.75 * reach * way + [0.0, 0.0, 0.1]
        lean = 1.0 + rng.uniform(0.1, 0.7)
        top = lean * reach * way + [0.0, 0.0, height_m * rng.uniform(0.72, 1.0)]
        turn = rng.uniform(0.0, 2.0 * np.pi) + np.array([0.0, 2.1, 4.2])
        ring = foot + 0.028 * np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=-1)
        u = rng.uniform()
        for k in range(3):
            blade = np.array([ring[k], ring[(k + 1) % 3], top])
            parts.append(polygon(blade, np.array([[u, 0.9], [u, 0.9], [u + 0.004, 0.04]])))
    return MeshData.join(parts)


def add_reeds(builder: SceneBuilder, bed: ReedBed, xy_m: Array) -> None:
    """Adds one tuft, its foot on the ground or in the water."""
    rng = builder.rng
    mesh, radius, height = pick(rng, bed.tufts)
    at = builder.on_ground(xy_m, -0.12)
    builder.geom("trees_reed", REED, mesh=mesh, material=bed.material,
                 pos=at, heading=draw_heading(rng))  # fmt: skip
    ring = unit_circle(8)
    low = np.column_stack([0.8 * radius * ring, np.full(8, 0.15)])
    high = np.column_stack([1.1 * radius * ring, np.full(8, 0.8 * height)])
    builder.cast(at + np.concatenate([low, high]), 0.55)
    builder.claim(xy_m, 0.4 * radius)


def planks(
    rng: np.random.Generator, size_m: tuple[float, float], px_per_m: float, base: Colour
) -> Image:
    """Weathered boards across a deck of size_m (length, width), with gaps and nails. The texture's
    width is the deck's length."""
    width, height = (max(8, round(s * px_per_m)) for s in size_m)
    cols = np.arange(width) / px_per_m / 0.145
    board = np.floor(cols).astype(int)
    tone = 1.0 + 0.13 * rng.standard_normal(board.max() + 1)[board][None, :, None]
    tint = 1.0 + 0.012 * rng.standard_normal((board.max() + 1, 3))[board][None]
    image = np.array(base) * tone * tint * np.ones((height, 1, 1))
    grain = fractal_noise(rng, (height, width), 3.0, 2)[..., None]
    stain = fractal_noise(rng, (height, width), 0.8 * px_per_m, 4, 0.6)[..., None]
    image *= 1.0 + 0.05 * grain + 0.08 * stain
    within = cols - board
    image[:, within < 0.10] *= 0.32
    nail = (np.abs(within - 0.5) < 1.2 / (0.145 * px_per_m))[None, :]
    for y in (0.12, size_m[1] - 0.12):
        row = int(y * px_per_m)
        image[row : row + 2] *= np.where(nail, 0.45, 1.0)[..., None]
    return to_texture(image.astype(np.float32))


@dataclass(frozen=True, kw_only=True, slots=True)
class Deck:
    """A level platform. plot: from its middle, u along it; size_m: length and width; top_m: world
    height."""

    plot: Plot
    size_m: tuple[float, float]
    top_m: float
    thick_m: float = 0.14


def add_deck(builder: SceneBuilder, deck: Deck, image: Image, surface: Surface = DECK) -> None:
    """Adds the platform with ``image`` on top."""
    name = builder.unique("deck")
    x, y = 0.5 * deck.size_m[0], 0.5 * deck.size_m[1]
    # Under the texture, so that the two tops do not coincide.
    body = box((x, y, 0.5 * deck.thick_m), (0, 0, -0.5 * deck.thick_m - 0.002))
    shade = np.column_stack([0.02 + 0.01 * (body.uv[:, 0] % 1.0), np.full(len(body.uv), 0.5)])
    data = plaque((x, y), replace(body, uv=shade))
    mesh, material = builder.mesh(name, data), builder.material(name, image)
    origin, angle = np.array([*deck.plot.origin_xy_m, deck.top_m]), deck.plot.angle
    builder.geom("path_deck", surface, mesh=mesh, material=material, pos=origin, heading=angle)
    builder.cast(turned(data.vertices[:4], angle, origin))


def add_pile(builder: SceneBuilder, xy_m: Array, top_m: float, radius_m: float = 0.09) -> None:
    """Adds a pile from the ground to the world height ``top_m``."""
    z = builder.terrain.point(*xy_m)
    grey = builder.rng.uniform(0.30, 0.42)
    builder.geom("pile", PILE, cylinder=radius_m, fromto=[*xy_m, z - 0.4, *xy_m, top_m],
                 rgba=[grey, 0.88 * grey, 0.74 * grey, 1])  # fmt: skip
    ring = np.column_stack([radius_m * unit_circle(8), np.zeros(8)])
    builder.cast(np.concatenate([[*xy_m, z] + ring, [*xy_m, top_m] + ring]))


def add_net(builder: SceneBuilder, xy_m: Array, heading: float) -> None:
    """Adds a volleyball net of 9.5 m between two posts."""
    across = left_of(heading)
    ends = [xy_m + side * 4.75 * across for side in (-1.0, 1.0)]
    z = float(np.mean([builder.terrain.point(*end) for end in ends]))
    for end in ends:
        add_pile(builder, end, z + 2.5, 0.05)
    builder.geom("net", NET, box=[0.01, 4.7, 0.45], heading=heading,
                 pos=[*xy_m, z + 1.98], rgba=[0.16, 0.17, 0.2, 0.45])  # fmt: skip
    builder.geom("net_tape", SIGN, box=[0.02, 4.7, 0.04], heading=heading,
                 pos=[*xy_m, z + 2.43], rgba=[0.95, 0.95, 0.92, 1])  # fmt: skip
    builder.cast_box((0.03, 4.7), (2.43,), heading, np.array([*xy_m, z]))
    builder.claim(xy_m, 5.2)


def add_molehill(builder: SceneBuilder, xy_m: Array) -> None:
    """Adds a mound of earth too small to be seen from high up and too high to land on."""
    rng = builder.rng
    half = rng.uniform([0.22, 0.22, 0.14], [0.36, 0.36, 0.24])
    at = builder.on_ground(xy_m)
    tone = rng.uniform(0.26, 0.36)
    builder.geom("field_molehill", EARTH, ellipsoid=half, pos=at,
                 rgba=[tone, 0.78 * tone, 0.58 * tone, 1])  # fmt: skip
    builder.claim(xy_m, 0.4)


BOAT = Surface(land_class="other", reflectivity=0.40)
BUOY = Surface(land_class="other", reflectivity=0.45)
PAINTS: tuple[Colour, ...] = ((196.0, 52.0, 44.0), (232.0, 232.0, 226.0), (40.0, 92.0, 150.0),
              (54.0, 116.0, 92.0), (226.0, 172.0, 60.0), (120.0, 88.0, 62.0))  # fmt: skip
_BEAM = np.array([0.72, 0.86, 0.96, 1.0, 0.98, 0.90, 0.74, 0.46, 0.05])
"""Half width at stations from the stern to the bow, as a fraction of the maximum."""
_OUTSIDE, _INSIDE = 0.05, 0.45
"""Where a texture's skin and boards begin, as a fraction of its height."""


def hull_mesh(length_m: float, width_m: float, rim_m: float, decked: bool) -> MeshData:
    """Returns a round hull, bow along x: open with three thwarts, or ``decked`` over."""
    fraction = np.linspace(0.0, 1.0, len(_BEAM))
    x = (fraction - 0.5) * length_m
    half = 0.5 * width_m * _BEAM
    rim = rim_m * (1.0 + 0.55 * fraction**3)
    keel = -0.16 + (0.16 + 0.4 * rim_m) * fraction**7
    skin = _section(x, [half, 0.74 * half, 0.0 * half], [rim, keel + 0.07, keel])
    parts = _loft(skin[:, ::-1], _OUTSIDE, length_m)
    stern = skin[0]
    parts.append(polygon(stern, _board_uv(stern[:, 1], stern[:, 2], _OUTSIDE)))
    if decked:
        lid = _section(x, [half], [rim])
        parts += _loft(lid, _INSIDE, length_m)
        return MeshData.join(parts)
    inner = np.maximum(half - 0.06, 0.005)
    floor = np.minimum(np.maximum(keel + 0.1, 0.04), rim - 0.06)
    well = _section(x, [inner, 0.7 * inner], [rim, floor])
    parts += _loft(well, _INSIDE, length_m)
    for left, right in ((skin[:, 0], well[:, 0]), (well[:, -1], skin[:, -1])):
        parts += _loft(np.stack([left, right], axis=1), 0.9, length_m)
    parts.append(polygon(well[0, ::-1], _board_uv(well[0, ::-1, 1], well[0, ::-1, 2], _INSIDE)))
    for at in (0.18, 0.45, 0.72):
        beam = 0.5 * width_m * float(np.interp(at, fraction, _BEAM)) - 0.05
        centre = np.array([(at - 0.5) * length_m, 0.0, 0.78 * rim_m])
        seat = box(np.array([0.13, beam, 0.02]), centre)
        uv = np.column_stack([seat.uv[:, 0], np.full(len(seat.uv), 0.93)])
        parts.append(replace(seat, uv=uv))
    return MeshData.join(parts)


def _section(x: Array, halves: list[Array], heights: list[Array]) -> Array:
    """(S, K, 3) stations of points from the left rim over the keel to the right rim."""
    left = [np.stack([x, h, z], axis=-1) for h, z in zip(halves, heights, strict=True)]
    right = [points * [1.0, -1.0, 1.0] for points in left if points[:, 1].any()]
    return np.stack([*left, *right[::-1]], axis=1)


def _board_uv(along: Array, across: Array, first: float) -> Array:
    """Texture coordinates of a band of the texture that begins at ``first`` of its height."""
    return np.stack([0.5 * along, first + 0.08 + 0.15 * np.clip(across + 0.5, 0.0, 2.0)], axis=-1)


def _loft(stations: Array, first: float, length_m: float) -> list[MeshData]:
    """Quads between neighbouring stations; the points run from the left to the
    right of what faces up."""
    parts = []
    across = np.linspace(0.02, 0.36, stations.shape[1])
    if first > 0.8:
        across = np.full(stations.shape[1], 0.05)
    for one, two in pairwise(stations):
        for k in range(stations.shape[1] - 1):
            corners = np.array([one[k], one[k + 1], two[k + 1], two[k]])
            v = first + across[[k, k + 1, k + 1, k]]
            parts.append(polygon(corners, np.stack([corners[:, 0] / length_m + 0.5, v], axis=-1)))
    return parts


def boat_texture(rng: np.random.Generator, paint: Colour, decked: bool) -> NDArray[np.uint8]:
    """(256, 256, 3): painted strakes above, boards of the inside or the deck below, rim at the
    foot."""
    rows, cols = np.mgrid[0:256, 0:256] / 256.0
    image = np.empty((256, 256, 3), np.float32)
    image[:] = np.array(paint, np.float32)
    image *= np.where((rows * 28.0) % 1.0 < 0.16, 0.72, 1.0)[..., None]
    wood = np.array((222.0, 214.0, 196.0) if decked else (164.0, 124.0, 82.0), np.float32)
    boards = (rows > _INSIDE) & (rows < 0.88)
    tone = 1.0 + 0.12 * np.sin(np.floor(rows * 48.0) * 12.9)
    tone *= np.where((rows * 48.0) % 1.0 < 0.14, 0.6, 1.0)
    tone *= np.where(np.abs((cols * 9.0) % 1.0 - 0.5) < 0.05, 0.8 if not decked else 1.0, 1.0)
    image[boards] = (tone[..., None] * wood)[boards].astype(np.float32)
    image[rows >= 0.88] = (202.0, 176.0, 132.0)
    image *= 1.0 + 0.07 * fractal_noise(rng, (256, 256), 40.0, 4)[..., None]
    return to_texture(image)


def add_boat_models(builder: SceneBuilder, count: int) -> list[tuple[str, str, float]]:
    """``count`` differing rowing boats: (mesh, material, length in metres)."""
    models = []
    paints = builder.rng.permutation(len(PAINTS))
    for index in range(count):
        length = float(builder.rng.uniform(3.4, 4.8))
        mesh = builder.mesh(f"boat_{index}", hull_mesh(length, 0.36 * length, 0.36, False))
        paint = PAINTS[int(paints[index % len(PAINTS)])]
        image = boat_texture(builder.rng, paint, False)
        models.append((mesh, builder.material(f"boat_paint_{index}", image, 0.1), length))
    return models


def add_boat(
    builder: SceneBuilder,
    model: tuple[str, str, float],
    xy_m: Array,
    heading: float,
    upturned: bool = False,
) -> None:
    """Adds a rowing boat afloat, or upturned on the ground."""
    mesh, material, length = model
    z = builder.terrain.point(*xy_m) + (0.38 if upturned else 0.0)
    origin = np.array([*xy_m, z])
    half = 0.5 * heading
    # Upturned: half a turn about the boat's long axis first.
    quat = [0.0, np.cos(half), np.sin(half), 0.0] if upturned else quat_z(heading)
    builder.geom("boat", BOAT, mesh=mesh, material=material, pos=origin, quat=quat)
    rim = _rim(length, 0.36 * length, 0.1 if upturned else 0.36)
    builder.cast(turned(rim, heading, origin), 0.9)
    builder.claim(xy_m, 0.5 * length + 0.4)


def _rim(length_m: float, width_m: float, z_m: float) -> Array:
    """(N, 3) outline of a hull, for shadows."""
    x = (np.linspace(0.0, 1.0, len(_BEAM)) - 0.5) * length_m
    half = 0.5 * width_m * _BEAM
    return np.column_stack([np.tile(x, 2), [*half, *-half], np.full(2 * len(x), z_m)])


def add_sailing_boat(builder: SceneBuilder, xy_m: Array, heading: float) -> None:
    """Adds a small yacht at anchor, sails furled: cabin, mast of 8 m, boom, stays."""
    rng = builder.rng
    name = builder.unique("yacht")
    length = float(rng.uniform(6.2, 8.0))
    paint = PAINTS[int(rng.integers(1, 4))]
    material = builder.material(name, boat_texture(rng, paint, True), 0.2)
    mesh = builder.mesh(name, hull_mesh(length, 0.33 * length, 0.72, True))
    origin = builder.on_ground(xy_m)
    builder.geom("boat", BOAT, mesh=mesh, material=material, pos=origin, heading=heading)

    def at(x: float, y: float, z: float) -> Array:
        return turned(np.array([[x, y, z]]), heading, origin)[0]

    builder.geom("boat_cabin", BOAT, box=[0.15 * length, 0.10 * length, 0.2], rgba=[0.93, 0.92,
                 0.88, 1], pos=at(0.03 * length, 0, 0.95), heading=heading)  # fmt: skip
    builder.geom("boat_cockpit", BOAT, box=[0.12 * length, 0.08 * length, 0.02], rgba=[0.42, 0.31,
                 0.22, 1], pos=at(-0.27 * length, 0, 0.77), heading=heading)  # fmt: skip
    mast, tip, stern = at(0.12 * length, 0, 0.7), at(0.12 * length, 0, 8.0), (-0.34 * length)
    bow = at(0.47 * length, 0, 1.1)
    boom = at(0.1 * length, 0, 1.75), at(stern, 0, 1.75)
    lines = (
        (mast, tip, 0.06, [0.80, 0.80, 0.82, 1]),
        (bow, tip, 0.015, [0.5, 0.5, 0.52, 1]),
        (*boom, 0.13, [0.92, 0.90, 0.84, 1]),
    )
    for start, end, radius, rgba in lines:
        builder.geom("boat_mast", BOAT, fromto=[*start, *end], capsule=radius, rgba=rgba)
        spread = np.array([[radius, 0, 0], [-radius, 0, 0], [0, radius, 0]])
        builder.cast(np.concatenate([start + spread, end + spread]))
    builder.cast(turned(_rim(length, 0.33 * length, 0.75), heading, origin), 0.95)
    builder.claim(xy_m, 0.5 * length + 1.0)


def add_buoy(builder: SceneBuilder, xy_m: Array, radius_m: float, rgba: list[float]) -> None:
    """Adds a ball that floats half out of the water; large ones carry a pole with a topmark."""
    at = builder.on_ground(xy_m, 0.3 * radius_m)
    builder.geom("buoy", BUOY, ball=radius_m, pos=at, rgba=rgba)
    ring = np.column_stack([radius_m * unit_circle(10), np.zeros(10)])
    builder.cast(np.concatenate([at + ring, at + [[0.0, 0.0, radius_m]]]), 0.9)
    if radius_m > 0.35:
        builder.geom("buoy_pole", BUOY, cylinder=0.05, rgba=rgba,
                     fromto=[*at, *(at + [0.0, 0.0, 2.3])])  # fmt: skip
        builder.geom("buoy_mark", BUOY, box=[0.2, 0.2, 0.2], rgba=rgba, pos=at + [0.0, 0.0, 2.4])
    builder.claim(xy_m, radius_m + 0.3)
