"""The sets of flights that README and the results pages print: their plans, and flying them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from touchdown.experiments.campaign.forecast import Forecast, forecast
from touchdown.experiments.campaign.plan import Plan, load_plan
from touchdown.experiments.campaign.results_table import finished_ids, is_campaign, load_rows
from touchdown.experiments.campaign.session import Watcher, default_jobs, fly_campaign, make_engine
from touchdown.experiments.errors import UsageError, nearest
from touchdown.experiments.io.provenance import DIRTY, UNRECORDED_REMEDY, git_revision

ROOT = Path(__file__).resolve().parents[2]
"""the source tree with its plans and pages"""
DEFAULT_PROFILE = "field"


@dataclass(frozen=True, slots=True)
class FlightSet:
    """Flights of one profile; ``file``: their campaign, relative to the source tree."""

    name: str
    profile: str
    file: str

    @property
    def key(self) -> str:
        """``field/landings``: directory below ``--out``, and name in the file of results."""
        return f"{self.profile}/{self.name}"

    @property
    def command(self) -> str:
        """The command that flies the sets of its profile."""
        profile = "" if self.profile == DEFAULT_PROFILE else f" PROFILE={self.profile}"
        return f"make results{profile}"

    def plan(self, root: Path = ROOT) -> Plan:
        """The runs of the campaign in this profile. Raises UsageError without a source tree."""
        file = root / self.file
        if not file.is_file():
            raise UsageError(
                f"'{file}' does not exist: the flights of the results pages are planned in the "
                "source tree of Touchdown; call the command of a git checkout"
            )
        plan = load_plan(file)
        runs = [run for run in plan.runs if run.values.get("profile") == self.profile]
        return replace(plan, runs=tuple(runs))


SETS = (
    FlightSet("landings", "field", "configs/results_landings.toml"),
    FlightSet("positioning", "field", "configs/results_positioning.toml"),
    FlightSet("blind", "field", "configs/field_blind.toml"),
    FlightSet("short", "field", "configs/results_short.toml"),
    FlightSet("landings", "ideal", "configs/results_landings.toml"),
    FlightSet("positioning", "ideal", "configs/results_positioning.toml"),
)


def chosen(profile: str, only: Sequence[str] = ()) -> list[FlightSet]:
    """The sets of a profile; those called ``only`` where any are named. Raises UsageError for an
    unknown name."""
    of_profile = [found for found in SETS if found.profile == profile]
    names = [found.name for found in of_profile]
    for name in only:
        if name not in names:
            raise UsageError(
                f"--only {name}: no set of profile '{profile}'{nearest(name, names)}; "
                f"known: {', '.join(names)}"
            )
    return [found for found in of_profile if not only or found.name in only]


def forecasts(sets: Sequence[FlightSet], out: Path, jobs: int | None) -> list[Forecast]:
    """The cost of each set, of the flights that ``out`` lacks."""
    at_once = jobs or default_jobs()
    return [forecast(plan := found.plan(), plan.runs, out / found.key, at_once) for found in sets]


def fly(
    sets: Sequence[FlightSet], out: Path, jobs: int | None, watcher: Callable[[], Watcher]
) -> list[dict[str, Any]]:
    """Flies what is left of the sets, each into ``out``/profile/name, and returns their summaries.
    Raises UsageError before the first flight where the rows could not be printed in the end: the
    revision is not known, not committed, or not that of the flights that exist."""
    plans = {found: found.plan() for found in sets}
    todo = [
        out / found.key
        for found, plan in plans.items()
        if {run.run_id for run in plan.runs} - finished_ids(out / found.key)
    ]
    if todo:
        revision = git_revision()
        if revision is None:
            raise UsageError(f"the git revision of the flights is not known: {UNRECORDED_REMEDY}")
        if revision.endswith(DIRTY):
            raise UsageError(
                "the source tree has changes that are not committed: no page can say of which "
                "revision flights of it are; commit or stash them first"
            )
        for directory in todo:
            _check_same_revision(directory, revision)
    return [
        fly_campaign(plan, out / found.key, make_engine("local", jobs), watcher=watcher())
        for found, plan in plans.items()
    ]


def _check_same_revision(directory: Path, revision: str) -> None:
    """Raises UsageError where ``directory`` holds flights of another revision."""
    if not is_campaign(directory) or not finished_ids(directory):
        return
    others = {str(row["git_revision"]) for row in load_rows(directory)} - {revision}
    if others:
        raise UsageError(
            f"'{directory}' holds flights of revision {min(others)[:12]}, the source tree is at "
            f"{revision[:12]}; check that revision out, or name another --out"
        )
