"""What varies between the flights of a report, and what that changes.

A factor is the method or the condition, where flights have several. Each of its other levels is
compared with the first over pairs: flights of equal scene, seed and all else.
"""

import tomllib
from collections.abc import Sequence

import numpy as np
import pandas as pd

from touchdown.experiments.config.keys import flatten
from touchdown.experiments.reporting.flights import ordered, values_and_units
from touchdown.experiments.reporting.measures import measure_of
from touchdown.experiments.reporting.statistics import Estimate, mean_interval, min_pairs
from touchdown.experiments.reporting.tables import (
    INDEPENDENT,
    MAX_COLUMNS,
    Cell,
    Table,
    cell,
    count,
    make_table,
    mean,
)
from touchdown.sim.typing import Array

_FACTORS = ("condition", "estimator")
_ERROR = "position_error_m.mean"
_LANDINGS = (
    "safe", "landing.obstacle_distance_m", "landing.slope_deg", "landing.target_offset_m",
    "go_arounds", _ERROR,
)  # fmt: skip
_SURVEYS = (
    "success", _ERROR, "trajectory_error_m", "nees.below_14_2", "map.levelness_error_deg.mean",
)  # fmt: skip
_LEVELS = 8
"""levels of a factor that are compared"""
_SHOWN = ("smaller", "larger")
NEEDED = min_pairs(0.025)
"""fewest independent pairs with which a two-sided test of signs can reach 5 %"""


def factors_of(frame: pd.DataFrame) -> list[str]:
    """The columns among condition and estimator that vary."""
    return [name for name in _FACTORS if frame[name].nunique() > 1]


def condition_names(configuration: str) -> str:
    """The axes of a campaign's text beside scene, method and seed; "condition" without any."""
    try:
        axes = dict(flatten(tomllib.loads(configuration).get("axes", {})))
    except (tomllib.TOMLDecodeError, AttributeError):
        return "condition"
    names = [key for key, found in axes.items() if isinstance(found, list) and len(found) > 1]
    return " × ".join(n for n in names if n not in ("scene", "estimator", "seeds")) or "condition"


def judged(frame: pd.DataFrame) -> tuple[pd.DataFrame, Sequence[str]]:
    """The flights that are compared, landings where there are some, and the measures: columns,
    ``safe`` among them, which is 1 of a landing on safe ground."""
    landings = frame[frame["mode"] == "land"] if "mode" in frame else frame[:0]
    if not len(landings):
        return frame, _SURVEYS
    on_safe = landings["ground_safe"].eq(True) if "ground_safe" in landings else False
    return landings.assign(safe=((landings["outcome"] == "LANDED") & on_safe) * 1.0), _LANDINGS


def level_table(frame: pd.DataFrame) -> Table:
    """A line for each level, or for each scene where nothing varies."""
    flights, measures = judged(frame)
    names = factors_of(frame) or ["scene"]
    known = [column for column in measures if len(values_and_units(flights, column)[0])]
    by_error = "estimator" in names or measures is _SURVEYS
    kept = [c for c in known if c != "go_arounds" and (by_error or c != _ERROR)]
    taken = len(names) + 1 + int(flights.duplicated([*names, "unit"]).any())
    measured = map(mean, kept[: MAX_COLUMNS - taken])
    columns = [count("flights"), INDEPENDENT, *measured]
    return make_table(flights, "levels", "At a glance", columns, names, plain=True)


def difference_tables(
    frame: pd.DataFrame, but: Sequence[str] = ()
) -> tuple[list[Table], list[str]]:
    """For each level of each factor but the first a table of paired differences from that, and
    sentences on what they show. ``but``: factors that are not compared."""
    flights, measures = judged(frame)
    factors = factors_of(frame)
    tables, words = [], []
    for factor in (factor for factor in factors if factor not in but):
        base, *others = ordered(flights, factor) or [""]
        keys = ["scene", "seed", *(other for other in factors if other != factor)]
        first = flights[flights[factor] == base]
        for level in others[:_LEVELS]:
            pairs = first.merge(flights[flights[factor] == level], on=keys, suffixes=("", "+"))
            table, said = _differences(pairs, factor, base, level, measures)
            tables.append(table)
            words += said
        if len(others) > _LEVELS:
            words.append(f"{len(others) - _LEVELS} more of {factor} are not compared here.")
    return tables, words


def _differences(
    pairs: pd.DataFrame, factor: str, base: str, level: str, measures: Sequence[str]
) -> tuple[Table, list[str]]:
    title = f"`{level}` against `{base}`, over equal scenes and seeds"
    header = ["measure", base, level, "difference", "pairs", "shown"]
    table = Table(f"differences_{factor}_{level}", title, header, [])
    equal, larger, units_seen = [], [], 0
    for column in measures:
        scale = measure_of(column).scale
        before, after, units = _paired(pairs, column)
        difference = mean_interval(after - before, units)
        if difference is None:
            continue
        if not np.any(after - before):
            equal.append(measure_of(column).words)
            continue
        word = verdict(difference)
        is_shown = word in _SHOWN
        several = f"{difference.units} independent" * (difference.units < difference.flights)
        table.rows.append([
            Cell(measure_of(column).plain, kind="name"), cell(float(before.mean()), scale=scale),
            cell(float(after.mean()), scale=scale),
            cell(difference, scale=scale, kind="best" if is_shown else ""),
            Cell(str(difference.flights), several), Cell(word),
        ])  # fmt: skip
        table.numbers[column] = difference.as_json()
        units_seen = max(units_seen, difference.units)
        if is_shown:
            unit = measure_of(column).unit
            size = cell(abs(difference.value), scale=scale).text
            larger.append(f"{measure_of(column).words} {word} by {size} {unit}".rstrip())
    words = []
    if larger:
        words.append(f"`{level}` against `{base}`: {', '.join(larger)}.")
    elif table.rows and units_seen < NEEDED:
        words.append(
            f"`{level}` against `{base}`: n = {units_seen} says nothing. A difference is told from "
            f"chance by {NEEDED} independent pairs at the least."
        )
    elif table.rows:
        words.append(
            f"`{level}` against `{base}`: no difference is shown by {units_seen} independent pairs."
        )
    if equal:
        table.notes.append(f"The same in every pair: {', '.join(equal)}.")
    return table, words


def _paired(pairs: pd.DataFrame, column: str) -> tuple[Array, Array, list[str]]:
    """Values of the first and the other level of pairs that have both, and the units."""
    if column not in pairs:
        return np.empty(0), np.empty(0), []
    both = pairs[[column, f"{column}+"]].apply(pd.to_numeric, errors="coerce")
    known = np.isfinite(both.to_numpy(np.float64, na_value=np.nan)).all(axis=1)
    before, after = both[known].to_numpy(np.float64).T
    return before, after, list(pairs["unit"][known])


def verdict(difference: Estimate) -> str:
    """What a paired difference shows, in words."""
    if difference.units < NEEDED:
        return f"n = {difference.units} says nothing"
    if difference.excludes(0.0):
        return _SHOWN[difference.value > 0.0]
    return "no difference shown"


def varying_words(frame: pd.DataFrame, configuration: str) -> list[str]:
    """What varies, with its levels."""
    titles = {"estimator": "method", "condition": condition_names(configuration)}
    return [
        f"Varies: {titles[factor]} ({', '.join(f'`{name}`' for name in ordered(frame, factor))})."
        for factor in factors_of(frame)
    ]
