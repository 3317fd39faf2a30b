"""State of each part of a reproduction on disk."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from touchdown.experiments.errors import UsageError, reason_of
from touchdown.experiments.io.untrusted import read_object, shown
from touchdown.experiments.reproduce.plans import EditionName, Extent
from touchdown.experiments.reproduce.steps import PARTS, Part

MARK, STATE, ERROR, REPORT = "reproduction.json", "part.json", "error.txt", "report"


class PartState(BaseModel):
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
        state = PartState.model_validate(read_object(file))
        if state.part != file.parent.name:
            raise ValueError(f"it is of the part {shown(state.part)}")
    except (OSError, ValueError) as error:
        raise UsageError(
            f"'{file}' is damaged or of another program ({reason_of(error)}); delete it, and its "
            "part runs again"
        ) from error
    return state


def is_done(part: Part, out: Path, extent: Extent) -> bool:
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
