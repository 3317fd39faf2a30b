"""Cars: one textured mesh each, drawn from above and from the side."""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Array, Surface
from touchdown.scenes.authoring.builder import SceneBuilder, turned
from touchdown.scenes.authoring.meshes import MeshData, cylinder_y, polygon
from touchdown.scenes.authoring.plane import rotated
from touchdown.scenes.authoring.textures import Colour

CAR_SURFACE = Surface(land_class="other", reflectivity=0.35)
PX_PER_M = 64.0
ATLAS_PX = 512
TOP_ROW, SIDE_ROW, END_ROW = 0, 150, 270
PAINTS: tuple[Colour, ...] = ((176, 28, 30), (232, 232, 228), (38, 66, 122), (44, 46, 50),
              (168, 172, 176), (214, 150, 34), (52, 96, 74), (120, 32, 48))  # fmt: skip


@dataclass(frozen=True, kw_only=True, slots=True)
class CarShape:
    """Side profile; x forward from the middle, z up from the ground, metres."""

    length_m: float
    width_m: float
    belt_m: float
    height_m: float
    screen_x_m: tuple[float, float]
    """foot and head of the windscreen"""
    rear_x_m: tuple[float, float]
    """foot and head of the rear window"""
    nose_m: float
    """height of the bonnet's front edge"""


Models = list[tuple[str, str, CarShape]]
"""names of mesh and material of each, and its shape"""

SHAPES: dict[str, CarShape] = {"hatch": CarShape(length_m=4.05, width_m=1.76, belt_m=0.92,
             height_m=1.48, screen_x_m=(1.02, 0.30), rear_x_m=(-1.92, -1.52), nose_m=0.72),
             "saloon": CarShape(length_m=4.60, width_m=1.82, belt_m=0.90, height_m=1.44,
             screen_x_m=(1.10, 0.35), rear_x_m=(-1.65, -1.00), nose_m=0.70),
             "van": CarShape(length_m=4.95, width_m=1.94, belt_m=1.08, height_m=1.95,
             screen_x_m=(1.85, 1.20), rear_x_m=(-2.44, -2.36), nose_m=0.92)}  # fmt: skip


def car_mesh(shape: CarShape) -> MeshData:
    """Returns the body (bonnet, cabin, boot) and four wheels; x forward, origin on the ground."""
    half, top = 0.5 * shape.width_m, 0.36 * shape.width_m
    front, back = 0.5 * shape.length_m, -0.5 * shape.length_m
    sill, belt, roof = 0.24, shape.belt_m, shape.height_m
    tuck = 0.95 * half
    # Stations front to rear: x, height and half width of the shoulder line.
    shoulder = np.array([[front, shape.nose_m, 0.86 * half],
                        [front - 0.35, shape.nose_m + 0.08, tuck],
                        [shape.screen_x_m[0], belt, half], [shape.rear_x_m[0], belt, half],
                        [back + 0.06, belt - 0.06, 0.92 * half]])  # fmt: skip
    parts: list[MeshData] = []
    for first, second in pairwise(shoulder):
        (x0, z0, w0), (x1, z1, w1) = first, second
        deck = [[x0, -w0, z0], [x0, w0, z0], [x1, w1, z1], [x1, -w1, z1]]
        left = [[x0, w0, z0], [x0, w0, sill], [x1, w1, sill], [x1, w1, z1]]
        right = [[x1, -w1, z1], [x1, -w1, sill], [x0, -w0, sill], [x0, -w0, z0]]
        parts += [_panel(np.array(face), shape) for face in (deck, left, right)]
    (x0, z0, w0), (x1, z1, w1) = shoulder[0], shoulder[-1]
    nose = [[x0, -w0, sill], [x0, w0, sill], [x0, w0, z0], [x0, -w0, z0]]
    tail = [[x1, w1, sill], [x1, -w1, sill], [x1, -w1, z1], [x1, w1, z1]]
    parts += [_panel(np.array(nose), shape), _panel(np.array(tail), shape)]
    foot = [(shape.screen_x_m[0], belt, 0.93 * half), (shape.rear_x_m[0], belt, 0.90 * half)]
    head = [(shape.screen_x_m[1], roof, top), (shape.rear_x_m[1], roof - 0.03, top)]
    (fx, fz, fw), (rx, rz, rw) = foot
    (hx, hz, hw), (tx, tz, tw) = head
    cabin = [
        [[fx, -fw, fz], [fx, fw, fz], [hx, hw, hz], [hx, -hw, hz]],
        [[hx, -hw, hz], [hx, hw, hz], [tx, tw, tz], [tx, -tw, tz]],
        [[tx, -tw, tz], [tx, tw, tz], [rx, rw, rz], [rx, -rw, rz]],
        [[hx, hw, hz], [fx, fw, fz], [rx, rw, rz], [tx, tw, tz]],
        [[tx, -tw, tz], [rx, -rw, rz], [fx, -fw, fz], [hx, -hw, hz]],
    ]
    parts += [_panel(np.array(face), shape) for face in cabin]
    rubber = np.array([[0.97, 0.97], [0.90, 0.97]])
    for x in (0.31 * shape.length_m, -0.30 * shape.length_m):
        for side in (-1.0, 1.0):
            centre = np.array([x, side * (half - 0.10), 0.32])
            parts.append(cylinder_y(0.32, 0.11, centre, rubber, 12))
    return MeshData.join(parts)


def _panel(corners: Array, shape: CarShape) -> MeshData:
    """A panel mapped from above where it faces up, else from the side or the end."""
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normal /= np.linalg.norm(normal)
    x, y, z = corners.T
    if normal[2] > 0.12:
        u, v = x + 0.5 * shape.length_m, y + 0.5 * shape.width_m + TOP_ROW / PX_PER_M
    elif abs(normal[1]) > 0.6:
        u, v = x + 0.5 * shape.length_m, shape.height_m - z + SIDE_ROW / PX_PER_M
    else:
        offset = 2.2 if normal[0] < 0 else 0.0
        u, v = y + 0.5 * shape.width_m + offset, shape.height_m - z + END_ROW / PX_PER_M
    return polygon(corners, np.stack([u, v], axis=-1) * PX_PER_M / ATLAS_PX)


def car_atlas(rng: np.random.Generator, shape: CarShape, paint: Colour) -> NDArray[np.uint8]:
    """(512, 512, 3): the car from above, from the side, from both ends; tyre and hub colours."""
    atlas = np.empty((ATLAS_PX, ATLAS_PX, 3), np.float32)
    atlas[:] = np.array(paint, np.float32)
    glass, trim, plate = (34.0, 42.0, 50.0), tuple(0.55 * c for c in paint), (225.0, 225.0, 215.0)
    length, width, top = shape.length_m, shape.width_m, shape.height_m
    fx, hx = (x + 0.5 * length for x in shape.screen_x_m)
    rx, tx = (x + 0.5 * length for x in shape.rear_x_m)

    def quad(row: int, colour: tuple[float, ...], *points: tuple[float, float]) -> None:
        pixels = np.array(points) * PX_PER_M + [0.0, row]
        cv2.fillConvexPoly(atlas, (pixels * 16).astype(np.int32), colour, cv2.LINE_AA, 4)

    def rectangle(
        row: int, colour: tuple[float, ...], x: tuple[float, float], y: tuple[float, float]
    ) -> None:
        quad(row, colour, (x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1]))

    m = 0.5 * width
    low, high, left, right = m - 0.43 * width, m + 0.43 * width, m - 0.33 * width, m + 0.33 * width
    quad(TOP_ROW, glass, (fx - 0.06, low), (fx - 0.06, high), (hx, right), (hx, left))
    quad(TOP_ROW, (70.0, 86.0, 98.0), (fx - 0.10, m - 0.30 * width), (fx - 0.10, m - 0.1 * width),
         (hx + 0.04, m - 0.02 * width), (hx + 0.04, m - 0.20 * width))  # fmt: skip
    quad(TOP_ROW, glass, (tx, left), (tx, right), (rx + 0.05, m + 0.40 * width),
         (rx + 0.05, m - 0.40 * width))  # fmt: skip
    for y in (0.17, 0.83):
        near, far = y * width, (0.5 + 0.85 * (y - 0.5)) * width
        quad(TOP_ROW, trim, (fx + 0.1, near), (length - 0.2, far), (length - 0.2, far + 0.02),
             (fx + 0.1, near + 0.02))  # fmt: skip
    if rng.random() < 0.4:
        rectangle(TOP_ROW, (48.0, 54.0, 60.0), (tx + 0.35, hx - 0.15), (m - 0.38, m + 0.38))
    for y in (0.10, 0.90):
        quad(TOP_ROW, (225.0, 230.0, 232.0), (length - 0.32, (y - 0.07) * width),
             (length, (y - 0.05) * width), (length, (y + 0.05) * width),
             (length - 0.32, (y + 0.07) * width))  # fmt: skip
    sill = top - shape.belt_m - 0.03
    quad(SIDE_ROW, glass, (fx - 0.12, sill), (hx, 0.10), (tx, 0.12), (rx + 0.14, sill))
    for x in (0.5 * (hx + tx) + 0.15, hx - 0.1, tx + 0.2):
        rectangle(SIDE_ROW, trim, (x, x + 0.05), (0.05, top - 0.3))
    for x in (0.5 * length + 0.31 * length, 0.5 * length - 0.30 * length):
        centre = (int(x * PX_PER_M), int((top - 0.32) * PX_PER_M) + SIDE_ROW)
        cv2.circle(atlas, centre, int(0.38 * PX_PER_M), (18, 18, 20), -1, cv2.LINE_AA)
    low = top - shape.nose_m + 0.08
    for end, lamp in ((0.0, (235.0, 238.0, 236.0)), (2.2, (170.0, 16.0, 18.0))):
        for y in (0.08, 0.74):
            rectangle(END_ROW, lamp, (end + y * width, end + (y + 0.18) * width), (low, low + 0.16))
        rectangle(END_ROW, plate, (end + 0.36 * width, end + 0.64 * width), (low + 0.1, low + 0.22))
    atlas[480:, 480:] = (22.0, 22.0, 24.0)
    atlas[480:, 448:480] = (150.0, 152.0, 155.0)
    return np.clip(atlas, 0, 255).astype(np.uint8)


def add_car_models(builder: SceneBuilder, count: int) -> Models:
    """``count`` differing models: (mesh name, material name, shape)."""
    models = []
    kinds = list(SHAPES)
    meshes = {kind: builder.mesh(f"car_{kind}", car_mesh(SHAPES[kind])) for kind in kinds}
    paints = builder.rng.permutation(len(PAINTS))
    for index in range(count):
        kind = kinds[int(builder.rng.choice(3, p=[0.45, 0.37, 0.18]))]
        paint = PAINTS[int(paints[index % len(PAINTS)])]
        image = car_atlas(builder.rng, SHAPES[kind], paint)
        material = builder.material(f"car_paint_{index}", image, shine=0.35)
        models.append((meshes[kind], material, SHAPES[kind]))
    return models


def park_car(
    builder: SceneBuilder, model: tuple[str, str, CarShape], xy_m: Array, heading: float
) -> None:
    """A parked car on the ground at ``xy_m``."""
    mesh, material, shape = model
    wheels = np.array([[x, y] for x in (1.3, -1.3) for y in (0.8, -0.8)])
    z = float(builder.terrain.at(xy_m + rotated(wheels, heading)).mean())
    origin = np.array([xy_m[0], xy_m[1], z])
    builder.geom("car", CAR_SURFACE, mesh=mesh, material=material, pos=origin, heading=heading)
    builder.cast(turned(car_outline(shape), heading, origin))
    builder.claim(xy_m, 0.5 * shape.length_m + 0.3)


def car_outline(shape: CarShape) -> Array:
    """(12, 3) corners of the body and the roof, for shadows."""
    half, front = 0.5 * shape.width_m, 0.5 * shape.length_m
    low = [[sx * front, sy * half, z] for sx in (-1, 1) for sy in (-1, 1) for z in (0.15, 0.75)]
    roof = [[x, sy * 0.36 * shape.width_m, shape.height_m]
            for x in (shape.screen_x_m[1], shape.rear_x_m[1]) for sy in (-1, 1)]  # fmt: skip
    return np.array(low + roof)
