"""Triangle meshes of a compiled MJCF model, for the recording.

Each primitive becomes vertices in its own geom frame; a group of geoms is merged into one coloured
mesh, so that a scene of hundreds of objects is a few entities in the viewer.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Faces = NDArray[np.int32]
Colours = NDArray[np.uint8]

_HIDDEN_GROUP = 3
"""MuJoCo's viewer hides geom groups from here on."""
_ROUND_SEGMENTS = 12
_CRISP_FACES = 80
"""Meshes up to this many triangles are shaded flat, larger ones smoothly with shared vertices."""
_GEOM = mujoco.mjtGeom
_RGB_ROLE = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)


@dataclass(frozen=True, slots=True)
class Mesh:
    """vertices (V, 3) m; faces (F, 3), counter-clockwise from outside; colours (V, 3) RGB."""

    vertices: Array
    faces: Faces
    colours: Colours


@dataclass(frozen=True, slots=True)
class Terrain:
    """A height field in its world position with the texture that lies on it.

    vertices (V, 3) world; faces (F, 3); texcoords (V, 2) in [0, 1] with v = 0 at the first texture
    row, which MuJoCo lays along the edge of largest y; texture (H, W, 3) RGB or None; colour (3,)
    RGB for an untextured one.
    """

    vertices: Array
    faces: Faces
    texcoords: Array
    texture: Colours | None
    colour: Colours


def visible_geoms(model: Any) -> list[int]:
    """Geoms that a viewer shows: a common group and not transparent."""
    shown = (model.geom_group < _HIDDEN_GROUP) & (_geom_rgba(model)[:, 3] > 0.0)
    return [int(geom) for geom in np.flatnonzero(shown)]


def merged_mesh(model: Any, geoms: Iterable[int], poses: dict[int, Array]) -> Mesh | None:
    """One shaded mesh of several geoms. ``poses[geom]`` is the (4, 4) target_from_geom; geom
    kinds without a mesh (planes, height fields) are left out. None if nothing remains."""
    rgba = _geom_rgba(model)
    vertices, faces, colours = [], [], []
    offset = 0
    for geom in geoms:
        shape = _geom_triangles(model, geom)
        if shape is None:
            continue
        placed, triangles = shape[0] @ poses[geom][:3, :3].T + poses[geom][:3, 3], shape[1]
        if len(triangles) <= _CRISP_FACES:  # own corners per face, for sharp edges
            placed = placed[triangles].reshape(-1, 3)
            triangles = np.arange(len(placed), dtype=np.int32).reshape(-1, 3)
        shade = _vertex_shades(placed, triangles)[:, None]
        colours.append(np.clip(255.0 * rgba[geom, :3] * shade, 0, 255).astype(np.uint8))
        vertices.append(placed)
        faces.append(triangles + np.int32(offset))
        offset += len(placed)
    if not vertices:
        return None
    return Mesh(np.concatenate(vertices), np.concatenate(faces), np.concatenate(colours))


def geom_poses_world(model: Any) -> dict[int, Array]:
    """(4, 4) world_from_geom of every geom in the model's initial configuration."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    poses = {}
    for geom in range(model.ngeom):
        pose = np.eye(4)
        pose[:3, :3] = data.geom_xmat[geom].reshape(3, 3)
        pose[:3, 3] = data.geom_xpos[geom]
        poses[geom] = pose
    return poses


def geom_poses_body(model: Any, body: int, geoms: Iterable[int]) -> dict[int, Array]:
    """(4, 4) body_from_geom in the model's initial configuration."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    body_from_world = np.eye(4)
    rotation = data.xmat[body].reshape(3, 3)
    body_from_world[:3, :3] = rotation.T
    body_from_world[:3, 3] = -rotation.T @ data.xpos[body]
    world = geom_poses_world(model)
    return {geom: body_from_world @ world[geom] for geom in geoms}


def terrain(
    model: Any, geom: int, world_from_geom: Array, *, max_side: int, texture_pixels: int
) -> Terrain:
    """The height field of a geom, thinned to ``max_side`` vertices a side."""
    hfield = int(model.geom_dataid[geom])
    rows, cols = int(model.hfield_nrow[hfield]), int(model.hfield_ncol[hfield])
    start = int(model.hfield_adr[hfield])
    heights = model.hfield_data[start : start + rows * cols].reshape(rows, cols)
    half_x, half_y, scale, _base = model.hfield_size[hfield]
    row = np.unique(np.linspace(0, rows - 1, min(rows, max_side)).round().astype(int))
    col = np.unique(np.linspace(0, cols - 1, min(cols, max_side)).round().astype(int))
    u, v = np.meshgrid(col / (cols - 1), row / (rows - 1))
    local = np.stack(
        [(2 * u - 1) * half_x, (2 * v - 1) * half_y, heights[np.ix_(row, col)] * scale], axis=-1
    ).reshape(-1, 3)
    return Terrain(
        vertices=local @ world_from_geom[:3, :3].T + world_from_geom[:3, 3],
        faces=_grid_faces(len(row), len(col)),
        texcoords=np.stack([u, 1.0 - v], axis=-1).reshape(-1, 2),
        texture=_texture(model, geom, texture_pixels),
        colour=(255 * _geom_rgba(model)[geom, :3]).astype(np.uint8),
    )


# ---------------------------------------------------------------------------------------- colours


def _geom_rgba(model: Any) -> Array:
    """(G, 4) colour of every geom in [0, 1]: its material's where it has one."""
    rgba = np.array(model.geom_rgba, dtype=np.float64)
    for geom in np.flatnonzero(model.geom_matid >= 0):
        material = int(model.geom_matid[geom])
        rgba[geom] = model.mat_rgba[material]
        texture = int(model.mat_texid[material, _RGB_ROLE])
        if texture >= 0 and model.geom_type[geom] != _GEOM.mjGEOM_HFIELD:
            rgba[geom, :3] *= _texture_pixels(model, texture)[::8, ::8].mean(axis=(0, 1)) / 255.0
    return rgba


def _texture_pixels(model: Any, texture: int) -> Colours:
    """(H, W, 3) view of a texture in the model."""
    height, width = int(model.tex_height[texture]), int(model.tex_width[texture])
    channels = int(model.tex_nchannel[texture])
    start = int(model.tex_adr[texture])
    flat = model.tex_data[start : start + height * width * channels]
    pixels: Colours = flat.reshape(height, width, channels)
    return pixels[:, :, :3] if channels >= 3 else np.repeat(pixels[:, :, :1], 3, axis=2)


def _texture(model: Any, geom: int, max_pixels: int) -> Colours | None:
    import cv2

    material = int(model.geom_matid[geom])
    texture = int(model.mat_texid[material, _RGB_ROLE]) if material >= 0 else -1
    if texture < 0:
        return None
    pixels = _texture_pixels(model, texture)
    shrink = min(1.0, max_pixels / max(pixels.shape[:2]))
    size = (max(1, round(pixels.shape[1] * shrink)), max(1, round(pixels.shape[0] * shrink)))
    resized = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(resized, dtype=np.uint8)


def _vertex_shades(vertices: Array, faces: Faces) -> Array:
    """(V,) brightness by the mean direction of the faces around, a soft sun from the south-west."""
    triangle = vertices[faces]
    normal = np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
    mean = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(mean, faces[:, corner], normal)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    sun = np.array([-0.4, -0.3, 0.866])
    return np.asarray(0.62 + 0.38 * np.clip(mean @ sun, -0.4, 1.0))


# ----------------------------------------------------------------------------------------- shapes


def _geom_triangles(model: Any, geom: int) -> tuple[Array, Faces] | None:
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    if kind == _GEOM.mjGEOM_BOX:
        return _box(size)
    if kind in (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_ELLIPSOID):
        return _ellipsoid(size if kind == _GEOM.mjGEOM_ELLIPSOID else np.repeat(size[0], 3))
    if kind == _GEOM.mjGEOM_CYLINDER:
        return _revolved([(0.0, -size[1]), (size[0], -size[1]), (size[0], size[1]), (0.0, size[1])])
    if kind == _GEOM.mjGEOM_CAPSULE:
        return _revolved(_capsule_profile(size[0], size[1]))
    if kind == _GEOM.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        vertex, face = int(model.mesh_vertadr[mesh]), int(model.mesh_faceadr[mesh])
        vertices = model.mesh_vert[vertex : vertex + int(model.mesh_vertnum[mesh])]
        faces = model.mesh_face[face : face + int(model.mesh_facenum[mesh])]
        return vertices.astype(np.float64), faces.astype(np.int32)
    return None


def _box(half: Array) -> tuple[Array, Faces]:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [(a, b, c) for a, b, c, _ in quads] + [(a, c, d) for a, _, c, d in quads]
    return corners * half, np.array(faces, dtype=np.int32)


def _ellipsoid(radii: Array) -> tuple[Array, Faces]:
    angles = np.linspace(-np.pi / 2, np.pi / 2, _ROUND_SEGMENTS // 2 + 1)
    vertices, faces = _revolved(list(zip(np.cos(angles), np.sin(angles), strict=True)))
    return vertices * radii, faces


def _capsule_profile(radius: float, half: float) -> list[tuple[float, float]]:
    low = np.linspace(-np.pi / 2, 0.0, 4)
    high = np.linspace(0.0, np.pi / 2, 4)
    bottom = [(radius * np.cos(a), radius * np.sin(a) - half) for a in low]
    return bottom + [(radius * np.cos(a), radius * np.sin(a) + half) for a in high]


def _revolved(profile: list[tuple[float, float]]) -> tuple[Array, Faces]:
    """Turns a (radius, z) profile, from low to high, about the z axis."""
    angle = np.linspace(0.0, 2 * np.pi, _ROUND_SEGMENTS, endpoint=False)
    rings = [
        np.column_stack([r * np.cos(angle), r * np.sin(angle), np.full_like(angle, z)])
        for r, z in profile
    ]
    faces = []
    for ring in range(len(profile) - 1):
        for i in range(_ROUND_SEGMENTS):
            j = (i + 1) % _ROUND_SEGMENTS
            a, b = ring * _ROUND_SEGMENTS + i, ring * _ROUND_SEGMENTS + j
            c, d = a + _ROUND_SEGMENTS, b + _ROUND_SEGMENTS
            faces += [(a, b, d), (a, d, c)]
    return np.concatenate(rings), np.array(faces, dtype=np.int32)


def _grid_faces(rows: int, cols: int) -> Faces:
    first = (np.arange(rows - 1)[:, None] * cols + np.arange(cols - 1)[None, :]).ravel()
    lower = np.column_stack([first, first + 1, first + cols + 1])
    upper = np.column_stack([first, first + cols + 1, first + cols])
    return np.concatenate([lower, upper]).astype(np.int32)
