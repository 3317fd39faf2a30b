"""A room with a movable chessboard for calibrating camera and LIDAR."""

from typing import Any
from zlib import crc32

import mujoco
import numpy as np

from touchdown.scenes.api import Image, Scene, Surface
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.generation import finish
from touchdown.scenes.authoring.meshes import MeshData
from touchdown.scenes.authoring.plots import SurveyFrame
from touchdown.scenes.authoring.relief import HeightField
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
    flat = HeightField(heights_m=np.zeros((2, 2)), half_m=_HALF_M)
    spec = mujoco.MjSpec()
    builder = SceneBuilder(spec=spec, rng=rng, terrain=flat, sun=np.array([0.0, 0.0, -1.0]))
    _add_floor(builder)
    _add_crates(builder)
    _add_board(builder, image, width_m, height_m)
    light = spec.worldbody.add_light(name="lamp", pos=[1.0, -2.0, 9.0], dir=[-0.1, 0.2, -1.0])
    light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    light.diffuse, light.specular = [0.35] * 3, [0.0] * 3
    spec.visual.headlight.ambient = [0.35] * 3
    spec.visual.headlight.diffuse = [0.3] * 3
    spec.visual.headlight.specular = [0.0] * 3
    draft = finish(SurveyFrame(takeoff_xy_m=np.zeros(2), takeoff_yaw=0.0), builder, None)
    prepare_spec(draft)
    return compile_scene(spec, draft, "calibration_room", seed, "the calibration room")


def _add_floor(builder: SceneBuilder) -> None:
    rng = builder.rng
    coarse = np.kron(rng.normal(0.0, 7.0, (64, 64)), np.ones((8, 8)))
    grey = np.clip(118.0 + coarse + rng.normal(0.0, 9.0, coarse.shape), 0, 255).astype(np.uint8)
    builder.material("concrete", np.repeat(grey[:, :, None], 3, axis=2))
    builder.geom("floor", _CONCRETE, name="floor", box=[_HALF_M, _HALF_M, 0.05],
                 pos=[0.0, 0.0, -0.05], material="concrete")  # fmt: skip


def _add_crates(builder: SceneBuilder) -> None:
    """Adds planes of other sizes than the board's, clear of the vehicle."""
    rng = builder.rng
    for number in range(_CRATES):
        angle = 2.0 * np.pi * (number + rng.uniform(-0.3, 0.3)) / _CRATES
        distance = rng.uniform(1.2, 3.2)
        half = rng.uniform([0.12, 0.12, 0.1], [0.3, 0.3, 0.35])
        yaw = rng.uniform(0.0, np.pi)
        at = [distance * np.cos(angle), distance * np.sin(angle), half[2]]
        rgba = [*rng.uniform([0.45, 0.3, 0.15], [0.7, 0.5, 0.3]), 1.0]
        builder.geom("crate", _WOOD, box=half, pos=at, heading=yaw, rgba=rgba)


def _add_board(builder: SceneBuilder, image: Image, width_m: float, height_m: float) -> None:
    builder.material("board_image", image)
    x, y = 0.5 * width_m, 0.5 * height_m
    # Counter-clockwise seen from -z, the side that is seen; v runs down the image.
    face = MeshData(
        vertices=np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]], float),
        faces=np.array([[0, 2, 1], [0, 3, 2]], np.int32),
        uv=np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float),
    )
    builder.mesh("board_face", face)
    body = builder.spec.worldbody.add_body(
        name=BOARD_BODY, mocap=True, pos=[0.0, 0.0, 0.5 * height_m]
    )
    body.quat = [0.5**0.5, 0.5**0.5, 0.0, 0.0]
    behind = [0.0, 0.0, 0.5 * _THICKNESS_M + 0.002]
    pole = [0.0, 0.0, _THICKNESS_M + 0.5 * _POLE_M]
    looks: dict[str, dict[str, Any]] = {
        "board_face": {"mesh": "board_face", "material": "board_image"},
        "board_plate": {"box": [x, y, 0.5 * _THICKNESS_M], "pos": behind,
                        "rgba": [0.8, 0.8, 0.8, 1.0]},
        "board_pole": {"cylinder": (0.02, 0.5 * _POLE_M), "pos": pole,
                       "rgba": [0.3, 0.3, 0.32, 1.0]},
    }  # fmt: skip
    for name, look in looks.items():
        builder.geom(name, _PAINT, body, name=name, contype=0, conaffinity=0, **look)
