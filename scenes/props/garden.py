"""Objects of gardens: sheds, greenhouses, trampolines, washing lines, tables, beds."""

from dataclasses import replace

import numpy as np

from touchdown.scenes.api import Array, Surface
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.meshes import MeshData, boxes, polygon, walls
from touchdown.scenes.authoring.plane import pick, unit, unit_circle
from touchdown.scenes.authoring.textures import planks
from touchdown.scenes.props.houses import gable_roof_mesh, wall_mesh
from touchdown.scenes.props.street import STEEL, WOOD, add_post, add_wire

SHED = Surface(land_class="building", reflectivity=0.38)
GLASS = Surface(land_class="building", reflectivity=0.12)
CLOTH = Surface(land_class="other", reflectivity=0.55)
MAT = Surface(land_class="other", reflectivity=0.10)
CROP = Surface(land_class="field", reflectivity=0.40)
_SHED_TINTS = ([0.62, 0.46, 0.32, 1], [0.50, 0.55, 0.48, 1], [0.42, 0.34, 0.28, 1])
_ROOF_TINTS = ([0.30, 0.31, 0.33, 1], [0.46, 0.28, 0.22, 1], [0.36, 0.40, 0.36, 1])


def plank_material(builder: SceneBuilder) -> str:
    """The material of planks that a scene's wooden objects share."""
    name = "other_planks"
    if builder.spec.material(name) is None:
        builder.material(name, planks(builder.rng))
    return name


def add_shed(
    builder: SceneBuilder, xy_m: Array, heading: float, size_m: tuple[float, float, float]
) -> None:
    """Adds a wooden shed with a low gable roof. size_m: length, width, wall height."""
    length, width, height = size_m
    origin, name = builder.on_ground(xy_m), builder.unique("shed")
    roof = gable_roof_mesh(length, width, 0.28 * width, 0.2)
    for part, data, rise, tints in (("", wall_mesh(size_m, 0.28 * width), 0.0, _SHED_TINTS),
                                    ("_roof", roof, height, _ROOF_TINTS)):  # fmt: skip
        mesh = builder.mesh(f"{name}{part or '_walls'}", data)
        builder.geom(f"building_shed{part}", SHED, mesh=mesh, pos=origin + [0.0, 0.0, rise],
                     heading=heading, material=plank_material(builder),
                     rgba=pick(builder.rng, tints))  # fmt: skip
    builder.cast_box((0.5 * length + 0.2, 0.5 * width + 0.2), (0.0, height), heading, origin)
    builder.claim(xy_m, 0.5 * float(np.hypot(length, width)) + 0.6)


def add_greenhouse(builder: SceneBuilder, xy_m: Array, heading: float) -> None:
    """Adds a glass house of 3 x 2.2 m: panes between bars."""
    size = (3.0, 2.2, 1.5)
    origin, name = builder.on_ground(xy_m), "building_glass"
    if builder.spec.material(name) is None:
        pane = np.full((64, 64, 3), (150, 182, 186), np.uint8)
        pane[8:30, 8:56] = (172, 202, 204)
        pane[:4], pane[:, :4] = 236, 236
        builder.material(name, pane, shine=0.5)
    walls = builder.mesh(builder.unique("glass_walls"), _tiled(wall_mesh(size, 0.8)))
    gable = _tiled(gable_roof_mesh(3.0, 2.2, 0.8, 0.05))
    roof = builder.mesh(builder.unique("glass_roof"), gable)
    for mesh, rise in ((walls, 0.0), (roof, size[2])):
        builder.geom("building_greenhouse", GLASS, mesh=mesh, material=name,
                     pos=origin + [0.0, 0.0, rise], heading=heading)  # fmt: skip
    builder.cast_box((1.5, 1.1), (0.0, 1.5), heading, origin, 0.35)
    builder.claim(xy_m, 2.4)


def _tiled(data: MeshData) -> MeshData:
    """The mesh with a pane every 0.6 m: by x and the larger of the other two extents."""
    x, y, z = data.vertices.T
    return replace(data, uv=np.stack([(x + y) / 0.6, (z + y) / 0.6], -1))


def drum(radius: float, low: float, high: float, sides: int = 16) -> MeshData:
    """A closed upright cylinder."""
    ring = radius * unit_circle(sides)
    lower, upper = (np.column_stack([ring, np.full(sides, z)]) for z in (low, high))
    lids = [polygon(upper, ring), polygon(lower[::-1], ring[::-1])]
    return MeshData.join([*lids, *walls(lower, upper)])


def add_trampoline(builder: SceneBuilder, xy_m: Array) -> None:
    """Adds a round trampoline, 3.4 m across and 0.75 m high: from far above a level dark disc."""
    origin = builder.on_ground(xy_m)
    tint = pick(builder.rng, ([0.16, 0.34, 0.66, 1], [0.20, 0.46, 0.24, 1]))
    builder.geom("trampoline", MAT, cylinder=(1.7, 0.05), rgba=tint, pos=origin + [0.0, 0.0, 0.72])
    feet = 1.5 * unit(np.arange(0.4, 2.0 * np.pi, 0.5 * np.pi))
    parts = [
        drum(1.38, 0.70, 0.785, 24),
        *boxes(*([0.03, 0.03, 0.36, x, y, 0.35] for x, y in feet)),
    ]
    mat = builder.mesh(builder.unique("mat"), MeshData.join(parts))
    builder.geom("trampoline_mat", MAT, mesh=mat, rgba=[0.10, 0.10, 0.11, 1], pos=origin)
    ring = 1.7 * unit(np.arange(0, 6.2, 0.4))
    builder.cast(np.column_stack([xy_m + ring, np.full(len(ring), origin[2] + 0.72)]))
    builder.claim(xy_m, 2.2)


def add_washing_line(
    builder: SceneBuilder, start_xy_m: Array, end_xy_m: Array, laundry: bool = True
) -> None:
    """Adds two posts with two lines at 1.9 m, some laundry on one of them."""
    span = end_xy_m - start_xy_m
    across = np.array([-span[1], span[0]]) / float(np.hypot(*span))
    heading = float(np.arctan2(span[1], span[0]))
    steel = [0.62, 0.63, 0.62, 1]
    tops = []
    for end in (start_xy_m, end_xy_m):
        add_post(builder, end, 1.95, 0.03, steel)
        tops.append(builder.on_ground(end, 1.9))
        arm = np.array([*(0.5 * across), 0.0])
        add_wire(builder, tops[-1] - arm, tops[-1] + arm, 0.02, steel)
    for side in (-0.45, 0.45):
        offset = np.array([*(side * across), 0.0])
        add_wire(builder, tops[0] + offset, tops[1] + offset, 0.008, [0.85, 0.85, 0.82, 1])
    rng = builder.rng
    for fraction in np.arange(0.25, 0.85, 0.3) if laundry else ():
        size = rng.uniform([0.3, 0.3], [0.5, 0.55])
        at = tops[0] + fraction * (tops[1] - tops[0]) + [*(0.45 * across), -size[1] - 0.02]
        builder.geom("laundry", CLOTH, box=[size[0], 0.012, size[1]], pos=at, heading=heading,
                     rgba=[*rng.uniform(0.55, 0.95, 3), 1.0])  # fmt: skip
    builder.claim_line(start_xy_m, end_xy_m, 5)


def add_table(builder: SceneBuilder, xy_m: Array, heading: float) -> None:
    """Adds a garden table with four chairs."""
    parts = boxes(
        [0.75, 0.45, 0.025, 0.0, 0.0, 0.72],
        *([0.03, 0.03, 0.36, x, y, 0.36] for x in (-0.66, 0.66) for y in (-0.38, 0.38)),
    )
    for x in (-0.4, 0.4):
        for side in (-1.0, 1.0):
            parts += boxes([0.22, 0.22, 0.22, x, side * 0.72, 0.22],
                           [0.22, 0.02, 0.24, x, side * 0.94, 0.64])  # fmt: skip
    tint = pick(builder.rng, ([0.90, 0.90, 0.88, 1], [0.55, 0.40, 0.26, 1]))
    builder.stand("table", WOOD, parts, xy_m, heading, rgba=tint)
    builder.claim(xy_m, 1.3)


def add_crop_rows(
    builder: SceneBuilder, xy_m: Array, heading: float, size_m: tuple[float, float], height_m: float
) -> None:
    """Plants in rows along ``heading`` on a bed of ``size_m`` (along, across), one mesh."""
    rng = builder.rng
    parts = []
    for across in np.arange(-0.5 * size_m[1] + 0.3, 0.5 * size_m[1], 0.75):
        for along in np.arange(-0.5 * size_m[0] + 0.3, 0.5 * size_m[0] - 0.1, 0.5):
            high = height_m * rng.uniform(0.6, 1.2)
            wide = rng.uniform(0.13, 0.24)
            foot = np.array([along, across]) + rng.normal(0.0, 0.04, 2)
            parts.append(_tuft(foot, wide, high))
    tint = [rng.uniform(0.24, 0.40), rng.uniform(0.44, 0.56), rng.uniform(0.18, 0.26), 1]
    builder.stand("field_crops", CROP, parts, xy_m, heading, rgba=tint)
    builder.claim(xy_m, 0.5 * max(size_m))


def _tuft(foot: Array, wide: float, high: float) -> MeshData:
    """A small octahedron with its lower half in the soil."""
    turn = np.linspace(0.0, 2.0 * np.pi, 5, endpoint=False) + foot[0]
    ring = np.column_stack([foot + wide * unit(turn), np.full(5, 0.35 * high)])
    tip, root = np.array([*foot, high]), np.array([*foot, -0.1])
    parts = []
    for i in range(5):
        j = (i + 1) % 5
        parts.append(polygon(np.array([ring[i], ring[j], tip])))
        parts.append(polygon(np.array([ring[j], ring[i], root])))
    return MeshData.join(parts)


def add_toys(builder: SceneBuilder, xy_m: Array) -> None:
    """Adds toys left on the grass, 0.15 to 0.5 m high: a ball, a bucket, a tricycle."""
    rng = builder.rng
    for _ in range(int(rng.integers(1, 3))):
        spot = xy_m + rng.normal(0.0, 0.8, 2)
        tint = [*rng.permutation([0.85, rng.uniform(0.1, 0.8), 0.12]), 1.0]
        radius = float(rng.uniform(0.11, 0.2))
        builder.geom("toy", CLOTH, ball=radius, rgba=tint, pos=builder.on_ground(spot, radius))
    parts = boxes([0.35, 0.05, 0.05, 0.0, 0.0, 0.32], [0.10, 0.10, 0.03, -0.2, 0.0, 0.42], [0.02,
                  0.25, 0.02, 0.3, 0.0, 0.52], [0.15, 0.03, 0.15, 0.35, 0.0, 0.15], [0.15, 0.03,
                  0.15, -0.3, 0.22, 0.15], [0.15, 0.03, 0.15, -0.3, -0.22, 0.15])  # fmt: skip
    spot = xy_m + rng.normal(0.0, 0.6, 2)
    heading = float(rng.uniform(0.0, 6.28))
    builder.stand("toy_tricycle", STEEL, parts, spot, heading, rgba=[0.8, 0.2, 0.2, 1])
    builder.claim(xy_m, 1.8)
