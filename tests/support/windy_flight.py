"""A vehicle that follows the lander exactly in a wind, with the tilt and the rotor speed that the
balance of forces needs: what a lander feels of the wind."""

import dataclasses
import math
from collections.abc import Callable, Iterator

import numpy as np
from scipy.optimize import fsolve

from touchdown.landing.api import LanderView
from touchdown.landing.mission.lander import SiteLander
from touchdown.sim.api import GRAVITY_MPS2, VehicleModel
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array

from support.lander_support import PARAMS, QUICK, flat_map
from support.landing_support import LEG_HEIGHT, make_estimate, make_imu, make_obs, make_rig, view_of

STEP_TICKS = 12


def draggy_vehicle() -> VehicleModel:
    """A 4 kg quadrotor that holds against a wind of 15 m/s, and not against one of 18 m/s."""
    return dataclasses.replace(
        make_rig().vehicle, thrust_coefficient=6e-5, linear_drag=0.6, rotor_speed_max=560.0,
        rotor_inflow=1.8e-3, quadratic_drag=0.05,
    )  # fmt: skip


@dataclasses.dataclass(frozen=True, slots=True)
class Balance:
    """Attitude (world_from_body) and mean rotor speed (rad/s) of a motion."""

    rotation: Array
    speed: float


def balance(vehicle: VehicleModel, through_air: Array, acceleration: Array) -> Balance:
    """Solves Newton's second law for thrust axis and rotor speed: three equations, three unknown
    (the axis by its horizontal components)."""
    mass, weight = vehicle.mass_kg, vehicle.mass_kg * GRAVITY_MPS2
    hover = math.sqrt(weight / (4.0 * vehicle.thrust_coefficient))
    per_rotor = vehicle.linear_drag / (4.0 * hover)

    air_x, air_y, air_z = through_air.tolist()
    wanted = (mass * acceleration + [0.0, 0.0, weight]).tolist()
    body = vehicle.quadratic_drag * math.hypot(air_x, air_y, air_z)

    def excess(unknown: Array) -> list[float]:
        x, y, fraction = unknown.tolist()
        z = math.sqrt(max(1.0 - x * x - y * y, 1e-6))
        speed, along = fraction * hover, air_x * x + air_y * y + air_z * z
        thrust = vehicle.thrust_coefficient * speed**2 - vehicle.rotor_inflow * speed * along
        disc, lift = 4.0 * per_rotor * speed, 4.0 * thrust
        return [
            (lift * up - disc * (air - along * up) - body * air - force) / weight
            for up, air, force in zip((x, y, z), (air_x, air_y, air_z), wanted, strict=True)
        ]

    x, y, fraction = fsolve(excess, np.array([0.02 * through_air[0], 0.02 * through_air[1], 1.0]))
    z = np.array([x, y, np.sqrt(1.0 - x * x - y * y)])
    left = np.array([0.0, z[2], -z[1]]) / math.hypot(z[1], z[2])
    return Balance(np.column_stack([np.cross(left, z), left, z]), float(fraction * hover))


def windy_run(
    wind: Callable[[float, float], Array],
    seconds: float,
    min_height_m: float = 10.0,
    **params: object,
) -> Iterator[tuple[float, LanderView, Array]]:
    """Yields time, view and reference of a landing over flat ground, every control step, in a wind
    of a time and a height above the ground."""
    rig = dataclasses.replace(make_rig(), vehicle=draggy_vehicle())
    survey = dataclasses.replace(QUICK, min_height_m=min_height_m)
    lander = SiteLander(rig, dataclasses.replace(PARAMS, slow_in_wind=True, **params), survey)
    position, velocity = np.array([0.0, 0.0, LEG_HEIGHT]), np.zeros(3)
    acceleration, motors = np.zeros(3), False
    hover = np.sqrt(rig.vehicle.mass_kg * GRAVITY_MPS2 / (4 * rig.vehicle.thrust_coefficient))
    map_view = view_of(flat_map(), None)
    for tick in range(0, round(seconds * 600), STEP_TICKS):
        time_s = tick / 600.0
        height = position[2] - LEG_HEIGHT
        airborne = height > 1e-9
        balanced = Balance(np.eye(3), hover if motors else 0.0)
        if airborne:
            balanced = balance(rig.vehicle, velocity - wind(time_s, height), acceleration)
        obs = make_obs(
            tick, imu=(make_imu(tick, GRAVITY_MPS2),), rotor_speed_radps=np.full(4, balanced.speed)
        )
        estimate = dataclasses.replace(
            make_estimate(tick, Pose(balanced.rotation, position.copy()), velocity),
            acceleration_odom=acceleration,
        )
        setpoint = lander.update(obs, estimate, map_view)
        yield time_s, lander.view(), setpoint.position_odom
        motors = setpoint.motors_on
        if motors:
            position = setpoint.position_odom.copy()
            position[2] = max(position[2], LEG_HEIGHT)
            velocity, acceleration = setpoint.velocity_odom, setpoint.acceleration_odom
