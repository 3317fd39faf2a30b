"""Campaign directories that were flown apart, made one: ``touchdown merge``."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from touchdown.experiments.campaign.directory import (
    PARTIAL,
    PLAN_FILE,
    SOURCE_FILE,
    check_plain,
    locked,
    read_plan_file,
    write_plan_file,
)
from touchdown.experiments.campaign.results_table import (
    CAMPAIGN_RUN_FILES,
    FAILED,
    RUNS,
    finished_ids,
    read_row,
    refresh,
)
from touchdown.experiments.campaign.session import summary
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.run_directory import put_in_place
from touchdown.experiments.io.untrusted import inside, refuse_links


def merge(out: Path, parts: Sequence[Path]) -> dict[str, Any]:
    """Copies the finished and the crashed runs of ``parts``, directories of one campaign that were
    flown apart, into ``out``, which is new or one of them that others have joined. Returns
    `summary` of ``out``. It may be stopped and given again; runs that ``out`` has stay.

    Raises UsageError, before anything is copied, where the parts plan different runs or revisions,
    or a row is damaged."""
    documents = [read_plan_file(part) for part in parts]
    known = [*zip(parts, documents, strict=True)]
    if (out / PLAN_FILE).is_file():
        known.append((out, read_plan_file(out)))
    for part, document in known[1:]:
        _check_same(parts[0], documents[0], part, document)
    for part in parts:
        check_plain(part)
        for run_id in finished_ids(part):
            refuse_links((part / RUNS / run_id).iterdir(), "a campaign")
            read_row(part / RUNS / run_id)
    with locked(out, None):
        for part in parts:
            _copy_runs(part, out, {run["run_id"] for run in documents[0]["runs"]})
        if not (out / PLAN_FILE).is_file():
            shutil.copyfile(parts[0] / SOURCE_FILE, out / SOURCE_FILE)
        sessions = {str(one): one for _, document in known for one in document["sessions"]}
        write_plan_file(out, documents[0] | {"sessions": [*sessions.values()]})
        refresh(out, must_write=True)
    return summary(out)


def _check_same(first: Path, mine: dict[str, Any], part: Path, other: dict[str, Any]) -> None:
    for key in ("git_revision", "runs"):
        if mine[key] != other[key]:
            raise UsageError(
                f"'{part}' is not of the campaign of '{first}': {key} differ; merge directories "
                "that were flown from one file by one revision"
            )


def _copy_runs(part: Path, out: Path, planned: set[str]) -> None:
    """A run appears whole in ``out``, as in a campaign; one that crashed only where none is."""
    for folder in (RUNS, FAILED, PARTIAL):
        (out / folder).mkdir(exist_ok=True)
    for run_id in sorted(finished_ids(part) & planned - finished_ids(out)):
        made = inside(out / PARTIAL, f"{run_id}.merged")
        shutil.rmtree(made, ignore_errors=True)
        shutil.copytree(part / RUNS / run_id, made)
        put_in_place(made, out / RUNS / run_id, CAMPAIGN_RUN_FILES)
        (out / FAILED / f"{run_id}.json").unlink(missing_ok=True)
    for record in (part / FAILED).glob("*.json"):
        if record.stem in planned - finished_ids(out):
            shutil.copyfile(record, out / FAILED / record.name)
