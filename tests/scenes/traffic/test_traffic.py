"""People, animals and vehicles: where their paths are drawn, and how they move."""

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest

from touchdown.scenes.api import Guests, Limb, MovingBody, Scene, TrafficParams
from touchdown.scenes.truth import static_surface
from touchdown.sim.moving import OUT_OF_THE_WORLD_M, MovingBodies

from support.places import bare_scene, scene_of

PLACE = """<mujoco><worldbody>
  <geom name="lawn" type="plane" size="20 20 1"/>
  <geom name="building" type="box" size="4 20 3" pos="14 0 3"/>
  <geom name="water_pond" type="box" size="3 3 0.02" pos="-8 8 0.02"/>
  <site name="takeoff" pos="0 -15 0"/>
</worldbody></mujoco>"""


@pytest.fixture(scope="module")
def busy() -> Scene:
    counts = TrafficParams(people=12, dogs=4, bicycles=4, cars=2)
    return scene_of(PLACE, 5, traffic=counts, guests=Guests(intruders=1))


def roots(scene: Scene) -> list[MovingBody]:
    return [body for body in scene.moving if body.walker == body.body_name]


def test_who_was_asked_for_is_there_and_the_seed_decides_where(busy: Scene) -> None:
    kinds = [body.body_name.split("/")[1].split("_")[0] for body in roots(busy)]
    assert [kinds.count(kind) for kind in ("person", "dog", "bicycle", "car", "intruder")] == [
        12, 4, 4, 2, 1,
    ]  # fmt: skip
    same, other = (
        scene_of(PLACE, seed, traffic=busy.traffic, guests=Guests(intruders=1)) for seed in (5, 6)
    )
    path = roots(busy)[0].path_world
    assert np.array_equal(path, roots(same)[0].path_world)
    assert not np.array_equal(path, roots(other)[0].path_world)
    assert scene_of(PLACE, 5).moving == ()


def test_nobody_walks_through_walls_or_water_or_over_the_pad(busy: Scene) -> None:
    for body in roots(busy):
        if body.intruder:
            continue
        x, y, z = body.path_world.T
        assert (x < 10.0).all() and not ((np.abs(x + 8) < 3) & (np.abs(y - 8) < 3)).any()
        assert (np.hypot(x, y + 15.0) > 3.0).all()
        assert z == pytest.approx(static_surface.cast_points(busy, body.path_world[:, :2])[0])


def test_limbs_swing_by_the_way_gone_and_hang_when_one_stands() -> None:
    spec = mujoco.MjSpec()
    for name in ("walker", "leg"):
        body = spec.worldbody.add_body(name=name, mocap=True)
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0])
    leg = Limb(joint_m=np.array([0.0, 0.1, 0.9]), swing_deg=30.0, stride_m=2.0, phase_deg=0.0)
    path = np.array([[0.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 4.0, 0.0]])
    times = np.array([1.0, 5.0, 9.0])
    common = {"path_world": path, "times_s": times, "walker": "walker", "alive": True}
    walker = MovingBody(body_name="walker", **common)
    swinging = MovingBody(body_name="leg", limb=leg, **common)
    moving = MovingBodies(bare_scene(spec.compile(), moving=(walker, swinging)))
    tracks = moving.tracks(np.array([0.0, 1.5, 2.5, 8.0]))
    assert tracks["walker"].positions[:, 1].tolist() == [0.0, 0.5, 1.5, 4.0]
    # a quarter of a stride and three
    angles = [2.0 * math.degrees(math.asin(math.hypot(q[1], q[2]))) for q in
              tracks["leg"].quats_wxyz]  # fmt: skip
    assert angles == pytest.approx([0.0, 30.0, 30.0, 0.0])
    assert tracks["leg"].positions[1] == pytest.approx(
        [-0.1, 0.5, 0.9]
    )  # left of one who goes north


def test_an_intruder_is_out_of_the_world_until_it_is_sent(busy: Scene) -> None:
    moving, data = MovingBodies(busy), mujoco.MjData(busy.model)
    (intruder,) = [body for body in roots(busy) if body.intruder]
    moving.write(data, 3.0)
    assert moving.tracks(np.array([3.0]))[intruder.body_name].positions[0, 2] == OUT_OF_THE_WORLD_M
    assert len(moving.living(data)) == 20  # cars do not live
    before = moving.tracks(np.array([2.0]))[intruder.body_name].positions
    path = np.array([[5.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    moving.send(intruder.body_name, path, np.array([3.0, 5.0]))
    assert np.array_equal(moving.tracks(np.array([2.0]))[intruder.body_name].positions, before)
    moving.write(data, 4.0)
    assert len(moving.living(data)) == 21
    assert moving.living(data)[-1] == pytest.approx([2.5, 0.0, 0.0])


def test_own_paths(tmp_path: Path) -> None:
    file = tmp_path / "paths.csv"
    file.write_text("name,t,x,y\nperson_a,2,0,0\nperson_a,6,4,0\ndog_b,0,1,1\ndog_b,1,1,3\n")
    scene = scene_of(PLACE, traffic=TrafficParams(paths=str(file)))
    places = MovingBodies(scene).tracks(np.array([0.0, 4.0, 99.0]))
    assert places["traffic/own_person_a"].positions[:, 0] == pytest.approx([0.0, 2.0, 4.0])
    assert places["traffic/own_dog_b"].positions[:, 1] == pytest.approx([1.0, 3.0, 3.0])


@pytest.mark.parametrize(("text", "said"), [
    ("name,t,x\nperson,0,1\n", "column 'y' is missing"),
    ("name,t,x,y\ncat,0,1,1\n", "'cat' begins with none"),
    ("name,t,x,y\nperson,0,1,1\n", "two rows or more"),
    ("name,t,x,y\nperson,1,1,1\nperson,0,1,2\n", "rising t"),
    ("name,t,x,y\nperson,0,nan,1\n", "not finite"),
    ("name,t,x,y\nperson,0,1,1\nperson,1,1,1\n", "goes nowhere"),
])  # fmt: skip
def test_wrong_paths_are_named(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "paths.csv").write_text(text)
    with pytest.raises(ValueError, match=said):
        scene_of(PLACE, traffic=TrafficParams(paths=str(tmp_path / "paths.csv")))


def test_a_place_where_nobody_can_walk() -> None:
    with pytest.raises(ValueError, match="nobody can walk within 30 m"):
        scene_of(PLACE.replace('"lawn"', '"water"'), traffic=TrafficParams(people=1))
