"""What is on disk of a reproduction: the state of each part."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from touchdown.experiments.errors import UsageError
from touchdown.experiments.reproduce.plans import Extent
from touchdown.experiments.reproduce.steps import PARTS, Part

MARK, STATE, ERROR, REPORT = "reproduction.json", "part.json", "error.txt", "report"
_LOCK = ".lock"


@dataclass(frozen=True, slots=True)
class PartState:
    """``part.json``: what a part came to. ``error`` is of a part that could not be ended, and is
    tried again; ``why`` says in what a part failed its purpose, empty where it did not."""

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
    def good(self) -> bool:
        return not self.why and not self.error


@dataclass(frozen=True, slots=True)
class Reproduction:
    """``states`` by name of the part, of all parts that were ever ended; ``skipped`` are those that
    were left out now, whatever earlier calls did."""

    out: Path
    quick: bool
    states: dict[str, PartState]
    skipped: tuple[str, ...]
    wall_s: float

    @property
    def good(self) -> bool:
        """Whether every part that was asked for did what it is for."""
        return all(state.good for name, state in self.states.items() if name not in self.skipped)


def read_states(out: Path) -> dict[str, PartState]:
    """What each part came to, in the order of `PARTS`. Raises UsageError for a damaged state."""
    return {part.name: state for part in PARTS if (state := _read_state(out / part.name / STATE))}


def _read_state(file: Path) -> PartState | None:
    if not file.is_file():
        return None
    try:
        return PartState(**json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise UsageError(
            f"'{file}' is damaged or of another program; delete it, and its part is done again"
        ) from error


def _is_done(part: Part, out: Path, extent: Extent) -> bool:
    """Parts whose settings are the same quick and whole serve as both. A campaign with flights that
    came to no outcome is gone on with."""
    state = _read_state(out / part.name / STATE)
    if state is None or state.error:
        return False
    lost = state.figures.get("crashed", 0) or state.figures.get("remaining", 0)
    return not lost and state.settings == _as_read(part.settings(extent))


def _as_read(tree: Mapping[str, Any]) -> Any:
    """As it comes back from a file: tuples are lists there."""
    return json.loads(json.dumps(tree))
