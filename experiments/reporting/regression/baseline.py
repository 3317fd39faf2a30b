"""The baseline of `touchdown regress`: outcomes and figures of a campaign's flights by cell.

A *cell* is a scene with a method and a variant, see `_variant`.
"""

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import AllowInfNan, BaseModel, ConfigDict, NonNegativeFloat

from touchdown.experiments.campaign.plan import SAME_FLIGHT
from touchdown.experiments.campaign.results_table import is_successful
from touchdown.experiments.config.files import read_tree
from touchdown.experiments.config.keys import flatten
from touchdown.experiments.config.profiles import PRESETS, WHOLE
from touchdown.experiments.errors import UsageError, reason_of
from touchdown.experiments.io.result_parts import PartNames
from touchdown.experiments.io.run_directory import write_text
from touchdown.experiments.io.untrusted import read_object
from touchdown.experiments.reporting.flights import Row, condition_of, number
from touchdown.experiments.reporting.tables import ALL_SCENES
from touchdown.sim.files.opening import no_file

_Figures = dict[str, Annotated[NonNegativeFloat, AllowInfNan(False)]]
REPEATED = "again"
"""begins the variants of a campaign that repeat a flight with a change that means nothing"""


class Trial(BaseModel):
    """One flight. ``bad``: not successful; ``figures``: those of `FIGURES` that it has, by column;
    ``repeats``: those of its repetitions."""

    model_config = ConfigDict(strict=True, frozen=True)

    seed: int
    outcome: str
    bad: bool
    figures: _Figures
    repeats: list[_Figures] = []


class Figure(NamedTuple):
    """A figure of a flight. Values below ``floor`` count as ``floor``, so that their logarithms do
    not decide. More is worse, with ``both_sides`` less too."""

    title: str
    column: str
    floor: float
    both_sides: bool = False

    def log_of(self, figures: Mapping[str, float]) -> float | None:
        """Logarithm of the figure; None for a flight without it."""
        value = figures.get(self.column)
        return None if value is None else math.log(max(value, self.floor))


METRIC = "position_error_m.mean"
ERROR = Figure("position error (m)", METRIC, 1e-4)
FIGURES = (
    ERROR._replace(floor=0.01),
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
Trials = Mapping[int, Trial]
"""flights of a cell by seed"""
Pairs = Mapping[Key, tuple[Trials, Trials]]
"""flights of a cell, new and old"""


class _Cell(BaseModel):
    scene: str
    estimator: str
    variant: str
    flights: list[Trial]


class Baseline(BaseModel):
    """The file of a baseline. ``config_sha``: one hash over the configurations of all flights;
    ``config``: `common_config` of them, empty in files of before it was kept."""

    format: Literal["touchdown-baseline-1"] = "touchdown-baseline-1"
    git_revision: str | None
    config_sha: str
    config: dict[str, Any] = {}
    cells: list[_Cell]

    @property
    def trials(self) -> dict[Key, Trials]:
        """Flights by cell and seed."""
        return {
            (c.scene, c.estimator, c.variant): {t.seed: t for t in c.flights} for c in self.cells
        }

    @property
    def some_cells(self) -> str:
        """The names of its first cells."""
        return "; ".join(map(cell_name, sorted(self.trials)[:6])) or "none"


def baseline_of(rows: Sequence[Row]) -> Baseline:
    """The baseline of flights. Raises UsageError as `cells_of`."""
    revisions = sorted({str(row["git_revision"]) for row in rows if row.get("git_revision")})
    cells = [
        _Cell(scene=scene, estimator=estimator, variant=variant,
              flights=[trials[seed] for seed in sorted(trials)])
        for (scene, estimator, variant), trials in sorted(cells_of(rows).items())
    ]  # fmt: skip
    return Baseline(
        git_revision=", ".join(revisions) or None, config_sha=configuration_sha(rows),
        config=common_config(rows), cells=cells,
    )  # fmt: skip


def write_baseline(rows: Sequence[Row], path: Path) -> None:
    """Writes the baseline of flights, atomically. Raises UsageError, without writing, where
    ``path`` is another kind of file."""
    if path.exists():
        read_baseline(path)
    text = baseline_of(rows).model_dump_json(indent=1) + "\n"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, text)
    except OSError as error:
        raise UsageError(f"--baseline {path}: cannot be written: {error.strerror}") from error


def read_baseline(path: Path) -> Baseline:
    """Returns the baseline of a file. Raises UsageError where it is missing or damaged."""
    if reason := no_file(path):
        raise UsageError(f"baseline '{path}' {reason}; write it with --update")
    try:
        return Baseline.model_validate({"format": "", **read_object(path)})
    except (OSError, ValueError) as error:
        raise UsageError(
            f"'{path}' is no baseline of `touchdown regress`: {reason_of(error)}; write one with "
            "--update to another name"
        ) from None


def cells_of(rows: Iterable[Row]) -> dict[Key, dict[int, Trial]]:
    """Flights by cell and seed. Raises UsageError when a cell has a seed twice, or a repetition of
    none of its flights."""
    cells: dict[Key, dict[int, Trial]] = {}
    for row in sorted(rows, key=_is_repeated):
        key = (row["scene"], row["estimator"], _variant(row))
        trials, seed = cells.setdefault(key, {}), int(row["seed"])
        found = {figure.column: number(row, figure.column) for figure in FIGURES}
        figures = {column: value for column, value in found.items() if value is not None}
        if _is_repeated(row) and seed in trials:
            trials[seed].repeats.append(figures)
            continue
        if seed in trials or _is_repeated(row):
            raise UsageError(
                f"{cell_name(key)} was flown twice with seed {seed}, or its repetitions alone "
                f"('{row['run_id']}' is one of the runs); keep one of them"
            )
        bad = not is_successful(row)
        trials[seed] = Trial(seed=seed, outcome=str(row["outcome"]), bad=bad, figures=figures)
    return cells


def _variant(row: Row) -> str:
    """The variant of a run: "land" for landings, the preset of a flight that is not whole, then the
    further axes at the end of its name, or the parts that are not those by default."""
    preset = row.get("preset") or WHOLE
    named = (*PRESETS, "as_is")
    parts = [part for part in condition_of(row).split("-") if part not in named]
    axes = "-".join(part for part in parts if not part.startswith(REPEATED))
    parts = [str(row[f"parts.{kind}"]) for kind in PartNames.model_fields
             if row.get(f"parts.{kind}")]  # fmt: skip
    found = ["land" * (row["mode"] == "land"), preset if preset != WHOLE else ""]
    return " ".join(filter(None, [*found, *([axes] if axes else parts)]))


def _is_repeated(row: Row) -> bool:
    return any(part.startswith(REPEATED) for part in condition_of(row).split("-"))


def cell_name(key: Key) -> str:
    scene, method, variant = key
    return f"{scene}, {method}" + (f" ({variant})" if variant else "")


def over_scenes(keys: Iterable[Key]) -> dict[Key, list[Key]]:
    """The cells of each method and variant that has several, by the key of all of them together."""
    found: dict[Key, list[Key]] = {}
    for key in keys:
        found.setdefault((ALL_SCENES, *key[1:]), []).append(key)
    return {total: own for total, own in found.items() if len(own) > 1}


def newly_bad(pairs: Pairs) -> list[str]:
    """Equal seeds that were successful in the baseline and are no longer."""
    return [
        f"{cell_name(key)}, seed {seed}: {old[seed].outcome} before, {new[seed].outcome} now"
        for key, (new, old) in pairs.items()
        for seed in sorted(new.keys() & old.keys())
        if new[seed].bad and not old[seed].bad
    ]


def common_config(rows: Iterable[Row]) -> dict[str, Any]:
    """The keys of ``config.json`` in which all flights that have one are equal, and the values,
    without those that change nothing of a flight."""
    common: dict[str, Any] | None = None
    for row in rows:
        with suppress(UsageError):
            values = dict(flatten(read_tree(Path(str(row.get("run_dir"))) / "config.json")))
            shared = values if common is None else common
            common = {key: v for key, v in shared.items() if key in values and values[key] == v}
    return {key: v for key, v in (common or {}).items() if key not in SAME_FLIGHT}


def configuration_sha(rows: Iterable[Row]) -> str:
    """One hash over the configurations of all flights, in no particular order."""
    shas = sorted({str(row.get("config_sha")) for row in rows})
    return hashlib.sha256(" ".join(shas).encode()).hexdigest()[:12]
