"""Houses with pitched or flat roofs."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Array, Surface
from touchdown.scenes.authoring.builder import SceneBuilder, turned
from touchdown.scenes.authoring.meshes import MeshData, box, plaque, polygon
from touchdown.scenes.authoring.plane import pick
from touchdown.scenes.authoring.textures import Colour, facade_bay, flat_roof, roof_tiles

WALL = Surface(land_class="building", reflectivity=0.40)
ROOF = Surface(land_class="building", reflectivity=0.30)
FLAT_ROOF = Surface(land_class="building", reflectivity=0.25)
BAY_M, STOREY_M = 3.0, 2.8
WALLS: tuple[tuple[Colour, bool], ...] = (
    ((168.0, 92.0, 70.0), True),
    ((222.0, 212.0, 188.0), False),
    ((196.0, 188.0, 176.0), False),
    ((206.0, 172.0, 120.0), True),
    ((228.0, 228.0, 224.0), False),
)
ROOFS: tuple[Colour, ...] = ((158.0, 90.0, 66.0), (112.0, 72.0, 58.0), (92.0, 96.0, 104.0),
             (142.0, 76.0, 58.0))  # fmt: skip


@dataclass(frozen=True, kw_only=True, slots=True)
class House:
    """size_m: length (along the ridge), width, wall height; ridge_m: over the eaves, 0: flat."""

    centre_xy_m: Array
    angle: float
    size_m: tuple[float, float, float]
    ridge_m: float
    hipped: bool = False
    """four slopes instead of two and two gables"""

    @property
    def gable_m(self) -> float:
        return 0.0 if self.hipped else self.ridge_m


@dataclass(frozen=True, kw_only=True, slots=True)
class HouseLooks:
    """Names of materials that several houses share."""

    wall: str
    roof: str


def paint_house_looks(builder: SceneBuilder, roofs: list[NDArray[np.uint8]]) -> list[HouseLooks]:
    """Adds one set of looks per texture of a pitched roof (see `gable_roof_mesh` for its halves),
    walls in turn."""
    rng = builder.rng
    order = rng.permutation(len(WALLS))
    looks = []
    for index, image in enumerate(roofs):
        colour, brick = WALLS[int(order[index % len(WALLS)])]
        wall = builder.material(f"building_wall_{index}", facade_bay(rng, colour, brick))
        roof = builder.material(f"building_roof_{index}", image)
        looks.append(HouseLooks(wall=wall, roof=roof))
    return looks


def tiled_roof(rng: np.random.Generator, length: float, slope_m: float) -> NDArray[np.uint8]:
    """A texture for both slopes of a roof, ``slope_m`` from ridge to eaves each, in a colour of
    its own."""
    base = pick(rng, ROOFS)
    image = roof_tiles(rng, base, (length, 2.0 * slope_m))
    _finish_roof(rng, image)
    return image


def add_house(builder: SceneBuilder, house: House, looks: HouseLooks | None = None) -> None:
    """Adds walls, a roof and objects on it, in ``looks`` or in colours of its own. The ground below
    is taken as level."""
    rng = builder.rng
    origin = builder.on_ground(house.centre_xy_m)
    name = builder.unique("house")
    if looks is None:
        colour, brick = pick(rng, WALLS)
        bay = builder.material(f"{name}_wall", facade_bay(rng, colour, brick))
    else:
        bay = looks.wall
    mesh = builder.mesh(f"{name}_walls", wall_mesh(house.size_m, house.gable_m))
    pose = {"pos": origin, "heading": house.angle}
    builder.geom("building_wall", WALL, mesh=mesh, material=bay, **pose)
    if house.ridge_m > 0.0:
        _add_pitched_roof(builder, house, name, origin, looks)
    else:
        _add_flat_roof(builder, house, name, origin)
    _cast_house(builder, house, origin)
    length, width, _ = house.size_m
    builder.claim(house.centre_xy_m, 0.5 * float(np.hypot(length, width)) + 1.0)


def wall_mesh(size_m: tuple[float, float, float], ridge_m: float) -> MeshData:
    """Returns four walls, whole window bays around, from 0.6 m below the ground, with gables below
    pitched roofs."""
    length, width, height = size_m
    x, y, low = 0.5 * length, 0.5 * width, -0.6
    storeys = max(1, round(height / STOREY_M))
    parts = []
    corners = [(-x, -y), (x, -y), (x, y), (-x, y)]
    for index in range(4):
        (x0, y0), (x1, y1) = corners[index], corners[(index + 1) % 4]
        span = float(np.hypot(x1 - x0, y1 - y0))
        bays = max(1, round(span / BAY_M))
        levels = [low, *np.linspace(0.0, height, storeys + 1)]
        for first, last in pairwise(levels):
            wall = np.array([[x0, y0, first], [x1, y1, first], [x1, y1, last], [x0, y0, last]])
            upper, lower = (0.0, 0.499) if first >= 0.0 else (0.52, 0.52 - 0.5 * low / STOREY_M)
            uv = np.array([[0.0, lower], [bays, lower], [bays, upper], [0.0, upper]])
            parts.append(polygon(wall, uv))
        if ridge_m > 0.0 and index % 2 == 1:
            tip = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1), height + ridge_m])
            gable = np.array([[x0, y0, height], [x1, y1, height], tip])
            peak = max(0.99 - 0.5 * ridge_m / STOREY_M, 0.51)
            parts.append(polygon(gable, np.array([[0.0, 0.99], [bays, 0.99], [0.5 * bays, peak]])))
    top = np.array([[-x, -y, height], [x, -y, height], [x, y, height], [-x, y, height]])
    parts.append(polygon(top, 0.8))
    return MeshData.join(parts)


def gable_roof_mesh(length: float, width: float, ridge_m: float, eaves_m: float) -> MeshData:
    """Returns two slopes with a thickness of 0.16 m that reach ``eaves_m`` over the walls; the
    texture's upper half is one slope, the lower half the other, ridge at the top of each."""
    x = 0.5 * length + eaves_m
    drop = eaves_m * ridge_m / (0.5 * width)
    y, low, thick = 0.5 * width + eaves_m, -drop, 0.16
    parts = []
    for sign, first in ((1.0, 0.0), (-1.0, 0.5)):
        slope = np.array([[sign * x, sign * y, low], [-sign * x, sign * y, low],
                          [-sign * x, 0.0, ridge_m], [sign * x, 0.0, ridge_m]])  # fmt: skip
        uv = np.array([[0.0, first + 0.49], [1.0, first + 0.49], [1.0, first], [0.0, first]])
        parts.append(polygon(slope + np.array([0.0, 0.0, thick]), uv))
        parts.append(polygon(slope[::-1], 0.01))
        edge = slope[[0, 1]]
        fascia = np.array([edge[1], edge[0], edge[0] + [0, 0, thick], edge[1] + [0, 0, thick]])
        parts.append(polygon(fascia, 0.01))
    for sign in (1.0, -1.0):
        for half in (1.0, -1.0):
            top = np.array([[sign * x, half * y, low], [sign * x, 0.0, ridge_m]])
            quad = np.array([top[0], top[1], top[1] + [0, 0, thick], top[0] + [0, 0, thick]])
            verge = quad if sign * half < 0 else quad[::-1]
            parts.append(polygon(verge, 0.01))
    return MeshData.join(parts)


def hip_roof_mesh(length: float, width: float, ridge_m: float, eaves_m: float) -> MeshData:
    """Returns four slopes over a rectangle that is longer than wide, mapped as `gable_roof_mesh`
    maps its two; the hips' ends use a corner of the texture's upper half."""
    drop = eaves_m * ridge_m / (0.5 * width)
    x, y, low = 0.5 * length + eaves_m, 0.5 * width + eaves_m, -drop
    reach = max(x - y, 0.3)
    parts = []
    for sign, first in ((1.0, 0.0), (-1.0, 0.5)):
        slope = np.array([[sign * x, sign * y, low], [-sign * x, sign * y, low],
                          [-sign * reach, 0.0, ridge_m], [sign * reach, 0.0, ridge_m]])  # fmt: skip
        fraction = 0.5 * (1.0 - reach / x)
        uv = [[0.0, first + 0.49], [1.0, first + 0.49], [1.0 - fraction, first], [fraction, first]]
        parts.append(polygon(slope, np.array(uv)))
        hip = np.array([[sign * x, -sign * y, low], [sign * x, sign * y, low],
                        [sign * reach, 0.0, ridge_m]])  # fmt: skip
        wide = y / x
        parts.append(polygon(hip, np.array([[0.0, 0.49], [wide, 0.49], [0.5 * wide, 0.0]])))
    soffit = np.array([[-x, -y, low], [-x, y, low], [x, y, low], [x, -y, low]])
    parts.append(polygon(soffit, 0.01))
    return MeshData.join(parts)


def _finish_roof(rng: np.random.Generator, image: NDArray[np.uint8]) -> None:
    """A ridge cap and a gutter line for each slope, roof windows or panels."""
    half_px = image.shape[0] // 2
    for first in (0, half_px):
        image[first : first + 8] = np.clip(image[first : first + 8] * 1.15 + 12, 0, 255)
        image[first + half_px - 14 : first + half_px - 7] = (84, 84, 86)
    _add_skylights(rng, image, half_px)


def _add_pitched_roof(
    builder: SceneBuilder, house: House, name: str, origin: Array, looks: HouseLooks | None
) -> None:
    rng = builder.rng
    length, width, height = house.size_m
    eaves = 0.45
    if looks is None:
        slope_m = float(np.hypot(0.5 * width + eaves, house.ridge_m * (1.0 + 2.0 * eaves / width)))
        image = tiled_roof(rng, length + 2 * eaves, slope_m)
        material = builder.material(f"{name}_roof", image)
    else:
        material = looks.roof
    shape = hip_roof_mesh if house.hipped else gable_roof_mesh
    mesh = builder.mesh(f"{name}_roof", shape(length, width, house.ridge_m, eaves))
    at = origin + np.array([0.0, 0.0, height])
    builder.geom("building_roof", ROOF, mesh=mesh, material=material, pos=at, heading=house.angle)
    chimney = np.array([rng.uniform(-0.3, 0.3) * length, rng.choice([-1, 1]) * 0.16 * width, 0.0])
    spot = turned(chimney[None], house.angle, at)[0] + [0.0, 0.0, 0.78 * house.ridge_m]
    builder.geom("building_chimney", WALL, box=[0.32, 0.26, 0.75], rgba=[0.52, 0.33, 0.27, 1],
                 pos=spot, heading=house.angle)  # fmt: skip


def _add_skylights(rng: np.random.Generator, image: NDArray[np.uint8], half_px: int) -> None:
    """Adds roof windows, or solar panels on one slope, painted into the roof's texture."""
    width = image.shape[1]
    if rng.random() < 0.45:
        top, left = int(0.22 * half_px), int(rng.uniform(0.12, 0.3) * width)
        columns = int(min(5, (width - left - 20) // 60))
        for row in range(2):
            for col in range(columns):
                y, x = top + row * 96, left + col * 60
                if y + 92 < half_px - 20:
                    image[y : y + 92, x : x + 56] = (186, 190, 194)
                    image[y + 3 : y + 89, x + 3 : x + 53] = (24, 32, 62)
                    image[y + 3 : y + 89 : 14, x + 3 : x + 53] = (52, 62, 96)
                    image[y + 3 : y + 89, x + 28 : x + 30] = (52, 62, 96)
    for _ in range(int(rng.integers(1, 3))):
        x = int(rng.uniform(0.1, 0.85) * (width - 60))
        y = half_px + int(rng.uniform(0.25, 0.5) * half_px)
        image[y : y + 66, x : x + 46] = (70, 72, 76)
        image[y + 5 : y + 61, x + 5 : x + 41] = (126, 152, 176)


def _add_flat_roof(builder: SceneBuilder, house: House, name: str, origin: Array) -> None:
    rng = builder.rng
    length, width, height = house.size_m
    material = builder.material(f"{name}_roof", flat_roof(rng, (length, width)))
    x, y = 0.5 * length, 0.5 * width
    body = box((x, y, 0.025), (0.0, 0.0, 0.025), 1e3)
    mesh = builder.mesh(f"{name}_roof", plaque((x, y), body, 0.06))
    at = origin + np.array([0.0, 0.0, height])
    builder.geom("building_roof", FLAT_ROOF, mesh=mesh, material=material, pos=at,
                 heading=house.angle)  # fmt: skip
    for dx, dy, hx, hy in ((0, y, x, 0.12), (0, -y, x, 0.12), (x, 0, 0.12, y), (-x, 0, 0.12, y)):
        spot = turned(np.array([[dx, dy, 0.2]]), house.angle, at)[0]
        builder.geom("building_parapet", WALL, box=[hx + 0.12, hy + 0.0, 0.26],
                     rgba=[0.78, 0.77, 0.74, 1], pos=spot, heading=house.angle)  # fmt: skip
    for _ in range(int(rng.integers(3, 6))):
        local = np.array([rng.uniform(-0.75, 0.75) * x, rng.uniform(-0.7, 0.3) * y, 0.5])
        size = rng.uniform([0.4, 0.4, 0.35], [1.1, 0.7, 0.55])
        spot = turned(local[None], house.angle, at)[0]
        builder.geom("building_unit", WALL, box=size, rgba=[0.70, 0.72, 0.73, 1], pos=spot,
                     heading=house.angle)  # fmt: skip


def _cast_house(builder: SceneBuilder, house: House, origin: Array) -> None:
    length, width, height = house.size_m
    x, y = 0.5 * length + 0.4, 0.5 * width + 0.4
    corners = [[sx * x, sy * y, z] for sx in (-1, 1) for sy in (-1, 1) for z in (0.0, height)]
    if house.ridge_m > 0.0:
        corners += [[-x, 0.0, height + house.ridge_m], [x, 0.0, height + house.ridge_m]]
    builder.cast(turned(np.array(corners), house.angle, origin))
