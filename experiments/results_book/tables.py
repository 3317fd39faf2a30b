"""The tables of README and the results pages, from the rows of `record.Record`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from touchdown.experiments.reporting import published
from touchdown.experiments.reporting.conditions import condition_of
from touchdown.experiments.reporting.flights import cell, methods_of, scenes_of, values
from touchdown.experiments.reporting.measures import (
    SET_MARK,
    is_marked,
    setting_notes,
    setting_of,
    titled,
)
from touchdown.experiments.reporting.statistics import mean_interval, share_interval
from touchdown.experiments.reporting.tables import ALL_SCENES, MISSING, digits, interval_text

Row = Mapping[str, Any]
_ERROR, _PATH, _NEES = "position_error_m.mean", "trajectory_error_m", "nees.below_14_2"
_LEVEL, _LEVEL_MAX = "map.levelness_error_deg.mean", "map.levelness_error_deg.max"
_D_L, _V_Z = "landing.target_offset_m", "landing.vertical_speed_mps"
_A_Z, _SLOPE = "landing.vertical_accel_mps2", "landing.slope_deg"
_INTERVALS = "Brackets: 95 % intervals of the mean over flights (bootstrap), of shares Wilson's."


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a table: its title and its cell for some rows."""

    title: str
    text: Callable[[Sequence[Row]], str]


def mean_of(title: str, column: str, scale: float = 1.0) -> Column:
    """Mean of ``column`` with its interval."""

    def text(rows: Sequence[Row]) -> str:
        found = mean_interval([scale * value for value in values(rows, column)])
        if found is None:
            return MISSING
        only = {row["estimator"] for row in rows}
        mark = SET_MARK * (len(only) == 1 and is_marked(column, only.pop()))
        return " ".join(filter(None, (digits(found.value), interval_text(found), mark)))

    return Column(titled(title, column), text)


def largest_of(title: str, column: str) -> Column:
    """Largest value of ``column``."""

    def text(rows: Sequence[Row]) -> str:
        found = values(rows, column)
        return digits(max(found)) if found else MISSING

    return Column(titled(title, column), text)


def _flown(rows: Sequence[Row]) -> str:
    return str(len(rows))


def _outcomes(rows: Sequence[Row]) -> str:
    return ", ".join(f"{name} {n}" for name, n in Counter(r["outcome"] for r in rows).most_common())


def _landed(rows: Sequence[Row]) -> str:
    return str(sum(row["outcome"] == "LANDED" for row in rows))


def _unsafe(rows: Sequence[Row]) -> str:
    return str(sum(row.get("ground_safe") is False for row in rows))


_COUNTS = (
    Column("flights", _flown),
    Column("landed", _landed),
    Column("unsafe touchdowns", _unsafe),
)
_LANDING = (
    mean_of("d_L (m)", _D_L),
    mean_of("v_z (m/s)", _V_Z),
    mean_of("a_z (m/s²)", _A_Z),
    mean_of("α_L (°)", _SLOPE),
)
_POSITION = (
    Column("flights", _flown),
    Column("outcomes", _outcomes),
    mean_of("mean error (m)", _ERROR),
    largest_of("worst flight (m)", _ERROR),
    mean_of("E_tra (m)", _PATH),
    mean_of("NEES below 14.2 (%)", _NEES, 100.0),
)
_LEVELNESS = (
    mean_of("levelness, mean (°)", _LEVEL),
    largest_of("largest at any place (°)", _LEVEL_MAX),
)


# --------------------------------------------------------------------------------------- tables


def landings(rows: Sequence[Row]) -> list[str]:
    """A line for each scene and one for all of them."""
    columns = (*_COUNTS, mean_of("position error (m)", _ERROR), *_LANDING, *_LEVELNESS)
    lines = _table(["scene"], columns, [([_scene(s)], own) for s, own in _by_scene(rows)])
    lost = [row for row in rows if row["outcome"] != "LANDED" or row.get("ground_safe") is False]
    notes = [
        "Figures of touchdowns are over the flights that touched ground. "
        "d_L: from the first contact to the site as committed at 4 m; v_z, a_z: mean absolute "
        "values over the last 0.5 s; α_L: slope of the true ground. "
        f"{_INTERVALS}",
        *setting_notes([_V_Z], methods_of(rows)),
        *(_lost(row) for row in lost),
    ]
    return [*lines, "", *(f"- {note}" for note in notes)]


def _lost(row: Row) -> str:
    reason = f" ({row['reason']})" if row.get("reason") else ""
    unsafe = ", on unsafe ground" if row.get("ground_safe") is False else ""
    return f"`{row['scene']}`, seed {row['seed']}: {row['outcome']}{unsafe}{reason}."


def positioning(surveys: Sequence[Row], landed: Sequence[Row]) -> list[str]:
    """A line for each method and scene, and one for each method over all scenes."""
    rows = _positioned(surveys, landed)
    groups = [
        ([f"`{method}`", _scene(scene)], own)
        for method in methods_of(rows)
        for scene, own in _by_scene(cell(rows, None, method))
    ]
    notes = [
        "mean error: distance of the estimate from the truth, not aligned; E_tra: deviation of the "
        "flown path from the reference; both from lift-off to the end of the survey. The surveys "
        f"of `livo` are those of the landings. {_INTERVALS}",
        *setting_notes([_ERROR, _PATH], methods_of(rows)),
    ]
    return [*_table(["method", "scene"], _POSITION, groups), "", *(f"- {n}" for n in notes)]


def _positioned(surveys: Sequence[Row], landed: Sequence[Row]) -> list[Row]:
    """The rows that show a method's positioning: a landing begins with the same survey, over which
    position error and deviation from the reference are taken."""
    return [*landed, *(row for row in surveys if row["estimator"] != "oracle")]


def levelness(surveys: Sequence[Row], landed: Sequence[Row]) -> list[str]:
    """A line for each scene and kind of flight that made a map: Δα, mean and largest."""
    kinds = [(f"survey, `{m}`", cell(surveys, None, m)) for m in ("oracle", "zou2024")]
    kinds.append(("landing, `livo`", list(landed)))
    groups = [
        ([_scene(scene), kind], own)
        for scene in [*scenes_of([*surveys, *landed]), ALL_SCENES]
        for kind, rows in kinds
        if (own := [row for row in rows if scene in (row["scene"], ALL_SCENES)])
    ]
    columns = (Column("flights", _flown), *_LEVELNESS)
    printed = ", ".join(f"±{value:g}" for value in published.LEVELNESS_DEG)
    notes = (
        "Angle between the normals of map and true ground at 10 places of a flight, at the end of "
        f"the survey; `oracle` has the true pose. {_INTERVALS}",
        f"The paper's Table 1 prints {printed}° for its scenes 1 to 4, which it does not name, and "
        f"the bound {published.LEVELNESS_BOUND_DEG:g}° over all of them.",
    )
    return [*_table(["scene", "flight"], columns, groups), "", *(f"- {note}" for note in notes)]


def blind(rows: Sequence[Row]) -> list[str]:
    """A line for each condition and scene."""
    groups = [
        ([f"`{condition}`", _scene(scene)], own)
        for condition in dict.fromkeys(condition_of(row) for row in rows)
        for scene, own in _by_scene([r for r in rows if condition_of(r) == condition])
    ]
    columns = (
        Column("flights", _flown),
        Column("outcomes", _outcomes),
        Column("unsafe touchdowns", _unsafe),
        mean_of("mean error (m)", _ERROR),
        largest_of("largest error (m)", "position_error_m.max"),
        mean_of("error at the commit (m)", "landing.estimate_error_at_commit_m"),
        mean_of("NEES below 14.2 (%)", _NEES, 100.0),
    )
    return [*_table(["condition", "scene"], columns, groups), "", f"- {_INTERVALS}"]


def summary(landed: Sequence[Row], surveys: Sequence[Row]) -> list[str]:
    """README's two tables, over all scenes: landings by measure, surveys by method."""
    positioned = _positioned(surveys, landed)
    notes = setting_notes([_V_Z, _PATH, _ERROR], methods_of(positioned))
    return [
        *_landing_summary(landed),
        "",
        *_survey_summary(positioned),
        "",
        " ".join([*notes, _INTERVALS]),
    ]


def _landing_summary(rows: Sequence[Row]) -> list[str]:
    safe = [row for row in rows if row["outcome"] == "LANDED" and row.get("ground_safe") is True]
    share = share_interval(len(safe), len(rows))
    low, high = 100.0 * (share.low or 0.0), 100.0 * (share.high or 0.0)
    scenes = len(scenes_of(rows))
    lines = [
        f"| {len(rows)} landings with `livo`, {scenes} scenes | paper | mean | largest |",
        "|---|---|---|---|",
        f"| landed; on safe ground; touched unsafe ground | – | {_landed(rows)}; {len(safe)} "
        f"({100.0 * share.value:.0f} % [{low:.0f}, {high:.0f}]); {_unsafe(rows)} | – |",
    ]
    for title, unit, column, worst, theirs in _MEASURES:
        mean, largest = mean_of("", column).text(rows), largest_of("", worst).text(rows)
        lines.append(f"| {titled(title, column)} ({unit}) | {theirs} | {mean} | {largest} |")
    return lines


def _paper(printed: Mapping[str, published.Published]) -> str:
    return f"{printed['zou2024'].value:g}"


_MEASURES = (
    ("d_L, offset from the chosen site", "m", _D_L, _D_L, _paper(published.LANDING_OFFSET_M)),
    ("v_z before the first contact", "m/s", _V_Z, _V_Z, MISSING),
    ("a_z before it", "m/s²", _A_Z, _A_Z, _paper(published.LANDING_ACCEL_MPS2)),
    ("α_L, slope of the ground there", "°", _SLOPE, _SLOPE, _paper(published.LANDING_SLOPE_DEG)),
    ("levelness of the map", "°", _LEVEL, _LEVEL_MAX,
     f"within {published.LEVELNESS_BOUND_DEG:g}"),
)  # fmt: skip


def _survey_summary(rows: Sequence[Row]) -> list[str]:
    columns = (
        Column("completed", lambda own: f"{_completed(own)} of {len(own)}"),
        mean_of("position error (m)", _ERROR),
        mean_of("E_tra (m)", _PATH),
        Column("E_tra, paper (m)", _printed_path),
        mean_of("NEES below 14.2 (%)", _NEES, 100.0),
    )
    groups = [([f"`{method}`"], cell(rows, None, method)) for method in methods_of(rows)]
    return _table([f"surveys, {len(scenes_of(rows))} scenes"], columns, groups)


def _completed(rows: Sequence[Row]) -> int:
    return sum(row["outcome"] in ("COMPLETED", "LANDED") for row in rows)


def _printed_path(rows: Sequence[Row]) -> str:
    method = rows[0]["estimator"]
    printed = published.TRAJECTORY_ERROR_M.get(method)
    return MISSING if printed is None or setting_of(_PATH, method) else f"{printed.value:g}"


# ---------------------------------------------------------------------------------------- helpers


def _scene(name: str) -> str:
    return name if name == ALL_SCENES else f"`{name}`"


def _by_scene(rows: Sequence[Row]) -> list[tuple[str, list[Row]]]:
    """Rows by scene, and after several scenes all of them."""
    found = [(scene, cell(rows, scene)) for scene in scenes_of(rows)]
    return [*found, (ALL_SCENES, list(rows))] if len(found) > 1 else found


def _table(
    names: Sequence[str],
    columns: Sequence[Column],
    groups: Sequence[tuple[Sequence[str], Sequence[Row]]],
) -> list[str]:
    """Lines of a Markdown table; columns without a figure are left out."""
    cells = [[column.text(rows) for _, rows in groups] for column in columns]
    kept = [n for n, found in enumerate(cells) if any(text != MISSING for text in found)]
    header = [*names, *(columns[n].title for n in kept)]
    lines = [f"| {' | '.join(header)} |", "|" + "---|" * len(header)]
    for line, (heads, _) in enumerate(groups):
        lines.append("| " + " | ".join([*heads, *(cells[n][line] for n in kept)]) + " |")
    return lines
