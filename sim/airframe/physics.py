"""MuJoCo's options and the vehicle's start on the ground."""

from typing import Any

import mujoco
import numpy as np

from touchdown.scenes.api import Scene
from touchdown.sim.airframe.contacts import GroundProbe
from touchdown.sim.airframe.vehicle import foot_positions, vehicle_body_id
from touchdown.sim.api import AIR_DENSITY_KGPM3, GRAVITY_MPS2
from touchdown.sim.frames import matrix_from_quat_wxyz, rotation_from_yaw, tilt_from_rotation
from touchdown.sim.typing import Array

AIR_VISCOSITY_PAS = 1.8e-5
SETTLE_S = 2.0
START_GAP_M = 0.002
MAX_START_TILT = np.radians(15.0)
MAX_START_SPEED_MPS = 0.01


def prepare_physics(model: Any, tick_hz: int) -> None:
    """Sets the options that a flight relies on; they override those of the MJCF."""
    model.opt.timestep = 1.0 / tick_hz
    model.opt.gravity[:] = (0.0, 0.0, -GRAVITY_MPS2)
    model.opt.density = AIR_DENSITY_KGPM3
    model.opt.viscosity = AIR_VISCOSITY_PAS
    model.opt.wind[:] = 0.0
    # A diverged state must stay visible, not jump back to the start.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET


def settle_on_ground(scene: Scene, data: Any) -> Array:
    """Stands the vehicle on its take-off spot until it rests there.

    Returns MuJoCo's integration state with time 0. ValueError: no ground below the spot, or the
    vehicle slides or tips.
    """
    model = scene.model
    body_id = vehicle_body_id(model)
    if model.body_jntnum[body_id] != 1 or model.jnt_type[model.body_jntadr[body_id]] != 0:
        raise ValueError("the vehicle's body must have one free joint and no other")
    qpos = data.qpos[model.jnt_qposadr[model.body_jntadr[body_id]] :][:7]
    qvel = data.qvel[model.body_dofadr[body_id] :][:6]
    feet = foot_positions(model)
    half_yaw = 0.5 * scene.takeoff_yaw
    qpos[:2] = scene.takeoff_xy_m
    qpos[3:] = (np.cos(half_yaw), 0.0, 0.0, np.sin(half_yaw))
    mujoco.mj_forward(model, data)
    qpos[2] = _ground_below_feet(scene, data, feet, qpos[2]) - feet[:, 2].min() + START_GAP_M
    start_xy = qpos[:2].copy()
    for _ in range(round(SETTLE_S / model.opt.timestep)):
        mujoco.mj_step(model, data)
    tilt = tilt_from_rotation(matrix_from_quat_wxyz(qpos[3:]))
    slid = float(np.linalg.norm(qpos[:2] - start_xy))
    if not (
        tilt < MAX_START_TILT and slid < 0.1 and np.linalg.norm(qvel[:3]) < MAX_START_SPEED_MPS
    ):
        raise ValueError(
            f"the vehicle does not stand at take-off spot {np.round(scene.takeoff_xy_m, 2)} of "
            f"scene {scene.name!r} (tilt {np.degrees(tilt):.0f} deg, slid {slid:.2f} m); "
            "choose flatter ground"
        )
    data.time = 0.0
    state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
    return state


def _ground_below_feet(scene: Scene, data: Any, feet: Array, start_z: float) -> float:
    """Height of the highest ground below a foot, for feet (F, 3) in the body frame."""
    probe = GroundProbe(scene.model)
    heights = []
    for foot in feet @ rotation_from_yaw(scene.takeoff_yaw).T:
        start = np.array([*(scene.takeoff_xy_m + foot[:2]), start_z])
        heights.append(start_z - probe.clearance(data, start))
    if not np.all(np.isfinite(heights)):
        raise ValueError(
            f"there is no ground below take-off spot {np.round(scene.takeoff_xy_m, 2)} of scene "
            f"{scene.name!r}"
        )
    return max(heights)
