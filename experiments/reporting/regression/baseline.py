"""The baseline of `touchdown regress`: errors and outcomes of a campaign's flights."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

from annotated_types import Ge
from pydantic import AllowInfNan, ConfigDict, TypeAdapter, ValidationError, with_config

from touchdown.experiments.campaign.results_table import is_successful
from touchdown.experiments.config.profiles import PRESETS, WHOLE
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.results import PartNames
from touchdown.experiments.io.run_directory import write_text
from touchdown.experiments.io.untrusted import read_object
from touchdown.experiments.reporting.flights import Row, number
from touchdown.scenes.api import short_name
from touchdown.sim.files.opening import no_file

FORMAT = "touchdown-baseline-1"
METRIC = "position_error_m.mean"
ALL_SCENES = "all scenes"

_Figure = Annotated[float, Ge(0.0), AllowInfNan(False)]


@with_config(ConfigDict(strict=True))
@dataclass(frozen=True, slots=True)
class Trial:
    """One flight. ``error_m`` is None without a position error; ``bad``: not successful;
    ``figures``: those of `FIGURES` that it has, by column."""

    seed: int
    error_m: _Figure | None
    outcome: str
    bad: bool
    figures: dict[str, _Figure] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of a flight. Values below ``floor`` count as ``floor``, so that their logarithms do
    not decide. More is worse, with ``both_sides`` less too."""

    title: str
    column: str
    floor: float
    both_sides: bool = False

    def log_of(self, trial: Trial) -> float | None:
        """Logarithm of the figure; None for a flight without it."""
        value = trial.figures.get(self.column)
        return None if value is None else math.log(max(value, self.floor))


FIGURES = (
    Figure("position error (m)", METRIC, 0.01),
    Figure("NEES", "nees.mean", 0.3),  # a tenth of what is consistent
    # Less is overconfidence that small errors hide, more is a measurement that is lost.
    Figure("stated σ (m)", "nees.sigma_m", 0.001, both_sides=True),
    Figure("stated σ of z (m)", "nees.sigma_z_m", 0.0001, both_sides=True),
    Figure("d_L (m)", "landing.target_offset_m", 0.01),
    Figure("levelness (°)", "map.levelness_error_deg.mean", 0.1),
)
"""What `bounds` compares."""


Key = tuple[str, str, str]
"""scene, method, variant"""
Cells = Mapping[Key, Mapping[int, Trial]]
"""flights by cell and seed"""
Pairs = Mapping[Key, tuple[Mapping[int, Trial], Mapping[int, Trial]]]
"""flights of a cell by seed, new and old"""


@dataclass(frozen=True, slots=True)
class Baseline:
    """``config_sha`` is one hash over the configurations of all flights."""

    cells: Cells
    git_revision: str | None
    config_sha: str

    @property
    def some_cells(self) -> str:
        """The names of its first cells."""
        return "; ".join(map(cell_name, sorted(self.cells)[:6])) or "none"


def cell_name(key: Key) -> str:
    scene, method, variant = key
    return f"{scene}, {method}" + (f" ({variant})" if variant else "")


def newly_bad(pairs: Pairs) -> list[str]:
    """Equal seeds that were successful in the baseline and are no longer."""
    return [
        f"{cell_name(key)}, seed {seed}: {old[seed].outcome} before, {new[seed].outcome} now"
        for key, (new, old) in pairs.items()
        for seed in sorted(new.keys() & old.keys())
        if new[seed].bad and not old[seed].bad
    ]


# ------------------------------------------------------------------------------------------- rows


def cells_of(rows: Iterable[Row]) -> dict[Key, dict[int, Trial]]:
    """Flights by cell and seed. Raises UsageError when a cell has a seed twice."""
    cells: dict[Key, dict[int, Trial]] = {}
    for row in rows:
        key = (row["scene"], row["estimator"], _variant(row))
        trials = cells.setdefault(key, {})
        seed = int(row["seed"])
        if seed in trials:
            raise UsageError(
                f"{cell_name(key)} was flown twice with seed {seed} ('{row['run_id']}' is one of "
                "the runs); keep one of them"
            )
        found = {figure.column: number(row, figure.column) for figure in FIGURES}
        figures = {column: value for column, value in found.items() if value is not None}
        bad = not is_successful(row)
        trials[seed] = Trial(seed, number(row, METRIC), str(row["outcome"]), bad, figures)
    return cells


def _variant(row: Row) -> str:
    """The variant of a run: "land" for landings, the preset of a flight that is not whole, then the
    further axes at the end of its name, or the parts that are not those by default."""
    name = str(row["run_id"]).rpartition("/")[2]
    start = f"{short_name(row['scene'])}-{row['estimator']}-s{row['seed']}-"
    parts = ["land"] if row["mode"] == "land" else []
    preset = row.get("preset") or WHOLE
    if preset != WHOLE:
        parts.append(preset)
    if name.startswith(start):
        further = [p for p in name.removeprefix(start).split("-") if p not in PRESETS]
        parts += ["-".join(further)] if further else []
    else:
        named = (row.get(f"parts.{kind}") for kind in PartNames.model_fields)
        parts += [str(part) for part in named if part]
    return " ".join(parts)


def configuration_sha(rows: Iterable[Row]) -> str:
    """One hash over the configurations of all flights, in no particular order."""
    shas = sorted({str(row.get("config_sha")) for row in rows})
    return hashlib.sha256(" ".join(shas).encode()).hexdigest()[:12]


# ------------------------------------------------------------------------------------------- file


@with_config(ConfigDict(strict=True))
@dataclass(frozen=True, slots=True)
class _StoredCell:
    scene: str
    estimator: str
    variant: str
    flights: list[Trial]


_STORED_CELLS = TypeAdapter(list[_StoredCell])


def write_baseline(rows: Sequence[Row], path: Path) -> None:
    """Writes the flights of ``rows`` as a baseline, atomically. Raises UsageError, without writing,
    where ``path`` is another kind of file."""
    if path.exists():
        read_baseline(path)
    revisions = sorted({str(row["git_revision"]) for row in rows if row.get("git_revision")})
    tree = {
        "format": FORMAT,
        "metric": METRIC,
        "git_revision": ", ".join(revisions) or None,
        "config_sha": configuration_sha(rows),
        "cells": [
            asdict(_StoredCell(*key, [trials[seed] for seed in sorted(trials)]))
            for key, trials in sorted(cells_of(rows).items())
        ],
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, json.dumps(tree, indent=1) + "\n")
    except OSError as error:
        raise UsageError(f"--baseline {path}: cannot be written: {error.strerror}") from error


def read_baseline(path: Path) -> Baseline:
    """Returns the baseline of a file. Raises UsageError where it is missing or damaged."""
    if reason := no_file(path):
        raise UsageError(f"baseline '{path}' {reason}; write it with --update")
    try:
        tree = read_object(path)
        if tree["format"] != FORMAT:
            raise ValueError(f"its format is {tree['format']!r}, not {FORMAT!r}")
        stored = _STORED_CELLS.validate_json(json.dumps(tree["cells"]))
        cells = {(c.scene, c.estimator, c.variant): {f.seed: f for f in c.flights} for c in stored}
        return Baseline(cells, tree["git_revision"], str(tree["config_sha"]))
    except (OSError, ValueError, TypeError, LookupError) as error:
        raise UsageError(
            f"'{path}' is no baseline of `touchdown regress`: {_reason(error)}; write one with "
            "--update to another name"
        ) from None


def _reason(error: Exception) -> str:
    if isinstance(error, ValidationError):
        first = error.errors(include_url=False)[0]
        return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    text = f"'{error.args[0]}' is missing" if isinstance(error, KeyError) else str(error)
    return " ".join(text.split())
