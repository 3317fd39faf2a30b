"""Wires a configuration into the objects of one flight.

With ``experiments._build_tools_left`` the only module that knows all folders.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from touchdown.controller.api import Controller
from touchdown.estimator.api import (
    Estimator,
    Mapper,
)
from touchdown.experiments.config.schema import Config
from touchdown.experiments.errors import UsageError, nearest
from touchdown.experiments.external.loading import check_external, is_external
from touchdown.experiments.external.wrapper import ExternalEstimator
from touchdown.experiments.flight.bias_injection import BiasedEstimator
from touchdown.experiments.flight.estimator_calibration import believed_rig
from touchdown.landing.api import Lander
from touchdown.scenes.api import LowSun, Scene
from touchdown.scenes.registry import scene_names
from touchdown.sim.api import SensorRig, Truth, World, WorldParams

if TYPE_CHECKING:
    from touchdown.landing.classification.onboard import OnnxGroundClassifier

Array = NDArray[np.float64]


@dataclass(slots=True)
class Flight:
    """The parts of one flight, ready for ``experiments.flight.loop.run_flight``."""

    scene: Scene
    world: World
    estimator: Estimator
    mapper: Mapper
    lander: Lander
    controller: Controller
    faults: Callable[[], list[dict[str, Any]]]
    """what the scheduled sensor faults have done so far"""
    believed_rig: SensorRig
    """the rig as the estimator knows it"""
    network: dict[str, Any] | None = None
    """what recognises places, for the result; None: nothing does"""


def build_scene(config: Config) -> Scene:
    """Loads the scene of a configuration. Raises ValueError or FileNotFoundError, one line each."""
    from touchdown.scenes.compose import load_scene

    seed = config.seed if config.scene_seed is None else config.scene_seed
    return load_scene(config.scene, seed, low_sun(config))


def low_sun(config: Config) -> LowSun | None:
    """The sun that the faults of a configuration ask for, None: the scene's own."""
    faults = config.faults
    if not any(fault.kind == "low_sun" for fault in faults.schedule()):
        return None
    return LowSun(elevation_deg=faults.low_sun_deg, azimuth_deg=faults.low_sun_azimuth_deg)


def build_flight(config: Config, scene: Scene) -> Flight:
    """Everything that flies. The estimator gets the truth only if it is the oracle."""
    from touchdown.controller.cascade import CascadeController
    from touchdown.landing.mission.lander import SiteLander

    make_estimator = _estimator_factory(config)
    places = build_classifier(config)
    world = make_world(config, scene)
    try:
        rig = believed_rig(world.rig, config)
        estimator = _biased(make_estimator(rig, world.truth), config)
    except ValueError:
        world.close()
        raise
    mapper = _mapper(config, rig)
    lander = SiteLander(rig, config.landing, config.survey, places)
    needs = estimator.needs
    if config.mapper.enabled:
        needs = needs | mapper.needs | lander.needs
    world.require(needs)
    controller = CascadeController(world.rig.vehicle, config.control)
    return Flight(
        scene=scene,
        world=world,
        estimator=estimator,
        mapper=mapper,
        lander=lander,
        controller=controller,
        faults=lambda: world.faults.summary() + world.disturbances.summary(),
        believed_rig=rig,
        network=None if places is None else places.description(),
    )


def classifier_file(config: Config) -> Path | None:
    """The network that recognises places in a flight, None where none does: ``off``, nothing to
    choose, or ``auto`` without one that comes with the project."""
    from touchdown.landing.classification.onboard import SHIPPED

    wanted = config.landing.classifier
    if wanted == "off" or config.landing.survey_only:
        return None
    if wanted != "auto":
        return Path(wanted)
    return SHIPPED if SHIPPED.is_file() else None


def build_classifier(config: Config) -> OnnxGroundClassifier | None:
    """Raises UsageError where the network's file cannot be used, or its engine is missing."""
    file, params = classifier_file(config), config.landing
    if file is None:
        return None
    if not params.classifier_patch_m > 0.0:
        raise UsageError(
            f"landing.classifier_patch_m = {params.classifier_patch_m:g} must be positive"
        )
    if not 0.0 <= params.classifier_min_probability <= 1.0:
        raise UsageError(
            "landing.classifier_min_probability = "
            f"{params.classifier_min_probability:g} must be within 0 to 1"
        )
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
    from touchdown.estimator.mapping.mapper import GridMapper
    from touchdown.estimator.mapping.no_map import NoMap

    grid = GridMapper(rig, config.mapper)
    return grid if config.mapper.enabled else NoMap(grid)


def world_params(config: Config) -> WorldParams:
    """The configured parameters of the simulated world."""
    return WorldParams(
        sim=config.sim,
        wind=config.wind,
        lidar=config.lidar,
        camera=config.camera,
        imu=config.imu,
        nav=config.nav,
        faults=config.faults,
    )


def make_world(config: Config, scene: Scene) -> Any:
    from touchdown.sim.world import MujocoWorld

    return MujocoWorld(scene, world_params(config), config.seed)


def build_estimator(config: Config, rig: SensorRig) -> Estimator:
    """The configured estimator without a world, which the oracle cannot do. Raises UsageError."""
    if config.estimator == "oracle":
        raise UsageError("estimator 'oracle' knows the truth and needs a flight; replay another")

    def no_truth() -> Truth:
        raise RuntimeError("no estimator but the oracle asks for the truth")

    return _biased(_estimator_factory(config)(rig, no_truth), config)


def _biased(estimator: Estimator, config: Config) -> Estimator:
    return BiasedEstimator(estimator, config.bias) if any(config.bias.xy_m) else estimator


_EstimatorFactory = Callable[[SensorRig, Callable[[], Truth]], Estimator]


def _livo(config: Config) -> _EstimatorFactory:
    from touchdown.estimator.livo.estimator import Livo

    return lambda rig, _truth: Livo(rig, config.livo, seed=config.seed)


def _paper(config: Config) -> _EstimatorFactory:
    from touchdown.estimator.paper.estimator import PaperEstimator

    return lambda rig, _truth: PaperEstimator(rig, config.paper)


def _gps(config: Config) -> _EstimatorFactory:
    from touchdown.estimator.baselines.gps import GpsEstimator

    return lambda rig, _truth: GpsEstimator(rig, config.gps_estimator)


def _optical_flow(config: Config) -> _EstimatorFactory:
    from touchdown.estimator.baselines.optical_flow import OpticalFlowEstimator

    return lambda rig, _truth: OpticalFlowEstimator(rig, config.optical_flow)


def _hybrid_flow(config: Config) -> _EstimatorFactory:
    from touchdown.estimator.baselines.hybrid_flow import HybridFlowEstimator

    return lambda rig, _truth: HybridFlowEstimator(rig, config.hybrid_flow)


def _stereo(config: Config) -> _EstimatorFactory:
    from touchdown.estimator.baselines.stereo import StereoEstimator

    return lambda rig, _truth: StereoEstimator(rig, config.stereo_vo)


def _oracle(config: Config) -> _EstimatorFactory:
    from touchdown.estimator.oracle import Oracle

    return lambda rig, truth: Oracle(truth, rig)


ESTIMATORS: Mapping[str, Callable[[Config], _EstimatorFactory]] = {
    "livo": _livo,
    "paper": _paper,
    "gps": _gps,
    "optical_flow": _optical_flow,
    "hybrid_flow": _hybrid_flow,
    "stereo": _stereo,
    "oracle": _oracle,
}


def check_estimator(name: str) -> None:
    """Raises UsageError naming the nearest known estimator unless ``name`` may be that of one, or
    MODULE:FUNCTION; `find_estimator` looks whether that is there."""
    if name not in ESTIMATORS and not is_external(name):
        known = ", ".join(ESTIMATORS)
        raise UsageError(
            f"unknown estimator '{name}'{nearest(name, ESTIMATORS)}; "
            f"known: {known}, or MODULE:FUNCTION of your own"
        )


def find_estimator(name: str) -> None:
    """Raises UsageError unless ``name`` can be built, as far as can be told without a rig."""
    check_estimator(name)
    if is_external(name):
        check_external(name)


def _estimator_factory(config: Config) -> _EstimatorFactory:
    check_estimator(config.estimator)
    if config.estimator in ESTIMATORS:
        return ESTIMATORS[config.estimator](config)
    return lambda rig, _truth: ExternalEstimator(config.estimator, config.external, rig)


def check_scene_name(name: str, where: str = "") -> None:
    """Raises UsageError unless a scene has that name, or a file is there; ``where`` it was given,
    such as " in FILE"."""
    if "/" in name or name.endswith(".xml"):
        if not Path(name).is_file():
            raise UsageError(f"scene file '{name}'{where} does not exist")
    elif name not in (known := scene_names()):
        raise UsageError(
            f"unknown scene '{name}'{where}{nearest(name, known)}; known: {', '.join(known)}, or "
            "the path of an MJCF file"
        )
