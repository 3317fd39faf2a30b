"""Tables of a report with measured and published figures, for Markdown and HTML."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from touchdown.experiments.campaign.results_table import is_successful
from touchdown.experiments.reporting import published
from touchdown.experiments.reporting.flights import (
    Row,
    flies_paper_methods,
    methods_of,
    number,
    scenes_of,
    values,
)
from touchdown.experiments.reporting.measures import (
    SET_MARK,
    TRAJECTORY_VARIANCE,
    Measure,
    estimates,
    is_marked,
    mean_of,
    setting_notes,
    titled,
)
from touchdown.experiments.reporting.queries import (
    CellKey,
    count_by_method,
    flown_cells,
    numbers_by_cell,
    outcome_counts,
    outcomes_by_cell,
)
from touchdown.experiments.reporting.statistics import Estimate

MISSING = "–"
ALL_SCENES = "all scenes"
STAGES = ("world", "estimator", "mapper", "lander", "controller", "recorder", "referee")


@dataclass(frozen=True, slots=True)
class Cell:
    """A figure and, smaller, its interval. ``kind``: "", "best", "published" or "name"."""

    text: str
    interval: str = ""
    kind: str = ""

    @property
    def plain(self) -> str:
        return f"{self.text} {self.interval}".rstrip()


@dataclass(slots=True)
class Table:
    """``numbers`` are the figures behind the cells, for ``--json``."""

    key: str
    title: str
    header: list[str]
    rows: list[list[Cell]]
    notes: list[str] = field(default_factory=list)
    numbers: dict[str, Any] = field(default_factory=dict)


def digits(value: float) -> str:
    """Three figures, at most four decimals; powers of ten below that, 0 below a millionth."""
    size = abs(value)
    for limit, decimals in ((100.0, 0), (10.0, 1), (1.0, 2), (0.01, 3)):
        if size >= limit:
            return f"{value:.{decimals}f}"
    if size >= 5e-5:
        return f"{value:.4f}"
    return f"{value:.0e}" if size >= 1e-6 else "0"


def interval_text(estimate: Estimate) -> str:
    if estimate.low is None or estimate.high is None:
        return ""
    return f"[{digits(estimate.low)}, {digits(estimate.high)}]"


def figure(estimate: Estimate | None, kind: str = "", *, marked: bool = False) -> Cell:
    """``marked``: the configuration sets this figure."""
    if estimate is None:
        return Cell(MISSING)
    text = f"{digits(estimate.value)} {SET_MARK}" if marked else digits(estimate.value)
    return Cell(text, interval_text(estimate), kind)


def name_cell(name: str) -> Cell:
    return Cell(f"`{name}`", kind="name")


def cell_names(key: CellKey) -> list[Cell]:
    """Returns the table cells of a method and its scene."""
    return [name_cell(key.method), Cell(key.scene or ALL_SCENES, kind="name")]


def ordered_cells(rows: Sequence[Row]) -> list[CellKey]:
    """Returns the cells with a flight, by method and scene in the order of a report."""
    flown, scenes = flown_cells(rows), scenes_of(rows)
    keys = (CellKey(method, scene) for method in methods_of(rows) for scene in scenes)
    return [key for key in keys if key in flown]


def method_scene_table(
    rows: Sequence[Row],
    key: str,
    title: str,
    measure: Measure,
    printed: dict[str, published.Published] | None = None,
    *,
    best: bool = True,
    all_scenes: bool = True,
) -> Table:
    """Returns a table with a line per method and a column per scene, and the paper's figures beside
    its scene where its methods flew."""
    scenes, methods = scenes_of(rows), methods_of(rows)
    printed = printed if flies_paper_methods(rows) else None
    found = estimates(rows, measure)
    marked = {method: is_marked(measure.columns[0], method) for method in methods}
    measured = [method for method in methods if not marked[method]]
    leaders = {s: _leader(found, measured, s) for s in scenes} if best and len(methods) > 1 else {}
    header = ["method"]
    for scene in scenes:
        header.append(scene)
        if printed and scene == published.ANALYSED_SCENE:
            header.append("paper prints")
    together = all_scenes and len(scenes) > 1
    pooled = estimates(rows, measure, pooled=True) if together else {}
    if together:
        header.append(ALL_SCENES)
    table = Table(key, title, header, [])
    for method in methods:
        line = [name_cell(method)]
        for scene in scenes:
            leads = leaders.get(scene) == method
            own = found.get(CellKey(method, scene))
            line.append(figure(own, "best" * leads, marked=marked[method]))
            if printed and scene == published.ANALYSED_SCENE:
                line.append(published_cell({} if marked[method] else printed, method))
        if together:
            line.append(figure(pooled.get(CellKey(method)), marked=marked[method]))
        table.rows.append(line)
        table.numbers[method] = {
            scene: estimate.as_json()
            for scene in scenes
            if (estimate := found.get(CellKey(method, scene))) is not None
        }
    table.notes = setting_notes(measure.columns, methods)
    return table


def published_cell(printed: dict[str, published.Published] | Any, method: str) -> Cell:
    value = printed.get(method)
    return Cell(MISSING if value is None else f"{value.value:g}", kind="published")


def _leader(found: Mapping[CellKey, Estimate], methods: Sequence[str], scene: str) -> str | None:
    """The method with the smallest figure; the oracle does not compete."""
    ranked = [
        (estimate.value, method)
        for method in methods
        if method != "oracle" and (estimate := found.get(CellKey(method, scene))) is not None
    ]
    return min(ranked)[1] if ranked else None


# ------------------------------------------------------------------------------ the paper's tables


def map_tables(rows: Sequence[Row]) -> list[Table]:
    """Table 1: scan time, map density, levelness deviation, of the flights that made a map."""
    rows = [row for row in rows if number(row, "map.density_per_m2")]
    if not rows:
        return []
    scenes, methods = scenes_of(rows), methods_of(rows)
    table = Table(
        "table1",
        "Table 1: scan time, map density and levelness",
        [
            "method",
            titled("T_total (s)", "map.duration_s"),
            "ρ_map (1/m²)",
            *(f"Δα {scene} (°)" for scene in scenes),
        ],
        [],
    )
    pooled = {
        key: estimates(rows, mean_of(f"map.{key}"), pooled=True)
        for key in ("duration_s", "density_per_m2")
    }
    levelness = estimates(rows, mean_of("map.levelness_error_deg.mean"))
    for method in methods:
        measured = {key: found.get(CellKey(method)) for key, found in pooled.items()}
        measured |= {scene: levelness.get(CellKey(method, scene)) for scene in scenes}
        table.rows.append([name_cell(method), *map(figure, measured.values())])
        table.numbers[method] = {
            name: estimate.as_json() for name, estimate in measured.items() if estimate is not None
        }
    table.notes = _paper_map_notes() if flies_paper_methods(rows) else [_LEVELNESS_NOTE]
    table.notes += setting_notes(["map.duration_s"], methods)
    worst = method_scene_table(
        rows,
        "levelness_max",
        "Largest levelness deviation of any place (°), mean over flights",
        mean_of("map.levelness_error_deg.max"),
        all_scenes=False,
    )
    density = method_scene_table(
        rows,
        "density",
        "Map density ρ_map (1/m²)",
        mean_of("map.density_per_m2"),
        best=False,
        all_scenes=False,
    )
    return [table, worst, density]


_LEVELNESS_NOTE = (
    "Δα: mean angle between map and true normal at 10 points per flight, drawn from the seed where "
    "the ground is planar; the largest is in the next table."
)


def _paper_map_notes() -> list[str]:
    """Notes on the figures of the paper's Table 1."""
    printed = ", ".join(f"±{value:g}" for value in published.LEVELNESS_DEG)
    return [
        f"The paper's Table 1 prints T_total and ρ_map run together as "
        f'"{published.SCAN_TIME_AND_DENSITY}"; where one number ends and the other begins cannot '
        "be known, so neither is compared.",
        f"For its scenes 1 to 4, which it does not name, the paper prints Δα = {printed}°, and the "
        f"bound {published.LEVELNESS_BOUND_DEG:g}° over all of them. It does not define ±.",
        _LEVELNESS_NOTE,
    ]


def trajectory_tables(rows: Sequence[Row]) -> list[Table]:
    """Table 2 and the error of the estimate itself."""
    error = method_scene_table(
        rows,
        "table2_error",
        "Table 2: E_tra (m), mean deviation of the flown path from the reference",
        mean_of("trajectory_error_m"),
        dict(published.TRAJECTORY_ERROR_M),
    )
    variance = method_scene_table(
        rows,
        "table2_variance",
        "Table 2: σ²_tra (m²), variance of that deviation, pooled over flights",
        TRAJECTORY_VARIANCE,
        dict(published.TRAJECTORY_VARIANCE_M2),
    )
    variance.notes += [
        "Variance of all samples of all flights thrown together, every flight weighing the same: "
        "the mean of the variances within flights plus the variance between their means."
    ]
    position = method_scene_table(
        rows,
        "position_error",
        "Position error of the estimate (m): mean 3-D distance from the truth, not aligned",
        mean_of("position_error_m.mean"),
    )
    if flies_paper_methods(rows):
        position.notes += ["The paper prints no such figure: its Table 2 is of the flown path."]
    return [error, variance, position]


AXES = (("x", "x (m)"), ("y", "y (m)"), ("z", "z (m)"), ("yaw_deg", "yaw (°)"))


def axis_tables(rows: Sequence[Row]) -> list[Table]:
    """The numbers of Fig. 10 b-e."""
    tables = []
    for key, title in (
        ("path_deviation", "Mean absolute deviation of the flown path from the reference"),
        ("position_error_m", "Mean absolute error of the estimate"),
    ):
        if not values(rows, f"{key}.x"):
            continue
        table = Table(f"axes_{key}", title, ["method", "scene", *(t for _, t in AXES)], [])
        found = [estimates(rows, mean_of(f"{key}.{axis}")) for axis, _ in AXES]
        for flown in ordered_cells(rows):
            marked = is_marked(f"{key}.x", flown.method)
            measured = [figure(by_cell.get(flown), marked=marked) for by_cell in found]
            table.rows.append([*cell_names(flown), *measured])
        table.notes = setting_notes([f"{key}.x"], methods_of(rows))
        tables.append(table)
    return tables


# ------------------------------------------------------------------------------------- the flights


def outcome_table(rows: Sequence[Row]) -> Table:
    """Table of outcomes per method and scene."""
    outcomes = list(outcome_counts(rows))
    table = Table("outcomes", "Outcomes", ["method", "scene", "flights", *outcomes], [])
    by_cell = outcomes_by_cell(rows)
    for flown in ordered_cells(rows):
        counts = by_cell[flown]
        shown = [Cell(str(counts.get(outcome, 0) or MISSING)) for outcome in outcomes]
        table.rows.append([*cell_names(flown), Cell(str(sum(counts.values()))), *shown])
        table.numbers.setdefault(flown.method, {})[flown.scene] = counts
    lost = [row for row in rows if not is_successful(row)]
    unmeasured = [row for row in lost if number(row, "position_error_m.mean") is None]
    table.notes = [
        f"{len(lost)} of {len(rows)} flights were not successful. Their errors up to the loss "
        "are in every figure; none is left out"
        + (f", but {len(unmeasured)} that have no figure at all." if unmeasured else ".")
    ]
    table.notes += [
        "{}, `{}`, seed {}: {}{}".format(
            row["scene"],
            row["estimator"],
            row["seed"],
            row["outcome"],
            f" ({row['reason']})" if row.get("reason") else "",
        )
        for row in lost[:20]
    ]
    if len(lost) > 20:
        table.notes.append(f"and {len(lost) - 20} more.")
    return table


def nees_table(rows: Sequence[Row]) -> Table | None:
    """Table of the median NEES; None without such figures."""
    if not values(rows, "nees.median"):
        return None
    table = method_scene_table(
        rows,
        "nees",
        "Median NEES of the position, mean over flights (2.4 if consistent)",
        mean_of("nees.median"),
        best=False,
    )
    table.notes += [
        "Normalised estimation error squared, three degrees of freedom: above 2.4 an estimator "
        "is overconfident, below it conservative."
    ]
    return table


def time_table(rows: Sequence[Row]) -> Table | None:
    """Table of wall times and of the share of each stage; None without times."""
    timed = [row for row in rows if number(row, "timing.wall_s")]
    if not timed:
        return None
    stages = [s for s in STAGES if values(timed, f"timing.stage_ms.{s}")]
    header = ["method", "flights", "wall (s)", "real-time factor", *(f"{s} (%)" for s in stages)]
    table = Table("time", "Wall time and the share of each stage", [*header, "other (%)"], [])
    flights = count_by_method(timed)
    factors = estimates(timed, mean_of("timing.real_time_factor"), pooled=True)
    spent_keys = [f"spent_s.{stage}" for stage in stages]
    spent_rows = [
        {**row, **{f"spent_s.{stage}": _stage_s(row, stage) for stage in stages}} for row in timed
    ]
    seconds = numbers_by_cell(spent_rows, ("timing.wall_s", *spent_keys), pooled=True)
    for method in methods_of(timed):
        # Python's sum, in the order of the rows: that of pyarrow rounds otherwise.
        wall, *spent = (sum(numbers) for numbers in seconds[CellKey(method)])
        shares = [100.0 * stage_s / wall for stage_s in spent]
        line = [name_cell(method), Cell(str(flights[method])), Cell(digits(wall / flights[method]))]
        line.append(figure(factors.get(CellKey(method))))
        shares.append(max(0.0, 100.0 - sum(shares)))
        table.rows.append([*line, *(Cell(f"{share:.0f}") for share in shares)])
        table.numbers[method] = {
            "wall_s": wall,
            "shares": dict(zip([*stages, "other"], (s / 100.0 for s in shares), strict=True)),
        }
    hours = sum(values(timed, "timing.wall_s")) / 3600.0
    table.notes = [
        f"{len(timed)} flights took {digits(hours)} hours of wall time, added up over processes."
    ]
    return table


def _stage_s(row: Row, stage: str) -> float:
    """Seconds that a stage took: ``stage_ms`` is per 0.1 s of simulated time."""
    per_scan = number(row, f"timing.stage_ms.{stage}") or 0.0
    return 1e-3 * per_scan * (number(row, "timing.sim_s") or 0.0) / 0.1
