"""The objects of one flight, built from a configuration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from touchdown.controller.api import Controller
from touchdown.estimator.api import Estimate, Estimator, Mapper, spare_sensors
from touchdown.experiments.api import BiasParams
from touchdown.experiments.config.schema import Config
from touchdown.experiments.config.slots import PX4, SLOTS, names_code, params_of
from touchdown.experiments.errors import UsageError, nearest, usage_errors
from touchdown.experiments.flight.estimator_calibration import nominal_rig
from touchdown.experiments.flight.slots import (
    Overheard,
    external_name,
    external_of,
    external_part,
    lander_rig,
)
from touchdown.landing.api import Lander, Watch, WatchRig
from touchdown.scenes.api import Guests, ImportOptions, LowSun, Scene, names_function
from touchdown.scenes.registry import scene_names
from touchdown.sim.api import Observation, SensorRig, Truth, World, WorldParams
from touchdown.sim.effects import WorldRecord
from touchdown.sim.files.opening import no_file
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array

if TYPE_CHECKING:
    from touchdown.experiments.external.wrapper import ExternalPart
    from touchdown.experiments.px4.autopilot import Px4Autopilot
    from touchdown.landing.classification.onboard import OnnxGroundClassifier


@dataclass(slots=True)
class FlightStack:
    """The parts of one flight, ready for `touchdown.experiments.flight.loop.run_flight`."""

    scene: Scene
    world: World
    estimator: Estimator
    mapper: Mapper
    lander: Lander
    controller: Controller
    record: Callable[[], WorldRecord]
    """what the world has done to the flight so far, for the result alone"""
    nominal_rig: SensorRig
    """the rig as the estimator knows it"""
    network: dict[str, Any] | None = None
    """the network of the ground classifier, for the result; None without one"""
    external: tuple[ExternalPart, ...] = ()
    """the parts that code from outside fills"""
    autopilot: Px4Autopilot | None = None
    """the controller where it is a program of its own, to be closed after the flight"""


def build_scene(config: Config) -> Scene:
    """Loads the scene of a configuration. Raises ValueError or FileNotFoundError, one line each."""
    from touchdown.scenes.cache import cached_scene

    seed = config.seed if config.scene_seed is None else config.scene_seed
    options = None if config.scene_as_is else ImportOptions(classes=config.scene_classes or "")
    intruders = sum(fault.kind == "intruder" for fault in config.faults.schedule())
    turns = (config.lidar.mount_deg, config.lidar.second_mount_deg)
    guests = Guests(config.vehicle, intruders, config.camera.mount_deg, turns)
    how = (seed, low_sun(config), config.light, options, config.dials, config.traffic, guests)
    if names_function(config.scene):
        from touchdown.experiments.external.places import place_file

        with place_file(config.scene, seed) as file:
            scene = replace(cached_scene(str(file), *how), source=config.scene)
    else:
        scene = cached_scene(config.scene, *how)
    if config.landing.site_xy_m is not None:
        _refuse_site_of_the_file(np.array(config.landing.site_xy_m), scene)
    return scene


def _refuse_site_of_the_file(site: Array, scene: Scene) -> None:
    """Raises ValueError for a site in the coordinates of a file whose origin was moved."""
    moved = site - scene.origin_m[:2]
    low, high = scene.bounds_xy_m
    inside = bool(((moved >= low) & (moved <= high)).all())
    if inside and not bool(((site >= low) & (site <= high)).all()):
        x, y = scene.origin_m[:2]
        raise ValueError(
            f"site {site[0]:g},{site[1]:g} is in the coordinates of the file; the world's origin "
            f"lies at {x:.0f},{y:.0f} there: give {moved[0]:g},{moved[1]:g}"
        )


def low_sun(config: Config) -> LowSun | None:
    """The sun of a ``low_sun`` fault; None leaves the scene's own."""
    faults = config.faults
    if not any(fault.kind == "low_sun" for fault in faults.schedule()):
        return None
    return LowSun(elevation_deg=faults.low_sun_deg, azimuth_deg=faults.low_sun_azimuth_deg)


def build_flight_stack(config: Config, scene: Scene) -> FlightStack:
    """Builds all parts of a flight. Only the oracle gets the truth."""
    from touchdown.controller.cascade import CascadeController
    from touchdown.landing.deck.lander import DeckLander
    from touchdown.landing.mission.lander import SiteLander

    network = build_classifier(config)
    world = make_world(config, scene)
    try:
        rig = nominal_rig(world.rig, config)
        own_estimator = _estimator(config, rig, world.truth)
        selector = external_part(config, "selector", rig)
        controller = external_part(config, "controller", rig)
        own_classifier = external_part(config, "classifier", rig)
        own_mapper = external_part(config, "mapper", rig)
        own_watch = external_part(config, "watch", rig)
        classifier, watch = own_classifier or network, own_watch or _watch(config, rig)
        select = None if selector is None else selector.select
        own_lander = external_part(
            config, "lander", rig, lander_rig(config, rig, select, classifier, watch)
        )
        autopilot = _autopilot(config, rig)
    except ValueError:
        world.close()
        raise
    estimator = _completed(own_estimator, rig, config)
    own_controller = CascadeController(world.rig.vehicle, config.control)
    if autopilot is not None:
        estimator = Overheard(estimator, autopilot.sense)
    elif controller is None:
        estimator = Overheard(estimator, lambda obs: own_controller.hear(obs.rotor_speed_radps))
    mapper = own_mapper or _mapper(config, rig)
    lander: Lander
    if config.survey.trajectory:
        from touchdown.experiments.flight.carried import Passenger

        lander = Passenger(world.duration_s)
    elif own_lander is None and config.landing.moving_site:
        lander = DeckLander(rig, config.landing, config.survey)
    else:
        lander = own_lander or SiteLander(
            rig, config.landing, config.survey, classifier, select, watch
        )
    needs = estimator.needs
    if autopilot is not None:
        lander = autopilot.holding(lander)
        needs = needs | autopilot.needs
    if config.mapper.enabled:
        needs = needs | mapper.needs | lander.needs
        if own_watch is not None:
            needs = needs | own_watch.needs
    world.require(needs)
    return FlightStack(
        scene=scene,
        world=world,
        estimator=estimator,
        mapper=mapper,
        lander=lander,
        controller=controller or autopilot or own_controller,
        record=world.record,
        nominal_rig=rig,
        network=None if classifier is None else classifier.description(),
        external=external_of(
            own_estimator,
            selector,
            controller,
            own_classifier,
            own_mapper,
            own_lander,
            own_watch,
        ),
        autopilot=autopilot,
    )


def check_autopilot(config: Config) -> None:
    """Raises UsageError, one line with what to do, where PX4 is to control and cannot."""
    if config.control.controller == PX4:
        from touchdown.experiments.px4.autopilot import check_px4

        check_px4(config)


def _autopilot(config: Config, rig: SensorRig) -> Px4Autopilot | None:
    """PX4 where it is the controller."""
    if config.control.controller != PX4:
        return None
    from touchdown.experiments.px4.autopilot import Px4Autopilot

    return Px4Autopilot(config, rig)


def classifier_file(config: Config) -> Path | None:
    """The network file of the ground classifier. None for ``off``, for a survey alone, for a
    selector without the gate ``class``, for ``auto`` without a shipped network, and for an external
    classifier. With the paper's selector ``auto`` is the paper's network."""
    from touchdown.landing.classification import onboard

    wanted, gates = config.landing.classifier, config.landing.chosen_selector.gates
    if external_name(config, "classifier") is not None:
        return None
    if wanted == "off" or config.landing.survey_only or "class" not in gates:
        return None
    if wanted != "auto":
        return Path(wanted)
    shipped = onboard.ZOU2024 if config.landing.selector == "zou2024" else onboard.SHIPPED
    return shipped if shipped.is_file() else None


def build_classifier(config: Config) -> OnnxGroundClassifier | None:
    """Loads the ground classifier; None without one. Raises UsageError where the file cannot be
    used or ONNX Runtime is missing."""
    file = classifier_file(config)
    if file is None:
        return None
    from touchdown.landing.classification.onboard import load_onboard_classifier

    try:
        return load_onboard_classifier(file, config.landing.classifier_threads)
    except (ValueError, OSError) as error:
        raise UsageError(f"landing.classifier: {error}") from error
    except ImportError as error:
        raise UsageError(
            f"landing.classifier needs {error.name}: install it, or set it to off"
        ) from error


def _mapper(config: Config, rig: SensorRig) -> Mapper:
    from touchdown.estimator.mapping.mapper import GridMapper, NoMap

    grid = GridMapper(rig, config.mapper)
    used = config.mapper.enabled and not config.landing.moving_site
    return grid if used else NoMap(grid)


def _watch(config: Config, rig: SensorRig) -> Watch | None:
    """The shipped watch; None where it is off or has nothing to do."""
    if config.landing.watch == "off" or config.landing.survey_only or config.landing.moving_site:
        return None
    from touchdown.landing.watch.standard import StandardWatch

    return StandardWatch(WatchRig(sensors=rig, landing=config.landing))


def world_params(config: Config) -> WorldParams:
    """The configured parameters of the simulated world."""
    return WorldParams(**{one.name: getattr(config, one.name) for one in fields(WorldParams)})


def make_world(config: Config, scene: Scene, drawn: bool = False) -> Any:
    """The world of a configuration; ``drawn`` as in `sim.world.MujocoWorld`."""
    if config.survey.trajectory:
        from touchdown.experiments.flight.carried import carried_world

        return carried_world(config, scene, world_params(config), drawn)
    from touchdown.sim.world import MujocoWorld

    return MujocoWorld(scene, world_params(config), config.world_seed, drawn=drawn)


def build_estimator(config: Config, rig: SensorRig) -> Estimator:
    """The configured estimator without a world. Raises UsageError; the oracle needs a world."""
    if config.estimator == "oracle":
        raise UsageError("estimator 'oracle' returns the truth and needs a flight; replay another")

    def no_truth() -> Truth:
        raise RuntimeError("only the oracle may read the truth")

    return _completed(_estimator(config, rig, no_truth), rig, config)


def estimator_builder(config: Config) -> Callable[[dict[str, Any], SensorRig], Estimator]:
    """``build(params, rig)`` of the configured estimator. Raises UsageError where there is none."""
    check_estimator_name(config.estimator)
    if config.estimator in ESTIMATORS:
        return lambda _params, rig: build_estimator(config, rig)
    from touchdown.experiments.external.loading import external_builder

    return usage_errors(lambda: external_builder(config.estimator))  # type: ignore[no-any-return]


def _completed(estimator: Estimator, rig: SensorRig, config: Config) -> Estimator:
    """With what follows a deck, and with a bias, where they are asked for."""
    if config.landing.moving_site:
        from touchdown.estimator.deck.odometry import DeckOdometry

        estimator = DeckOdometry(estimator, rig, config.landing.deck_tag_m)
    return BiasedEstimator(estimator, config.bias) if any(config.bias.xy_m) else estimator


ESTIMATORS = ("livo", "zou2024", "gps", "optical_flow", "hybrid_flow", "stereo", "oracle")


def _estimator(config: Config, rig: SensorRig, truth: Callable[[], Truth]) -> Estimator:
    """The configured estimator without a bias; the oracle alone gets the truth."""
    check_estimator_name(config.estimator)
    if config.estimator not in ESTIMATORS:
        from touchdown.experiments.external.wrapper import ExternalEstimator

        return ExternalEstimator(config.estimator, params_of(config, "estimator"), rig)
    if config.estimator == "oracle":
        from touchdown.estimator.oracle import Oracle

        return Oracle(truth)
    if config.estimator == "livo":
        from touchdown.estimator.livo.estimator import Livo

        return Livo(rig, config.livo)
    from touchdown.estimator.filtering.inertial_filter import with_flown_noise

    rig = with_flown_noise(rig, config.flown_imu)
    if config.estimator == "zou2024":
        from touchdown.estimator.zou2024.estimator import Zou2024Estimator

        return Zou2024Estimator(rig, config.zou2024)
    return _baseline(config, rig)


def _baseline(config: Config, rig: SensorRig) -> Estimator:
    if config.estimator == "gps":
        from touchdown.estimator.baselines.gps import GpsEstimator

        return GpsEstimator(rig, config.gps_estimator, config.calibration_prior)
    if config.estimator == "optical_flow":
        from touchdown.estimator.baselines.optical_flow import OpticalFlowEstimator

        return OpticalFlowEstimator(rig, config.optical_flow, config.calibration_prior)
    if config.estimator == "hybrid_flow":
        from touchdown.estimator.baselines.optical_flow import HybridFlowEstimator

        return HybridFlowEstimator(rig, config.hybrid_flow, config.calibration_prior)
    from touchdown.estimator.baselines.stereo import StereoEstimator

    return StereoEstimator(rig, config.stereo_vo, config.calibration_prior)


def check_estimator_name(name: str) -> None:
    """Raises UsageError, naming the nearest estimator, unless ``name`` is a known estimator or has
    the form MODULE:FUNCTION. Imports nothing; `slots.check_parts_available` does."""
    if name not in ESTIMATORS and not names_code(SLOTS["estimator"], name):
        known = ", ".join(ESTIMATORS)
        raise UsageError(
            f"unknown estimator '{name}'{nearest(name, ESTIMATORS)}; "
            f"known: {known}, or MODULE:FUNCTION of your own"
        )


def check_scene_name(name: str, where: str = "") -> None:
    """Raises UsageError unless ``name`` is a known scene or a file that holds one, which is loaded.
    ``where`` completes the message, such as " in FILE"."""
    from touchdown.scenes.compose import load_scene

    if names_function(name):
        from touchdown.experiments.external.places import place_file

        with place_file(name, 0) as file:
            load_scene(str(file), 0)
    elif "/" in name or name.endswith(".xml"):
        if reason := no_file(Path(name)):
            raise UsageError(f"scene file '{name}'{where} {reason}")
        try:
            load_scene(name, 0, options=ImportOptions())
        except (OSError, ValueError) as error:
            raise UsageError(f"scene{where}: {error}") from error
    elif name not in (known := scene_names()):
        raise UsageError(
            f"unknown scene '{name}'{where}{nearest(name, known)}; known: {', '.join(known)}, or "
            "the path of an MJCF file, or MODULE:FUNCTION that makes one"
        )


_TAKEN_OFF_M = 1.0


class BiasedEstimator:
    """Adds a horizontal offset to another estimator's pose, ramped in linearly after take-off."""

    def __init__(self, inner: Estimator, params: BiasParams) -> None:
        self.needs, self.spare_sensors = inner.needs, spare_sensors(inner)
        self._inner = inner
        self._bias = np.array([*params.xy_m, 0.0])
        self._ramp_s = params.ramp_s
        self._start_height: float | None = None
        self._since_s: float | None = None

    def update(self, obs: Observation) -> Estimate:
        estimate = self._inner.update(obs)
        height = float(estimate.odom_from_body.translation[2])
        if self._start_height is None:
            self._start_height = height
        if self._since_s is None:
            if height < self._start_height + _TAKEN_OFF_M:
                return estimate
            self._since_s = estimate.time_s
        elapsed = (estimate.time_s - self._since_s) / self._ramp_s
        return self._shifted(estimate, min(elapsed, 1.0), ramping=elapsed < 1.0)

    def _shifted(self, estimate: Estimate, fraction: float, *, ramping: bool) -> Estimate:
        pose = estimate.odom_from_body
        offset = fraction * self._bias
        track = estimate.scan_track
        if track is not None:
            track = replace(track, positions_odom=track.positions_odom + offset)
        rate = self._bias / self._ramp_s if ramping else np.zeros(3)
        return replace(
            estimate,
            odom_from_body=Pose(pose.rotation, pose.translation + offset),
            velocity_odom=estimate.velocity_odom + rate,
            scan_track=track,
        )
