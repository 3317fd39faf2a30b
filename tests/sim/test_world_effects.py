"""What the world's parameters and faults do in a flight: each arrives where it acts."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from touchdown.scenes.api import Scene
from touchdown.sim import api as sim
from touchdown.sim.airframe.vehicle import rotor_geometry
from touchdown.sim.effects import Effects, Returns
from touchdown.sim.faults.disturbances import Disturbances
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array
from touchdown.sim.world import MujocoWorld

from support.places import scene_of
from support.worlds import NO_NOISE, STILL_AIR

XML = """<mujoco><worldbody>
  <geom name="lawn_floor" type="plane" size="60 60 0.1"/><site name="takeoff" pos="-8 0 0"/>
  <geom name="trees_1" type="ellipsoid" size="2 3 2" pos="0 5 4"/>
</worldbody></mujoco>"""


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scene_of(XML)


class Flown:
    """Half a second, or ``steps``, from a hover at ``height``."""

    def __init__(
        self, scene: Scene, needs: sim.SensorNeeds | None = None, height: float = 12.0,
        speed_fraction: float = 1.0, steps: int = 100, **groups: Any,
    ) -> None:  # fmt: skip
        params = {"sim": sim.SimParams(threads=1), "wind": STILL_AIR, "imu": NO_NOISE}
        params |= {"camera": sim.CameraParams(width=64, height=36), **groups}
        world = MujocoWorld(scene, sim.WorldParams(**params), 3, needs or sim.SensorNeeds())
        vehicle = world.rig.vehicle
        self.hover = math.sqrt(
            vehicle.mass_kg * sim.GRAVITY_MPS2 / (4 * vehicle.thrust_coefficient)
        )
        world.start_in_air(np.array([0.0, 0.0, height]), 0.0)
        self.seen: list[sim.Observation] = []
        self.accelerations, self.poses = [], [world.truth().world_from_body]
        for _ in range(steps):
            self.seen.append(
                world.step(sim.Command(rotor_speed_radps=np.full(4, speed_fraction * self.hover)))
            )
            self.accelerations.append(world.truth().acceleration_world)
            self.poses.append(world.truth().world_from_body)
        self.truth, self.rig, self.record = world.truth(), world.rig, world.record()
        world.close()

    def forces(self) -> Array:
        """(N, 3) specific forces of the IMU."""
        return np.array([s.specific_force for obs in self.seen for s in obs.imu])

    def scans(self) -> list[sim.LidarScan]:
        return [scan for obs in self.seen for scan in obs.scans]


def test_a_weak_motor_turns_its_rotor_more_slowly(scene: Scene) -> None:
    faults = sim.FaultParams(events=("motor_loss@0",), motor=1, motor_loss_fraction=0.36)
    fractions = Flown(scene, faults=faults).truth.rotor_speed_radps / Flown(scene).hover
    np.testing.assert_allclose(fractions, [1.0, 0.8, 1.0, 1.0], atol=1e-3)


def test_scans_are_cast_from_the_true_mount(scene: Scene) -> None:
    """Ground points lie at height 0 by the mount that the fault has turned, by the rig's not."""
    faults = sim.FaultParams(
        events=("miscalibration@0",), miscalibration_deg=3.0, miscalibration_m=0.1
    )
    lidar = sim.LidarParams(range_sigma_m=0.0, angle_sigma_deg=0.0, divergence=False)
    flown = Flown(scene, sim.SensorNeeds(lidar=True), steps=40, faults=faults, lidar=lidar)
    nominal = flown.rig.body_from_lidar
    true = Disturbances(faults, 600, 0.0, 3).lidar_mount(60, nominal)
    scan = flown.scans()[0]
    body = np.array([0.0, 0.0, 12.0])

    def heights(mount: Pose) -> Array:
        ahead = (scan.points.astype(float) @ mount.rotation.T + mount.translation + body)[:, 2]
        return np.abs(ahead)[np.abs(ahead) < 1.5]

    assert np.median(heights(true)) < 0.01  # the hover falls by a millimetre in a scan
    assert np.median(heights(nominal)) > 0.05


def test_crowns_sway_with_the_square_of_the_mean_wind(scene: Scene) -> None:
    amounts = []
    for kmh in (18.0, 36.0):
        flown = Flown(
            scene,
            sim.SensorNeeds(lidar=True),
            steps=45,
            wind=sim.WindParams(mean_kmh=kmh, direction_deg=20.0, turbulence=False),
            lidar=sim.LidarParams(
                sway=1.0, range_sigma_m=0.0, angle_sigma_deg=0.0, divergence=False
            ),
        )
        amounts.append(flown.record.effects["scans"]["sway"].mean_amount)
    assert amounts[1] == pytest.approx(4.0 * amounts[0], rel=0.15)
    assert amounts[0] > 1e-3


@pytest.mark.parametrize("fraction", [1.0, 0.8])
def test_the_imu_is_shaken_by_the_rotors_that_turn(scene: Scene, fraction: float) -> None:
    plain = Flown(scene, speed_fraction=fraction).forces()
    white = replace(NO_NOISE, vibration_accel_density=0.2)
    lines = replace(NO_NOISE, vibration_harmonics=1.0)
    density = (Flown(scene, speed_fraction=fraction, imu=white).forces() - plain)[30:].std()
    assert density * math.sqrt(3 / 600) == pytest.approx(0.2 * fraction**2, rel=0.2)
    shaken = (Flown(scene, speed_fraction=fraction, imu=lines).forces() - plain)[30:]
    still = (Flown(scene, speed_fraction=1e-9, imu=lines).forces()
             - Flown(scene, speed_fraction=1e-9).forces())[90:]  # fmt: skip
    assert shaken.std(axis=0).min() > 3.0 * still.std(axis=0).max()


def test_thrust_grows_near_the_ground(scene: Scene) -> None:
    """By Cheeseman and Bennett, at the height of the rotors over the lawn."""
    geometry = rotor_geometry(scene.model)
    height = 0.5
    near = Flown(scene, height=height, steps=2).accelerations[0][2]
    far = Flown(scene, height=12.0, steps=2).accelerations[0][2]
    rotor = height + float(geometry.positions_body[:, 2].mean())
    gain = 1.0 / (1.0 - (geometry.radius_m / (4.0 * rotor)) ** 2)
    assert far == pytest.approx(0.0, abs=0.02)
    assert near - far == pytest.approx(sim.GRAVITY_MPS2 * (gain - 1.0), rel=0.05)


def test_wind_pushes_rotors_and_fuselage(scene: Scene) -> None:
    wind = sim.WindParams(mean_kmh=36.0, direction_deg=90.0, turbulence=False)
    flown = Flown(scene, steps=2, height=6.096, wind=wind)
    push, drag = flown.accelerations[0], rotor_geometry(scene.model).drag
    rotors = 4.0 * drag * flown.hover * 10.0 / flown.rig.vehicle.mass_kg
    assert abs(push[0]) < 0.05
    assert 1.05 * rotors < push[1] < 3.0 * rotors


def test_faults_of_messages_act_in_the_world(scene: Scene) -> None:
    needs = sim.SensorNeeds(gps=True)
    assert sum(len(obs.gps) for obs in Flown(scene, needs, steps=150).seen) >= 3
    lost = Flown(scene, needs, steps=150, faults=sim.FaultParams(events=("gps_dropout@0",)))
    assert not any(obs.gps for obs in lost.seen)


def test_the_lamp_lights_the_ground_at_night() -> None:
    night = scene_of(XML, light="night")
    means = []
    for below_m in (0.0, 20.0):
        flown = Flown(
            night, sim.SensorNeeds(camera_hz=10), steps=50, lamp=sim.LampParams(below_m=below_m),
            camera=sim.CameraParams(width=64, height=36, exposure=True),
        )  # fmt: skip
        means.append(np.mean([image.rgb.mean() for obs in flown.seen for image in obs.images]))
    assert means[1] > 1.5 * means[0]


def test_effects_count_once_their_message_is_delivered() -> None:
    effects = Effects()
    for fraction in (0.5, 0.0, 1.0):
        effects.note(("fog", "rain"), fraction, 10.0 * fraction)
        effects.end_message()
    assert effects.delivered == {}
    effects.deliver(2)
    fog = effects.delivered["fog"]
    assert (fog.came, fog.messages, fog.mean_fraction, fog.mean_amount) == (2, 1, 0.25, 2.5)
    assert effects.delivered["rain"] == fog
    effects.deliver(1)
    assert effects.delivered["fog"].messages == 2
    effects.clear()
    assert effects.delivered == {}


def test_images_and_lengths_that_differ() -> None:
    effects = Effects()
    before = np.full((16, 32, 3), 100, np.uint8)
    after = before.copy()
    after[:, :16] = 108  # of the compared pixels one half
    effects.note_image(("lens_dirt",), before, after)
    effects.note_lengths("sway", 4, 2, 1.5)
    effects.end_message()
    effects.deliver(1)
    dirt, sway = effects.delivered["lens_dirt"], effects.delivered["sway"]
    assert (dirt.mean_fraction, dirt.mean_amount) == (0.5, 4.0)
    assert sway.mean_fraction == 0.5 and sway.mean_amount == pytest.approx(0.75)


def test_returns_that_differ() -> None:
    seen = Returns(np.array([5, 5, 5, 0], np.float32), np.array([50, 50, 50, 0], np.uint8))
    before = seen.copy()
    seen.ranges[:] = [5.05, 0.0, 5.0, 3.0]
    seen.intensity[:] = [50, 0, 49, 9]
    assert seen.changed_fraction(before) == 0.75
    assert seen.changed_fraction(seen.copy()) == 0.0
