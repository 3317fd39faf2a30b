"""Bodies of a file that move along a path."""

import re

import mujoco
import numpy as np
import pytest

from touchdown.scenes.api import ImportOptions, Scene
from touchdown.sim.moving import MovingBodies

from support.places import scene_of

TRUCK = (
    '<body name="truck" mocap="true" pos="3 0 1">'
    '<geom name="road_bed" type="box" size="2 1 1"/></body>'
)
LOOP = '<numeric name="truck:path" data="10 0 1  10 20 1"/><numeric name="truck:speed" data="2"/>'


def _load(custom: str, seed: int = 0, body: str = TRUCK) -> Scene:
    return scene_of(
        f'<mujoco><custom>{custom}</custom><worldbody><light pos="0 0 9"/>'
        f'<geom name="lawn" type="plane" size="60 60 1"/>{body}</worldbody></mujoco>',
        seed, options=ImportOptions(),
    )  # fmt: skip


def _place_at(scene: Scene, time_s: float) -> np.ndarray:
    data = mujoco.MjData(scene.model)
    MovingBodies(scene).write(data, time_s)
    mujoco.mj_kinematics(scene.model, data)
    return data.body("truck").xpos.copy()


def test_a_body_goes_round_and_is_seen_where_it_is() -> None:
    """There and back again over 20 m at 2 m/s; a ray from above meets its roof."""
    scene = _load(LOOP)
    for time_s, y in ((0.0, 0.0), (4.0, 8.0), (11.0, 18.0), (25.0, 10.0)):
        np.testing.assert_allclose(_place_at(scene, time_s), [10.0, y, 1.0], atol=1e-9)
    data = mujoco.MjData(scene.model)
    MovingBodies(scene).write(data, 4.0)
    mujoco.mj_kinematics(scene.model, data)
    hit = mujoco.mj_ray(scene.model, data, np.array([10.0, 9.5, 9.0]), np.array([0, 0, -1.0]), None,
                        1, -1, np.full(1, -1, np.int32))  # fmt: skip
    assert hit == pytest.approx(7.0)  # its long side lies along the path


def test_a_body_goes_once_by_times() -> None:
    once = LOOP.replace('"truck:speed" data="2"', '"truck:times" data="5 15"')
    scene = _load(once)
    for time_s, y in ((0.0, 0.0), (5.0, 0.0), (10.0, 10.0), (60.0, 20.0)):
        np.testing.assert_allclose(_place_at(scene, time_s), [10.0, y, 1.0], atol=1e-9)


def test_a_start_by_seed() -> None:
    drawn = LOOP + '<text name="truck:start" data="seed"/>'
    starts = [_place_at(_load(drawn, seed), 0.0)[1] for seed in (1, 1, 2)]
    assert starts[0] == starts[1] != starts[2]


def test_paths_count_from_the_origin_of_the_file() -> None:
    far = '<site name="takeoff" pos="500000 4000000 0"/>'
    body = TRUCK.replace('pos="3 0 1"', 'pos="500003 4000000 1"') + far
    floor = (
        '<body pos="500000 4000000 0"><geom name="lawn_here" type="box" size="60 60 .1"/></body>'
    )
    custom = LOOP.replace("10 0 1  10 20 1", "500010 4000000 1  500010 4000020 1")
    scene = _load(custom, body=body + floor)
    np.testing.assert_allclose(_place_at(scene, 4.0)[:2], [10.0, 8.0], atol=1e-6)


@pytest.mark.parametrize(("custom", "word"), [
    (LOOP.replace("truck", "lorry"), "no body of the world is lorry"),
    (LOOP.replace("10 20 1", "10 20"), "x y z"),
    (LOOP.replace("10 20 1", "10 0 1"), "one place"),
    (LOOP.replace('data="2"', 'data="-2"'), "speed is not between"),
    (LOOP.replace('data="2"', 'data="2 3"'), "speed is not between"),
    (LOOP.split("/>")[0] + "/>", "give truck:speed, or truck:times"),
    (LOOP + '<numeric name="truck:times" data="0 9"/>', "give truck:speed, or truck:times"),
    (LOOP.replace('"truck:speed" data="2"', '"truck:times" data="9 3"'), "rising"),
    (LOOP.replace('"truck:speed" data="2"', '"truck:times" data="0 0.01"'), "2000 m/s"),
    (LOOP + '<text name="truck:start" data="random"/>', "start may be seed"),
])  # fmt: skip
def test_a_path_that_cannot_be_followed_is_one_line(custom: str, word: str) -> None:
    with pytest.raises(ValueError, match=re.escape(word)) as caught:
        _load(custom)
    assert "\n" not in str(caught.value)
    still = TRUCK.replace(' mocap="true"', "")
    with pytest.raises(ValueError, match="mocap"):
        _load(LOOP, body=still)
