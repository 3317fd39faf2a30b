"""State of each part of a reproduction on disk."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ConfigDict, TypeAdapter, ValidationError, with_config

from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.untrusted import read_object, refuse_links, shown
from touchdown.experiments.reporting.published import SITES
from touchdown.experiments.reproduce.networks import NETWORKS, PICTURES, SETTINGS
from touchdown.experiments.reproduce.plans import PAPER_SCENES, QUICK, WHOLE, WHOLE_ON_GPU, Extent
from touchdown.experiments.reproduce.steps import FLIGHTS, PARTS, Part

MARK, STATE, ERROR, REPORT = "reproduction.json", "part.json", "error.txt", "report"
_LOCK = ".lock"
_EDITIONS = tuple(edition.name for edition in (QUICK, WHOLE, WHOLE_ON_GPU))


@with_config(ConfigDict(strict=True, extra="forbid"))
@dataclass(frozen=True, slots=True)
class PartState:
    """``part.json``: result of a part. ``error``: of a part that did not end and will run again;
    ``why``: the reason why a part failed its purpose, else empty."""

    part: str
    edition: str
    settings: dict[str, Any]
    figures: dict[str, Any]
    why: str
    error: str
    wall_s: float
    finished_utc: str
    git_revision: str | None

    @property
    def successful(self) -> bool:
        """True if the part ended and served its purpose."""
        return not self.why and not self.error


@dataclass(frozen=True, slots=True)
class Reproduction:
    """Result of a reproduction. ``states``: of all parts that ever ended, by name; ``skipped``:
    parts that this call left out."""

    out: Path
    quick: bool
    states: dict[str, PartState]
    skipped: tuple[str, ...]
    wall_s: float

    @property
    def successful(self) -> bool:
        """True if every requested part served its purpose."""
        return all(
            state.successful for name, state in self.states.items() if name not in self.skipped
        )


def read_states(out: Path) -> dict[str, PartState]:
    """States of the parts in the order of `PARTS`. Raises UsageError for a damaged state."""
    return {part.name: state for part in PARTS if (state := _read_state(out / part.name / STATE))}


def _read_state(file: Path) -> PartState | None:
    if not file.exists():
        return None
    try:
        state = _STATE.validate_json(json.dumps(read_object(file)))
        if state.part != file.parent.name:
            raise ValueError(f"it is of the part {shown(state.part)}")
        _check_names(state)
    except (OSError, ValueError, TypeError, LookupError) as error:
        if isinstance(error, ValidationError):
            first = error.errors(include_url=False)[0]
            reason = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
        else:
            reason = str(error)
        raise UsageError(
            f"'{file}' is damaged or of another program ({reason}); delete it, and its part runs "
            "again"
        ) from error
    return state


_STATE = TypeAdapter(PartState)


def _check_names(state: PartState) -> None:
    """Raises ValueError or LookupError for figures whose names, from which the report makes the
    names of files, are not those of its part."""
    figures = state.figures
    if state.edition not in _EDITIONS:
        raise ValueError(f"its edition is {shown(state.edition)}")
    if state.error and not figures:
        return
    if state.part == "recognition" and figures["folder"] not in _EDITIONS:
        raise ValueError(f"its folder is {shown(figures['folder'])}")
    scenes: list[Any] = []
    known: Iterable[str] = ()
    if state.part == "world":
        scenes, known = list(figures["scenes"]), PAPER_SCENES
    elif state.part == "sites":
        scenes, known = [place["scene"] for place in figures["places"]], SITES
    for name in scenes:
        if not isinstance(name, str) or name not in known:
            raise ValueError(f"its scene {shown(name)} is none of the part")


def check_plain(out: Path) -> None:
    """Raises UsageError where a reproduction would write, replace or remove through a link."""
    names = [MARK, _LOCK, REPORT]
    for part in PARTS:
        names += [part.name]
        names += [f"{part.name}/{name}" for name in (STATE, ERROR, PICTURES, FLIGHTS, *_EDITIONS)]
    for edition in _EDITIONS:
        for part_name in ("recognition", "photographs"):
            names += [f"{part_name}/{edition}/{name}" for name in (PICTURES, NETWORKS, SETTINGS)]
    refuse_links((out / name for name in names), "a reproduction")
    for folder in (out, *(out / part.name for part in PARTS)):
        if folder.is_dir():
            partials = (path for path in folder.iterdir() if path.name.startswith("."))
            refuse_links(partials, "a reproduction")
    trained = (
        out / part / edition / NETWORKS
        for part in ("recognition", "photographs")
        for edition in _EDITIONS
    )
    for folder in filter(Path.is_dir, trained):
        refuse_links(folder.iterdir(), "a reproduction")


def _is_done(part: Part, out: Path, extent: Extent) -> bool:
    """True if a part with the same settings ended; quick and whole editions may share it. A
    campaign with flights without an outcome is not done."""
    state = _read_state(out / part.name / STATE)
    if state is None or state.error:
        return False
    lost = state.figures.get("crashed", 0) or state.figures.get("remaining", 0)
    return not lost and state.settings == _as_read(part.settings(extent))


def _as_read(tree: Mapping[str, Any]) -> Any:
    """Tree as read back from a file, where tuples are lists."""
    return json.loads(json.dumps(tree))
