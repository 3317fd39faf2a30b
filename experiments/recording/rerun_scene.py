"""Scene and vehicle in a recording: meshes once, moving bodies by their poses."""

from __future__ import annotations

import math
from collections.abc import Iterable

import mujoco
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from touchdown.experiments.recording.mjcf_meshes import (
    Mesh,
    Terrain,
    geom_poses_body,
    geom_poses_world,
    merged_mesh,
    terrain,
    visible_geoms,
)
from touchdown.experiments.recording.rerun_blueprint import TIMELINE
from touchdown.scenes.api import MovingBody, Scene
from touchdown.sim.frames import rotation_from_yaw

Array = NDArray[np.float64]

_VEHICLE_PREFIX = "vehicle/"
_TERRAIN_SIDE = 257
_GROUND_TINT = (140, 143, 155)
"""Darkens the ground, so that the map is visible on it."""


def log_scene(stream: rr.RecordingStream, scene: Scene, texture_pixels: int) -> None:
    """Logs terrain and static objects in world coordinates, and each moving body in its own."""
    model = scene.model
    poses = geom_poses_world(model)
    moving = {moving_body_id(scene, body): body for body in scene.moving}
    static, carried = [], {body: [] for body in moving}  # type: ignore[var-annotated]
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
            stream.log(f"world/scene/{model.geom(geom).name}", _ground_mesh(ground), static=True)
        else:
            static.append(geom)
    _log_mesh(stream, "world/scene/objects", merged_mesh(model, static, poses))
    for body, geoms in carried.items():
        mesh = merged_mesh(model, geoms, geom_poses_body(model, body, geoms))
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
    _log_mesh(
        stream,
        "world/vehicle/mesh",
        merged_mesh(model, geoms, geom_poses_body(model, roots[0], geoms)),
    )


def log_moving(stream: rr.RecordingStream, scene: Scene, time_s: float) -> None:
    """Logs the poses of the moving bodies at a time."""
    stream.set_time(TIMELINE, duration=time_s)
    for body in scene.moving:
        position, yaw = pose_on_path(body, time_s)
        stream.log(
            f"world/moving/{body.body_name}",
            rr.Transform3D(translation=position, mat3x3=rotation_from_yaw(yaw)),
        )


def pose_on_path(body: MovingBody, time_s: float) -> tuple[Array, float]:
    """Position (3,) world and heading in radians of a body on its closed path."""
    corners = np.vstack([body.path_world, body.path_world[:1]])
    legs = np.diff(corners, axis=0)
    lengths = np.linalg.norm(legs, axis=1)
    ends = np.cumsum(lengths)
    along = (body.start_m + body.speed_mps * time_s) % float(ends[-1])
    leg = min(int(np.searchsorted(ends, along, side="right")), len(legs) - 1)
    share = (along - (ends[leg] - lengths[leg])) / lengths[leg]
    heading = math.atan2(legs[leg][1], legs[leg][0])
    return corners[leg] + share * legs[leg], heading


def moving_body_id(scene: Scene, body: MovingBody) -> int:
    return int(scene.model.body(body.body_name).id)


def _moving_ancestor(model: mujoco.MjModel, body: int, moving: Iterable[int]) -> int | None:
    known = set(moving)
    while body > 0:
        if body in known:
            return body
        body = int(model.body_parentid[body])
    return None


def _ground_mesh(ground: Terrain) -> rr.Mesh3D:
    if ground.texture is None:
        colours = np.broadcast_to(ground.colour, (len(ground.vertices), 3))
        return rr.Mesh3D(
            vertex_positions=ground.vertices,
            triangle_indices=ground.faces,
            vertex_colors=colours,
            albedo_factor=_GROUND_TINT,
        )
    return rr.Mesh3D(
        vertex_positions=ground.vertices,
        triangle_indices=ground.faces,
        vertex_texcoords=ground.texcoords,
        albedo_texture=ground.texture,
        albedo_factor=_GROUND_TINT,
    )


def _log_mesh(stream: rr.RecordingStream, path: str, mesh: Mesh | None) -> None:
    if mesh is None:
        return
    stream.log(
        path,
        rr.Mesh3D(
            vertex_positions=mesh.vertices, triangle_indices=mesh.faces, vertex_colors=mesh.colours
        ),
        static=True,
    )
