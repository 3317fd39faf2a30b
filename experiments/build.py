"""Wires a configuration into the objects of one flight.

With ``experiments.build_tools`` the only module that knows all folders.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from controller.api import Controller
from estimator.api import Estimator, Mapper
from experiments.bias import BiasedEstimator
from experiments.config import Config, UsageError
from experiments.outside import check_outside, is_outside
from experiments.outside_estimator import OutsideEstimator
from experiments.rig import told_rig
from experiments.suggest import nearest
from landing.api import Lander
from scenes.api import LowSun, Scene
from sim.api import SensorRig, Truth, World

if TYPE_CHECKING:
    from landing.recognition.in_flight import NetworkPlaces

Array = NDArray[np.float64]


@dataclass(slots=True)
class Flight:
    """The parts of one flight, ready for ``experiments.loop.run_flight``."""

    scene: Scene
    world: World
    estimator: Estimator
    mapper: Mapper
    lander: Lander
    controller: Controller
    faults: Callable[[], list[dict[str, Any]]]
    """what the scheduled sensor faults have done so far"""
    told: SensorRig
    """the rig as the estimator knows it"""
    network: dict[str, Any] | None = None
    """what recognises places, for the result; None: nothing does"""


def build_scene(config: Config) -> Scene:
    """Loads the scene of a configuration. Raises ValueError or FileNotFoundError, one line each."""
    from scenes.compose import load_scene

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
    from controller.cascade import CascadeController
    from landing.lander import SiteLander

    make_estimator = _estimator_factory(config)
    places = build_places(config)
    world = make_world(config, scene)
    try:
        rig = told_rig(world.rig, config)
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
        told=rig,
        network=None if places is None else places.description(),
    )


def places_file(config: Config) -> Path | None:
    """The network that recognises places in a flight, None where none does: ``off``, nothing to
    choose, or ``auto`` without one that comes with the project."""
    from landing.recognition.in_flight import SHIPPED

    wanted = config.landing.place_recognition
    if wanted == "off" or config.landing.survey_only:
        return None
    if wanted != "auto":
        return Path(wanted)
    return SHIPPED if SHIPPED.is_file() else None


def build_places(config: Config) -> NetworkPlaces | None:
    """Raises UsageError where the network's file cannot be used, or its engine is missing."""
    file, params = places_file(config), config.landing
    if file is None:
        return None
    if not params.place_patch_m > 0.0:
        raise UsageError(f"landing.place_patch_m = {params.place_patch_m:g} must be positive")
    if not 0.0 <= params.place_least_probability <= 1.0:
        raise UsageError(
            f"landing.place_least_probability = {params.place_least_probability:g} must be within "
            "0 to 1"
        )
    from landing.recognition.in_flight import load_places

    try:
        return load_places(file, config.landing.place_threads)
    except (ValueError, OSError) as error:
        raise UsageError(f"landing.place_recognition: {error}") from error
    except ImportError as error:
        raise UsageError(
            f"landing.place_recognition needs {error.name}: install it, or set it to off"
        ) from error


def _mapper(config: Config, rig: SensorRig) -> Mapper:
    from estimator.mapper import GridMapper
    from estimator.no_map import NoMap

    grid = GridMapper(rig, config.mapper)
    return grid if config.mapper.enabled else NoMap(grid)


def make_world(config: Config, scene: Scene) -> Any:
    from sim.world import MujocoWorld

    return MujocoWorld(
        scene,
        sim=config.sim,
        wind=config.wind,
        lidar=config.lidar,
        camera=config.camera,
        imu=config.imu,
        nav=config.nav,
        faults=config.faults,
        seed=config.seed,
    )


@dataclass(frozen=True, slots=True)
class TruthLookup:
    """The true ground, for referee and metrics."""

    scene: Scene

    def judge(self, xy: Array) -> Any:
        """``scenes.truth.TouchdownJudgement`` of the point ``xy`` (2,), world frame."""
        from scenes.truth import judge_touchdown

        return judge_touchdown(self.scene, xy)

    def surface_points(self, xy: Array, radius_m: float) -> Array:
        """(N, 3) points of the true surface on a grid of 5 cm in the disc around ``xy``."""
        from scenes.raycast import cast_down

        cell = 0.05
        cells = int(radius_m / cell)
        side = 2 * cells + 1
        origin = xy - (cells + 0.5) * cell
        heights, _ = cast_down(self.scene, origin, cell, (side, side))
        rows, cols = np.mgrid[:side, :side]
        offsets = (np.stack([cols, rows], axis=-1) - cells) * cell
        near = (np.hypot(offsets[..., 0], offsets[..., 1]) <= radius_m) & np.isfinite(heights)
        return np.column_stack([xy + offsets[near], heights[near]])

    @property
    def moving_geoms(self) -> frozenset[str]:
        """Names of the geoms of moving bodies."""
        model = self.scene.model
        bodies = {model.body(moving.body_name).id for moving in self.scene.moving}
        return frozenset(
            model.geom(i).name for i in range(model.ngeom) if int(model.geom_bodyid[i]) in bodies
        )


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
    from estimator.livo import Livo

    return lambda rig, _truth: Livo(rig, config.livo, seed=config.seed)


def _paper(config: Config) -> _EstimatorFactory:
    from estimator.paper.estimator import PaperEstimator

    return lambda rig, _truth: PaperEstimator(rig, config.paper)


def _gps(config: Config) -> _EstimatorFactory:
    from estimator.baselines.gps import GpsEstimator

    return lambda rig, _truth: GpsEstimator(rig, config.gps_estimator)


def _optical_flow(config: Config) -> _EstimatorFactory:
    from estimator.baselines.optical_flow import OpticalFlowEstimator

    return lambda rig, _truth: OpticalFlowEstimator(rig, config.optical_flow)


def _hybrid_flow(config: Config) -> _EstimatorFactory:
    from estimator.baselines.hybrid_flow import HybridFlowEstimator

    return lambda rig, _truth: HybridFlowEstimator(rig, config.hybrid_flow)


def _stereo(config: Config) -> _EstimatorFactory:
    from estimator.baselines.stereo import StereoEstimator

    return lambda rig, _truth: StereoEstimator(rig, config.stereo_vo)


def _oracle(config: Config) -> _EstimatorFactory:
    from estimator.oracle import Oracle

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
    if name not in ESTIMATORS and not is_outside(name):
        known = ", ".join(ESTIMATORS)
        raise UsageError(
            f"unknown estimator '{name}'{nearest(name, ESTIMATORS)}; "
            f"known: {known}, or MODULE:FUNCTION of your own"
        )


def find_estimator(name: str) -> None:
    """Raises UsageError unless ``name`` can be built, as far as can be told without a rig."""
    check_estimator(name)
    if is_outside(name):
        check_outside(name)


def _estimator_factory(config: Config) -> _EstimatorFactory:
    check_estimator(config.estimator)
    if config.estimator in ESTIMATORS:
        return ESTIMATORS[config.estimator](config)
    return lambda rig, _truth: OutsideEstimator(config.estimator, config.outside, rig)
