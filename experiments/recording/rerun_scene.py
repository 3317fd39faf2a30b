"""Scene and vehicle in a recording: meshes once, moving bodies by their poses.

A group of geoms is merged into one coloured mesh, so that a scene of hundreds of objects is a few
entities in the viewer.
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Any

import cv2
import mujoco
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from touchdown.experiments.recording.rerun_blueprint import TIMELINE
from touchdown.scenes.api import Scene
from touchdown.sim.frames import Pose
from touchdown.sim.geometry.ray_target import body_pose, geom_pose
from touchdown.sim.geometry.tessellation import geom_mesh, grid_triangles
from touchdown.sim.moving import MovingBodies
from touchdown.sim.typing import Array

Faces = NDArray[np.int32]
Colours = NDArray[np.uint8]

_VEHICLE_PREFIX = "vehicle/"
_TERRAIN_SIDE = 257
_GROUND_TINT = (140, 143, 155)
"""Darkens the ground, so that the map is visible on it."""
_HIDDEN_GROUP = 3
"""MuJoCo's viewer hides geom groups from here on."""
_CHORD_FRACTION = 0.02
"""Round shapes have 16 edges all around."""
_CRISP_FACES = 80
"""Meshes up to this many triangles are shaded flat, larger ones smoothly with shared vertices."""
_GEOM = mujoco.mjtGeom
_RGB_ROLE = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)


@dataclass(frozen=True, slots=True)
class Mesh:
    """A triangle mesh, of a height field with the texture that lies on it."""

    vertices: Array
    """(V, 3) m"""
    faces: Faces
    """(F, 3), counter-clockwise from outside"""
    colours: Colours
    """(V, 3) RGB"""
    texcoords: Array | None = None
    """(V, 2) in [0, 1] with v = 0 at the first texture row, which MuJoCo lays along the edge of
    largest y; None for a mesh that is no height field"""
    texture: Colours | None = None
    """(H, W, 3) RGB"""


def log_scene(stream: rr.RecordingStream, scene: Scene, texture_pixels: int) -> None:
    """Logs terrain and static objects in world coordinates, and each moving body in its own."""
    model = scene.model
    poses = geom_poses(model)
    moving = [int(model.body(body.body_name).id) for body in scene.moving]
    static: list[int] = []
    carried: dict[int, list[int]] = {body: [] for body in moving}
    for geom in visible_geoms(model):
        body = int(model.geom_bodyid[geom])
        if model.body(body).name.startswith(_VEHICLE_PREFIX):
            continue
        root = _moving_ancestor(model, body, moving)
        if root is not None:
            carried[root].append(geom)
        elif model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_HFIELD:
            ground = terrain(
                model, geom, poses[geom], max_side=_TERRAIN_SIDE, texture_pixels=texture_pixels
            )
            _log_mesh(stream, f"world/scene/{model.geom(geom).name}", ground)
        else:
            static.append(geom)
    _log_mesh(stream, "world/scene/objects", merged_mesh(model, static, poses))
    for body, geoms in carried.items():
        mesh = merged_mesh(model, geoms, geom_poses(model, body))
        _log_mesh(stream, f"world/moving/{model.body(body).name}/mesh", mesh)


def log_vehicle(stream: rr.RecordingStream, scene: Scene) -> None:
    """Logs the airframe in body coordinates, under ``world/vehicle``."""
    model = scene.model
    roots = [
        body
        for body in range(model.nbody)
        if model.body(body).name.startswith(_VEHICLE_PREFIX)
        and not model.body(model.body_parentid[body]).name.startswith(_VEHICLE_PREFIX)
    ]
    geoms = [
        geom
        for geom in visible_geoms(model)
        if model.body(int(model.geom_bodyid[geom])).name.startswith(_VEHICLE_PREFIX)
    ]
    if not roots:
        return
    mesh = merged_mesh(model, geoms, geom_poses(model, roots[0]))
    _log_mesh(stream, "world/vehicle/mesh", mesh)


def log_moving(stream: rr.RecordingStream, scene: Scene, time_s: float) -> None:
    """Logs the poses of the moving bodies at a time."""
    stream.set_time(TIMELINE, duration=time_s)
    for name, track in MovingBodies(scene).tracks(np.array([time_s])).items():
        pose = track.last_pose
        stream.log(
            f"world/moving/{name}",
            rr.Transform3D(translation=pose.translation, mat3x3=pose.rotation),
        )


def _moving_ancestor(model: mujoco.MjModel, body: int, moving: Collection[int]) -> int | None:
    while body > 0 and body not in moving:
        body = int(model.body_parentid[body])
    return body or None


def _log_mesh(stream: rr.RecordingStream, path: str, mesh: Mesh | None) -> None:
    if mesh is None:
        return
    ground = mesh.texcoords is not None
    logged = rr.Mesh3D(
        vertex_positions=mesh.vertices,
        triangle_indices=mesh.faces,
        vertex_colors=mesh.colours if mesh.texture is None else None,
        vertex_texcoords=None if mesh.texture is None else mesh.texcoords,
        albedo_texture=mesh.texture,
        albedo_factor=_GROUND_TINT if ground else None,
    )
    stream.log(path, logged, static=True)


def visible_geoms(model: Any) -> list[int]:
    """Geoms that a viewer shows: a common group and not transparent."""
    shown = (model.geom_group < _HIDDEN_GROUP) & (_geom_rgba(model)[:, 3] > 0.0)
    return [int(geom) for geom in np.flatnonzero(shown)]


def merged_mesh(model: Any, geoms: Iterable[int], poses: dict[int, Pose]) -> Mesh | None:
    """One shaded mesh of several geoms. ``poses[geom]`` is target_from_geom; planes and
    height fields are left out. None if nothing remains."""
    rgba = _geom_rgba(model)
    vertices, faces, colours = [], [], []
    offset = 0
    for geom in geoms:
        shape = geom_mesh(model, geom, 0.0, _CHORD_FRACTION)
        if shape is None or int(model.geom_type[geom]) in (_GEOM.mjGEOM_PLANE, _GEOM.mjGEOM_HFIELD):
            continue
        placed, triangles = poses[geom].apply(shape[0]), shape[1]
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


def geom_poses(model: Any, body: int = 0) -> dict[int, Pose]:
    """Poses of all geoms in a body, by default in the world, in the model's initial
    configuration."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    body_from_world = body_pose(data, body).inverse()
    return {geom: body_from_world @ geom_pose(data, geom) for geom in range(model.ngeom)}


def terrain(
    model: Any, geom: int, world_from_geom: Pose, *, max_side: int, texture_pixels: int
) -> Mesh:
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
    return Mesh(
        vertices=world_from_geom.apply(local),
        faces=grid_triangles(len(row), len(col)),
        texcoords=np.stack([u, 1.0 - v], axis=-1).reshape(-1, 2),
        texture=_texture(model, geom, texture_pixels),
        colours=np.tile((255 * _geom_rgba(model)[geom, :3]).astype(np.uint8), (len(local), 1)),
    )


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
