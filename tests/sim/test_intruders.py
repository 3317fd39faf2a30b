"""Intruders: from where they come, and when."""

import math

import mujoco
import numpy as np
import pytest

from touchdown.experiments.flight.metrics import Nearest
from touchdown.scenes.api import Guests, Scene, TrafficParams
from touchdown.sim.api import Command, FaultParams, Truth, WorldParams
from touchdown.sim.frames import Pose
from touchdown.sim.world import MujocoWorld

from support.places import scene_of

PLACE = """<mujoco><worldbody>
  <geom name="lawn" type="plane" size="60 60 1"/>
  <geom name="building" type="box" size="30 3 3" pos="0 {y} 3"/>
  <geom name="building_2" type="box" size="3 30 3" pos="{y} 0 3"/>
</worldbody></mujoco>"""


@pytest.fixture
def scene() -> Scene:
    """Walls in the north and the east of a site at (0, 0)."""
    traffic = TrafficParams(intruder="runner", intruder_from_m=10.0, intruder_stays_s=3.0)
    return scene_of(PLACE.format(y=9), traffic=traffic, guests=Guests(intruders=1))


def flown(scene: Scene, seed: int, fault: str, seconds: float) -> tuple[MujocoWorld, list[Truth]]:
    """The truth at each control step, on the ground, in phase DESCEND from 1 s on."""
    world = MujocoWorld(scene, WorldParams(faults=FaultParams(events=(fault,))), seed)
    still, truths = Command(rotor_speed_radps=np.zeros(4)), []
    world.reset()
    while world.truth().time_s < seconds:
        truths.append(world.truth())
        now = truths[-1].time_s
        world.follow("DESCEND" if now >= 1.0 else "APPROACH", np.zeros(3))
        world.step(still)
    return world, truths


@pytest.mark.parametrize("seed", range(4))
def test_an_intruder_comes_over_open_ground_stays_and_goes_on(scene: Scene, seed: int) -> None:
    world, truths = flown(scene, seed, "intruder@descend", 12.0)
    found = [(t.time_s, *t.living_world[0]) for t in truths if len(t.living_world)]
    assert found[0][0] == pytest.approx(1.0, abs=0.02)
    x, y = np.array(found)[:, 1], np.array(found)[:, 2]
    assert math.hypot(x[0], y[0]) == pytest.approx(10.0, abs=0.1)
    arrived = np.hypot(x, y) < 1e-6
    assert arrived.sum() / 200.0 == pytest.approx(3.0, abs=0.02)
    before = np.arange(len(x)) < np.flatnonzero(arrived)[0]
    assert (x[before] < 6.0).all() and (y[before] < 6.0).all()  # not through the walls
    speed = np.hypot(np.diff(x), np.diff(y))[: before.sum() - 1] * 200.0
    assert np.all((speed > 2.5 - 1e-6) & (speed < 3.5 + 1e-6))
    (record,) = [r for r in world.record().faults if "intruder" in r["fault"]]
    assert record["who"] == "runner" and record["acted_s"] == pytest.approx(11.0, abs=0.05)
    world.close()


def test_beside_the_ground_an_intruder_walks_on_at_its_height() -> None:
    raft = (
        "<mujoco><worldbody><geom name='lawn' type='box' size='8 8 1' pos='0 0 1'/>"
        "<site name='takeoff' pos='5 5 2'/></worldbody></mujoco>"
    )
    traffic = TrafficParams(intruder="runner", intruder_from_m=12.0, intruder_stays_s=0.1)
    scene = scene_of(raft, traffic=traffic, guests=Guests(intruders=1))
    world, truths = flown(scene, 0, "intruder@descend", 12.0)
    heights = np.concatenate([t.living_world[:, 2] for t in truths])
    assert len(heights) > 2000 and heights == pytest.approx(heights[0])
    world.close()


def test_a_height_counts_over_a_site_alone(scene: Scene) -> None:
    """Without a site no height is reached, on the way home neither."""
    world = MujocoWorld(scene, WorldParams(faults=FaultParams(events=("intruder@12m",))), 0)
    world.reset()
    world.follow("RETURN", None)
    world.step(Command(rotor_speed_radps=np.zeros(4)))
    assert len(world.truth().living_world) == 0
    world.follow("RETURN", np.zeros(3))
    world.step(Command(rotor_speed_radps=np.zeros(4)))
    assert len(world.truth().living_world) == 1
    world.close()


def test_nobody_comes_before_the_height(scene: Scene) -> None:
    world, truths = flown(scene, 0, "intruder@0m", 2.0)
    assert sum(len(t.living_world) for t in truths[:200]) == 0
    world.close()


def test_the_distance_is_to_the_nearest_of_all_and_of_the_last_ten_seconds() -> None:
    nearest = Nearest(steps_per_s=1.0)
    people = np.array([[9.0, 0.0, 0.0], [0.0, 4.0, 0.0]])
    for step in range(20):
        here = np.array([8.5 if step == 5 else 0.0, 0.0, 20.0 if step == 12 else 1.0])
        nearest.add(truth_at(here, people))
    assert nearest.summary() == {"nearest_person_m": 4.0, "nearest_person_10s_m": 4.0}
    nearest.add(truth_at(np.array([0.0, 4.0, 2.3]), people))  # over a head
    assert nearest.now_m == pytest.approx(0.5)
    assert Nearest(1.0).summary()["nearest_person_m"] is None


def truth_at(position: np.ndarray, people: np.ndarray) -> Truth:
    zero = np.zeros(3)
    return Truth(
        tick=0, time_s=0.0, world_from_body=Pose(np.eye(3), position), velocity_world=zero,
        acceleration_world=zero, angular_velocity_body=zero, wind_world=zero,
        rotor_speed_radps=np.zeros(4), contacts=(), peak_contact_accel=0.0, energy_used_j=0.0,
        living_world=people,
    )  # fmt: skip


def test_bodies_can_be_touched(scene: Scene) -> None:
    geoms = [g for g in range(scene.model.ngeom) if "intruder" in scene.model.geom(g).name]
    assert geoms and all(scene.model.geom_contype[g] for g in geoms)
    assert mujoco.mj_name2id(scene.model, mujoco.mjtObj.mjOBJ_BODY, "traffic/intruder_0_runner") > 0
