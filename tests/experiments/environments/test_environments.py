"""The landing task behind Gymnasium and dm_control: interfaces, rewards, endings, determinism."""

import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

gymnasium = pytest.importorskip("gymnasium")
pytest.importorskip("dm_control")

import glfw  # noqa: E402
from absl.testing import absltest  # noqa: E402
from dm_env import test_utils  # noqa: E402
from gymnasium.utils.env_checker import check_env  # noqa: E402

from touchdown import UsageError, suite  # noqa: E402
from touchdown.experiments.environments.gymnasium_env import TouchdownEnv  # noqa: E402
from touchdown.experiments.environments.landing_task import LandingTask, TaskOptions  # noqa: E402
from touchdown.experiments.errors import require_dm_control  # noqa: E402

Array = NDArray[Any]
MakeTask = Callable[..., LandingTask]

SMALL = {"camera_pixels": (32, 24), "view_pixels": (64, 48)}
HALF_LAWN = """<mujoco><worldbody>
  <light pos="0 0 30" dir="0 0 -1"/>
  <geom name="lawn_west" type="box" size="30 40 0.5" pos="-25 0 -0.5" rgba="0.3 0.5 0.2 1"/>
  <geom name="road_east" type="box" size="20 40 0.5" pos="25 0 -0.5" rgba="0.3 0.3 0.3 1"/>
  <geom name="building_hut" type="box" size="3 3 2" pos="25 0 2" rgba="0.6 0.3 0.2 1"/>
  <site name="takeoff" pos="{x} 0 0.2"/>
</worldbody></mujoco>"""


def write_scene(folder: Path, x: float) -> str:
    path = folder / f"scene_{x:g}.xml"
    path.write_text(HALF_LAWN.format(x=x))
    return str(path)


@pytest.fixture(scope="module")
def lawn(tmp_path_factory: pytest.TempPathFactory) -> str:
    return write_scene(tmp_path_factory.mktemp("lawn"), -20.0)


@pytest.fixture(scope="module")
def road(tmp_path_factory: pytest.TempPathFactory) -> str:
    return write_scene(tmp_path_factory.mktemp("road"), 12.0)


@pytest.fixture
def make_task(closed: Any) -> MakeTask:
    def make(scene: str, **options: Any) -> LandingTask:
        defaults: dict[str, Any] = {"start_spread_m": 1.0, "start_height_m": 4.0}
        return closed(LandingTask(TaskOptions(scene=scene, **SMALL, **(defaults | options))))

    return make


def test_gymnasium_checker_passes(lawn: str) -> None:
    """`check_env` raises nothing and gives no warning."""
    env = gymnasium.make(
        "Touchdown-v0",
        scene=lawn,
        sensors=("imu", "rangefinder", "barometer", "magnetometer", "rotors", "gps", "camera"),
        privileged=True,
        **SMALL,
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env.unwrapped)
    env.close()
    assert [str(w.message) for w in caught if "WARN" in str(w.message)] == []


def test_rendering_shows_the_ground_below(lawn: str) -> None:
    env = gymnasium.make("Touchdown-v0", scene=lawn, render_mode="rgb_array", **SMALL)
    env.reset(seed=0)
    view = env.render()
    assert view.shape == (48, 64, 3) and view.dtype == np.uint8
    assert view[..., 1].mean() > view[..., 0].mean() + 10  # the lawn is green
    env.close()
    with pytest.raises(ValueError, match=r"render_mode 'ansi'"):
        TouchdownEnv(render_mode="ansi", scene=lawn)


class TestSuite(test_utils.EnvironmentTestMixin, absltest.TestCase):  # type: ignore[misc]
    """dm_env's own checks; full thrust climbs out of the episode, so that terminations occur."""

    scene: str

    @pytest.fixture(autouse=True)
    def _set_scene(self, lawn: str) -> None:
        TestSuite.scene = lawn

    def make_object_under_test(self) -> suite.LandingEnvironment:
        return suite.load(self.scene, "land", {"random": 1, "time_limit": 0.5, **SMALL})

    def make_action_sequence(self) -> Iterator[Array]:
        for _ in range(60):
            yield np.zeros(4, dtype=np.float32)


@pytest.mark.parametrize(("place", "worth"), [
    ("lawn", 10.0 * (1.0 - 0.5 * 0.3 * 2.5 / 1.5)), ("road", -2.0),
])  # fmt: skip
def test_a_descent_of_the_suite_is_gymnasiums(
    place: str, worth: float, make_task: MakeTask, request: pytest.FixtureRequest
) -> None:
    """Rewards and observations are those that Gymnasium gives; the same seed gives the same time
    steps to the bit; the physics is the world itself, in step with its position."""
    kwargs = {"random": 3, "layout": 0, "start_spread_m": 1.0, "start_height_m": 4.0, **SMALL}
    scene = request.getfixturevalue(place)
    both = [suite.load(scene, "land_by_velocity", kwargs) for _ in range(2)]
    task = make_task(scene, action="velocity")
    task.reset(0, np.random.default_rng(np.random.RandomState(3).randint(2**31)))
    steps = [env.reset() for env in both]
    spec = both[0].action_spec()
    assert spec.minimum.shape == spec.maximum.shape == spec.shape == (4,)
    assert spec.minimum.tolist() == [-1.0] * 4 == (-spec.maximum).tolist()
    physics, down = both[0].physics, np.array([0.1, 0.0, -0.3, 0.0], dtype=np.float32)
    assert physics.data.ptr is both[0].task.landing.world.data
    while not steps[0].last():
        steps, other = [env.step(down) for env in both], task.step(down)
        assert steps[0].reward == steps[1].reward == other.reward
        for name, seen in steps[0].observation.items():
            np.testing.assert_array_equal(seen, steps[1].observation[name])
            np.testing.assert_array_equal(seen, other.observation[name])
        at = physics.named.data.xpos["vehicle/quadrotor"]
        np.testing.assert_allclose(at, physics.data.qpos[:3], atol=1e-12)
    info = both[0].task.info
    assert (steps[0].discount, info["outcome"], info["safe"]) == (0.0, "LANDED", place == "lawn")
    assert steps[0].reward == pytest.approx(worth, abs=0.7)
    assert physics.render(60, 80, camera_id=-1).std() > 10.0
    below = physics.render(60, 80, camera_id="vehicle/camera").mean(axis=(0, 1))
    assert (below[1] > below[0] + 10) == (place == "lawn")
    for env in both:
        env.close()


def test_the_suite_pushes_shows_and_names(lawn: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A wrench that is set between steps pushes the vehicle for one step: 40 N for 0.02 s give 4.2
    kg 0.19 m/s."""
    pairs = [("flat", "land"), ("flat", "land_by_velocity")]
    assert set(pairs) < set(suite.ALL_TASKS) and set(suite.BENCHMARKING) < set(suite.ALL_TASKS)
    speeds = []
    for force in (0.0, 40.0):
        kwargs = {"random": 3, "profile": "ideal", "wind_kmh": 0.0, **SMALL}
        env = suite.load(lawn, "land", kwargs, {"flat_observation": True}, visualize_reward=True)
        first, data = env.reset(), env.physics.named.data
        assert first.observation.keys() == env.observation_spec().keys() == {"observations"}
        env.observation_spec()["observations"].validate(first.observation["observations"])
        colour = env.physics.named.model.geom_rgba["vehicle/body_fuselage"].copy()
        data.xfrc_applied["vehicle/quadrotor"] = [force, 0, 0, 0, 0, 0]
        env.step(np.zeros(4))
        env.step(np.zeros(4))
        speeds.append(env.physics.data.qvel[0])
        assert (env.physics.named.model.geom_rgba["vehicle/body_fuselage"] != colour).any()
        env.close()
    assert speeds[1] - speeds[0] == pytest.approx(40.0 * 0.02 / 4.2, rel=0.05)
    with pytest.raises(UsageError, match=r"task 'lnad' does not exist \(did you mean 'land'\?\)"):
        suite.load(lawn, "lnad")
    with pytest.raises(ValueError, match=r"did you mean 'crossroad'"):
        suite.load("crosroad", "land")
    held = {glfw.KEY_UP, glfw.KEY_RIGHT, glfw.KEY_PAGE_DOWN, glfw.KEY_HOME, glfw.KEY_END}
    monkeypatch.setattr(glfw, "get_key", lambda _window, key: int(key in held))
    monkeypatch.setattr(glfw, "get_current_context", lambda: "window")
    np.testing.assert_allclose(suite.Keyboard(0.5)(None), [0.5, -0.5, -0.5, 0.0])
    monkeypatch.setitem(sys.modules, "dm_control", None)
    with pytest.raises(UsageError, match=r"suite needs dm_control, which is not installed: pip"):
        require_dm_control("touchdown.suite")


def test_observations_hold_sensors_only(lawn: str, make_task: MakeTask) -> None:
    """At the start: upright and nearly still, 4 m up by the rangefinder (which sits 0.13 m below
    the body's origin), rotors near 0.7 of full speed, the field of the earth."""
    task = make_task(lawn)
    seen = task.reset(0, np.random.default_rng(3)).observation
    assert set(seen) == {"imu", "rangefinder", "barometer", "magnetometer", "rotors"}
    assert np.linalg.norm(seen["imu"][3:]) == pytest.approx(9.81, abs=1.0)
    assert seen["rangefinder"][0] == pytest.approx(4.0 - 0.13, abs=0.4)
    assert np.linalg.norm(seen["magnetometer"]) == pytest.approx(54.8, abs=3.0)
    np.testing.assert_allclose(seen["rotors"], 0.7, atol=0.1)
    assert abs(seen["barometer"][0]) < 1.5
    for name, bounds in task.observations.bounds.items():
        assert seen[name].dtype == bounds.dtype and seen[name].shape == bounds.shape


def test_privileged_state_is_the_truth(lawn: str, make_task: MakeTask) -> None:
    task = make_task(lawn, sensors=("gps", "camera"), privileged=True)
    first = task.reset(0, np.random.default_rng(3)).observation
    assert set(first) == {"gps", "camera", "state"}
    state = first["state"]
    rotation = state[6:15].reshape(3, 3)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    assert state[2] == pytest.approx(state[18], abs=1e-3)  # level ground at the take-off height
    assert np.abs(state[:2]).max() < 1.5 and np.linalg.norm(first["gps"][:3] - state[:3]) < 4.0
    assert first["camera"].shape == (24, 32, 3) and first["camera"].max() > 0


def test_shaping_telescopes(lawn: str, make_task: MakeTask) -> None:
    """The shaping sums to the difference of the potentials for any path: 0.1 a metre of height over
    safe ground."""
    task = make_task(lawn, action="velocity", privileged=True, sensors=("rotors",))
    first = task.reset(0, np.random.default_rng(5))
    rng = np.random.default_rng(1)
    steps = [task.step(rng.uniform(-1, 1, 4) * [1, 1, 0.2, 1]) for _ in range(60)]
    dropped = first.observation["state"][2] - steps[-1].observation["state"][2]
    expected = 0.1 * dropped - 0.01 * 60 / 50
    assert sum(s.reward for s in steps) == pytest.approx(expected, abs=1e-4)


def test_moving_towards_safe_ground_is_rewarded(road: str, make_task: MakeTask) -> None:
    """From the road, 12 m east of the lawn's safe part, flying west gains 0.1 a metre."""
    task = make_task(road, action="velocity", privileged=True, start_spread_m=0.0)
    first = task.reset(0, np.random.default_rng(2)).observation["state"]
    yaw = np.arctan2(first[9], first[6])
    west = np.array([-np.cos(yaw), np.sin(yaw), 0.0, 0.0])
    steps = [task.step(west) for _ in range(60)]
    last = steps[-1].observation["state"]
    flown, sunk = first[0] - last[0], first[2] - last[2]
    assert flown > 1.0
    expected = 0.1 * (flown + sunk) - 0.01 * 60 / 50
    assert sum(s.reward for s in steps) == pytest.approx(expected, abs=0.06)


@pytest.mark.parametrize(("action", "outcome"), [
    ([-1.0, -1.0, -1.0, -1.0], "COLLIDED"), ([0.3, 0.3, -0.3, -0.3], "TIPPED"),
    ([1.0, 1.0, 1.0, 1.0], "ABORTED"),
])  # fmt: skip
def test_failures_are_penalized(
    lawn: str, make_task: MakeTask, action: list[float], outcome: str
) -> None:
    task = make_task(lawn, start_height_m=12.0, profile="ideal")
    task.reset(0, np.random.default_rng(1))
    for _ in range(600):
        last = task.step(np.array(action))
        if last.terminated:
            break
    # beyond the edge of the scene safe ground counts as 20 m away: 2 at most
    edge = 2.0 * (outcome == "ABORTED")
    assert last.info["outcome"] == outcome and -10.5 - edge < last.reward < -9.5


def test_time_limit_truncates(lawn: str, make_task: MakeTask) -> None:
    task = make_task(lawn, time_limit_s=0.2)
    task.reset(0, np.random.default_rng(1))
    ends = [task.step(np.zeros(4)) for _ in range(10)]
    assert [e.truncated for e in ends] == [False] * 9 + [True]
    assert not ends[-1].terminated and ends[-1].info["outcome"] == "TIMEOUT"
    assert ends[-1].info["time_s"] == pytest.approx(0.2)


def test_invalid_options_and_actions_raise(lawn: str, make_task: MakeTask) -> None:
    cases: list[tuple[dict[str, Any], str]] = [
        ({"action": "thrust"}, r"action 'thrust' is unknown: give one of rotors, velocity"),
        ({"sensors": ("sonar",)}, r"'sonar': give some of imu"),
        ({"sensors": ()}, r"sensors holds none"),
        ({"start_height_m": 1.0}, r"start_height_m must be 2"),
        ({"time_limit_s": 0.0}, r"time_limit_s is 0"),
        ({"action_hz": 60}, r"action_hz is 60: give a divisor of 200"),
        ({"camera_pixels": (0, 10)}, r"camera\.width"),
    ]
    for options, message in cases:
        with pytest.raises(ValueError, match=message):
            LandingTask(TaskOptions(scene=lawn, **options))
    task = make_task(lawn)
    with pytest.raises(RuntimeError, match=r"reset the environment"):
        task.step(np.zeros(4))
    task.reset(0, np.random.default_rng(0))
    with pytest.raises(ValueError, match=r"4 finite numbers"):
        task.step(np.array([0.0, np.nan, 0.0, 0.0]))
    with pytest.raises(ValueError, match=r"did you mean 'crossroad'"):
        LandingTask(TaskOptions(scene="crosroad")).reset(0, np.random.default_rng(0))
