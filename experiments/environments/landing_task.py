"""The landing task: fly from a hover to a touchdown on safe ground.

**Episode.** The vehicle hovers ``start_height_m`` over a random point near the take-off spot, held
by an autopilot for 0.4 s while the sensors deliver their first measurements; then the policy flies.
The episode ends with the first contact, a tilt above 75 degrees, leaving the scene or climbing 30 m
above the start; it is cut off after ``time_limit_s``.

**Action**, (4,) in [-1, 1], held for 1 / ``action_hz``. ``rotors``: one number for each rotor,
linear in thrust from idle to full; 0 is close to hover. ``velocity``: forward, left, up (4, 4,
2.5 m/s) and yaw rate (60 deg/s) in the heading frame, flown by the project's cascade controller
from the true state, which the policy does not observe.

**Observation**, a dictionary of the chosen ``sensors``, with their noise, bias and delay; with
``privileged`` also ``state``, the true state.

===============  =========  =====================================================================
``imu``          (6,)       mean since the last action: rad/s, m/s^2, IMU frame
``rangefinder``  (1,)       metres down the body's axis, 0 without a return
``barometer``    (1,)       metres above the first reading
``magnetometer`` (3,)       microtesla, body frame
``rotors``       (4,)       speeds, 1 = full
``gps``          (6,)       position of the antenna from the take-off spot and velocity, m and m/s
``camera``       (H, W, 3)  newest image, uint8, 10 Hz
``state``        (19,)      position from the take-off spot, velocity, rotation matrix by rows, body
                            rates, height over the surface below (at most 1000)
===============  =========  =====================================================================

**Reward.** Progress is potential-based, so that it changes no optimal policy (Ng, Harada, Russell
1999): every step gives Phi(now) - Phi(before) with Phi = -0.1 (height + distance), the height of
the feet over the take-off ground and the horizontal distance to the nearest truly safe point (at
most 20), both in metres; less 0.01 a second. The end gives

- a touchdown on the legs at most 1.5 m/s down, 1 m/s sideways and 20 degrees tilted: 10 on a truly
  safe point, less up to half for vertical speed (linear to 1.5 m/s); -2 on any other ground;
- anything else that ends the episode: -10.

"Truly safe" is the rule that the referee applies to all flights (`scenes.api.TruthMaps.safe`).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.api import Outcome
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.config.profiles import DEFAULT, PROFILES
from touchdown.experiments.config.schema import Config
from touchdown.experiments.environments.action_modes import ACTIONS, Autopilot, rotor_command
from touchdown.experiments.environments.observations import SENSORS, ObservationBuffer, sensor_needs
from touchdown.experiments.environments.task_scene import TaskScene, task_scene
from touchdown.experiments.flight.referee import TruthLookup, stands_on_truth
from touchdown.experiments.flight.wiring import build_scene, make_world
from touchdown.sim.api import CameraParams, Command, Truth
from touchdown.sim.frames import tilt_from_rotation
from touchdown.sim.typing import Array

WARM_UP_S = 0.4
MAX_TILT_DEG = 75.0
MAX_CLIMB_M = 30.0
TOUCH_DOWN_MPS = 1.5
TOUCH_SIDE_MPS = 1.0
TOUCH_TILT_DEG = 20.0
PROGRESS_PER_M = 0.1
TIME_COST_PER_S = 0.01
SAFE, UNSAFE, FAILED = 10.0, -2.0, -10.0
_EDGE_M = 5.0


@dataclass(frozen=True, kw_only=True, slots=True)
class TaskOptions:
    """Arguments of ``gymnasium.make`` and of ``touchdown.suite``. Raises ValueError if invalid."""

    scene: str = "crossroad"
    """a name or the path of an MJCF file"""
    action: str = "rotors"
    """``rotors`` or ``velocity``"""
    sensors: tuple[str, ...] = ("imu", "rangefinder", "barometer", "magnetometer", "rotors")
    privileged: bool = False
    """adds the true state to the observation"""
    start_height_m: float = 10.0
    """above the highest surface within 3 m of the start"""
    start_spread_m: float = 10.0
    """the start lies in a square of twice this side around the take-off spot"""
    time_limit_s: float = 60.0
    action_hz: int = 50
    wind_kmh: float = 12.0
    profile: str = DEFAULT
    """how kind the world is: ``field``, ``ideal`` or ``harsh``"""
    camera_pixels: tuple[int, int] = (84, 84)
    """width, height; the field of view is 69 degrees along the longer side"""
    view_pixels: tuple[int, int] = (424, 240)
    """of rendered views, width, height"""

    def __post_init__(self) -> None:
        for name, known in (("action", ACTIONS), ("profile", tuple(PROFILES))):
            if getattr(self, name) not in known:
                given, all_known = getattr(self, name), ", ".join(known)
                raise ValueError(f"{name} '{given}' is unknown: give one of {all_known}")
        unknown = [name for name in self.sensors if name not in SENSORS]
        if unknown or not (self.sensors or self.privileged):
            given = f"'{unknown[0]}'" if unknown else "none"
            raise ValueError(f"sensors holds {given}: give some of {', '.join(SENSORS)}")
        if not self.start_height_m >= 2.0 or not self.start_spread_m >= 0.0:
            raise ValueError("start_height_m must be 2 or more, start_spread_m 0 or more")
        if not self.time_limit_s > 0.0:
            raise ValueError(f"time_limit_s is {self.time_limit_s:g}: give a positive time")


@dataclass(frozen=True, slots=True)
class Step:
    """Result of one action."""

    observation: dict[str, NDArray[Any]]
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]


@dataclass(frozen=True, slots=True)
class _End:
    """End of an episode. Its reward is added to that of the last step."""

    outcome: Outcome
    safe: bool
    reward: float


class LandingTask:
    """Runs episodes of the task. Call ``reset`` before the first ``step``; ``step`` is
    ``take_action``, then ``advance`` until the action is flown, then ``result``. ``drawn``: the
    world's own model can be drawn."""

    def __init__(self, options: TaskOptions, drawn: bool = False) -> None:
        self.options = options
        self._drawn = drawn
        self.observations = ObservationBuffer(
            options.sensors, options.privileged, options.camera_pixels
        )
        self._config = _configuration(options)
        sim = self._config.sim
        control_hz = sim.tick_hz // sim.control_ticks
        if options.action_hz < 1 or control_hz % options.action_hz:
            raise ValueError(f"action_hz is {options.action_hz}: give a divisor of {control_hz}")
        self._steps_per_action = control_hz // options.action_hz
        self.control_ticks = sim.control_ticks
        """ticks of a control step, of which an action takes several"""
        self._layout: TaskScene | None = None
        self._world: Any = None
        self._view: Any = None
        self._end: _End | None = None

    def reset(self, layout_seed: int | None, rng: np.random.Generator) -> Step:
        """Begins an episode on the layout of ``layout_seed`` (None: the present one). ``rng`` draws
        start, wind and sensor errors. The step's reward is 0."""
        self.close()
        layout = self.layout(layout_seed)
        world_seed = int(rng.integers(2**31))
        self._build(layout, self._config.model_copy(update={"seed": world_seed}))
        self._end = None
        rig = self._world.rig
        self.observations.reset(rig)
        self._home = rig.world_from_body_start.translation - [0.0, 0.0, rig.vehicle.leg_height_m]
        self._obs = self._world.start_in_air(*self._start(layout, rng))
        self._start_z = float(self._world.truth().world_from_body.translation[2])
        self._start_tick = round(WARM_UP_S * rig.tick_hz)
        while self._obs.tick < self._start_tick:
            self._advance(self._autopilot.command(self._obs, np.zeros(4)))
        self._potential = -PROGRESS_PER_M * self.away_m
        return Step(self._observation(), 0.0, False, False, self._info(None))

    def _build(self, layout: TaskScene, config: Config) -> None:
        """World, autopilot and viewing camera of one episode."""
        from touchdown.controller.cascade import CascadeController
        from touchdown.estimator.oracle import Oracle
        from touchdown.experiments.flight.platform import limit_threads
        from touchdown.sim.camera.sensor import CameraSensor

        limit_threads()
        self._world = make_world(config, layout.scene, self._drawn)
        self._world.require(sensor_needs(self.options.sensors))
        width, height = self.options.view_pixels
        lens = CameraParams(noise_sigma=0.0, samples=4, width=width, height=height)
        self._view = CameraSensor(layout.scene, lens, config.world_seed)
        self._autopilot = Autopilot(
            Oracle(self._world.truth),
            CascadeController(self._world.rig.vehicle, config.control),
            config.sim.control_ticks / config.sim.tick_hz,
        )

    def step(self, action: NDArray[Any]) -> Step:
        """Flies one action; raises as ``take_action``."""
        self.take_action(action)
        for _ in range(self._steps_per_action):
            if not self.advance():
                break
        return self.result()

    def take_action(self, action: NDArray[Any]) -> None:
        """Sets the action that is flown next, (4,), clipped to [-1, 1].

        Raises ValueError for a wrong shape or values that are not finite, and RuntimeError before
        the first reset.
        """
        self._require_world()
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (4,) or not np.all(np.isfinite(action)):
            raise ValueError(f"an action is 4 finite numbers, not {action!r}")
        self._action = np.clip(action, -1.0, 1.0)

    def advance(self) -> bool:
        """Flies one control step of the action; False where it ended the episode."""
        before = self._truth
        if self.options.action == "rotors":
            self._advance(rotor_command(self._action, self._world.rig.vehicle))
        else:
            self._advance(self._autopilot.command(self._obs, self._action))
        self._end = self._judge(before, self._truth)
        return self._end is None

    def result(self) -> Step:
        """Returns what the action came to."""
        end, before = self._end, self._potential
        self._potential = -PROGRESS_PER_M * self.away_m
        reward = self._potential - before - TIME_COST_PER_S / self.options.action_hz
        if end is not None:
            reward += end.reward
        truncated = end is None and self._time_s() >= self.options.time_limit_s
        info = self._info(end, truncated)
        return Step(self._observation(), reward, end is not None, truncated, info)

    @property
    def world(self) -> Any:
        """``sim.world.MujocoWorld`` of the episode. Raises RuntimeError before the first reset."""
        self._require_world()
        return self._world

    @property
    def away_m(self) -> float:
        """Height of the feet over the take-off ground, and horizontal distance to the nearest truly
        safe point, at most 20, together."""
        assert self._layout is not None
        position = self._truth.world_from_body.translation
        feet = position[2] - self._world.rig.vehicle.leg_height_m
        return float(feet - self._home[2]) + self._layout.distance_at(position[:2])

    def layout(self, seed: int | None) -> TaskScene:
        """Returns the layout of a seed (None: the present one), which the next ``reset`` takes."""
        if self._layout is None or seed not in (None, self._layout.scene.seed):
            self._layout = None  # frees the old one first
            scene = build_scene(self._config.model_copy(update={"seed": seed or 0}))
            self._layout = task_scene(scene)
        return self._layout

    def render(self) -> NDArray[np.uint8]:
        """Returns the vehicle's view downwards, (H, W, 3) uint8. Raises RuntimeError before the
        first reset."""
        self._require_world()
        return self._view.render(self._world.snapshot(), 0).copy()  # type: ignore[no-any-return]

    def close(self) -> None:
        """Frees the world; a later ``reset`` builds another."""
        if self._world is not None:
            self._view.close()
            self._world.close()
            self._world = self._view = None

    # ------------------------------------------------------------------------------ inside

    def _require_world(self) -> None:
        if self._world is None:
            raise RuntimeError("reset the environment first")

    def _start(self, layout: TaskScene, rng: np.random.Generator) -> tuple[Array, float]:
        spread = self.options.start_spread_m
        low, high = layout.scene.bounds_xy_m + np.array([[_EDGE_M], [-_EDGE_M]])
        xy = layout.scene.takeoff_xy_m + rng.uniform(-spread, spread, 2)
        xy = np.clip(xy, low, high)
        z = layout.highest_near(xy) + self.options.start_height_m
        return np.array([*xy, z]), float(rng.uniform(-np.pi, np.pi))

    def _advance(self, command: Command) -> None:
        self._obs = self._world.step(command)
        self._truth: Truth = self._world.truth()
        self.observations.update(self._obs)

    def _judge(self, before: Truth, now: Truth) -> _End | None:
        """Returns the end of the episode, None in flight."""
        assert self._layout is not None
        if now.contacts:
            return self._judge_contact(before, now)
        if np.degrees(tilt_from_rotation(now.world_from_body.rotation)) > MAX_TILT_DEG:
            return _End(Outcome.TIPPED, False, FAILED)
        low, high = self._layout.scene.bounds_xy_m
        position = now.world_from_body.translation
        inside = np.all(position[:2] >= low) and np.all(position[:2] <= high)
        if not inside or position[2] > self._start_z + MAX_CLIMB_M or position[2] < -500.0:
            return _End(Outcome.ABORTED, False, FAILED)
        return None

    def _judge_contact(self, before: Truth, now: Truth) -> _End:
        assert self._layout is not None
        lookup = TruthLookup(self._layout.scene)
        down = -float(before.velocity_world[2])
        side = float(np.linalg.norm(before.velocity_world[:2]))
        tilt_deg = np.degrees(tilt_from_rotation(before.world_from_body.rotation))
        gentle = down <= TOUCH_DOWN_MPS and side <= TOUCH_SIDE_MPS and tilt_deg <= TOUCH_TILT_DEG
        moving = lookup.moving_geoms
        legs = all(c.part == "leg" and c.other not in moving for c in now.contacts)
        if not (gentle and legs):
            return _End(Outcome.COLLIDED, False, FAILED)
        on_truth = stands_on_truth(lookup.height_gap_m(now.contacts)) is not False
        safe = on_truth and bool(lookup.judge(now.world_from_body.translation[:2]).safe)
        if not safe:
            return _End(Outcome.LANDED, False, UNSAFE)
        return _End(Outcome.LANDED, True, SAFE * (1.0 - 0.5 * max(down, 0.0) / TOUCH_DOWN_MPS))

    def _observation(self) -> dict[str, NDArray[Any]]:
        height = self._world.height_over_ground()
        return self.observations.observation(self._truth, self._home, height)

    def _time_s(self) -> float:
        return float((self._obs.tick - self._start_tick) / self._world.rig.tick_hz)

    def _info(self, end: _End | None, truncated: bool = False) -> dict[str, Any]:
        outcome = Outcome.TIMEOUT if truncated else end and end.outcome
        assert self._layout is not None
        return {
            "time_s": self._time_s(),
            "layout": self._layout.scene.seed,
            "outcome": "" if outcome is None else str(outcome),
            "safe": end is not None and end.safe,
        }


def _configuration(options: TaskOptions) -> Config:
    width, height = options.camera_pixels
    longer = max(width, height)
    half_tangents = np.tan(np.radians(34.5)) * np.array([width, height]) / longer
    fov = 2.0 * np.degrees(np.arctan(half_tangents))
    return load_config(
        None,
        [
            f"camera.width={width}",
            f"camera.height={height}",
            f"camera.fov_x_deg={fov[0]}",
            f"camera.fov_y_deg={fov[1]}",
            f"wind.mean_kmh={options.wind_kmh}",
            "sim.threads=1",
            "scene_as_is=true",
        ],
        scene=options.scene,
        estimator="oracle",
        profile=options.profile,
    )
