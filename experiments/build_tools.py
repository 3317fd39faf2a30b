"""Wires a configuration into what is no flight: pictures, stands, practice, benchmarks.

Beside ``experiments.build`` the only module that knows all folders.
"""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from controller.api import Controller
from estimator.api import (
    CalibrationResult,
    CalibrationView,
    Chessboard,
    Estimate,
    Estimator,
    GridMap,
    Mapper,
    MapView,
)
from experiments.build import make_world
from experiments.config import Config, UsageError
from experiments.suggest import nearest
from landing.api import PlaceClassifier, Selection, SurveyParams
from scenes.api import Scene, TruthMaps
from sim.api import SensorNeeds, SensorRig, VehicleModel
from sim.frames import Pose

if TYPE_CHECKING:
    from estimator.paper.still_scan import StillFeatures
    from scenes.place_facts import PlaceFacts
    from scenes.survey_facts import Difference, Layout, SurveyFacts
    from sim.aerial import AerialCamera, AerialView
    from sim.bare import BareWorld
    from sim.hover import HoverView
    from sim.lidar_peers import LidarPeers
    from sim.stand import SensorStand
    from sim.tow import SensorTow

Array = NDArray[np.float64]


STAND_HEIGHT_M = 5.5
"""of the vehicle over the floor while it is calibrated"""


@dataclass(slots=True)
class Practice:
    """A vehicle in the air over a scene, for a pilot from elsewhere: ``controller``, told the truth
    by ``estimator``, holds it until the pilot takes over. ``draw()`` is what a camera of
    ``view_pixels`` (width, height) on the vehicle sees now, (H, W, 3) uint8."""

    scene: Scene
    world: Any
    """``sim.world.MujocoWorld``, whose ``start_in_air`` begins an episode"""
    estimator: Estimator
    controller: Controller
    step_s: float
    """of one control step"""
    draw: Callable[[], NDArray[np.uint8]]
    close: Callable[[], None]


def build_practice(
    config: Config, scene: Scene, needs: SensorNeeds, view_pixels: tuple[int, int]
) -> Practice:
    """World and autopilot of ``config``, sensing what ``needs`` asks for."""
    from controller.cascade import CascadeController
    from estimator.oracle import Oracle
    from sim.api import CameraParams
    from sim.camera import CameraSensor

    world = make_world(config, scene)
    world.require(needs)
    width, height = view_pixels
    lens = CameraParams(noise_sigma=0.0, samples=4, width=width, height=height)
    view = CameraSensor(scene, lens, config.seed)

    def close() -> None:
        view.close()
        world.close()

    return Practice(
        scene=scene,
        world=world,
        estimator=Oracle(world.truth, world.rig),
        controller=CascadeController(world.rig.vehicle, config.control),
        step_s=config.sim.control_ticks / config.sim.tick_hz,
        draw=lambda: view.render(world.snapshot(), 0),
        close=close,
    )


def scene_names() -> list[str]:
    """Names that a configuration's ``scene`` may have besides the path of an MJCF file."""
    from scenes.registry import scene_names as names

    return names()


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


def scene_picture(scene: Scene, view: str, pixels: int | None = None) -> NDArray[np.uint8]:
    """(H, W, 3) RGB, as `scenes.render.scene_picture`."""
    from scenes.render import scene_picture as picture

    return picture(scene, view, pixels)


def vehicle_portrait(scene: Scene) -> tuple[NDArray[np.uint8], VehicleModel]:
    """(H, W, 3) RGB of the vehicle on the ground, and what its controller knows of it."""
    from scenes.render import vehicle_picture
    from sim.vehicle import vehicle_model

    return vehicle_picture(scene), vehicle_model(scene.model)


def scene_truth_maps(scene: Scene, cell_m: float, region: Array | None = None) -> TruthMaps:
    """As `scenes.truth.truth_maps`."""
    from scenes.truth import truth_maps

    return truth_maps(scene, cell_m, region)


def export_scene(scene: Scene, out_dir: Path) -> Path:
    """Writes MJCF and assets, as `scenes.export.export_scene`; returns the file."""
    from scenes.export import export_scene as export

    return export(scene, out_dir)


def hover_view(config: Config, scene: Scene, height_m: float, seconds: float) -> HoverView:
    """What the configured camera and LIDAR see from a hover above the take-off spot."""
    from sim.hover import hover_view as look

    return look(
        scene,
        sim=config.sim,
        camera=config.camera,
        lidar=config.lidar,
        seed=config.seed,
        height_m=height_m,
        seconds=seconds,
    )


@dataclass(slots=True)
class TowedSurvey:
    """The configured sensors on the planned survey, at its true poses, and what serves them."""

    rig: SensorRig
    tow: SensorTow
    mapper: Mapper
    path: Any
    """``landing.trajectory.PiecewiseTrajectory`` of the survey, world frame, yaw ``yaw``"""
    yaw: float
    select: Callable[[MapView, Estimate], Selection]
    """as the lander chooses at the end of its survey"""


def build_towed_survey(config: Config, scene: Scene) -> TowedSurvey:
    """A survey without a flight. Raises ValueError as `build_flight`."""
    from estimator.mapper import GridMapper
    from landing.selector import select_sites
    from landing.trajectory import survey_trajectory
    from sim.frames import yaw_from_rotation
    from sim.tow import SensorTow

    world = make_world(config, scene)
    rig = world.rig
    world.close()
    start = rig.world_from_body_start
    yaw = yaw_from_rotation(start.rotation)
    above = start.translation + np.array([0.0, 0.0, config.survey.height_m])
    above[2] -= rig.vehicle.leg_height_m
    return TowedSurvey(
        rig=rig,
        tow=SensorTow(
            scene, sim=config.sim, camera=config.camera, lidar=config.lidar, seed=config.seed
        ),
        mapper=GridMapper(rig, config.mapper),
        path=survey_trajectory(above, yaw, config.survey),
        yaw=yaw,
        select=partial(
            select_sites,
            params=config.landing,
            footprint_radius_m=rig.vehicle.footprint_radius_m,
        ),
    )


def check_survey(params: SurveyParams) -> None:
    """Raises ValueError for a survey that cannot be flown in its time."""
    from landing.trajectory import survey_trajectory

    survey_trajectory(np.zeros(3), 0.0, params)


def aerial_camera(config: Config, scene: Scene) -> AerialCamera:
    """The configured camera, to be carried anywhere over a scene."""
    from sim.aerial import AerialCamera

    return AerialCamera(scene, config.camera, config.seed)


def risk_model() -> Any:
    """The module `landing.risk`."""
    from landing import risk

    return risk


@dataclass(slots=True)
class SelectionStages:
    """The steps of selection, timed one by one: a map and the vehicle's position (3,) in the odom
    frame to ``landing.stages.Staged``."""

    ours: Callable[[GridMap, Array], Any]
    reference: Callable[[GridMap, Array], Any]
    """by Open3D, SciPy and scikit-image"""


def selection_stages(config: Config, rig: SensorRig) -> SelectionStages:
    """As `landing.stages.staged_selection` and `landing.reference.reference_selection`."""
    from landing.stages import staged_selection

    params, radius_m = config.landing, rig.vehicle.footprint_radius_m

    def reference(grid: GridMap, position: Array) -> Any:
        try:
            from landing.reference import reference_selection
        except ImportError as error:
            raise UsageError(
                f"the comparison needs scikit-image ({error}): install it, or give --no-reference"
            ) from error
        return reference_selection(grid, position, params, radius_m)

    def ours(grid: GridMap, position: Array) -> Any:
        return staged_selection(grid, position, params, radius_m)

    return SelectionStages(ours=ours, reference=reference)


def edge_detector(model: str) -> Callable[[NDArray[np.uint8]], NDArray[np.float32]]:
    """As `estimator.paper.edges.edge_detector`."""
    from estimator.paper.edges import edge_detector as detector

    return detector(model)


def segment_edges(segments: NDArray[np.int32]) -> NDArray[np.bool_]:
    """As `estimator.paper.structured_forest.segment_edges`."""
    from estimator.paper.structured_forest import segment_edges as edges

    return edges(segments)


def train_edges(
    images: Sequence[tuple[NDArray[np.uint8], NDArray[np.int32]]],
    out: Path,
    seed: int,
    notes: dict[str, str],
    progress: Callable[[int, int], None],
) -> dict[str, Any]:
    """Grows a structured forest from (picture, segments) and writes it; its size."""
    from estimator.paper.structured_forest import ForestParams, TrainingImages, grow_forest
    from estimator.paper.structured_model import write_model

    params = ForestParams()
    trees = grow_forest(TrainingImages.of(*zip(*images, strict=True)), params, seed, progress)
    write_model(out, trees, params, notes)
    leaves = sum(int((tree.child == 0).sum()) for tree in trees)
    return {"trees": len(trees), "leaves": leaves, "bytes": out.stat().st_size}


def check_edge_target(out: Path) -> None:
    """As `estimator.paper.structured_model.check_target`."""
    from estimator.paper.structured_model import check_target

    check_target(out)


def still_features(
    config: Config, scene: Scene, world_from_body: Pose, time_s: float
) -> tuple[AerialView, StillFeatures]:
    """What camera and LIDAR see from a pose, and what `paper` makes of one scan of it."""
    from estimator.paper.still_scan import features_of_still_scan
    from sim.aerial import AerialCamera, still_scan

    world = make_world(config, scene)
    rig = world.rig
    world.close()
    camera = AerialCamera(scene, config.camera, config.seed)
    try:
        view = camera.look(world_from_body, time_s, 0)
    finally:
        camera.close()
    start = round(time_s * config.sim.tick_hz)
    ticks = start + config.sim.lidar_scan_ticks * np.arange(2)
    scan = still_scan(scene, config.lidar, config.seed, world_from_body, ticks, config.sim.tick_hz)
    return view, features_of_still_scan(scan, view.rgb, rig, config.paper)


def build_stand(
    config: Config, picture: NDArray[np.uint8], size_m: tuple[float, float]
) -> SensorStand:
    """The configured camera and LIDAR, hung up in a room over a board of ``size_m`` (width, height)
    that shows ``picture`` (H, W, 3)."""
    from scenes.calibration_room import BOARD_BODY, calibration_room
    from sim.stand import SensorStand

    return SensorStand(
        calibration_room(picture, *size_m, config.seed),
        sim=config.sim,
        camera=config.camera,
        lidar=config.lidar,
        seed=config.seed,
        height_m=STAND_HEIGHT_M,
        board=BOARD_BODY,
    )


def calibrate(views: Sequence[CalibrationView], board: Chessboard, seed: int) -> CalibrationResult:
    """As `estimator.calibration.calibrate.calibrate`."""
    from estimator.calibration.calibrate import calibrate as run

    return run(views, board, seed)


def build_bare(config: Config, scene: Scene) -> BareWorld:
    """The bare computation beside a flight that was built before, whose world set the physics."""
    from sim.bare import BareWorld

    return BareWorld(
        scene, sim=config.sim, camera=config.camera, lidar=config.lidar, seed=config.seed
    )


def lidar_peers(config: Config, scene: Scene) -> LidarPeers:
    """Ray casters beside the configured LIDAR in a scene."""
    from sim.lidar_peers import LidarPeers

    return LidarPeers(scene, config.lidar, config.seed)


def survey_facts(config: Config, scene: Scene) -> SurveyFacts:
    """What the configured survey finds."""
    from scenes.survey_facts import survey_facts as facts

    return facts(scene, *_survey_reach(config.survey))


def place_facts(config: Config, scene: Scene) -> PlaceFacts:
    """What a file's place offers the configured survey."""
    from scenes.place_facts import place_facts as facts

    return facts(scene, *_survey_reach(config.survey))


def _survey_reach(survey: SurveyParams) -> tuple[float, float, float, float]:
    """Length and width of the rectangle of the legs, and how far is seen from it fore and aft and
    aside. A Livox Horizon sees 81.7 x 25.1 degrees: from 30 m, 26 m aside and 6.7 m ahead."""
    ahead, aside = survey.height_m * np.tan(0.5 * np.deg2rad([25.1, 81.7]))
    width = (survey.legs - 1) * survey.leg_spacing_m
    return survey.leg_length_m, width, float(ahead), float(aside)


def scene_layout(scene: Scene) -> Layout:
    """As `scenes.survey_facts.layout`."""
    from scenes.survey_facts import layout

    return layout(scene)


def layout_difference(a: Layout, b: Layout) -> Difference:
    """As `scenes.survey_facts.difference`."""
    from scenes.survey_facts import difference

    return difference(a, b)


def control_margins(config: Config, scene: Scene) -> list[Any]:
    """``controller.design.LoopMargin`` of every loop for the vehicle of a scene."""
    from controller.design import loop_margins
    from sim.vehicle import vehicle_model

    return loop_margins(vehicle_model(scene.model), config.control)


def import_dem(tif: Path, out: Path, **options: Any) -> tuple[Path, list[str]]:
    """A scene of an elevation model, as `scenes.dem.import_dem`: the MJCF file, and what the user
    should know of it."""
    from scenes.dem import import_dem as import_model

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        path = import_model(tif, out, **options)
    return path, [str(warning.message) for warning in caught]


def place_check(config: Config, rig: SensorRig, classifier: PlaceClassifier) -> Any:
    """``landing.place_check.PlaceCheck`` of a flight."""
    from landing.place_check import PlaceCheck

    return PlaceCheck(classifier, rig, config.landing)


def recognition(module: str) -> Any:
    """A module of the package `landing.recognition`, such as ``labels``. Raises UsageError where it
    needs a library that is not installed."""
    try:
        return importlib.import_module(f"landing.recognition.{module}")
    except ImportError as error:
        missing = (error.name or "").partition(".")[0]
        if missing not in ("torch", "onnx", "onnxruntime"):
            raise
        raise UsageError(
            f"this needs {missing}: install it with pip install 'touchdown[train]'"
        ) from error
