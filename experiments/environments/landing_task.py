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

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from touchdown.experiments.api import Outcome
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.config.profiles import DEFAULT, PROFILES
from touchdown.experiments.config.schema import Config
from touchdown.experiments.environments.action_modes import ACTION_MODES, ActionMode
from touchdown.experiments.environments.observations import SENSORS, ObservationBuffer, sensor_needs
from touchdown.experiments.environments.wiring import EnvBackend, build_env_backend
from touchdown.experiments.flight.truth_lookup import TruthLookup, stands_on_truth
from touchdown.experiments.flight.wiring import build_scene
from touchdown.scenes.api import Scene, TruthMaps
from touchdown.scenes.truth.maps import truth_maps as scene_truth_maps
from touchdown.sim.api import Truth
from touchdown.sim.frames import tilt_from_rotation

Array = NDArray[np.float64]

WARM_UP_S = 0.4
MAX_TILT_DEG = 75.0
MAX_CLIMB_M = 30.0
TOUCH_DOWN_MPS = 1.5
TOUCH_SIDE_MPS = 1.0
TOUCH_TILT_DEG = 20.0
_PROGRESS_PER_M = 0.1
_TIME_COST_PER_S = 0.01
_SAFE, _UNSAFE, _FAILED = 10.0, -2.0, -10.0
_MAP_CELL_M = 0.25
_MAX_DISTANCE_M = 20.0
_EDGE_M = 5.0
_CLEAR_RADIUS_M = 3.0


@dataclass(frozen=True, kw_only=True, slots=True)
class TaskOptions:
    """Arguments of ``gymnasium.make`` and of the dm_env class. Raises ValueError if invalid."""

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
        if self.action not in ACTION_MODES:
            known = ", ".join(ACTION_MODES)
            raise ValueError(f"action '{self.action}' is unknown: give one of {known}")
        unknown = [name for name in self.sensors if name not in SENSORS]
        if unknown or not (self.sensors or self.privileged):
            given = f"'{unknown[0]}'" if unknown else "none"
            raise ValueError(f"sensors holds {given}: give some of {', '.join(SENSORS)}")
        if not self.start_height_m >= 2.0 or not self.start_spread_m >= 0.0:
            raise ValueError("start_height_m must be 2 or more, start_spread_m 0 or more")
        if self.profile not in PROFILES:
            known = ", ".join(PROFILES)
            raise ValueError(f"profile '{self.profile}' is unknown: give one of {known}")
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
class TaskScene:
    """A scene with its true safe ground."""

    scene: Scene
    maps: TruthMaps
    safe_distance_m: Array
    """(rows, cols) to the nearest safe cell, on the grid of ``maps``"""

    def distance_at(self, xy: Array) -> float:
        """Metres to the nearest safe point, at most 20; 20 outside of the maps."""
        cell = _cell_of(self.maps, xy)
        return _MAX_DISTANCE_M if cell is None else float(self.safe_distance_m[cell])

    def highest_near(self, xy: Array) -> float:
        """Height of the highest surface within 3 m; 0 where there is none."""
        maps = self.maps
        row, col = np.floor((xy - maps.origin_xy_m) / maps.cell_m).astype(int)[::-1]
        reach = round(_CLEAR_RADIUS_M / maps.cell_m)
        window = maps.height_m[
            max(row - reach, 0) : row + reach + 1, max(col - reach, 0) : col + reach + 1
        ]
        seen = window[np.isfinite(window)]
        return float(seen.max()) if seen.size else 0.0


class LandingTask:
    """Runs episodes of the task. Call ``reset`` before the first ``step``."""

    def __init__(self, options: TaskOptions) -> None:
        self.options = options
        self.observations = ObservationBuffer(
            options.sensors, options.privileged, options.camera_pixels
        )
        self._config = _configuration(options)
        sim = self._config.sim
        control_hz = sim.tick_hz // sim.control_ticks
        if options.action_hz < 1 or control_hz % options.action_hz:
            raise ValueError(f"action_hz is {options.action_hz}: give a divisor of {control_hz}")
        self._steps_per_action = control_hz // options.action_hz
        self._layout: TaskScene | None = None
        self._backend: EnvBackend | None = None

    def reset(self, layout_seed: int | None, rng: np.random.Generator) -> Step:
        """Begins an episode on the layout of ``layout_seed`` (None: the present one). ``rng`` draws
        start, wind and sensor errors. The step's reward is 0."""
        if self._backend is not None:
            self._backend.close()
            self._backend = None
        layout = self._take_layout(layout_seed)
        world_seed = int(rng.integers(2**31))
        config = self._config.model_copy(update={"seed": world_seed})
        needs = sensor_needs(self.options.sensors)
        backend = build_env_backend(config, layout.scene, needs, self.options.view_pixels)
        self._backend = backend
        self._action_mode: ActionMode = ACTION_MODES[self.options.action](backend)
        rig = backend.world.rig
        self.observations.reset(rig)
        self._home = rig.world_from_body_start.translation - [0.0, 0.0, rig.vehicle.leg_height_m]
        self._obs = backend.world.start_in_air(*self._start(layout, rng))
        self._start_z = float(backend.world.truth().world_from_body.translation[2])
        self._start_tick = round(WARM_UP_S * rig.tick_hz)
        while self._obs.tick < self._start_tick:
            self._advance(self._action_mode.hold(self._obs))
        self._potential = self._potential_now()
        return Step(self._observation(), 0.0, False, False, self._info(None, False))

    def step(self, action: NDArray[Any]) -> Step:
        """Flies one action, (4,) clipped to [-1, 1].

        Raises ValueError for a wrong shape or values that are not finite, and RuntimeError before
        the first reset.
        """
        if self._backend is None:
            raise RuntimeError("reset the environment before its first step")
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (4,) or not np.all(np.isfinite(action)):
            raise ValueError(f"an action is 4 finite numbers, not {action!r}")
        action = np.clip(action, -1.0, 1.0)
        outcome, safe, ending = None, False, 0.0
        self._action_mode.set_action(action)
        for _ in range(self._steps_per_action):
            before = self._truth
            self._advance(self._action_mode.command(self._obs))
            outcome, safe, ending = self._judge(before, self._truth)
            if outcome is not None:
                break
        time_s = (self._obs.tick - self._start_tick) / self._backend.world.rig.tick_hz
        potential = self._potential_now()
        reward = potential - self._potential
        self._potential = potential
        reward += ending - _TIME_COST_PER_S / self.options.action_hz
        truncated = outcome is None and time_s >= self.options.time_limit_s
        named = Outcome.TIMEOUT if truncated else outcome
        return Step(
            self._observation(), reward, outcome is not None, truncated, self._info(named, safe)
        )

    def render(self) -> NDArray[np.uint8]:
        """Returns the vehicle's view downwards, (H, W, 3) uint8. Raises RuntimeError before the
        first reset."""
        if self._backend is None:
            raise RuntimeError("reset the environment before rendering it")
        return self._backend.render().copy()

    def close(self) -> None:
        """Frees the world; a later ``reset`` builds another."""
        if self._backend is not None:
            self._backend.close()
            self._backend = None

    # ------------------------------------------------------------------------------ inside

    def _take_layout(self, seed: int | None) -> TaskScene:
        if self._layout is None or seed not in (None, self._layout.scene.seed):
            self._layout = None  # frees the old one first
            scene = build_scene(self._config.model_copy(update={"seed": seed or 0}))
            maps = scene_truth_maps(scene, _MAP_CELL_M)
            self._layout = TaskScene(scene, maps, _distances(maps))
        return self._layout

    def _start(self, layout: TaskScene, rng: np.random.Generator) -> tuple[Array, float]:
        spread = self.options.start_spread_m
        low, high = layout.scene.bounds_xy_m + np.array([[_EDGE_M], [-_EDGE_M]])
        xy = layout.scene.takeoff_xy_m + rng.uniform(-spread, spread, 2)
        xy = np.clip(xy, low, high)
        z = layout.highest_near(xy) + self.options.start_height_m
        return np.array([*xy, z]), float(rng.uniform(-np.pi, np.pi))

    def _advance(self, command: Any) -> None:
        assert self._backend is not None
        self._obs = self._backend.world.step(command)
        self._truth: Truth = self._backend.world.truth()
        self.observations.update(self._obs)

    def _potential_now(self) -> float:
        assert self._layout is not None and self._backend is not None
        position = self._truth.world_from_body.translation
        feet = position[2] - self._backend.world.rig.vehicle.leg_height_m
        height = float(feet - self._home[2])
        return -_PROGRESS_PER_M * (height + self._layout.distance_at(position[:2]))

    def _judge(self, before: Truth, now: Truth) -> tuple[Outcome | None, bool, float]:
        """Returns outcome (None in flight), safety of the touchdown, and final reward."""
        assert self._layout is not None
        if now.contacts:
            return self._judge_contact(before, now)
        if np.degrees(tilt_from_rotation(now.world_from_body.rotation)) > MAX_TILT_DEG:
            return Outcome.TIPPED, False, _FAILED
        low, high = self._layout.scene.bounds_xy_m
        position = now.world_from_body.translation
        inside = np.all(position[:2] >= low) and np.all(position[:2] <= high)
        if not inside or position[2] > self._start_z + MAX_CLIMB_M or position[2] < -500.0:
            return Outcome.ABORTED, False, _FAILED
        return None, False, 0.0

    def _judge_contact(self, before: Truth, now: Truth) -> tuple[Outcome, bool, float]:
        assert self._layout is not None
        lookup = TruthLookup(self._layout.scene)
        down = -float(before.velocity_world[2])
        side = float(np.linalg.norm(before.velocity_world[:2]))
        tilt_deg = np.degrees(tilt_from_rotation(before.world_from_body.rotation))
        gentle = down <= TOUCH_DOWN_MPS and side <= TOUCH_SIDE_MPS and tilt_deg <= TOUCH_TILT_DEG
        moving = lookup.moving_geoms
        legs = all(c.part == "leg" and c.other not in moving for c in now.contacts)
        if not (gentle and legs):
            return Outcome.COLLIDED, False, _FAILED
        on_truth = stands_on_truth(lookup.height_gap_m(now.contacts)) is not False
        safe = on_truth and bool(lookup.judge(now.world_from_body.translation[:2]).safe)
        if not safe:
            return Outcome.LANDED, False, _UNSAFE
        return Outcome.LANDED, True, _SAFE * (1.0 - 0.5 * max(down, 0.0) / TOUCH_DOWN_MPS)

    def _observation(self) -> dict[str, NDArray[Any]]:
        assert self._backend is not None
        height = self._backend.world.height_over_ground()
        return self.observations.observation(self._truth, self._home, height)

    def _info(self, outcome: Outcome | None, safe: bool) -> dict[str, Any]:
        assert self._backend is not None and self._layout is not None
        ticks = self._obs.tick - self._start_tick
        return {
            "time_s": ticks / self._backend.world.rig.tick_hz,
            "layout": self._layout.scene.seed,
            "outcome": "" if outcome is None else str(outcome),
            "safe": safe,
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
        ],
        scene=options.scene,
        estimator="oracle",
        profile=options.profile,
    )


def _distances(maps: TruthMaps) -> Array:
    """(rows, cols) metres to the nearest safe cell, at most 20."""
    if not maps.safe.any():
        return np.full(maps.safe.shape, _MAX_DISTANCE_M)
    metres = ndimage.distance_transform_edt(~maps.safe) * maps.cell_m
    return np.minimum(metres, _MAX_DISTANCE_M)


def _cell_of(maps: TruthMaps, xy: Array) -> tuple[int, int] | None:
    col, row = np.floor((xy - maps.origin_xy_m) / maps.cell_m).astype(int)
    rows, cols = maps.safe.shape
    return (int(row), int(col)) if 0 <= row < rows and 0 <= col < cols else None
