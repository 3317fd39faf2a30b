"""Scene and vehicle in a recording: meshes once, moving bodies by their poses."""

from __future__ import annotations

from collections.abc import Collection

import mujoco
import numpy as np
import rerun as rr

from touchdown.experiments.recording.mjcf_meshes import (
    Mesh,
    Terrain,
    geom_poses,
    merged_mesh,
    terrain,
    visible_geoms,
)
from touchdown.experiments.recording.rerun_blueprint import TIMELINE
from touchdown.scenes.api import Scene
from touchdown.sim.moving import MovingBodies

_VEHICLE_PREFIX = "vehicle/"
_TERRAIN_SIDE = 257
_GROUND_TINT = (140, 143, 155)
"""Darkens the ground, so that the map is visible on it."""


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
            stream.log(f"world/scene/{model.geom(geom).name}", _ground_mesh(ground), static=True)
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


def _ground_mesh(ground: Terrain) -> rr.Mesh3D:
    bare = ground.texture is None
    return rr.Mesh3D(
        vertex_positions=ground.vertices,
        triangle_indices=ground.faces,
        vertex_colors=np.tile(ground.colour, (len(ground.vertices), 1)) if bare else None,
        vertex_texcoords=None if bare else ground.texcoords,
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
