"""A room with a movable chessboard for calibrating camera and LIDAR."""

from __future__ import annotations

from zlib import crc32

import mujoco
import numpy as np

from touchdown.scenes.api import Image, Scene, Surface
from touchdown.scenes.authoring.builder import RGB_ROLE, add_texture
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.compose import compile_scene, prepare_spec

BOARD_BODY = "board"
"""A mocap body. Its frame: x along the image's width, y down the image, z into the board, with
the origin in the middle of the face."""
_THICKNESS_M = 0.01
_POLE_M = 0.7
_HALF_M = 12.0
_CRATES = 7
_PAINT = Surface(land_class="other", reflectivity=0.6)
_WOOD = Surface(land_class="other", reflectivity=0.4)
_CONCRETE = Surface(land_class="road", reflectivity=0.25)


def calibration_room(image: Image, width_m: float, height_m: float, seed: int) -> Scene:
    """Returns the vehicle on a concrete floor with crates and a board of ``width_m`` x ``height_m``
    that shows ``image`` (H, W, 3) RGB, held by a pole from behind. The seed places the crates."""
    rng = np.random.default_rng([seed, crc32(b"scenes.calibration_room")])
    spec = mujoco.MjSpec()
    surfaces: dict[str, Surface] = {}
    _add_floor(spec, rng, surfaces)
    _add_crates(spec, rng, surfaces)
    _add_board(spec, image, width_m, height_m, surfaces)
    light = spec.worldbody.add_light(name="lamp", pos=[1.0, -2.0, 9.0], dir=[-0.1, 0.2, -1.0])
    light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    light.diffuse, light.specular = [0.35] * 3, [0.0] * 3
    spec.visual.headlight.ambient = [0.35] * 3
    spec.visual.headlight.diffuse = [0.3] * 3
    spec.visual.headlight.specular = [0.0] * 3
    draft = SceneDraft(
        spec=spec,
        takeoff_xy_m=np.zeros(2),
        takeoff_yaw=0.0,
        bounds_xy_m=np.array([[-_HALF_M, -_HALF_M], [_HALF_M, _HALF_M]]),
        surfaces=surfaces,
        ground=None,
    )
    prepare_spec(draft)
    return compile_scene(spec, draft, "calibration_room", seed, "the calibration room")


def _add_material(spec: mujoco.MjSpec, name: str, image: Image) -> None:
    add_texture(spec, name, image)
    material = spec.add_material(name=name, specular=0.0, shininess=0.0)
    textures = list(material.textures)
    textures[RGB_ROLE] = name
    material.textures = textures


def _add_floor(spec: mujoco.MjSpec, rng: np.random.Generator, surfaces: dict[str, Surface]) -> None:
    coarse = np.kron(rng.normal(0.0, 7.0, (64, 64)), np.ones((8, 8)))
    grey = np.clip(118.0 + coarse + rng.normal(0.0, 9.0, coarse.shape), 0, 255).astype(np.uint8)
    _add_material(spec, "concrete", np.repeat(grey[:, :, None], 3, axis=2))
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[_HALF_M, _HALF_M, 0.05],
        pos=[0.0, 0.0, -0.05],
        material="concrete",
    )
    surfaces["floor"] = _CONCRETE


def _add_crates(
    spec: mujoco.MjSpec, rng: np.random.Generator, surfaces: dict[str, Surface]
) -> None:
    """Adds planes of other sizes than the board's, clear of the vehicle."""
    for number in range(_CRATES):
        angle = 2.0 * np.pi * (number + rng.uniform(-0.3, 0.3)) / _CRATES
        distance = rng.uniform(1.2, 3.2)
        half = rng.uniform([0.12, 0.12, 0.1], [0.3, 0.3, 0.35])
        yaw = rng.uniform(0.0, np.pi)
        name = f"crate_{number}"
        spec.worldbody.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=half.tolist(),
            pos=[distance * np.cos(angle), distance * np.sin(angle), half[2]],
            quat=[np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw)],
            rgba=[*rng.uniform([0.45, 0.3, 0.15], [0.7, 0.5, 0.3]), 1.0],
        )
        surfaces[name] = _WOOD


def _add_board(
    spec: mujoco.MjSpec, image: Image, width_m: float, height_m: float, surfaces: dict[str, Surface]
) -> None:
    _add_material(spec, "board_image", image)
    mesh = spec.add_mesh(name="board_face")
    x, y = 0.5 * width_m, 0.5 * height_m
    # Counter-clockwise seen from -z, the side that is seen; v runs down the image.
    faces = np.array([[0, 2, 1], [0, 3, 2]], np.int32)
    mesh.uservert = np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]], float).ravel()
    mesh.userface = faces.ravel()
    mesh.usertexcoord = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float).ravel()
    mesh.userfacetexcoord = faces.ravel()
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    body = spec.worldbody.add_body(name=BOARD_BODY, mocap=True, pos=[0.0, 0.0, 0.5 * height_m])
    body.quat = [0.5**0.5, 0.5**0.5, 0.0, 0.0]
    body.add_geom(
        name="board_face",
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname="board_face",
        material="board_image",
        contype=0,
        conaffinity=0,
    )
    body.add_geom(
        name="board_plate",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[x, y, 0.5 * _THICKNESS_M],
        pos=[0.0, 0.0, 0.5 * _THICKNESS_M + 0.002],
        rgba=[0.8, 0.8, 0.8, 1.0],
        contype=0,
        conaffinity=0,
    )
    body.add_geom(
        name="board_pole",
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[0.02, 0.5 * _POLE_M, 0.0],
        pos=[0.0, 0.0, _THICKNESS_M + 0.5 * _POLE_M],
        rgba=[0.3, 0.3, 0.32, 1.0],
        contype=0,
        conaffinity=0,
    )
    for name in ("board_face", "board_plate", "board_pole"):
        surfaces[name] = _PAINT
