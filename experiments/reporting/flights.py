"""Flights of a directory as rows, one flat dictionary each with dotted keys, and as a frame."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.campaign.results_table import CRASHED, RUNS, is_campaign, load_rows
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.provenance import UNRECORDED_REMEDY
from touchdown.sim.files.opening import no_file

if TYPE_CHECKING:
    import pandas as pd

Row = Mapping[str, Any]

_ORDER = {
    "scene": ("crossroad", "lake", "houses", "forest"),
    "estimator": ("livo", "zou2024", "stereo", "hybrid_flow", "gps", "optical_flow", "oracle"),
}
"""Names that come first in a report, the paper's scenes and the project's estimators."""


def load_flights(directory: Path) -> list[dict[str, Any]]:
    """Returns every flight of a campaign, or below a plain directory, as rows of
    `touchdown.experiments.campaign.results_table.load_rows`, with the key ``run_dir``. Raises
    UsageError without a flight or for an unreadable one."""
    rows = load_rows(directory)
    folder = directory / RUNS if is_campaign(directory) else directory
    for row in rows:
        run_dir = folder / row["run_id"]
        row["run_dir"] = str(run_dir if run_dir.is_dir() else folder)
    return rows


def frame_of(rows: Sequence[Row]) -> pd.DataFrame:
    """A frame of rows, with the column ``condition``, empty where they have none."""
    import pandas as pd

    frame = pd.DataFrame([dict(row) for row in rows])
    if "condition" not in frame:
        frame["condition"] = ""
    return frame


def check_revisions(rows: Iterable[Row], directory: Path) -> None:
    """Raises UsageError where a flight that ended with a result has no git revision."""
    missing = [r for r in rows if r["outcome"] != CRASHED and not recorded_revision(r)]
    if missing:
        raise UsageError(
            f"'{directory}': {len(missing)} results have no git revision, the first is "
            f"'{missing[0]['run_id']}'; {UNRECORDED_REMEDY}"
        )


def recorded_revision(row: Row) -> str | None:
    """The git revision of a flight; None where it was not recorded, for which earlier versions
    wrote "unknown"."""
    found = row.get("git_revision")
    return str(found) if found and found != "unknown" else None


def campaign_text(directory: Path) -> str:
    """Returns the text of the campaign's file; empty without one."""
    file = directory / "campaign.toml"
    return "" if no_file(file) else file.read_text(encoding="utf-8", errors="replace")


def number(row: Row, key: str) -> float | None:
    """Returns a finite number of a row; None for any other value."""
    value = row.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if np.isfinite(value) else None


def values(frame: pd.DataFrame, column: str) -> NDArray[np.float64]:
    """The numbers of a column in the order of the flights, without missing ones."""
    import pandas as pd

    if column not in frame:
        return np.empty(0)
    found = pd.to_numeric(frame[column], errors="coerce").to_numpy(np.float64, na_value=np.nan)
    return found[np.isfinite(found)]


def ordered(frame: pd.DataFrame, column: str) -> list[str]:
    """The names in a column: scenes and methods in a fixed order, others by name; of any other
    column in the order of the flights."""
    found = list(dict.fromkeys(frame[column]))
    known = _ORDER.get(column)
    if known is None:
        return found
    return sorted(found, key=lambda n: (known.index(n) if n in known else len(known), n))
