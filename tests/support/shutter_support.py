"""A camera in motion over boxes on a floor: what its rows see, drawn instant by instant."""

import dataclasses
from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Scene
from touchdown.sim.camera.gl import Snapshot
from touchdown.sim.camera.optics import raster_rows, through_lens
from touchdown.sim.camera.sensor import CameraSensor
from touchdown.sim.frames import Pose, quat_wxyz_from_matrix, so3_exp
from touchdown.sim.moving import BodyTrack
from touchdown.sim.typing import Array

from support.camera_support import HEADLIGHT, HEIGHT_M, make_scene

Motion = Callable[[float], Pose]


def boxes_scene(seed: int = 0, count: int = 25) -> Scene:
    """A speckled floor 20 m below the camera, and speckled boxes up to 6 m high on it."""
    rng = np.random.default_rng(seed)
    boxes = [
        f'<geom type="box" size="1.2 0.9 {h}" pos="{x} {y} {h}" material="speckled"/>'
        for x, y, h in zip(
            rng.uniform(-10.0, 10.0, count), rng.uniform(-14.0, 14.0, count),
            rng.uniform(0.2, 3.0, count), strict=True,
        )
    ]  # fmt: skip
    plain = make_scene()
    model = mujoco.MjModel.from_xml_string(f"""
    <mujoco>{HEADLIGHT}
      <asset>
        <texture name="speckles" type="2d" builtin="flat" rgb1="0.3 0.3 0.3" width="200"
                 height="200" mark="random" markrgb="0.9 0.9 0.9" random="0.15"/>
        <material name="speckled" texture="speckles" texuniform="true" texrepeat="0.05 0.05"/>
      </asset>
      <worldbody>
        <body name="vehicle/quadrotor" pos="0 0 {HEIGHT_M}">
          <freejoint/><geom type="sphere" size="0.1" group="4"/>
          <camera name="vehicle/camera" xyaxes="0 -1 0 1 0 0"/>
        </body>
        <geom type="plane" size="100 100 1" material="speckled"/>{"".join(boxes)}
      </worldbody>
    </mujoco>""")
    return dataclasses.replace(plain, model=model)


def flight(time_s: float) -> Pose:
    """10 m/s ahead, 2 m/s aside, turning by up to 0.7 rad/s, shaken at 60 and 90 Hz."""
    shake = 2.0 * np.pi * time_s
    turn = np.array(
        [
            0.4 * time_s + 0.002 * np.sin(60.0 * shake),
            -0.5 * time_s,
            0.3 * time_s + 0.001 * np.sin(90.0 * shake),
        ]
    )
    return Pose(so3_exp(turn), np.array([10.0 * time_s, 2.0 * time_s, HEIGHT_M - time_s]))


class Stand:
    """Snapshots and tracks of a camera on a body that moves as ``motion`` says."""

    def __init__(self, scene: Scene, motion: Motion, tick_hz: int = 600) -> None:
        self._scene, self._motion, self._hz = scene, motion, tick_hz
        self._data = mujoco.MjData(scene.model)

    def snapshot(self, sensor: CameraSensor, time_s: float) -> Snapshot:
        pose = self._motion(time_s)
        self._data.qpos[:3] = pose.translation
        self._data.qpos[3:7] = quat_wxyz_from_matrix(pose.rotation)
        mujoco.mj_forward(self._scene.model, self._data)
        return sensor.snapshot(self._data)

    def track(self, first_tick: int, last_tick: int) -> BodyTrack:
        times: Array = np.arange(first_tick, last_tick + 1) / self._hz
        poses = [self._motion(float(t)) for t in times]
        return BodyTrack(
            times_s=times,
            positions=np.array([p.translation for p in poses]),
            quats_wxyz=np.array([quat_wxyz_from_matrix(p.rotation) for p in poses]),
        )

    def rows(
        self, sensor: CameraSensor, readout_s: float, tick: int = 0, end_s: float = 0.0
    ) -> NDArray[np.uint8]:
        """The image whose last row is exposed at ``end_s``, drawn in the middle of the readout."""
        drawn = round((end_s - 0.5 * readout_s) * self._hz)
        at_s, margin = drawn / self._hz, round((0.5 * readout_s + 0.02) * self._hz)
        track = self.track(drawn - margin, drawn + margin)
        return sensor.render_rows(self.snapshot(sensor, at_s), at_s, track, end_s, tick)


def drawn_by_rows(sensor: CameraSensor, instants: list[Snapshot]) -> NDArray[np.uint8]:
    """The image without noise of a camera whose rows, split evenly, are each drawn from an instant
    of their own, the oldest first."""
    image = np.empty((sensor._params.height, sensor._params.width, 3), dtype=np.uint8)
    edges = np.linspace(0, len(image), len(instants) + 1).round().astype(int).tolist()
    for instant, start, stop in zip(instants, edges[:-1], edges[1:], strict=True):
        rows = slice(start, stop)
        first, last = raster_rows(sensor._lens, rows)
        drawn = sensor._drawn(sensor._own_stage(), instant, first, last).image
        upright = np.ascontiguousarray(drawn[::-1])
        image[rows] = through_lens(sensor._lens, upright, first, rows, smooth=True)
    return image
