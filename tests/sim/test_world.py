"""Interface of the world to the main loop: exact arrivals, repeatable flights, truth, errors."""

import dataclasses
import hashlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest

from touchdown.scenes.api import MovingBody, Scene, Surface
from touchdown.sim import api
from touchdown.sim.airframe.contacts import ContactSensor, GroundProbe
from touchdown.sim.delivery import Latency
from touchdown.sim.frames import so3_exp, yaw_from_rotation
from touchdown.sim.moving import MovingBodies
from touchdown.sim.world import MujocoWorld

from support.places import scene_of
from support.worlds import NO_NOISE

SCENE_XML = """<mujoco><worldbody>
  <geom name="lawn_floor" type="plane" size="60 60 0.1" rgba="0.3 0.5 0.2 1"/>
  <geom name="building_wall" type="box" size="1 4 2" pos="6 0 2"/>
  <light pos="0 0 20" dir="0 0 -1"/>
  <site name="takeoff" pos="1 2 0" euler="0 0 30"/>
  <body name="cart" mocap="true" pos="0 -5 0.5">
    <geom name="cart_box" type="box" size="0.5 0.3 0.3"/>
  </body>
</worldbody></mujoco>"""
SQUARE = np.array([[0.0, -9.0, 0.5], [4.0, -9.0, 0.5], [4.0, -5.0, 0.5], [0.0, -5.0, 0.5]])
SMALL_IMAGE = api.CameraParams(width=64, height=36)

MakeWorld = Callable[..., MujocoWorld]


@pytest.fixture(scope="module")
def scene() -> Scene:
    plain = scene_of(SCENE_XML)
    cart = MovingBody(body_name="cart", path_world=SQUARE, speed_mps=2.0, start_m=1.0)
    return dataclasses.replace(plain, moving=(cart,))


@pytest.fixture
def make_world(scene: Scene, closed: Any) -> MakeWorld:
    def make(
        sim: api.SimParams | None = None, needs: api.SensorNeeds | None = None,
        imu: api.ImuParams | None = None, wind: api.WindParams | None = None, seed: int = 3,
    ) -> MujocoWorld:  # fmt: skip
        params = api.WorldParams(
            sim=sim or api.SimParams(threads=1), wind=wind or api.WindParams(),
            camera=SMALL_IMAGE, imu=imu or api.ImuParams(),
        )  # fmt: skip
        return closed(MujocoWorld(scene, params, seed, needs or api.SensorNeeds()))

    return make


def _climb(vehicle: api.VehicleModel, truth: api.Truth, *, rate_mps: float = 1.0) -> api.Command:
    """Upright and climbing, by the true state: a controller that suffices here."""
    rotation, rates = truth.world_from_body.rotation, truth.angular_velocity_body
    wanted = np.array([0.0, 0.0, api.GRAVITY_MPS2 + 2.0 * rate_mps]) - 2.0 * truth.velocity_world
    wanted[:2] = np.clip(wanted[:2], -2.0, 2.0)
    axis = rotation.T @ np.cross(rotation[:, 2], wanted / np.linalg.norm(wanted))
    torque = vehicle.inertia_kgm2 * (60.0 * axis - 14.0 * rates)
    x, y = vehicle.rotor_xy_m.T
    yaw = vehicle.rotor_spin * vehicle.torque_coefficient / vehicle.thrust_coefficient
    force = vehicle.mass_kg * wanted @ rotation[:, 2]
    thrusts = np.linalg.solve(np.stack([np.ones(4), y, -x, yaw]), [force, *torque])
    thrusts = np.maximum(thrusts, 0.1)
    return api.Command(rotor_speed_radps=np.sqrt(thrusts / vehicle.thrust_coefficient))


def _fly(world: MujocoWorld, steps: int) -> Iterator[tuple[api.Observation, api.Truth]]:
    obs = world.reset()
    yield obs, world.truth()
    for _ in range(steps):
        obs = world.step(_climb(world.rig.vehicle, world.truth()))
        yield obs, world.truth()


@pytest.mark.parametrize("threads", [1, 2])
def test_measurements_arrive_on_schedule(make_world: MakeWorld, threads: int) -> None:
    world = make_world(api.SimParams(threads=threads), api.SensorNeeds(camera_hz=10, lidar=True))
    scans, images, imu = [], [], []
    for obs, _ in _fly(world, 100):
        scans += [(obs.tick, s.start_tick, s.end_tick) for s in obs.scans]
        images += [(obs.tick, i.tick) for i in obs.images]
        imu += [(obs.tick, s.tick) for s in obs.imu]
    assert scans == [(60 * (k + 1) + 36, 60 * k, 60 * (k + 1)) for k in range(4)]
    assert images == [(60 * (k + 1) + 36, 60 * (k + 1)) for k in range(4)]
    assert imu == [(tick, tick) for tick in range(3, 301, 3)]


@pytest.mark.parametrize("threads", [1, 2])
def test_scans_and_images_arrive_after_latencies_of_their_own(
    make_world: MakeWorld, threads: int
) -> None:
    sim = api.SimParams(threads=threads, latency_sigma=0.3)
    world = make_world(sim, api.SensorNeeds(camera_hz=10, lidar=True))
    for _ in range(2):  # a reset starts the latencies anew
        scans, images = [], []
        for obs, _ in _fly(world, 140):
            scans += [(obs.tick, s.end_tick) for s in obs.scans]
            images += [(obs.tick, i.tick) for i in obs.images]
        for arrived, name in ((scans, b"scans"), (images, b"images")):
            latency = Latency(sim, 3, name)
            expected = [(latency.due(tick), tick) for tick in range(60, 360, 60)]
            assert arrived[:5] == expected
            assert len({due - tick for due, tick in expected}) > 2
        assert [due for due, _ in scans] != [due for due, _ in images]


@pytest.mark.parametrize("threads", [1, 2])
def test_scans_and_images_wait_for_one_another_in_a_busy_computer(
    make_world: MakeWorld, threads: int
) -> None:
    """Each takes 60 ms of every 100: of a scan and an image that come at once one waits, and more
    and more until they wait too long."""
    sim = api.SimParams(threads=threads, latency_by_load=True)
    world = make_world(sim, api.SensorNeeds(camera_hz=10, lidar=True))
    for _ in range(2):  # a reset frees the computer
        taken = [(obs.tick, s.end_tick) for obs, _ in _fly(world, 400) for s in obs.scans]
        assert taken[:3] == [(96, 60), (168, 120), (240, 180)]
    images = [i.tick for obs, _ in _fly(world, 400) for i in obs.images]
    assert images[:3] == [60, 120, 180] and len(images) < 18 and len(taken) < 18


def test_pulses_between_control_steps_come_at_the_next_one(make_world: MakeWorld) -> None:
    """30 Hz is every 20 ticks; a result due at tick 56 is first seen at tick 57."""
    world = make_world(needs=api.SensorNeeds(camera_hz=30))
    images = [(obs.tick, i.tick) for obs, _ in _fly(world, 40) for i in obs.images]
    assert images == [(57, 20), (78, 40), (96, 60), (117, 80)]


def test_stereo_sees_two_images_and_sensors_can_be_added_before_a_flight(
    make_world: MakeWorld,
) -> None:
    world = make_world()
    assert not any(obs.scans or obs.images for obs, _ in _fly(world, 40))
    world.reset()
    world.require(api.SensorNeeds(camera_hz=10, stereo=True))
    images = [i for obs, _ in _fly(world, 40) for i in obs.images]
    assert images[0].right_rgb.shape == images[0].rgb.shape == (36, 64, 3)
    with pytest.raises(RuntimeError, match=r"before a flight, not at tick 120"):
        world.require(api.SensorNeeds(lidar=True))


def _images_of(
    scene: Scene, camera: api.CameraParams, threads: int = 1
) -> list[tuple[int, api.CameraImage]]:
    """Images of a second of a wild flight, with the ticks of their arrival."""
    params = api.WorldParams(sim=api.SimParams(threads=threads), camera=camera)
    world = MujocoWorld(scene, params, 3, api.SensorNeeds(camera_hz=10, lidar=True))
    arrived = [(obs.tick, image) for obs, _ in _fly(world, 200) for image in obs.images]
    world.close()
    return arrived


def test_images_have_a_clock_and_stamps_of_their_own(scene: Scene) -> None:
    """Phase, delay and jitter: pulses every 0.1 s at one offset, which are no ends of scans; stamps
    3 ms after them, within a millisecond, and the tick nearest to each."""
    camera = dataclasses.replace(
        SMALL_IMAGE, phase_s=0.03, stamp_delay_s=0.003, stamp_jitter_s=0.0003
    )
    arrived = _images_of(scene, camera)
    plain = [image for _, image in _images_of(scene, SMALL_IMAGE)]
    assert len(arrived) == len(plain) == 9
    assert [image.tick for image in plain] == [60 * n for n in range(1, 10)]
    assert all(image.time_s == image.tick / 600 for image in plain)
    stamps = np.array([image.time_s for _, image in arrived])
    late = stamps - 0.1 * np.arange(1, 10)
    phase = round((late.mean() - 0.003) * 600) / 600
    assert 0.0 < phase <= 0.03
    np.testing.assert_allclose(late, phase + 0.003, atol=0.0015)
    assert np.ptp(late) > 1e-4
    assert all(image.tick == round(image.time_s * 600) for _, image in arrived)
    assert all(tick == 3 * -(-(60 * n + round(600 * phase) + 36) // 3) for n, (tick, _) in
               enumerate(arrived, start=1))  # fmt: skip


def test_a_scan_is_cast_from_the_poses_of_its_own_ticks(make_world: MakeWorld) -> None:
    """In a climb at 1 m/s the first pulses of a scan put the floor at height 0 by the true pose of
    its start, the last ones by that of its end, 0.1 m higher."""
    world = make_world(needs=api.SensorNeeds(lidar=True), wind=api.WindParams(mean_kmh=0.0))
    poses, heights = {}, []
    for obs, truth in _fly(world, 420):
        poses[truth.tick] = truth.world_from_body
        for scan in obs.scans:
            for tick, near in ((scan.start_tick, 0.0), (scan.end_tick, 0.1)):
                chosen = (scan.ranges > 0.0) & (np.abs(scan.time_offsets - near) < 0.004)
                if chosen.sum() < 100:
                    continue
                points = scan.points[chosen].astype(np.float64)
                pose = poses[tick] @ world.rig.body_from_lidar
                heights.append(np.median(pose.apply(points)[:, 2]))
    assert len(heights) > 10
    np.testing.assert_allclose(heights, 0.0, atol=0.01)


def _digest(world: MujocoWorld, steps: int = 60) -> str:
    digest = hashlib.sha256()
    for obs, truth in _fly(world, steps):
        for array in (
            truth.world_from_body.matrix(),
            truth.velocity_world,
            truth.angular_velocity_body,
            truth.wind_world,
            truth.rotor_speed_radps,
            *(s.specific_force for s in obs.imu),
            *(s.ranges for s in obs.scans),
            *(i.rgb for i in obs.images),
        ):
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def test_an_unkind_world_is_the_same_whatever_the_threads(scene: Scene) -> None:
    """Latency, range errors, texture, plants, sway and dust are all functions of seed and tick; so
    is what the world notes of them."""
    unkind = api.LidarParams(
        range_bias_m=0.02, range_noise_growth=0.2, texture=1.0, vegetation=1.0, sway=1.0
    )
    grassy = Surface(land_class="lawn", reflectivity=0.4, canopy_m=0.05, leaf_area=1.7, dust=1.0)
    planted = replace(scene, surfaces={**scene.surfaces, "lawn_floor": grassy})

    records = []

    def digest(threads: int, lidar: api.LidarParams, seed: int = 3) -> str:
        params = api.WorldParams(
            sim=api.SimParams(threads=threads, latency_sigma=0.3),
            camera=replace(
                SMALL_IMAGE, readout_s=0.015, phase_s=0.02, exposure=True, exposure_lag_s=0.3,
                stamp_delay_s=0.004,
            ),
            lidar=lidar, dust=api.DustParams(density=1.0), wind=api.WindParams(rotational=True),
            vehicle_error=api.VehicleErrorParams(center_of_mass_m=0.01),
            imu=api.ImuParams(scale_sigma=0.003),
        )  # fmt: skip
        world = MujocoWorld(planted, params, seed, api.SensorNeeds(camera_hz=10, lidar=True))
        world.start_in_air(np.array([1.0, 2.0, 1.5]), 0.0)
        vehicle, found = world.rig.vehicle, hashlib.sha256()
        for _ in range(60):
            obs = world.step(_climb(vehicle, world.truth()))
            for array in (*(s.points for s in obs.scans), *(i.rgb for i in obs.images)):
                found.update(obs.tick.to_bytes(4, "little"))
                found.update(np.ascontiguousarray(array).tobytes())
        world.close()
        records.append(world.record())
        return found.hexdigest()

    expected = digest(1, unkind)
    assert digest(2, unkind) == expected
    one, two = records
    assert one == two and one.renderer
    scans, images, air = (one.effects[name] for name in ("scans", "images", "air"))
    assert scans.keys() >= {"dust", "vegetation", "ranging"}
    assert 0.001 < scans["ranging"].mean_amount < 0.04
    assert scans["vegetation"].mean_fraction > 0.01 and scans["dust"].messages > 0
    assert images["dust"].messages > 0 and images["lamp"].messages == 0
    assert images["stamp_error_ms"].mean_amount == pytest.approx(4.0)
    assert 1e3 < images["light_lux"].mean_amount < 1e5
    assert images["exposure_ms"].mean_amount > 0.05 and images["gain"].mean_amount == 1.0
    assert images["exposure_error_stops"].came == images["gain"].came > 0
    assert air["rotation"].came == 60 and air["rotation"].mean_amount > 0.0
    assert 0.0 < one.deviations["center_of_mass_m"] < 0.02
    assert 0.0 < one.deviations["imu_scale"] < 0.01
    assert digest(1, api.LidarParams()) != expected
    assert digest(1, unkind, seed=4) != expected


def test_starts_at_rest_at_the_take_off_pose(make_world: MakeWorld, scene: Scene) -> None:
    world = make_world()
    obs, truth = world.reset(), world.truth()
    assert obs.tick == truth.tick == 0
    start = world.rig.world_from_body_start
    np.testing.assert_array_equal(start.matrix(), truth.world_from_body.matrix())
    np.testing.assert_allclose(start.translation[:2], scene.takeoff_xy_m, atol=1e-3)
    assert start.translation[2] == pytest.approx(world.rig.vehicle.leg_height_m, abs=1e-3)
    assert yaw_from_rotation(start.rotation) == pytest.approx(scene.takeoff_yaw, abs=1e-4)
    assert np.linalg.norm(truth.velocity_world) < 1e-3
    assert {(c.part, c.other) for c in truth.contacts} == {("leg", "lawn_floor")}
    weight = sum(c.normal_force_n for c in truth.contacts)
    assert weight == pytest.approx(world.rig.vehicle.mass_kg * api.GRAVITY_MPS2, rel=1e-3)


def test_truth_is_consistent_with_itself(make_world: MakeWorld) -> None:
    truths = [truth for _, truth in _fly(make_world(), 300)]
    assert truths[-1].contacts == ()
    assert truths[-1].energy_used_j > 0.0
    positions = np.array([t.world_from_body.translation for t in truths])
    velocities = np.array([t.velocity_world for t in truths])
    accelerations = np.array([t.acceleration_world for t in truths])
    np.testing.assert_allclose(np.diff(velocities, axis=0) * 200.0, accelerations[1:], atol=1e-9)
    mean_velocity = 0.5 * (velocities[1:] + velocities[:-1])
    np.testing.assert_allclose(np.diff(positions, axis=0) * 200.0, mean_velocity, atol=0.03)
    assert all(t.peak_contact_accel >= np.linalg.norm(t.acceleration_world) - 1e-9 for t in truths)


def test_perfect_imu_integrates_to_the_truth(make_world: MakeWorld) -> None:
    world = make_world(imu=NO_NOISE, wind=api.WindParams(mean_kmh=25.0))
    rotation, velocity = np.eye(3), np.zeros(3)
    for obs, truth in _fly(world, 600):
        if obs.tick == 0:
            rotation, velocity = truth.world_from_body.rotation.copy(), truth.velocity_world.copy()
        for sample in obs.imu:
            half = so3_exp(0.5 * sample.angular_velocity / 200.0)
            force = rotation @ half @ sample.specific_force
            velocity = velocity + (force - [0.0, 0.0, api.GRAVITY_MPS2]) / 200.0
            rotation = rotation @ half @ half
    np.testing.assert_allclose(velocity, truth.velocity_world, atol=1e-6)
    np.testing.assert_allclose(rotation, truth.world_from_body.rotation, atol=1e-6)


def test_messages_are_read_only(make_world: MakeWorld) -> None:
    world = make_world()
    obs, truth = world.reset(), world.truth()
    for array in (obs.rotor_speed_radps, truth.velocity_world, truth.world_from_body.rotation):
        with pytest.raises(ValueError, match=r"read-only"):
            array[0] = 1.0


def test_empty_battery_stops_the_rotors(make_world: MakeWorld) -> None:
    world = make_world(api.SimParams(threads=1, battery_capacity_j=300.0))
    *_, (obs, truth) = _fly(world, 600)
    assert obs.battery_fraction == 0.0
    assert truth.rotor_speed_radps.max() < 1.0


def test_contacts_are_named_by_part(scene: Scene) -> None:
    """Standing, upside down, and with a rotor in the wall."""
    model, data = scene.model, mujoco.MjData(scene.model)
    sensor = ContactSensor(model)
    poses = {
        "leg": [1.0, 2.0, 0.309, 1.0, 0.0, 0.0, 0.0],
        "body": [1.0, 2.0, 0.135, 0.0, 1.0, 0.0, 0.0],
        "rotor": [4.6, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0],
    }
    for part, qpos in poses.items():
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        contacts = sensor.read(data)
        other = "building_wall" if part == "rotor" else "lawn_floor"
        assert {(c.part, c.other) for c in contacts} == {(part, other)}
        assert all(c.normal_force_n > 0.0 for c in contacts)


def test_ground_probe_sees_what_is_below_but_not_the_vehicle(scene: Scene) -> None:
    data = mujoco.MjData(scene.model)
    mujoco.mj_forward(scene.model, data)
    probe = GroundProbe(scene.model)
    assert probe.clearance(data, np.array([1.0, 2.0, 3.0])) == pytest.approx(3.0)
    assert probe.clearance(data, np.array([6.0, 0.0, 5.0])) == pytest.approx(1.0)
    assert probe.clearance(data, np.array([900.0, 0.0, 5.0])) == np.inf


@pytest.mark.parametrize(("time_s", "xy", "yaw_deg"), [
    (0.0, (1, -9), 0), (1.0, (3, -9), 0), (2.0, (4, -8), 90), (7.0, (0, -8), -90),
    (8.0, (1, -9), 0),
])  # fmt: skip
def test_moving_body_follows_its_closed_path(
    scene: Scene, time_s: float, xy: tuple[float, float], yaw_deg: float
) -> None:
    bodies, data = MovingBodies(scene), mujoco.MjData(scene.model)
    bodies.write(data, time_s)
    np.testing.assert_allclose(data.mocap_pos[0], [*xy, 0.5], atol=1e-9)
    half = np.radians(yaw_deg) / 2
    np.testing.assert_allclose(data.mocap_quat[0], [np.cos(half), 0, 0, np.sin(half)], atol=1e-12)
    track = bodies.tracks(np.array([0.0, time_s]))["cart"]
    np.testing.assert_array_equal(track.positions[1], data.mocap_pos[0])
    np.testing.assert_array_equal(track.quats_wxyz[1], data.mocap_quat[0])


def test_a_moving_body_must_be_mocap(scene: Scene) -> None:
    wrong = MovingBody(body_name="nobody", path_world=SQUARE, speed_mps=1.0, start_m=0.0)
    fields = {name: getattr(scene, name) for name in scene.__dataclass_fields__}
    with pytest.raises(ValueError, match=r"'nobody' is not a mocap body"):
        MovingBodies(Scene(**{**fields, "moving": (wrong,)}))


@pytest.mark.parametrize(("sim", "needs", "message"), [
    (api.SimParams(control_ticks=7), api.SensorNeeds(), "sim.control_ticks is 7.*one of 1, 2, 3"),
    (api.SimParams(lidar_scan_ticks=0), api.SensorNeeds(), "sim.lidar_scan_ticks is 0"),
    (api.SimParams(tick_hz=100), api.SensorNeeds(), "sim.tick_hz must be 500 or more"),
    (api.SimParams(), api.SensorNeeds(camera_hz=7), "camera_hz is 7.*30 Hz.*0 or one of"),
])  # fmt: skip
def test_invalid_parameters_are_named(
    make_world: MakeWorld, sim: api.SimParams, needs: api.SensorNeeds, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        make_world(sim, needs)


def test_diverged_physics_is_an_error(make_world: MakeWorld) -> None:
    world = make_world()
    with pytest.raises(RuntimeError, match=r"tick 0: the command .* is not finite"):
        world.step(api.Command(rotor_speed_radps=np.array([1.0, np.nan, 1.0, 1.0])))
    world.reset()
    world._data.qvel[0] = np.nan
    with pytest.raises(RuntimeError, match=r"tick 3: the physics diverged"):
        world.step(api.Command(rotor_speed_radps=np.zeros(4)))
