"""Triangles of MuJoCo geoms, for ray casting outside MuJoCo.

Height fields get the triangulation that MuJoCo itself casts rays against. Round shapes are wrapped
in triangles that lie outside of them everywhere, so that no ray that meets the shape misses its
wrapping; where exactly it meets the shape is then a matter of `sim.geometry.quadrics`.
"""

import math
from functools import lru_cache

import mujoco
import numpy as np

from touchdown.sim.typing import Array, Indices, Int32

Triangles = Int32
Mesh = tuple[Array, Triangles]
"""Vertices (V, 3) in metres, geom frame; triangles (T, 3), counter-clockwise seen from outside."""

CHORD_M = 1e-3
"""About the largest gap between a round surface up to 1 m in radius and its wrapping."""
CHORD_RELATIVE = 1e-3
"""The same for larger ones, as a fraction of the radius."""
POROUS_CHORD_RELATIVE = 1e-2
"""As a fraction of the radius, for crowns and reeds, which are many."""
_MARGIN = 1.0 + 1e-5
"""Keeps a wrapping outside after its corners are rounded to single precision."""

FIRST_HIDDEN_GROUP = 3
"""Neither sensors nor MuJoCo's viewer show groups of geoms from here on."""
_PLANE_CELL_M = 25.0
_MAX_PLANE_CELLS = 400
"""along one side: planes are settled exactly, so that large cells of vast ones do no harm"""
_MIN_SEGMENTS = 12

_BOX_CORNERS = np.array(
    [[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)], dtype=np.float64
)
_BOX_QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]


def is_seen(model: mujoco.MjModel, geom: int) -> bool:
    """True for a geom that sensors see."""
    material = int(model.geom_matid[geom])
    alpha = model.mat_rgba[material, 3] if material >= 0 else model.geom_rgba[geom, 3]
    return bool(model.geom_group[geom] < FIRST_HIDDEN_GROUP and alpha > 0.0)


def may_move(model: mujoco.MjModel, geom: int) -> bool:
    """True for a geom of a body with joints, or of one that is moved."""
    body = int(model.geom_bodyid[geom])
    return bool(model.body_weldid[body] != 0 or model.body_mocapid[body] >= 0)


def geom_mesh(
    model: mujoco.MjModel,
    geom_id: int,
    plane_reach_m: float,
    chord: float | None = None,
    around: tuple[float, float] = (0.0, 0.0),
) -> Mesh | None:
    """Triangles of one geom in the geom's own frame, or None for a kind that has no surface here
    (flexible shapes). Signed-distance shapes have the mesh that MuJoCo makes of them. An unbounded
    plane reaches ``plane_reach_m`` around the point ``around`` of its own frame. ``chord``: the
    largest gap of a wrapping as a fraction of the radius."""
    size = np.array(model.geom_size[geom_id])
    kind = int(model.geom_type[geom_id])
    data_id = int(model.geom_dataid[geom_id])
    types = mujoco.mjtGeom
    if kind == types.mjGEOM_PLANE:
        bounded = size[:2] > 0.0
        half_sizes = np.where(bounded, size[:2], plane_reach_m)
        return plane(half_sizes, np.where(bounded, 0.0, around))
    if kind == types.mjGEOM_HFIELD:
        return height_field(model, data_id)
    if kind == types.mjGEOM_MESH or (kind == types.mjGEOM_SDF and data_id >= 0):
        return _stored_mesh(model, data_id)
    if kind == types.mjGEOM_BOX:
        return box(size)
    if kind == types.mjGEOM_SPHERE:
        return ellipsoid(np.full(3, size[0]), chord)
    if kind == types.mjGEOM_ELLIPSOID:
        return ellipsoid(size, chord)
    if kind == types.mjGEOM_CYLINDER:
        return cylinder(size[0], size[1], chord)
    if kind == types.mjGEOM_CAPSULE:
        return capsule(size[0], size[1], chord)
    return None


def plane(half_sizes: Array, middle: Array) -> Mesh:
    """A rectangle in z = 0 around (2,) ``middle``, cut into cells so that single-precision hits
    stay exact."""
    counts = np.clip(np.ceil(2.0 * half_sizes / _PLANE_CELL_M), 1, _MAX_PLANE_CELLS).astype(int)
    (left, low), (right, high) = middle - half_sizes, middle + half_sizes
    xs, ys = np.linspace(left, right, counts[0] + 1), np.linspace(low, high, counts[1] + 1)
    return _grid_vertices(xs, ys, np.zeros((ys.size, xs.size))), grid_triangles(ys.size, xs.size)


def box(half_sizes: Array) -> Mesh:
    return _BOX_CORNERS * half_sizes, _quads(np.array(_BOX_QUADS))


def height_field(model: mujoco.MjModel, field_id: int) -> Mesh:
    """Top surface, four sides and underside. The diagonal of every cell runs from its (row, col) to
    its (row + 1, col + 1) corner, as in MuJoCo's own ray caster."""
    rows, cols = int(model.hfield_nrow[field_id]), int(model.hfield_ncol[field_id])
    size_x, size_y, size_z, base = model.hfield_size[field_id]
    start = int(model.hfield_adr[field_id])
    heights = model.hfield_data[start : start + rows * cols].reshape(rows, cols) * size_z
    xs = np.linspace(-size_x, size_x, cols)
    ys = np.linspace(-size_y, size_y, rows)
    top = _grid_vertices(xs, ys, heights)
    index = np.arange(rows * cols).reshape(rows, cols)
    rim = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
    skirt = top[rim] * [1.0, 1.0, 0.0] - [0.0, 0.0, base]
    below = top.shape[0] + np.arange(rim.size)
    sides = np.stack([rim, below, np.roll(below, -1), np.roll(rim, -1)], axis=-1)
    corners = below[np.cumsum([0, cols - 1, rows - 1, cols - 1])]
    underside = corners[None, ::-1]
    triangles = np.concatenate(
        [grid_triangles(rows, cols), _quads(sides), _quads(underside)]
    ).astype(np.int32)
    return np.concatenate([top, skirt]), triangles


def ellipsoid(semi_axes: Array, chord: float | None = None) -> Mesh:
    segments = _segments(float(semi_axes.max()), chord)
    angles = np.linspace(-0.5 * math.pi, 0.5 * math.pi, segments // 2 + 1)
    vertices, triangles = _revolve(np.cos(angles), np.sin(angles), segments)
    return vertices * semi_axes * _swell(vertices, triangles), triangles


def cylinder(radius: float, half_length: float, chord: float | None = None) -> Mesh:
    segments = _segments(radius, chord)
    outer = radius * _MARGIN / math.cos(math.pi / segments)
    heights = half_length * np.array([-1.0, -1.0, 1.0, 1.0])
    return _revolve(np.array([0.0, outer, outer, 0.0]), heights, segments)


def capsule(radius: float, half_length: float, chord: float | None = None) -> Mesh:
    segments = _segments(radius, chord)
    radii, heights = _quarter(segments)
    outer = radius * _ball_swell(segments)
    caps = half_length + outer * heights
    return _revolve(
        outer * np.concatenate([radii[::-1], radii]), np.append(-caps[::-1], caps), segments
    )


def _quarter(segments: int) -> tuple[Array, Array]:
    """Radii and heights of a unit sphere's rings, from the equator up."""
    quarter = np.linspace(0.0, 0.5 * math.pi, segments // 4 + 1)
    return np.cos(quarter), np.sin(quarter)


@lru_cache(maxsize=64)
def _ball_swell(segments: int) -> float:
    """`_swell` of the two halves of a capsule without length."""
    radii, heights = _quarter(segments)
    ball = np.concatenate([radii[::-1], radii]), np.append(-heights[::-1], heights)
    return _swell(*_revolve(*ball, segments))


def _stored_mesh(model: mujoco.MjModel, mesh_id: int) -> Mesh:
    vertex, face = int(model.mesh_vertadr[mesh_id]), int(model.mesh_faceadr[mesh_id])
    vertices = model.mesh_vert[vertex : vertex + int(model.mesh_vertnum[mesh_id])]
    triangles = model.mesh_face[face : face + int(model.mesh_facenum[mesh_id])]
    return vertices.astype(np.float64), triangles.astype(np.int32)


def _segments(radius: float, fraction: float | None) -> int:
    """Even number of edges round a circle that keeps the chord error."""
    chord = max(CHORD_M, CHORD_RELATIVE * radius) if fraction is None else fraction * radius
    if chord >= radius:
        return _MIN_SEGMENTS
    needed = math.pi / math.acos(1.0 - chord / radius)
    return 4 * math.ceil(max(needed, _MIN_SEGMENTS) / 4.0)


def _swell(vertices: Array, triangles: Triangles) -> float:
    """Factor that puts the faces of a tessellated unit sphere just outside of it."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    distances = np.einsum("ij,ij->i", a, normals) / np.linalg.norm(normals, axis=1)
    return _MARGIN / float(distances.min())


def _revolve(radii: Array, heights: Array, segments: int) -> Mesh:
    """Surface of revolution about z of a profile that rises from the bottom pole to the top one."""
    angles = 2.0 * math.pi * np.arange(segments) / segments
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    vertices = np.empty((radii.size, segments, 3))
    vertices[..., :2] = radii[:, None, None] * ring
    vertices[..., 2] = heights[:, None]
    triangles, corners = _wound(radii.size, segments), vertices.reshape(-1, 3)
    # those of a ring are alike
    kept = _areas(corners, triangles[:, :, 0].reshape(-1, 3)) > 0.0
    return corners, triangles[kept.reshape(triangles.shape[:2])].reshape(-1, 3)


@lru_cache(maxsize=64)
def _wound(rings: int, segments: int) -> Triangles:
    """(2, rings - 1, segments, 3) both halves of the quads between rings."""
    index = np.arange(rings * segments).reshape(rings, segments)
    following = np.roll(index, -1, axis=1)
    quads = np.stack([index[:-1], following[:-1], following[1:], index[1:]], axis=-1)
    return _quads(quads.reshape(-1, 4)).reshape(2, rings - 1, segments, 3)


def _areas(vertices: Array, triangles: Triangles) -> Array:
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    areas: Array = np.linalg.norm(np.cross(b - a, c - a), axis=-1)
    return np.where(areas > 1e-12 * areas.max(), areas, 0.0)


def _grid_vertices(xs: Array, ys: Array, heights: Array) -> Array:
    grid_x, grid_y = np.meshgrid(xs, ys)
    return np.stack([grid_x, grid_y, heights], axis=-1).reshape(-1, 3)


def grid_triangles(rows: int, cols: int) -> Triangles:
    """(T, 3) triangles of a grid of vertices, row by row."""
    index = np.arange(rows * cols).reshape(rows, cols)
    corners = [index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]]
    return _quads(np.stack(corners, axis=-1).reshape(-1, 4))


def _quads(corners: Indices) -> Triangles:
    """(Q, 4) counter-clockwise corners -> (2 Q, 3), cut from corner 0 to corner 2."""
    halves = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]], axis=0)
    return halves.astype(np.int32)
