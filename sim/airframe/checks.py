"""What a vehicle's MJCF must hold so that it can fly and land; each mistake is one line."""

from collections.abc import Iterator
from itertools import combinations
from typing import Any

import mujoco
import numpy as np
from scipy.spatial import ConvexHull, QhullError

from touchdown.sim.airframe.vehicle import (
    foot_positions,
    rotor_geometry,
    rotor_sites,
    sensor_mounts,
    vehicle_body_id,
    vehicle_model,
)
from touchdown.sim.api import AIR_DENSITY_KGPM3, GRAVITY_MPS2, VehicleModel
from touchdown.sim.geometry.tessellation import geom_mesh
from touchdown.sim.typing import Array

MAX_ROTORS = 12
"""PX4 knows no more"""
MIN_THRUST = 1.5
"""least thrust of all rotors over the weight: errors of mass, thrust and a low battery take a
quarter of it"""
_APART_M = 0.01
_UPRIGHT = float(np.cos(np.radians(5.0)))
_DOWNWARD = 0.5
"""cosine of the largest angle between the camera's axis and straight down"""
_TRIP_MPS = 0.5
"""horizontal speed of a touchdown at which a foot catches, the largest of `bench touchdown`"""
_BELOW_M = 0.005


def checked_vehicle(model: mujoco.MjModel, prefix: str = "") -> VehicleModel:
    """The vehicle of a compiled MJCF. Raises ValueError, one line that names what is wrong and what
    would be right."""
    problem = next(_problems(model, prefix), "")
    if problem:
        raise ValueError(problem)
    return vehicle_model(model, prefix)


def _problems(model: Any, prefix: str) -> Iterator[str]:
    sites = rotor_sites(model, prefix)
    if not 4 <= len(sites) <= MAX_ROTORS:
        yield f"it has {len(sites)} rotors, the sites rotor_0 ...; give it 4 to {MAX_ROTORS}"
    for (i, one), (j, other) in combinations(enumerate(sites), 2):
        if np.linalg.norm(one.translation - other.translation) < _APART_M:
            yield f"sites rotor_{i} and rotor_{j} lie on one point; move each to its own hub"
    for i, site in enumerate(sites):
        if site.rotation[2, 2] < _UPRIGHT:
            yield f"site rotor_{i} leans; thrust acts along the body's z: leave out its rotation"
    yield from _mass_problems(model, prefix)
    vehicle = vehicle_model(model, prefix)
    yield from _rotor_problems(vehicle)
    mounts = sensor_mounts(model, prefix)
    if mounts.camera.rotation[2, 2] > -_DOWNWARD:
        yield (
            "site camera_0 does not look down; its z axis is the view, x right in the image: "
            "xyaxes='0 -1 0 -1 0 0' looks straight down with forward at the top"
        )
    if mounts.lidar.rotation[2, 2] > 0.0:
        yield (
            "site lidar_0 looks up; its z axis is the boresight, x the long axis of its view: "
            "xyaxes='0 -1 0 -1 0 0' looks straight down"
        )
    yield from _leg_problems(model, prefix, vehicle)


def _mass_problems(model: Any, prefix: str) -> Iterator[str]:
    body = vehicle_body_id(model, prefix)
    if not model.body_mass[body] > 0.0:
        yield "the body has no mass; give its geoms a mass, or the body an <inertial>"
    moments = np.sort(model.body_inertia[body])
    if not moments[0] > 1e-9 or moments[0] + moments[1] < moments[2] * (1.0 - 1e-6):
        yield (
            f"the moments of inertia {moments} kg m^2 are those of no solid body; correct "
            "diaginertia of its <inertial>, or leave it out: the geoms' masses give it"
        )


def _rotor_problems(vehicle: VehicleModel) -> Iterator[str]:
    for name in ("thrust_coefficient", "torque_coefficient", "rotor_speed_max",
                 "motor_time_constant_s"):  # fmt: skip
        if not getattr(vehicle, name) > 0.0:
            yield f"<numeric name='{name.removesuffix('_s')}'> must be above 0"
    if not 0.0 <= vehicle.rotor_speed_min < vehicle.rotor_speed_max:
        yield "<numeric name='rotor_speed_min'> must be below rotor_speed_max"
    if (np.abs(vehicle.rotor_spin) != 1.0).any():
        yield "<numeric name='rotor_spin'> must hold 1 or -1 for each rotor"
    weight = vehicle.mass_kg * GRAVITY_MPS2
    thrust = len(vehicle.rotor_spin) * vehicle.thrust_coefficient * vehicle.rotor_speed_max**2
    if thrust < MIN_THRUST * weight:
        yield (
            f"it is too heavy for its thrust: {weight:.1f} N of weight, {thrust:.1f} N of thrust "
            f"at rotor_speed_max, which must be {MIN_THRUST:g} times as much; correct "
            "thrust_coefficient (N per (rad/s)^2), rotor_speed_max (rad/s) or the mass (kg)"
        )
    if vehicle.torque_coefficient > 0.2 * vehicle.thrust_coefficient:
        yield (
            "torque_coefficient is more than a fifth of thrust_coefficient (metres); a propeller "
            "has about a tenth of its radius"
        )


def _leg_problems(model: Any, prefix: str, vehicle: VehicleModel) -> Iterator[str]:
    feet = foot_positions(model, prefix)
    if len(feet) < 3 or not support_distance_m(feet) > 0.0:
        yield (
            f"the {len(feet)} feet, the sites leg_0 ..., do not stand around the centre of mass; "
            "give three or more on all sides of it"
        )
    low = -vehicle.leg_height_m
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for geom in np.flatnonzero(model.geom_conaffinity | model.geom_contype):
        if (mesh := geom_mesh(model, int(geom), 0.0)) is None:
            continue
        up = data.geom_xmat[geom].reshape(3, 3)[2]
        bottom = data.geom_xpos[geom, 2] + float((mesh[0] @ up).min())
        if bottom < low - _BELOW_M and not model.geom(geom).name.startswith(f"{prefix}leg"):
            yield (
                f"geom '{model.geom(geom).name}' reaches {low - bottom:.3f} m below the feet; move "
                "the sites leg_* to the lowest points, or set contype and conaffinity 0"
            )


def support_distance_m(feet: Array) -> float:
    """Horizontal distance from the centre of mass, the origin, to the nearest edge between feet
    (F, 3) m; 0 or less where it lies outside."""
    try:
        hull = ConvexHull(feet[:, :2])
    except (QhullError, ValueError):  # fewer than three, or all in line
        return 0.0
    return float(-hull.equations[:, 2].max())


def tipping_slope_deg(model: mujoco.MjModel, prefix: str = "") -> float:
    """The slope on which a vehicle that comes down at `_TRIP_MPS` along it, and whose lower feet
    catch, has just the energy to tip over them; 0 where it tips on level ground.

    Tripping turns the momentum into a rotation about the line between two feet, of which J is the
    moment of inertia: m v h = J w. It tips where J w^2 / 2 lifts the centre of mass over that line.
    """
    vehicle, feet = vehicle_model(model, prefix), foot_positions(model, prefix)
    aside, height = support_distance_m(feet), vehicle.leg_height_m
    reach = float(np.hypot(aside, height))
    inertia = float(vehicle.inertia_kgm2[:2].max()) + vehicle.mass_kg * reach**2
    lifted = 0.5 * vehicle.mass_kg * (_TRIP_MPS * height) ** 2 / (inertia * GRAVITY_MPS2 * reach)
    if lifted >= 1.0:
        return 0.0
    return max(float(np.degrees(np.arctan2(aside, height) - np.arccos(1.0 - lifted))), 0.0)


def induced_speed_mps(model: mujoco.MjModel, prefix: str = "") -> float:
    """Speed of the air through the discs in hover, by momentum theory. A descent as fast flies in
    its own vortex ring. Discs over one another share the air of one."""
    vehicle, geometry = vehicle_model(model, prefix), rotor_geometry(model, prefix)
    columns: list[Array] = []
    for hub in geometry.positions_body[:, :2]:
        if all(np.linalg.norm(hub - other) > geometry.radius_m for other in columns):
            columns.append(hub)
    area = len(columns) * np.pi * geometry.radius_m**2
    weight = vehicle.mass_kg * GRAVITY_MPS2
    return float(np.sqrt(weight / (2.0 * AIR_DENSITY_KGPM3 * area)))
