"""The simulated world: physics, air, sensors and their delays behind ``sim.api.World``."""

import math
from dataclasses import fields, replace
from typing import TypeVar

import mujoco
import numpy as np

from touchdown.scenes.api import Scene
from touchdown.sim import api
from touchdown.sim.air import Airflow
from touchdown.sim.airframe.battery import Battery
from touchdown.sim.airframe.contacts import ContactSensor, GroundProbe
from touchdown.sim.airframe.deviations import SpeedTelemetry, draw_deviations, true_model
from touchdown.sim.airframe.physics import prepare_physics, settle_on_ground
from touchdown.sim.airframe.rotors import Rotors
from touchdown.sim.airframe.vehicle import (
    power_system,
    rotor_geometry,
    vehicle_body_id,
    vehicle_model,
)
from touchdown.sim.camera.degradations import sun_elevation_deg
from touchdown.sim.camera.sensor import Snapshot
from touchdown.sim.delivery import check_rates
from touchdown.sim.effects import WorldRecord, fault_records
from touchdown.sim.faults.disturbances import Disturbances
from touchdown.sim.faults.injector import FaultInjector
from touchdown.sim.faults.marks import Marks
from touchdown.sim.frames import Pose, matrix_from_quat_wxyz
from touchdown.sim.imaging_sensors import ImagingSensors
from touchdown.sim.imu import ImuSensor, MountedImu
from touchdown.sim.intruders import Intruders
from touchdown.sim.moving import MovingBodies
from touchdown.sim.navigation.channels import NavSensors
from touchdown.sim.typing import Array

_Sheet = TypeVar("_Sheet", api.LidarSheet, api.ImuSheet, api.GpsSheet, api.BarometerSheet)

_NOTHING = api.SensorNeeds()
_NEAR_GROUND_M = 4.0
"""Height above which the ground adds less than 0.02 % to the thrust, and is looked at less
often."""
_PROBE_STEPS = 8


class MujocoWorld:
    """One vehicle in one scene. The same arguments and commands give the same flight to the bit,
    with any number of ``sim.threads``.

    The first scan ends, and the first image is exposed, one period after tick 0. The world writes
    the physics options of ``scene.model`` (time step, air, wind). Raises ValueError for
    incompatible rates, parameters out of range, a scene without vehicle or a take-off spot on which
    the vehicle cannot stand. ``drawn``: ``model`` may be drawn, vehicle and all.
    """

    rig: api.SensorRig

    def __init__(
        self,
        scene: Scene,
        params: api.WorldParams,
        seed: int,
        needs: api.SensorNeeds = _NOTHING,
        drawn: bool = False,
    ) -> None:
        check_rates(params.sim, needs)
        self._vehicle = vehicle_model(scene.model)
        self._count = len(self._vehicle.rotor_spin)
        self._deviations = draw_deviations(params.vehicle_error, seed, self._count)
        nominal = scene
        scene = replace(scene, model=true_model(scene.model, self._deviations, drawn))
        self._scene, self._params, self._seed, self._needs = scene, params, seed, needs
        self._sim, self._model = params.sim, scene.model
        self._step_s = self._sim.control_ticks / self._sim.tick_hz
        self._prepare_body()
        self._imaging = ImagingSensors(nominal, params, seed, self._moving)
        self._imaging.add(needs)
        self._nav = self._make_nav()
        self.rig = self._make_rig()
        self.reset()

    # ------------------------------------------------------------------------ preparation

    def _prepare_body(self) -> None:
        prepare_physics(self._model, self._sim.tick_hz)
        self._data = mujoco.MjData(self._model)
        self._moving = MovingBodies(self._scene)
        self._moving.write(self._data, 0.0)
        self._start_state = settle_on_ground(self._scene, self._data)
        weight = self._vehicle.mass_kg * api.GRAVITY_MPS2
        self._hover_square = weight / self._vehicle.thrust_coefficient
        body_id = vehicle_body_id(self._model)
        position = int(self._model.jnt_qposadr[self._model.body_jntadr[body_id]])
        velocity = int(self._model.body_dofadr[body_id])
        # Views into MjData, so that a tick looks nothing up by name.
        self._position = self._data.qpos[position : position + 3]
        self._quat = self._data.qpos[position + 3 : position + 7]
        self._velocity = self._data.qvel[velocity : velocity + 3]
        self._angular_velocity = self._data.qvel[velocity + 3 : velocity + 6]
        self._wrench = self._data.xfrc_applied[body_id]
        self._contact_sensor = ContactSensor(self._model)
        self._ground = GroundProbe(self._model)
        self._probe_ticks = _PROBE_STEPS * self._sim.control_ticks

    def _make_nav(self) -> NavSensors:
        nav, plants = self._params.nav, self._imaging.plants
        return NavSensors(self._scene, nav, self._sim, self._needs, self._seed, plants)

    def _make_imu(self) -> MountedImu:
        hover = math.sqrt(self._hover_square / self._count)
        sim = self._sim
        sensor = ImuSensor(
            self._params.imu, sim.tick_hz, sim.imu_ticks, self._seed, hover, self._count
        )
        return MountedImu(sensor, self.rig.body_from_imu, self._hover_square)

    def _make_air(self) -> Airflow:
        leg_height = self._vehicle.leg_height_m
        return Airflow(
            self._scene,
            self._params.wind,
            self._seed,
            self._disturbances,
            self._model.opt.wind,
            span_m=2.0 * self._vehicle.footprint_radius_m,
            ground_m=float(self._position[2]) - leg_height,
            step_s=self._step_s,
        )

    def _make_rig(self) -> api.SensorRig:
        mounts, params = self._imaging.mounts, self._params
        return api.SensorRig(
            tick_hz=self._sim.tick_hz,
            body_from_imu=Pose(mounts.imu.rotation, mounts.imu.translation + params.imu.offset_m),
            body_from_lidar=mounts.lidar,
            body_from_camera=mounts.camera,
            body_from_camera_right=mounts.camera_right,
            camera=self._imaging.camera.intrinsics(),
            lidar=_sheet(api.LidarSheet, params.lidar),
            imu=_sheet(api.ImuSheet, params.imu),
            imu_ticks=self._sim.imu_ticks,
            camera_ticks=self._sim.camera_ticks,
            lidar_scan_ticks=self._sim.lidar_scan_ticks,
            compute_latency_ticks=self._sim.compute_latency_ticks,
            world_from_body_start=self._pose(),
            vehicle=self._vehicle,
            nav=api.NavSheet(
                gps=_sheet(api.GpsSheet, params.nav.gps),
                barometer=_sheet(api.BarometerSheet, params.nav.barometer),
                magnetometer=params.nav.magnetometer,
                rangefinder=params.nav.rangefinder,
            ),
            camera_readout_s=params.camera.readout_s,
        )

    # ------------------------------------------------------------------------ the protocol

    @property
    def model(self) -> mujoco.MjModel:
        """MuJoCo's model with the true vehicle: the one that moves, not a copy of it."""
        return self._model

    @property
    def data(self) -> mujoco.MjData:
        """MuJoCo's state, not a copy of it."""
        return self._data

    def require(self, needs: api.SensorNeeds) -> None:
        """Adds sensors before the flight begins; estimators state their needs only after they have
        got the rig. Raises ValueError for an incompatible rate, RuntimeError after tick 0."""
        if self._tick > 0:
            raise RuntimeError(f"sensors are added before a flight, not at tick {self._tick}")
        wanted = self._needs | needs
        check_rates(self._sim, wanted)
        self._needs = wanted
        self._imaging.add(wanted)
        self._nav = self._make_nav()

    def reset(self) -> api.Observation:
        """Returns to tick 0: on the ground at the take-off spot, rotors stopped, battery full."""
        self._imaging.clear()
        state = mujoco.mjtState.mjSTATE_INTEGRATION
        mujoco.mj_setState(self._model, self._data, self._start_state, state)
        faults, tick_hz = self._params.faults, self._sim.tick_hz
        self._marks = Marks(faults.schedule(), tick_hz)
        self._faults = FaultInjector(faults, tick_hz, self._marks)
        wind_kmh = self._params.wind.mean_kmh
        self._disturbances = Disturbances(
            faults, tick_hz, wind_kmh, self._seed, self._marks, self._count
        )
        self._moving = MovingBodies(self._scene)
        self._imaging.moving = self._moving
        self._moving.write(self._data, 0.0)
        self._intruders = Intruders(self._scene, faults.schedule(), self._marks, self._seed)
        self._air = self._make_air()
        self._air.start(self._vehicle.leg_height_m)
        mujoco.mj_forward(self._model, self._data)
        self._tick = 0
        self._clearance = 0.0
        self._truth: api.Truth | None = None
        self._rotors = Rotors(
            self._vehicle,
            rotor_geometry(self._model),
            tick_s=1.0 / self._sim.tick_hz,
            deviations=self._deviations,
        )
        self._telemetry = SpeedTelemetry(self._params.vehicle_error, self._seed, self._count)
        self._battery = Battery(
            self._sim.battery_capacity_j,
            self._sim.battery_sag,
            self._sim.battery_resistance_ohm,
            power_system(self._model),
        )
        self._imu = self._make_imu()
        self._nav = self._make_nav()
        self._mark_start()
        self._acceleration = np.zeros(3)
        self._peak_acceleration = 0.0
        self._contacts: tuple[api.Contact, ...] = self._contact_sensor.read(self._data)
        return self._observation(())

    def _mark_start(self) -> None:
        """Sets the present state as the earlier state of sensors that compare two."""
        self._imu.start(self._quat, self._velocity, self._angular_velocity)
        self._imaging.start(self._position, self._quat, self._disturbances)

    def step(self, command: api.Command) -> api.Observation:
        """Advances ``control_ticks``. Raises RuntimeError if the command or the physics is not
        finite."""
        self._take_command(command)
        self._air.step(self._tick, self._position, self._velocity)
        if self._clearance < _NEAR_GROUND_M or self._tick % self._probe_ticks == 0:
            self._clearance = self._ground.clearance(self._data, self._position)
        clearance = self._clearance
        velocity_before = self._velocity.copy()
        self._peak_acceleration = 0.0
        self._contacts = ()
        imu: list[api.ImuSample] = []
        for _ in range(self._sim.control_ticks):
            self._advance_tick(clearance)
            self._sense(imu)
        self._moving.write(self._data, self._tick / self._sim.tick_hz)
        self._acceleration = (self._velocity - velocity_before) / self._step_s
        self._battery.draw(self._rotors.shaft_power(), self._step_s)
        self._check_finite()
        return self._observation(tuple(imu))

    def start_in_air(self, position_world: Array, yaw: float) -> api.Observation:
        """Resets to a start in the air: level and at rest at (3,) ``position_world``, rotors at
        hover speed."""
        self.reset()
        self._position[:] = position_world
        self._quat[:] = np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw)
        self._velocity[:] = self._angular_velocity[:] = 0.0
        self._rotors.speeds[:] = np.sqrt(self._hover_square / len(self._rotors.speeds))
        mujoco.mj_forward(self._model, self._data)
        self._contacts = ()
        self._truth = None
        self._mark_start()
        return self._observation(())

    def height_over_ground(self) -> float:
        """Metres from the body origin down to the surface below; ``inf`` over nothing."""
        return self._ground.clearance(self._data, self._position)

    def snapshot(self) -> Snapshot:
        """The present state of the scene, for a camera other than the vehicle's."""
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        return self._imaging.camera.snapshot(self._data)

    def follow(self, phase: str, site_world: Array | None) -> None:
        """As `sim.api.World.follow`."""
        if self._marks.any:
            ground = -math.inf if site_world is None else float(site_world[2])
            height = float(self._position[2]) - self._vehicle.leg_height_m - ground
            self._marks.follow(self._tick, phase, height)
        site = self._position if site_world is None else site_world
        self._intruders.update(self._tick, self._sim.tick_hz, self._data, self._moving, site)

    def truth(self) -> api.Truth:
        """The true state now. ``acceleration_world`` is dv/dt: 0 in hover and at rest.
        ``contacts`` are those of the last tick of the control step that had any."""
        if self._truth is None or self._truth.tick != self._tick:
            self._truth = self._read_truth()
        return self._truth

    def _read_truth(self) -> api.Truth:
        return api.Truth(
            tick=self._tick,
            time_s=self._tick / self._sim.tick_hz,
            world_from_body=self._pose(),
            velocity_world=_frozen(self._velocity),
            acceleration_world=_frozen(self._acceleration),
            angular_velocity_body=_frozen(self._angular_velocity),
            wind_world=_frozen(self._air.velocity),
            rotor_speed_radps=_frozen(self._rotors.speeds),
            contacts=self._contacts,
            peak_contact_accel=self._peak_acceleration,
            energy_used_j=self._battery.energy_used_j,
            living_world=_frozen(self._moving.living(self._data)),
            intruders_world=_frozen(self._moving.living(self._data, intruders=True)),
            deck=self._moving.deck(self._tick / self._sim.tick_hz),
        )

    def record(self) -> WorldRecord:
        """Faults, effects and deviations of the flight so far."""
        sensors = {name: effects.delivered for name, effects in self._imaging.effects().items()}
        faults = [
            *self._faults.summary(),
            *self._disturbances.summary(self._step_s),
            *self._intruders.summary(self._tick / self._sim.tick_hz),
            *fault_records(self._params.faults, sensors, sun_elevation_deg(self._model)),
        ]
        drawn = self._deviations.sizes() | self._imu.sensor.errors.sizes()
        effects, renderer = {**sensors, "air": self._air.effects}, self._imaging.camera.renderer
        return WorldRecord(faults, effects, drawn, renderer)

    def take_textures(self) -> None:
        """Frees the memory that the scene has for its textures once the cameras have them, so that
        nobody else can draw it: for the owner of a scene that flies once."""
        self._imaging.take_textures()

    def close(self) -> None:
        """Ends the worker threads and frees the camera. The world is unusable afterwards."""
        self._imaging.close()

    # ------------------------------------------------------------------------ one step

    def _take_command(self, command: api.Command) -> None:
        if not math.isfinite(sum(command.rotor_speed_radps.tolist())):
            raise RuntimeError(
                f"tick {self._tick}: the command {command.rotor_speed_radps} is not finite"
            )
        if self._battery.empty:
            self._rotors.cut()
        else:
            fraction = self._disturbances.rotor_speed_fraction(self._tick)
            self._rotors.speed_fraction = self._battery.speed_fraction
            self._rotors.demand(command.rotor_speed_radps, fraction)

    def _advance_tick(self, clearance_m: float) -> None:
        before = self._velocity.tolist()
        relative_rate = self._angular_velocity
        if self._air.rotation is not None:  # relative to the air
            relative_rate = relative_rate - matrix_from_quat_wxyz(self._quat).T @ self._air.rotation
        self._wrench[:] = self._rotors.step(
            self._quat, self._velocity, relative_rate, self._air.velocity, clearance_m
        )
        mujoco.mj_step(self._model, self._data)
        self._tick += 1
        if self._data.ncon:
            self._contacts = self._contact_sensor.read(self._data)
        x, y, z = self._velocity.tolist()
        change = ((x - before[0]) ** 2 + (y - before[1]) ** 2 + (z - before[2]) ** 2) ** 0.5
        self._peak_acceleration = max(self._peak_acceleration, change * self._sim.tick_hz)

    def _sense(self, imu: list[api.ImuSample]) -> None:
        """Takes the measurements of this tick."""
        motion = self._position, self._quat, self._velocity, self._angular_velocity
        if self._tick % self._sim.imu_ticks == 0:
            imu.append(self._imu.sample(self._tick, *motion[1:], self._rotors.speeds))
        if self._nav.listening:
            self._nav.sense(self._tick, self._data, *motion)
        self._imaging.sense(self._tick, self._data, self._position, self._quat)

    # ------------------------------------------------------------------------ messages

    def _observation(self, imu: tuple[api.ImuSample, ...]) -> api.Observation:
        obs = api.Observation(
            tick=self._tick,
            time_s=self._tick / self._sim.tick_hz,
            imu=imu,
            scans=self._imaging.collect_scans(self._tick),
            images=self._imaging.collect_images(self._tick),
            gps=self._nav.gps.collect(self._tick),
            barometer=self._nav.barometer.collect(self._tick),
            magnetometer=self._nav.magnetometer.collect(self._tick),
            rangefinder=self._nav.rangefinder.collect(self._tick),
            rotor_speed_radps=_frozen(self._telemetry.read(self._rotors.speeds)),
            battery_fraction=self._battery.fraction,
        )
        return self._faults.apply(obs)

    def _pose(self) -> Pose:
        rotation = matrix_from_quat_wxyz(self._quat)
        rotation.setflags(write=False)
        return Pose(rotation, _frozen(self._position))

    def _check_finite(self) -> None:
        if not math.hypot(*self._position.tolist(), *self._velocity.tolist()) < 1e6:
            raise RuntimeError(
                f"tick {self._tick}: the physics diverged (position {self._position}, "
                f"velocity {self._velocity})"
            )


def _sheet(kind: type[_Sheet], params: _Sheet) -> _Sheet:
    """The data sheet's part of a sensor's parameters."""
    return kind(**{field.name: getattr(params, field.name) for field in fields(kind)})


def _frozen(array: Array) -> Array:
    """A read-only copy."""
    copy = array.copy()
    copy.setflags(write=False)
    return copy
