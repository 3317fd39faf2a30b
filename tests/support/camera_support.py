"""A vehicle with a downward camera over a plain floor, for the tests of the camera."""

from contextlib import closing

import mujoco
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Scene
from touchdown.sim.api import CameraParams
from touchdown.sim.camera.sensor import CameraSensor
from touchdown.sim.frames import BODY_FROM_DOWNWARD_OPTICAL, Pose
from touchdown.sim.typing import Array, Bytes

from support.places import bare_scene

CLEAN = CameraParams(noise_sigma=0.0)
HEIGHT_M = 20.0
HEADLIGHT = (
    '<visual><headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/></visual>'
    '<option><flag gravity="disable"/></option>'
)


def make_scene(objects: str = "", quat_wxyz: str = "1 0 0 0", floor: str = "0 0 0 1") -> Scene:
    """A vehicle with a downward camera 20 m over a plain floor; ``objects`` stand on it."""
    xml = f"""
    <mujoco>{HEADLIGHT}<worldbody>
      <body name="vehicle/quadrotor" pos="0 0 {HEIGHT_M}" quat="{quat_wxyz}">
        <freejoint/>
        <geom name="vehicle/plate" type="box" size="1 1 0.05" pos="0 0 -1" group="4"/>
        <camera name="vehicle/camera" xyaxes="0 -1 0 1 0 0"/>
        <camera name="vehicle/camera_right" xyaxes="0 -1 0 1 0 0" pos="0 -0.05 0"/>
      </body>
      <geom name="floor" type="plane" size="100 100 1" rgba="{floor}"/>{objects}
    </worldbody></mujoco>"""
    return bare_scene(mujoco.MjModel.from_xml_string(xml))


def box(name: str, x: float, y: float, rgba: str) -> str:
    return (
        f'<geom name="{name}" type="box" size="0.25 0.25 0.001" pos="{x} {y} 0.001" rgba="{rgba}"/>'
    )


def posed(scene: Scene) -> mujoco.MjData:
    data = mujoco.MjData(scene.model)
    mujoco.mj_forward(scene.model, data)
    return data


def take_image(
    scene: Scene, params: CameraParams = CLEAN, name: str = "vehicle/camera", tick: int = 0
) -> Bytes:
    with closing(CameraSensor(scene, params, 3, name)) as sensor:
        return sensor.render(sensor.snapshot(posed(scene)), tick)


def centroid(mask: NDArray[np.bool_]) -> Array:
    """(u, v) pixel centre of a blob, pixel centres at integers."""
    rows, cols = np.nonzero(mask)
    assert rows.size > 20
    return np.array([cols.mean(), rows.mean()])


def project(scene: Scene, world: Array, lever: Array | None = None) -> Array:
    k = CameraSensor(scene, CLEAN, 0).intrinsics()
    data = posed(scene)
    body = scene.model.body("vehicle/quadrotor").id
    world_from_body = Pose(data.xmat[body].reshape(3, 3), data.xpos[body])
    body_from_camera = Pose(BODY_FROM_DOWNWARD_OPTICAL, np.zeros(3) if lever is None else lever)
    point = (world_from_body @ body_from_camera).inverse().apply(world)
    return np.array([k.fx * point[0] / point[2] + k.cx, k.fy * point[1] / point[2] + k.cy])
