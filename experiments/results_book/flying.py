"""Flying the sets: what they cost, and at which revision."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from touchdown.experiments.campaign.forecast import Forecast, forecast
from touchdown.experiments.campaign.plan import Plan
from touchdown.experiments.campaign.results_table import finished_ids, is_campaign, load_rows
from touchdown.experiments.campaign.session import Watcher, default_jobs, fly_campaign, make_engine
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.provenance import DIRTY, UNRECORDED_REMEDY, git_revision
from touchdown.experiments.results_book.sets import FlightSet


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
    todo = [found for found, plan in plans.items() if _left(plan, out / found.key)]
    if todo:
        revision = git_revision()
        if revision is None:
            raise UsageError(f"the git revision of the flights is not known: {UNRECORDED_REMEDY}")
        if revision.endswith(DIRTY):
            raise UsageError(
                "the source tree has changes that are not committed: no page can say of which "
                "revision flights of it are; commit or stash them first"
            )
        for found in todo:
            check_same_revision(out / found.key, revision)
    return [
        fly_campaign(plan, out / found.key, make_engine("local", jobs), watcher=watcher())
        for found, plan in plans.items()
    ]


def _left(plan: Plan, directory: Path) -> bool:
    return bool({run.run_id for run in plan.runs} - finished_ids(directory))


def check_same_revision(directory: Path, revision: str) -> None:
    """Raises UsageError where ``directory`` holds flights of another revision."""
    if not is_campaign(directory) or not finished_ids(directory):
        return
    others = {str(row["git_revision"]) for row in load_rows(directory)} - {revision}
    if others:
        raise UsageError(
            f"'{directory}' holds flights of revision {min(others)[:12]}, the source tree is at "
            f"{revision[:12]}; check that revision out, or name another --out"
        )
