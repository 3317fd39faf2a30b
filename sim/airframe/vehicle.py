"""The airframe's parameters, from its MJCF: mass, inertia, rotors, sensor mounts.

The numbers live in ``scenes/vehicle/quadrotor.xml`` alone; another vehicle that keeps the names of
its sites and ``<numeric>`` entries works as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from touchdown.sim.api import GRAVITY_MPS2, VehicleModel
from touchdown.sim.frames import Pose, matrix_from_quat_wxyz
from touchdown.sim.typing import Array

VEHICLE_PREFIX = "vehicle/"
VEHICLE_BODY = "quadrotor"
ROTOR_COUNT = 4


@dataclass(frozen=True, kw_only=True, slots=True)
class RotorGeometry:
    """Parameters of the aerodynamics that the controller's ``VehicleModel`` does not hold."""

    positions_body: Array
    """(4, 3) m, hubs"""
    radius_m: float
    drag: float
    """In-plane drag of one rotor, N / ((rad/s)(m/s))"""
    inflow: float
    """Thrust lost by axial inflow, N / ((rad/s)(m/s))"""


class SensorMounts(NamedTuple):
    """Poses of the sensors on the body: body_from_imu, body_from_lidar and so on."""

    imu: Pose
    lidar: Pose
    camera: Pose
    camera_right: Pose


def vehicle_body_id(model: mujoco.MjModel, prefix: str = VEHICLE_PREFIX) -> int:
    """Id of the vehicle's root body. Raises ValueError where there is none."""
    name = prefix + VEHICLE_BODY
    body_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if body_id < 0:
        raise ValueError(f"the scene has no vehicle: body {name!r} is missing from the MJCF model")
    return int(body_id)


def vehicle_model(model: mujoco.MjModel, prefix: str = VEHICLE_PREFIX) -> VehicleModel:
    """Mass properties and rotor coefficients. Raises ValueError when the MJCF lacks one of them."""
    body_id = vehicle_body_id(model, prefix)
    geometry = rotor_geometry(model, prefix)
    mass = float(model.body_mass[body_id])
    principal_axes = matrix_from_quat_wxyz(model.body_iquat[body_id])
    inertia = principal_axes @ np.diag(model.body_inertia[body_id]) @ principal_axes.T
    thrust = _number(model, prefix, "thrust_coefficient")
    hover_speed = np.sqrt(mass * GRAVITY_MPS2 / (ROTOR_COUNT * thrust))
    return VehicleModel(
        mass_kg=mass,
        inertia_kgm2=np.diag(inertia).copy(),
        rotor_xy_m=geometry.positions_body[:, :2].copy(),
        rotor_spin=_numbers(model, prefix, "rotor_spin", ROTOR_COUNT),
        thrust_coefficient=thrust,
        torque_coefficient=_number(model, prefix, "torque_coefficient"),
        rotor_speed_min=_number(model, prefix, "rotor_speed_min"),
        rotor_speed_max=_number(model, prefix, "rotor_speed_max"),
        motor_time_constant_s=_number(model, prefix, "motor_time_constant"),
        linear_drag=float(ROTOR_COUNT * geometry.drag * hover_speed),
        leg_height_m=float(-foot_positions(model, prefix)[:, 2].min()),
        footprint_radius_m=float(
            np.linalg.norm(geometry.positions_body[:, :2], axis=1).max() + geometry.radius_m
        ),
        rotor_inflow=geometry.inflow,
        quadratic_drag=_optional_number(model, prefix, "fuselage_drag"),
    )


def rotor_geometry(model: mujoco.MjModel, prefix: str = VEHICLE_PREFIX) -> RotorGeometry:
    """Hubs from the sites ``rotor_0`` ... ``rotor_3``."""
    positions = [_site_pose(model, prefix, f"rotor_{i}").translation for i in range(ROTOR_COUNT)]
    return RotorGeometry(
        positions_body=np.stack(positions),
        radius_m=_number(model, prefix, "rotor_radius"),
        drag=_number(model, prefix, "rotor_drag"),
        inflow=_number(model, prefix, "rotor_inflow"),
    )


def sensor_mounts(model: mujoco.MjModel, prefix: str = VEHICLE_PREFIX) -> SensorMounts:
    """Poses of the sites ``imu``, ``lidar``, ``camera`` and ``camera_right``."""
    return SensorMounts(
        imu=_site_pose(model, prefix, "imu"),
        lidar=_site_pose(model, prefix, "lidar"),
        camera=_site_pose(model, prefix, "camera"),
        camera_right=_site_pose(model, prefix, "camera_right"),
    )


def foot_positions(model: mujoco.MjModel, prefix: str = VEHICLE_PREFIX) -> Array:
    """(F, 3) m, body frame: the lowest points of the feet (spheres named ``leg_*``)."""
    body_id = vehicle_body_id(model, prefix)
    feet = [
        model.geom_pos[geom_id] - np.array([0.0, 0.0, model.geom_size[geom_id, 0]])
        for geom_id in _geoms_of(model, body_id)
        if model.geom_type[geom_id] == mujoco.mjtGeom.mjGEOM_SPHERE
        and model.geom(geom_id).name.startswith(prefix + "leg")
    ]
    if not feet:
        raise ValueError(f"the vehicle has no feet: no sphere geom is named {prefix}leg_*")
    return np.stack(feet)


def _geoms_of(model: mujoco.MjModel, body_id: int) -> range:
    first = int(model.body_geomadr[body_id])
    return range(first, first + int(model.body_geomnum[body_id]))


def _site_pose(model: mujoco.MjModel, prefix: str, name: str) -> Pose:
    site_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, prefix + name)
    if site_id < 0:
        raise ValueError(f"the vehicle's MJCF has no site {prefix + name!r}; add it")
    return Pose(matrix_from_quat_wxyz(model.site_quat[site_id]), np.array(model.site_pos[site_id]))


def _number(model: mujoco.MjModel, prefix: str, name: str) -> float:
    return float(_numbers(model, prefix, name, 1)[0])


def _optional_number(model: mujoco.MjModel, prefix: str, name: str) -> float:
    """The entry's value; 0 where the MJCF has none."""
    known = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, prefix + name) >= 0
    return _number(model, prefix, name) if known else 0.0


def _numbers(model: mujoco.MjModel, prefix: str, name: str, count: int) -> Array:
    numeric_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, prefix + name)
    if numeric_id < 0:
        raise ValueError(f"the vehicle's MJCF has no <numeric name={prefix + name!r}>; add it")
    if model.numeric_size[numeric_id] != count:
        raise ValueError(f"<numeric name={prefix + name!r}> must hold {count} value(s)")
    address = int(model.numeric_adr[numeric_id])
    return np.array(model.numeric_data[address : address + count])
