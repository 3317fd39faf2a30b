"""Parts of a reproduction: each fills a directory and reports success or the reason of a failure.

Heavy modules are imported by the part that needs them.
"""

import functools
import hashlib
import importlib.util
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from touchdown.experiments.campaign.forecast import stated_core_s
from touchdown.experiments.campaign.plan import Plan, PlannedRun, config_for, load_plan
from touchdown.experiments.campaign.session import Watcher, default_jobs
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.errors import UsageError, nearest
from touchdown.experiments.io.run_directory import filled_folder
from touchdown.experiments.reporting.published import ANALYSED_SCENE, NETWORK_NAMES, SITES
from touchdown.experiments.reproduce.networks import PICTURES, Recognition, on_gpu, train_and_score

EditionName = Literal["quick", "whole", "whole-gpu"]
PAPER_SCENES = ("crossroad", "lake", "houses", "forest")
FLIGHTS, REPORT, VEHICLE = "flights", "report", "vehicle.jpg"
_PLANS = Path(__file__).parent / "plans"
_POSES = 12
"""of the chessboard"""
_ROUNDS = 9
"""repetitions of the timed site selection"""

Notes = Callable[[str], None]
Done = tuple[dict[str, Any], str]
"""figures for the report, and the reason why a part failed its purpose, else empty"""


# Without normalisation VGG19 does not begin to learn at the rate of the others. Inception has no
# input left below 75 pixels.
_PHOTOGRAPHS = Recognition(
    networks=tuple(NETWORK_NAMES),
    labels=("d_scene", "d_land"),
    image_size=64,
    epochs=80,
    patience=20,
    learning_rates=(("vgg19", 2e-4),),
    image_sizes=(("inception_v4", 80),),
    repeated=("resnet50", "resnet50_cbam"),
    seeds=(0, 1, 2),
)
_RENDERED = Recognition(
    images=4000,
    pixels=128,
    per_seed=40,
    networks=tuple(NETWORK_NAMES),
    labels=("d_scene", "d_land"),
    image_size=96,
    epochs=6,
)
_ONE_NETWORK: dict[str, Any] = {"networks": ("resnet18",), "labels": ("d_land",), "epochs": 6}
# Five seeds of each scene are the fewest that give all three splits.
_FEW_RENDERED = replace(
    _RENDERED, images=200, pixels=64, per_seed=8, scenes=(*PAPER_SCENES, "cottage"), image_size=64,
    **_ONE_NETWORK,
)  # fmt: skip
TRAININGS: dict[EditionName, dict[str, Recognition]] = {
    "quick": {
        "recognition": _FEW_RENDERED,
        "photographs": replace(_PHOTOGRAPHS, repeated=(), seeds=(0,), **_ONE_NETWORK),
    },
    "whole": {"recognition": _RENDERED, "photographs": _PHOTOGRAPHS},
    "whole-gpu": {
        "recognition": replace(_RENDERED, images=12000, image_size=128, epochs=30),
        "photographs": _PHOTOGRAPHS,
    },
}
"""Trainings by edition and part; results of CPU and GPU trainings are never in one table."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Extent:
    """Requested extent of a reproduction."""

    quick: bool
    photographs: tuple[str, ...] = ()
    """labelled images of the part ``photographs``, as ``--data`` of `touchdown train`"""

    @property
    def edition(self) -> EditionName:
        """The edition for this machine."""
        return "quick" if self.quick else "whole-gpu" if on_gpu() else "whole"


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """Input of a part: its directory, the extent of the work, and where to report progress."""

    folder: Path
    extent: Extent
    jobs: int = field(default_factory=default_jobs)
    notes: Notes = lambda _note: None
    watcher: Watcher = field(default_factory=Watcher)


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """One part of a reproduction. ``shows``: tables and figures of the paper; ``settings``: what
    determines its result; ``core_seconds``: approximate time on one core."""

    name: str
    title: str
    shows: tuple[str, ...]
    settings: Callable[[Extent], dict[str, Any]]
    run: Callable[[Job], Done]
    core_seconds: Callable[[Extent], float]
    needs_torch: bool = False
    needs_photographs: bool = False


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
    return report, "" if agreed else "its errors exceed its stated standard deviations"


def _edges(job: Job) -> Done:
    from touchdown.experiments.edges.scores import draw_figure

    with filled_folder(job.folder / PICTURES) as partial_folder:
        file = draw_figure(partial_folder, 0, "shipped", job.notes)
    return {"pictures": [file.name]}, ""


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
        picture, _ = vehicle_portrait(load_configured_scene(config))
        write_image(partial_folder / VEHICLE, picture)
        for scene in PAPER_SCENES:
            job.notes(f"drawing {scene}")
            render_view(scene, 0, "oblique", partial_folder / f"{scene}.jpg")
    return {"scenes": list(PAPER_SCENES)}, ""


def _sites(job: Job) -> Done:
    """Fig. 11: the steps from a map to a site, over the paper's five kinds of sites."""
    from touchdown.experiments.benchmarks.selection import sites as selector_check
    from touchdown.experiments.benchmarks.selection.curves import Drawings

    with filled_folder(job.folder / PICTURES) as partial_folder:
        found = selector_check.run(
            selector_check.Posed(tuple(SITES), "0"),
            ["zou2024"],
            jobs=min(job.jobs, len(SITES)),
            report=lambda place: job.notes(selector_check.row(place)),
            drawings=Drawings(pictures=partial_folder),
        )
    kept = ("scene", "seed", "chosen_safe", "accepted", "accepted_safe")
    places = [{key: place[key] for key in kept} for place in found["places"]]
    unsafe = [place["scene"] for place in places if place["chosen_safe"] is False]
    why = f"the site chosen on {', '.join(unsafe)} is unsafe by the true map" if unsafe else ""
    return {"selector": found["selector"], "places": places}, why


def _speed(job: Job) -> Done:
    """Table 7."""
    from touchdown.experiments.benchmarks.selection.timing import bench_landing

    job.notes("surveying crossroad, then choosing a site over and over")
    reference = importlib.util.find_spec("skimage") is not None
    return bench_landing(rounds=_ROUNDS, threads=job.jobs, reference=reference), ""


_QUICK_SCENES = {"zou2024_sites": "rooftop_parking"}
"""Scenes of the quick edition by campaign, where it is not the one that the paper analyses."""


@functools.cache
def plan_of(campaign: str, *, quick: bool) -> Plan:
    """Plan of a campaign from its file; for the quick edition, some runs of the first seed.

    The whole edition has all runs of the quick one, with the same names, and continues it.
    """
    plan = load_plan(_PLANS / f"{campaign}.toml")
    if not quick:
        return plan
    wanted = {
        "scene": _QUICK_SCENES.get(campaign, ANALYSED_SCENE),
        "seed": min(run.values["seed"] for run in plan.runs),
    }
    if campaign == "zou2024":
        wanted["landing.flatness_form"] = "corrected"
    runs = [run for run in plan.runs if wanted.items() <= run.values.items()]
    # The longest run first, so that the workers end at nearly the same time.
    runs.sort(key=lambda run: -_cost(plan.mode, run))
    return replace(plan, runs=tuple(runs), record="none")


def _cost(mode: str, run: PlannedRun) -> float:
    return stated_core_s(mode, config_for(run.values, f"run {run.run_id}"))


def _fly(name: str, job: Job) -> Done:
    from touchdown.experiments.campaign.session import fly_campaign, make_engine

    figures = fly_campaign(
        plan_of(name, quick=job.extent.quick),
        job.folder / FLIGHTS,
        make_engine("local", job.jobs),
        watcher=job.watcher,
    )
    kept = ("name", "mode", "runs", "finished", "crashed", "remaining", "outcomes", "errors")
    why = ""
    if lost := figures["crashed"] + figures["remaining"]:
        why = f"{lost} of {figures['runs']} flights have no outcome"
    elif not figures["as_expected"]:
        why = "not all flights are as the campaign's file expects"
    return {key: figures[key] for key in kept}, why


def _campaign(name: str, title: str, *shows: str) -> Part:
    def settings(extent: Extent) -> dict[str, Any]:
        runs = plan_of(name, quick=extent.quick).runs
        text = "\n".join(sorted(f"{run.run_id} {run.config_sha}" for run in runs))
        return {"flights": hashlib.sha256(text.encode()).hexdigest()[:12]}

    def core_seconds(extent: Extent) -> float:
        plan = plan_of(name, quick=extent.quick)
        return sum(_cost(plan.mode, run) for run in plan.runs)

    return Part(
        name=name,
        title=title,
        shows=shows,
        settings=settings,
        run=functools.partial(_fly, name),
        core_seconds=core_seconds,
    )


def _networks(name: str, title: str, *shows: str, photographs: bool = False) -> Part:
    """A part that trains networks, on rendered images or on photographs."""

    def size(extent: Extent) -> Recognition:
        return TRAININGS[extent.edition][name]

    def settings(extent: Extent) -> dict[str, Any]:
        return asdict(size(extent)) | (
            {"photographs": list(extent.photographs)} if photographs else {}
        )

    def run(job: Job) -> Done:
        own, data = settings(job.extent), job.extent.photographs if photographs else ()
        home = job.folder / job.extent.edition
        scores = train_and_score(home, size(job.extent), data, own, job.jobs, job.notes)
        short = [f"{one['network']}, {one['labels']}" for one in scores if not one["converged"]]
        failed = photographs and short and not job.extent.quick
        why = f"not converged: {'; '.join(short)}" if failed else ""
        return {"size": own, "networks": scores}, why

    def core_seconds(extent: Extent) -> float:
        """Six pictures rendered a second; a core learns from 90 a second with ResNet18 at 64
        pixels, from 25 or, of photographs, 50 with the networks of the whole edition on average.
        UC Merced has about a thousand training images."""
        own = size(extent)
        trainings = len(own.networks) * len(own.labels) + len(own.repeated) * (len(own.seeds) - 1)
        a_second = 90.0 if extent.quick else 50.0 if photographs else 25.0
        return own.images / 6.0 + trainings * own.epochs * (own.images or 1000) / a_second

    return Part(
        name=name,
        title=title,
        shows=shows,
        settings=settings,
        run=run,
        core_seconds=core_seconds,
        needs_torch=True,
        needs_photographs=photographs,
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


PARTS: tuple[Part, ...] = (
    _fixed("calibration", "Camera and LIDAR, calibrated", _calibration, 60.0, "Fig. 2"),
    _fixed("edges", "Edge energy and smoothness", _edges, 40.0, "Fig. 4"),
    _fixed("world", "Vehicle and scenes", _world, 30.0, "Fig. 7", "Fig. 8"),
    _fixed("sites", "From the map to the site", _sites, 80.0, "Fig. 11"),
    _campaign("positioning", "Positioning", "Table 1", "Table 2", "Fig. 9 a", "Fig. 10"),
    _campaign("commanded_site", "Landings on one spot", "Table 5", "Fig. 12"),
    _campaign("zou2024_sites", "Landings on five kinds of sites", "Table 6"),
    _campaign("zou2024", "Landings over four scenes", "Fig. 9 b"),
    _fixed("speed", "Time of a choice of site", _speed, 20.0, "Table 7"),
    _networks("recognition", "Ground classification", "Fig. 5", "Table 3", "Table 4"),
    _networks("photographs", "Ground classification of photographs", photographs=True),
)
"""In the order of work: drawings, flights, parts that are timed, networks."""


def part_named(name: str) -> Part:
    """Raises UsageError for an unknown name."""
    known = [part.name for part in PARTS]
    if name not in known:
        raise UsageError(f"unknown part '{name}'{nearest(name, known)}; known: {', '.join(known)}")
    return PARTS[known.index(name)]


class PartResult(BaseModel):
    """``part.json``: result of a part. ``error``: of a part that did not end and will run again;
    ``why``: the reason why a part failed its purpose, else empty."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    part: str
    edition: EditionName
    settings: dict[str, Any]
    figures: dict[str, Any]
    why: str
    error: str
    wall_s: float
    finished_utc: str
    git_revision: str | None

    @property
    def failure(self) -> str:
        """Why the part did not end or serve its purpose; empty where it did."""
        return self.error or self.why


@dataclass(frozen=True, slots=True)
class Reproduction:
    """Result of a reproduction. ``results``: of all parts that ever ended, by name in the order of
    `PARTS`; ``skipped``: parts that this call left out."""

    out: Path
    quick: bool
    results: dict[str, PartResult]
    skipped: tuple[str, ...]
    wall_s: float

    @property
    def successful(self) -> bool:
        """True if every requested part served its purpose."""
        return not any(r.failure for name, r in self.results.items() if name not in self.skipped)

    def as_json(self) -> dict[str, Any]:
        """Result of each part and the files of the report."""
        parts = [
            {
                "part": name,
                "edition": result.edition,
                "good": not result.failure,
                "why": result.failure,
                "wall_s": result.wall_s,
                "figures": result.figures,
            }
            for name, result in self.results.items()
        ]
        report = self.out / REPORT
        return {
            "directory": str(self.out),
            "edition": "quick" if self.quick else "whole",
            "good": self.successful,
            "skipped": list(self.skipped),
            "wall_s": self.wall_s,
            "parts": parts,
            "files": {kind: str(report / f"report.{kind}") for kind in ("html", "md", "json")},
        }
