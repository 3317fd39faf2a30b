"""Parts of a reproduction: each fills a directory and reports success or the reason of a failure.

Heavy modules are imported by the part that needs them.
"""

from __future__ import annotations

import dataclasses
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from touchdown.experiments.campaign.session import Watcher, default_jobs
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.run_directory import filled_folder
from touchdown.experiments.reporting.published import SITES
from touchdown.experiments.reproduce.networks import PICTURES, train_and_score
from touchdown.experiments.reproduce.plans import (
    PAPER_SCENES,
    Edition,
    Extent,
    core_seconds,
    digest,
    plan_of,
)

FLIGHTS = "flights"
VEHICLE = "vehicle.jpg"
_POSES = 12
"""of the chessboard"""
_ROUNDS = 9
"""repetitions of the timed site selection"""

Notes = Callable[[str], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """Input of a part: its directory, the extent of the work, and where to report progress."""

    folder: Path
    extent: Extent
    jobs: int = field(default_factory=default_jobs)
    notes: Notes = lambda _note: None
    watcher: Watcher = field(default_factory=Watcher)

    @property
    def edition(self) -> Edition:
        return self.extent.edition


@dataclass(frozen=True, slots=True)
class Done:
    """Result of a part. ``figures``: for the report; ``why``: the reason why it failed its purpose,
    else empty."""

    figures: dict[str, Any]
    why: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """One part of a reproduction."""

    name: str
    title: str
    shows: tuple[str, ...]
    """tables and figures of the paper"""
    settings: Callable[[Extent], dict[str, Any]]
    """settings that determine its result"""
    run: Callable[[Job], Done]
    core_seconds: Callable[[Extent], float]
    """approximate time on one core"""
    needs_torch: bool = False
    needs_photographs: bool = False


# ------------------------------------------------------------------------------- sensors, pictures


def _calibration(job: Job) -> Done:
    from touchdown.experiments.calibration.calibrate import run_calibration

    with filled_folder(job.folder / PICTURES) as partial_folder:
        report = run_calibration(
            load_config(seed=0, profile_default="ideal"),
            _POSES,
            partial_folder / "calibration.json",
            partial_folder,
            job.notes,
        )
    del report["file"]
    agreed = report["consistency"]["consistent"]
    return Done(report, "" if agreed else "its errors exceed its stated standard deviations")


def _edges(job: Job) -> Done:
    from touchdown.experiments.edges.scores import draw_figure

    with filled_folder(job.folder / PICTURES) as partial_folder:
        file = draw_figure(partial_folder, 0, "shipped", job.notes)
    return Done({"pictures": [file.name]})


def _world(job: Job) -> Done:
    """Figs. 7 and 8: the vehicle, and the paper's four scenes."""
    from touchdown.experiments.scene_tools.render import (
        load_configured_scene,
        render_view,
        vehicle_portrait,
    )
    from touchdown.experiments.scene_tools.views import write_image

    config = load_config(scene=PAPER_SCENES[0], seed=0, profile_default="ideal")
    with filled_folder(job.folder / PICTURES) as partial_folder:
        job.notes("drawing the vehicle")
        picture, vehicle = vehicle_portrait(load_configured_scene(config))
        write_image(partial_folder / VEHICLE, picture)
        for scene in PAPER_SCENES:
            job.notes(f"drawing {scene}")
            render_view(scene, 0, "oblique", partial_folder / f"{scene}.jpg")
    tick_hz = config.sim.tick_hz
    return Done({
        "mass_kg": vehicle.mass_kg,
        "footprint_radius_m": vehicle.footprint_radius_m,
        "lidar": config.lidar.preset,
        "lidar_scan_hz": tick_hz / config.sim.lidar_scan_ticks,
        "camera_px": [config.camera.width, config.camera.height],
        "camera_deg": [config.camera.fov_x_deg, config.camera.fov_y_deg],
        "imu_hz": tick_hz / config.sim.imu_ticks,
        "scenes": list(PAPER_SCENES),
    })  # fmt: skip


def _sites(job: Job) -> Done:
    """Fig. 11: the steps from a map to a site, over the paper's five kinds of sites."""
    from touchdown.experiments.benchmarks.selection import sites as selector_check

    with filled_folder(job.folder / PICTURES) as partial_folder:
        found = selector_check.run(
            selector_check.Posed(tuple(SITES), "0"),
            ["zou2024"],
            jobs=min(job.jobs, len(SITES)),
            report=lambda place: job.notes(selector_check.row(place)),
            pictures=partial_folder,
        )
    kept = ("scene", "seed", "chosen_safe", "accepted", "accepted_safe")
    places = [{key: place[key] for key in kept} for place in found["places"]]
    unsafe = [place["scene"] for place in places if place["chosen_safe"] is False]
    why = f"the site chosen on {', '.join(unsafe)} is unsafe by the true map" if unsafe else ""
    return Done({"selector": found["selector"], "places": places}, why)


# ---------------------------------------------------------------------------------------- flights


def _campaign(name: str, job: Job) -> Done:
    from touchdown.experiments.campaign.session import fly_campaign, make_engine

    figures = fly_campaign(
        plan_of(name, quick=job.extent.quick),
        job.folder / FLIGHTS,
        make_engine("local", job.jobs),
        watcher=job.watcher,
    )
    kept = ("name", "mode", "runs", "finished", "crashed", "remaining", "outcomes", "errors")
    why = ""
    if figures["crashed"] or figures["remaining"]:
        lost = figures["crashed"] + figures["remaining"]
        why = f"{lost} of {figures['runs']} flights have no outcome"
    elif not figures["as_expected"]:
        why = "not all flights are as the campaign's file expects"
    return Done({key: figures[key] for key in kept}, why)


# ----------------------------------------------------------------------------------------- speed


def _speed(job: Job) -> Done:
    """Table 7."""
    from touchdown.experiments.benchmarks.selection.timing import bench_landing

    job.notes("surveying crossroad, then choosing a site over and over")
    reference = importlib.util.find_spec("skimage") is not None
    return Done(bench_landing(rounds=_ROUNDS, threads=job.jobs, reference=reference))


# ------------------------------------------------------------------------------------ recognition


def _recognition(job: Job) -> Done:
    settings = _recognition_settings(job.extent)
    home, size = job.folder / job.edition.name, job.edition.recognition
    scores = train_and_score(home, size, (), settings, job.jobs, job.notes)
    return Done({"size": settings, "networks": scores})


def _photographs(job: Job) -> Done:
    settings, extent = _photographs_settings(job.extent), job.extent
    home, size = job.folder / job.edition.name, job.edition.photographs
    scores = train_and_score(home, size, extent.photographs, settings, job.jobs, job.notes)
    short = [f"{one['network']}, {one['labels']}" for one in scores if not one["converged"]]
    why = f"not converged: {'; '.join(short)}" if short and not extent.quick else ""
    return Done({"size": settings, "networks": scores}, why)


def _recognition_settings(extent: Extent) -> dict[str, Any]:
    return dataclasses.asdict(extent.edition.recognition)


def _photographs_settings(extent: Extent) -> dict[str, Any]:
    photographs = list(extent.photographs)
    return dataclasses.asdict(extent.edition.photographs) | {"photographs": photographs}


# ------------------------------------------------------------------------------------------- list


def _campaign_part(name: str, title: str, *shows: str) -> Part:
    return Part(
        name=name,
        title=title,
        shows=shows,
        settings=lambda extent: {"flights": digest(plan_of(name, quick=extent.quick))},
        run=partial(_campaign, name),
        core_seconds=lambda extent: core_seconds(plan_of(name, quick=extent.quick)),
    )


def _fixed(name: str, title: str, run: Callable[[Job], Done], seconds: float, *shows: str) -> Part:
    """A part that is the same in all editions."""
    return Part(
        name=name,
        title=title,
        shows=shows,
        settings=lambda _extent: {"seed": 0},
        run=run,
        core_seconds=lambda _extent: seconds,
    )


def _recognition_seconds(extent: Extent) -> float:
    """Six pictures rendered a second; a core learns from 90 a second with ResNet18 at 64 pixels,
    from 25 with the networks of the whole edition on average."""
    size = extent.edition.recognition
    passes = size.images * size.epochs * len(size.networks) * len(size.labels)
    return size.images / 6.0 + passes / (90.0 if extent.quick else 25.0)


def _photographs_seconds(extent: Extent) -> float:
    """Of about a thousand training images, as UC Merced has."""
    size = extent.edition.photographs
    trainings = len(size.networks) * len(size.labels)
    trainings += len(size.repeated) * (len(size.seeds) - 1)
    return trainings * size.epochs * 1000.0 / (90.0 if extent.quick else 50.0)


PARTS: tuple[Part, ...] = (
    _fixed("calibration", "Camera and LIDAR, calibrated", _calibration, 60.0, "Fig. 2"),
    _fixed("edges", "Edge energy and smoothness", _edges, 40.0, "Fig. 4"),
    _fixed("world", "Vehicle and scenes", _world, 30.0, "Fig. 7", "Fig. 8"),
    _fixed("sites", "From the map to the site", _sites, 80.0, "Fig. 11"),
    _campaign_part("positioning", "Positioning", "Table 1", "Table 2", "Fig. 9 a", "Fig. 10"),
    _campaign_part("commanded_site", "Landings on one spot", "Table 5", "Fig. 12"),
    _campaign_part("zou2024_sites", "Landings on five kinds of sites", "Table 6"),
    _campaign_part("zou2024", "Landings over four scenes", "Fig. 9 b"),
    _campaign_part("real_sites", "Five kinds of sites: `livo` and `risk`"),
    _campaign_part("landing", "Four scenes: `livo` and `risk`"),
    _fixed("speed", "Time of a choice of site", _speed, 20.0, "Table 7"),
    Part(
        name="recognition",
        title="Ground classification",
        shows=("Fig. 5", "Table 3", "Table 4"),
        settings=_recognition_settings,
        run=_recognition,
        core_seconds=_recognition_seconds,
        needs_torch=True,
    ),
    Part(
        name="photographs",
        title="Ground classification of photographs",
        shows=(),
        settings=_photographs_settings,
        run=_photographs,
        core_seconds=_photographs_seconds,
        needs_torch=True,
        needs_photographs=True,
    ),
)
"""In the order of work: drawings, flights, parts that are timed, networks. Of the flights the
paper's own system comes first, then, without an item of the paper, ours."""


def part_named(name: str) -> Part:
    """Raises UsageError for an unknown name."""
    from touchdown.experiments.errors import nearest

    known = [part.name for part in PARTS]
    if name not in known:
        raise UsageError(f"unknown part '{name}'{nearest(name, known)}; known: {', '.join(known)}")
    return PARTS[known.index(name)]
