"""Small textured meshes made by code."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.plane import SQUARE, unit_circle

Ints = NDArray[np.int32]


@dataclass(frozen=True, kw_only=True, slots=True)
class MeshData:
    """A triangle mesh. vertices: (N, 3) metres; faces: (M, 3) counter-clockwise seen from
    outside; uv: (N, 2) texture coordinates, u to the right and v DOWN the texture; normals: (N, 3)
    of any length, None: MuJoCo's."""

    vertices: Array
    faces: Ints
    uv: Array
    normals: Array | None = None

    @staticmethod
    def join(parts: list["MeshData"]) -> "MeshData":
        """One mesh out of several, with normals where all have them."""
        offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
        normals = [part.normals for part in parts if part.normals is not None]
        return MeshData(
            vertices=np.concatenate([part.vertices for part in parts]),
            faces=np.concatenate(
                [part.faces + offset for part, offset in zip(parts, offsets, strict=True)]
            ).astype(np.int32),
            uv=np.concatenate([part.uv for part in parts]),
            normals=np.concatenate(normals) if len(normals) == len(parts) else None,
        )

    def moved(self, offset: Array) -> "MeshData":
        """The mesh elsewhere, with MuJoCo's normals."""
        return MeshData(vertices=self.vertices + offset, faces=self.faces, uv=self.uv)


def polygon(corners: Array, uv: ArrayLike = 0.0) -> MeshData:
    """A flat convex polygon, (K, 3) corners counter-clockwise from outside, with its own vertices
    (so that it is shaded flat). uv: (K, 2), or what is the same at all corners."""
    count = len(corners)
    fan = np.array([[0, i, i + 1] for i in range(1, count - 1)], np.int32)
    return MeshData(
        vertices=np.asarray(corners, np.float64),
        faces=fan,
        uv=np.array(np.broadcast_to(uv, (count, 2)), np.float64),
    )


def walls(lower: Array, upper: Array, uv: ArrayLike = 0.0) -> list[MeshData]:
    """Flat quads between two closed outlines, (K, 3) each, counter-clockwise from the side of
    ``upper``."""
    quads = np.stack([lower, np.roll(lower, -1, 0), np.roll(upper, -1, 0), upper], axis=1)
    return [polygon(quad, uv) for quad in quads]


def plaque(half_m: Sequence[float], body: MeshData, z_m: float = 0.0, copies: int = 1) -> MeshData:
    """A level rectangle that shows the whole texture, with ``copies`` of it along either side, on
    ``body``; its corners are the first four vertices."""
    corners = np.column_stack([SQUARE * half_m, np.full(4, z_m)])
    uv = copies * np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])
    return MeshData.join([polygon(corners, uv), body])


def box(
    half: Sequence[float] | Array, centre: Sequence[float] | Array, metres_per_uv: float = 1.0
) -> MeshData:
    """An axis-aligned box; every face is mapped in metres divided by ``metres_per_uv``."""
    corners = np.empty((6, 4, 3))
    uv = np.empty((6, 4, 2))
    for face in range(6):
        axis, sign = face // 2, 2 * (face % 2) - 1
        first, second = (axis + 1) % 3, (axis + 2) % 3
        corners[face, :, axis] = sign * half[axis]
        corners[face][:, [first, second]] = SQUARE[::sign] * [half[first], half[second]]
        uv[face] = corners[face][:, [first, second]] * [1.0, -1.0] / metres_per_uv
    fans = 4 * np.arange(6)[:, None, None] + [[0, 1, 2], [0, 2, 3]]
    return MeshData(
        vertices=(corners + np.asarray(centre)).reshape(24, 3),
        faces=fans.reshape(12, 3).astype(np.int32),
        uv=uv.reshape(24, 2),
    )


def boxes(*rows: Sequence[float]) -> list[MeshData]:
    """Boxes by half sides and centre, (hx, hy, hz, x, y, z) metres each."""
    return [box(row[:3], row[3:]) for row in rows]


def plate(corners: Sequence[Sequence[float]] | Array, thick_m: float = 0.0) -> list[MeshData]:
    """A flat polygon that is seen from both sides, without a texture; ``thick_m``: how far below
    the upper one the lower side is."""
    upper = np.asarray(corners, np.float64)
    lower = upper[::-1] - [0.0, 0.0, thick_m] if thick_m else upper[::-1]
    return [polygon(side) for side in (upper, lower)]


def cylinder_y(radius: float, half_width: float, centre: Array, uv: Array, sides: int) -> MeshData:
    """A wheel: a cylinder about the y axis; rim vertices map to ``uv[0]``, hubs to ``uv[1]``."""
    up, ahead = radius * unit_circle(sides).T
    ring = np.stack([ahead, np.zeros(sides), up], axis=-1)
    aside = np.array([0.0, half_width, 0.0])
    left, right = ring + aside, ring - aside
    parts = walls(left, right, uv[0])
    for side, order in ((left, -1), (right, 1)):
        hub = side[0] * [0.0, 1.0, 0.0]
        loop = side[::order]
        for i in range(sides):
            corners = np.array([hub, loop[i], loop[(i + 1) % sides]])
            parts.append(polygon(corners, np.array([uv[1], uv[0], uv[0]])))
    return MeshData.join(parts).moved(centre)


def blob(
    rng: np.random.Generator,
    half: Array,
    exponent: float,
    roughness: float,
    rings: int,
    metres_per_uv: float,
) -> MeshData:
    """A lumpy closed surface: the superellipsoid ``sum |x_i / half_i|**exponent = 1`` (2: an
    ellipsoid, 8: a box with round edges), displaced along the radius by ``roughness`` (fraction of
    it). Texture: laid on from above and down the sides, ``metres_per_uv`` metres a texture."""
    unit = sphere_grid(rings)
    half = np.asarray(half, np.float64)
    # Directions evenly spread on the box-like shape, not on the sphere that it is stretched from.
    norm = (np.abs(unit) ** exponent).sum(axis=-1) ** (1.0 / exponent)
    shape = unit / norm[..., None]
    waves = rng.normal(size=(10, 3)) * np.linspace(2.0, 7.0, 10)[:, None]
    phases = rng.uniform(0.0, 2.0 * np.pi, 10)
    lumps = np.sin(unit @ waves.T + phases) @ (1.0 / np.linspace(1.5, 4.0, 10))
    lumps[:, -1] = lumps[:, 0]
    vertices = shape * half * (1.0 + roughness * lumps / 1.3)[..., None]
    return wrapped(rng, vertices, metres_per_uv)


def sphere_grid(rings: int) -> Array:
    """(rings + 1, 2 rings + 1, 3) points of the unit sphere as `wrapped` takes them."""
    azimuth = np.linspace(0.0, 2.0 * np.pi, 2 * rings + 1)
    theta, phi = np.meshgrid(np.linspace(0.0, np.pi, rings + 1), azimuth, indexing="ij")
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)


def wrapped(rng: np.random.Generator, vertices: Array, metres_per_uv: float) -> MeshData:
    """A closed surface from a grid of points, (rings + 1, sectors + 1, 3): row 0 and the last are
    the poles above and below, the last column repeats the first. Smooth normals; texture as in
    `blob`, shifted at random."""
    rings, sectors = vertices.shape[0] - 1, vertices.shape[1] - 1
    # Faces that look up are mapped from above, the others by the way around and the height.
    ring = vertices[rings // 2]
    around = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ring, axis=0), axis=1))])
    side = np.stack(np.broadcast_arrays(around, -vertices[..., 2]), axis=-1)
    uv = np.concatenate([vertices[..., :2].reshape(-1, 2), side.reshape(-1, 2)])
    uv = uv / metres_per_uv + rng.uniform(size=2)
    index = np.arange((rings + 1) * (sectors + 1)).reshape(rings + 1, sectors + 1)
    a, b = index[:-1, :-1].ravel(), index[1:, :-1].ravel()
    c, d = index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    points = vertices.reshape(-1, 3)
    corner = points[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.linalg.norm(normal, axis=1)
    upward = np.abs(normal[:, 2]) > 0.6 * area
    smooth = np.zeros_like(points)
    for column in range(3):
        np.add.at(smooth, faces[:, column], normal)
    # The seam's two columns are one line of the surface.
    smooth = smooth.reshape(*vertices.shape)
    smooth[:, 0] += smooth[:, -1]
    smooth[:, -1] = smooth[:, 0]
    smooth[0], smooth[-1] = smooth[0].sum(axis=0), smooth[-1].sum(axis=0)
    # Vertices exist once for each way of mapping (MJCF knows one texture coordinate a vertex); at
    # the poles the quads have a corner twice.
    split = np.where(upward[:, None], faces, faces + len(points))[area > 1e-9]
    used, split = np.unique(split, return_inverse=True)
    return MeshData(
        vertices=np.tile(points, (2, 1))[used],
        faces=split.reshape(-1, 3).astype(np.int32),
        uv=uv[used],
        normals=np.tile(smooth.reshape(-1, 3), (2, 1))[used],
    )
