"""Forecast of a campaign before it is flown: flights by condition, processor time, wall time."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from touchdown.experiments.campaign.expectations import demanded
from touchdown.experiments.campaign.plan import Plan, PlannedRun, config_for
from touchdown.experiments.campaign.results_table import RUNS, finished_ids, read_row
from touchdown.experiments.config.profiles import WHOLE
from touchdown.experiments.config.schema import Config
from touchdown.experiments.config.seeds import owners
from touchdown.experiments.flight.conditions import named_conditions
from touchdown.landing.api import SurveyParams

CORE_SECONDS: Mapping[tuple[str, str], float] = {
    ("fly", "oracle"): 31.0,
    ("fly", "gps"): 14.0,
    ("fly", "optical_flow"): 37.0,
    ("fly", "hybrid_flow"): 43.0,
    ("fly", "stereo"): 56.0,
    ("fly", "zou2024"): 63.0,
    ("fly", "livo"): 35.0,
    ("land", "gps"): 44.0,
    ("land", "optical_flow"): 44.0,
    ("land", "hybrid_flow"): 55.0,
    ("land", "zou2024"): 104.0,
    ("land", "livo"): 82.0,
}
"""CPU time of one flight in profile `ideal` on one core of the reference machine, by mode and
estimator: ``cpu_s`` of rows, rounded"""
PROFILE_FACTOR: Mapping[str, float] = {"ideal": 1.0, "field": 1.3, "harsh": 1.3}
"""Cost of a profile over `ideal`: landings of `livo` take 106 s in `field` and 83 s in
`ideal`."""
BEYOND_SURVEY_S: Mapping[str, float] = {"fly": 15.0, "land": 45.0}
"""Simulated seconds of a flight outside its survey: climb, approach, descent"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Group:
    """Flights of one method in one condition."""

    label: str
    """``field, livo, camera_black@0``"""
    flights: int
    finished: int
    core_s: float
    """expected of each flight"""
    measured: bool
    """True: the mean of finished rows; False: `stated_core_s`"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Forecast:
    """Flights and cost of a campaign; ``core_hours`` and ``wall_s`` are of what is left to fly."""

    name: str
    seeds: str
    """how many, and their owners"""
    flights: int
    finished: int
    jobs: int
    core_hours: float
    wall_s: float
    undemanded: tuple[str, ...]
    """named conditions that some run has and no expectation demands of it"""
    groups: tuple[Group, ...]

    def as_json(self) -> dict[str, Any]:
        """Returns the forecast as an object of JSON types."""
        return asdict(self)


def forecast(plan: Plan, runs: Sequence[PlannedRun], directory: Path | None, jobs: int) -> Forecast:
    """Returns the forecast of some runs of ``plan`` with ``jobs`` flights at a time on this
    machine; rows of finished runs in ``directory`` give the cost of others like them. Writes
    nothing. Raises UsageError for a damaged row."""
    finished = set() if directory is None else finished_ids(directory)
    members: dict[str, list[tuple[PlannedRun, float]]] = {}
    spent: dict[str, list[float]] = {}
    missing: dict[str, None] = {}
    known: dict[str, Config] = {}
    for run in runs:
        config = _config(run, known)
        label = condition_label(config)
        members.setdefault(label, []).append((run, stated_core_s(plan.mode, config)))
        asked = demanded(plan.expect, run.values)
        if asked is not True:
            missing |= dict.fromkeys(n for n in named_conditions(config) if n not in asked)
        if directory is not None and run.run_id in finished:
            cpu_s = read_row(directory / RUNS / run.run_id)["cpu_s"]
            spent.setdefault(label, []).extend([] if cpu_s is None else [cpu_s])
    groups, left_s, left = [], 0.0, 0
    for label, flights in members.items():
        rows = spent.get(label)
        each = fmean(rows) if rows else fmean(stated for _, stated in flights)
        done = sum(run.run_id in finished for run, _ in flights)
        groups.append(Group(label=label, flights=len(flights), finished=done, core_s=each,
                            measured=bool(rows)))  # fmt: skip
        left_s += (len(flights) - done) * each
        left += len(flights) - done
    at_once = max(1, min(jobs, left, len(os.sched_getaffinity(0))))
    return Forecast(
        name=plan.name,
        seeds=owners(run.values["seed"] for run in runs),
        flights=len(runs),
        finished=len(runs) - left,
        jobs=jobs,
        core_hours=left_s / 3600.0,
        wall_s=left_s / at_once,
        undemanded=tuple(missing),
        groups=tuple(groups),
    )


def _config(run: PlannedRun, known: dict[str, Config]) -> Config:
    """The configuration of a run; those of other seeds and scenes serve for it too."""
    key = repr([item for item in run.values.items() if item[0] not in ("seed", "scene")])
    if key not in known:
        known[key] = config_for(run.values, f"run {run.run_id}")
    return known[key]


def condition_label(config: Config) -> str:
    """Profile, method and named conditions: ``field, livo, night``."""
    names = named_conditions(config)
    wind = f"wind {config.wind.mean_kmh:g} km/h"
    short = [] if config.preset == WHOLE else [config.preset]
    if config.profile == "harsh" and not config.harsh_effects:
        names = names[: len(config.faults.events) + (config.light != "day")]
    return ", ".join(
        [
            config.profile,
            *short,
            config.estimator,
            *(wind if name == "wind" else name for name in names),
        ]
    )


def stated_core_s(mode: str, config: Config) -> float:
    """CPU seconds of a flight by `CORE_SECONDS`, in its profile and with its survey's duration; of
    an estimator that is not listed the largest of its mode."""
    of_mode = {name: cost for (flown, name), cost in CORE_SECONDS.items() if flown == mode}
    cost = of_mode.get(config.estimator, max(of_mode.values()))
    beyond = BEYOND_SURVEY_S[mode]
    longer = (config.survey.duration_s + beyond) / (SurveyParams().duration_s + beyond)
    return cost * PROFILE_FACTOR[config.profile] * longer


def lines(found: Forecast) -> list[str]:
    """Returns the forecast as lines of text."""
    width = max(len(group.label) for group in found.groups)
    text = [
        f"{found.name}: {found.flights} flights, {found.finished} of them finished; {found.seeds}"
    ]
    for group in found.groups:
        source = "as measured" if group.measured else "as stated"
        text.append(
            f"  {group.label:{width}}  {group.flights:4d} flights, "
            f"{group.core_s:4.0f} core-seconds each {source}"
        )
    minutes = round(found.wall_s / 60.0)
    text.append(
        f"to fly: {found.core_hours:.2f} core-hours, about {minutes // 60} h "
        f"{minutes % 60:02d} min here with {found.jobs} at a time"
    )
    if found.undemanded:
        text.append(f"conditions that no expectation demands: {', '.join(found.undemanded)}")
    return text
