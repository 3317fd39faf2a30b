"""The airframe's parameters, from its MJCF: mass, inertia, rotors, sensor mounts.

All numbers are those of the file: sites give places, ``<numeric>`` entries the rest
(docs/vehicles.md).
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import mujoco
import numpy as np

from touchdown.sim.airframe.battery import PowerSystem
from touchdown.sim.api import GRAVITY_MPS2, VehicleModel
from touchdown.sim.frames import Pose, matrix_from_quat_wxyz
from touchdown.sim.typing import Array

VEHICLE_PREFIX = "vehicle/"
VEHICLE_BODY = "quadrotor"
"""the vehicle's body in a composed scene, whatever the vehicle"""
IDLE_FRACTION = 0.14
"""of the highest speed, that of a motor that idles, where the file names none"""
MOTOR_TIME_CONSTANT_S = 0.04
_STALL_RATIO = 0.1814
"""axial speed at which a propeller's thrust vanishes, over that of its tip: an advance ratio of
0.57"""
_DRAG_OVER_INFLOW = 0.218
"""of rotors of which the file does not name the drag in their plane: that of `quadrotor`"""


@dataclass(frozen=True, kw_only=True, slots=True)
class RotorGeometry:
    """Parameters of the aerodynamics that the controller's ``VehicleModel`` does not hold."""

    positions_body: Array
    """(R, 3) m, hubs"""
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
    second_lidar: Pose | None
    """None: there is one LIDAR"""


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
    count, fastest = len(geometry.positions_body), _number(model, prefix, "rotor_speed_max")
    hover_speed = np.sqrt(mass * GRAVITY_MPS2 / (count * thrust))
    return VehicleModel(
        mass_kg=mass,
        inertia_kgm2=np.diag(inertia).copy(),
        rotor_xy_m=geometry.positions_body[:, :2].copy(),
        rotor_spin=_numbers(model, prefix, "rotor_spin", count),
        thrust_coefficient=thrust,
        torque_coefficient=_number(model, prefix, "torque_coefficient"),
        rotor_speed_min=optional_number(model, "rotor_speed_min", IDLE_FRACTION * fastest, prefix),
        rotor_speed_max=fastest,
        motor_time_constant_s=optional_number(
            model, "motor_time_constant", MOTOR_TIME_CONSTANT_S, prefix
        ),
        linear_drag=float(count * geometry.drag * hover_speed),
        leg_height_m=float(-foot_positions(model, prefix)[:, 2].min()),
        footprint_radius_m=float(
            np.linalg.norm(geometry.positions_body[:, :2], axis=1).max() + geometry.radius_m
        ),
        rotor_inflow=geometry.inflow,
        quadratic_drag=optional_number(model, "fuselage_drag", 0.0, prefix),
    )


def rotor_geometry(model: mujoco.MjModel, prefix: str = VEHICLE_PREFIX) -> RotorGeometry:
    """Hubs from the sites ``rotor_0``, ``rotor_1`` ... and aerodynamics; a file without drag and
    inflow has those of propellers of a usual pitch."""
    positions = [pose.translation for pose in rotor_sites(model, prefix)]
    radius = _number(model, prefix, "rotor_radius")
    usual = _number(model, prefix, "thrust_coefficient") / (_STALL_RATIO * radius)
    inflow = optional_number(model, "rotor_inflow", usual, prefix)
    return RotorGeometry(
        positions_body=np.stack(positions),
        radius_m=radius,
        drag=optional_number(model, "rotor_drag", _DRAG_OVER_INFLOW * inflow, prefix),
        inflow=inflow,
    )


def rotor_sites(model: mujoco.MjModel, prefix: str = VEHICLE_PREFIX) -> list[Pose]:
    """Poses of the sites ``rotor_0``, ``rotor_1`` ... on the body, one at least."""
    found = [_site_pose(model, prefix, "rotor_0")]
    while _id(model, mujoco.mjtObj.mjOBJ_SITE, f"{prefix}rotor_{len(found)}") >= 0:
        found.append(_site_pose(model, prefix, f"rotor_{len(found)}"))
    return found


def power_system(model: mujoco.MjModel, prefix: str = VEHICLE_PREFIX) -> PowerSystem:
    """``battery_cells`` and ``avionics_w``."""
    usual = PowerSystem()
    return PowerSystem(
        cells=optional_number(model, "battery_cells", usual.cells, prefix),
        avionics_w=optional_number(model, "avionics_w", usual.avionics_w, prefix),
    )


def sensor_mounts(model: mujoco.MjModel, prefix: str = VEHICLE_PREFIX) -> SensorMounts:
    """Poses of the sites ``imu``, ``lidar_0``, ``camera_0`` and ``camera_1``, the right one, and of
    ``lidar_1`` where there is one."""
    second = _id(model, mujoco.mjtObj.mjOBJ_SITE, prefix + "lidar_1") >= 0
    return SensorMounts(
        imu=_site_pose(model, prefix, "imu"),
        lidar=_site_pose(model, prefix, "lidar_0"),
        camera=_site_pose(model, prefix, "camera_0"),
        camera_right=_site_pose(model, prefix, "camera_1"),
        second_lidar=_site_pose(model, prefix, "lidar_1") if second else None,
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
    site_id = _id(model, mujoco.mjtObj.mjOBJ_SITE, prefix + name)
    if site_id < 0:
        raise ValueError(f"the vehicle's MJCF has no site {prefix + name!r}; add it")
    return Pose(matrix_from_quat_wxyz(model.site_quat[site_id]), np.array(model.site_pos[site_id]))


def _number(model: mujoco.MjModel, prefix: str, name: str) -> float:
    return float(_numbers(model, prefix, name, 1)[0])


def optional_number(
    model: mujoco.MjModel, name: str, usual: float, prefix: str = VEHICLE_PREFIX
) -> float:
    """The entry's value; ``usual`` where the MJCF has none."""
    known = _id(model, mujoco.mjtObj.mjOBJ_NUMERIC, prefix + name) >= 0
    return _number(model, prefix, name) if known else usual


def _id(model: mujoco.MjModel, kind: Any, name: str) -> int:
    return int(mujoco.mj_name2id(model, kind, name))


def _numbers(model: mujoco.MjModel, prefix: str, name: str, count: int) -> Array:
    numeric_id = _id(model, mujoco.mjtObj.mjOBJ_NUMERIC, prefix + name)
    if numeric_id < 0:
        raise ValueError(f"the vehicle's MJCF has no <numeric name={prefix + name!r}>; add it")
    if model.numeric_size[numeric_id] != count:
        raise ValueError(
            f"<numeric name={prefix + name!r}> must hold {count} value(s), not "
            f"{model.numeric_size[numeric_id]}"
        )
    address = int(model.numeric_adr[numeric_id])
    return np.array(model.numeric_data[address : address + count])
