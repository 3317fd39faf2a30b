"""Curves of a campaign's dials: keys of numbers that are an axis or swept. For each method the
probability of a safe landing, of an unsafe one and of a missed site against the dial."""

import tomllib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from touchdown.experiments.campaign.campaign_file import unrolled
from touchdown.experiments.campaign.plan import AXES
from touchdown.experiments.config.keys import flatten
from touchdown.experiments.io.result_parts import PartNames
from touchdown.experiments.reporting.comparison import NEEDED
from touchdown.experiments.reporting.figures import Picture, add_legend, colour_of, drawn, whiskers
from touchdown.experiments.reporting.flights import Row, config_numbers, ordered, values_and_units
from touchdown.experiments.reporting.logistic import LogisticFit, crossing_difference, fit_logistic
from touchdown.experiments.reporting.measures import measure_of
from touchdown.experiments.reporting.statistics import Estimate, clustered_fraction, mean_interval
from touchdown.experiments.reporting.tables import Cell, Table, cell, digits, name_cell

MIN_LEVELS = 3
"""of a key of numbers that is a dial"""
LEVELS = (0.9, 0.5)
_EVENTS = {
    "safe": "lands safely",
    "unsafe": "touches down unsafely",
    "missed": "finds no site although one is in view",
}
_ERROR = "position_error_m.mean"
_POINTS = 101


def dials_of(configuration: str) -> list[str]:
    """Keys of the configuration that a campaign's text varies over three or more numbers."""
    try:
        text = tomllib.loads(configuration)
        given = dict(flatten(unrolled({**text.get("axes", {}), **text.get("sweep", {})})))
    except (tomllib.TOMLDecodeError, AttributeError, TypeError, ValueError):
        return []
    return [
        AXES.get(key, key) for key, found in given.items()
        if key not in ("seed", "seeds") and isinstance(found, list)
        and len(set(filter(_is_number, found))) >= MIN_LEVELS
    ]  # fmt: skip


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def dial_frames(rows: Sequence[Row], frame: pd.DataFrame, dials: Sequence[str]) -> dict[str, Any]:
    """For each dial the flights with the others at their usual value, that of most flights, with
    the columns ``dial``, ``safe``, ``unsafe`` and ``missed``; ``estimator`` names other parts too
    that are not those by default. Where all values of all dials were flown together every flight
    counts."""
    known = {str(row["run_id"]): config_numbers(row, dials) for row in rows}
    table = pd.DataFrame([known[str(name)] for name in frame["run_id"]], index=frame.index)
    methods = [_method(row) for row in frame.to_dict("records")]
    flown = frame.assign(**_events(frame), estimator=methods)
    usual_of = table.fillna(np.inf)  # unset
    together = len(usual_of.drop_duplicates()) == np.prod(usual_of.nunique())
    found = {}
    for dial in dials:
        others = [other for other in dials if other != dial and not together]
        usual = [usual_of[other] == usual_of[other].mode().iloc[0] for other in others]
        kept = table[dial].notna() & np.logical_and.reduce(usual or [np.ones(len(table), bool)])
        found[dial] = flown[kept].assign(dial=table[dial][kept])
    return {dial: own for dial, own in found.items() if own["dial"].nunique() >= MIN_LEVELS}


def methods_over(rows: Sequence[Row], frame: pd.DataFrame, dials: Sequence[str]) -> pd.DataFrame:
    """All flights, with ``estimator`` as of `dial_frames` and the values of the dials as
    ``condition``."""
    known = {str(row["run_id"]): config_numbers(row, dials) for row in rows}
    values = [str(list(known[str(name)].values())) for name in frame["run_id"]]
    methods = [_method(row) for row in frame.to_dict("records")]
    return frame.assign(condition=values, estimator=methods)


def _method(row: Mapping[Any, Any]) -> str:
    """``livo + zou2024`` for that estimator with that selector."""
    parts = (row.get(f"parts.{kind}") for kind in PartNames.model_fields)
    return " + ".join([row["estimator"], *(p for p in parts if isinstance(p, str) and p)])


def _events(frame: pd.DataFrame) -> dict[str, Any]:
    empty = pd.Series(index=frame.index, dtype=object)
    safe = (frame["outcome"] == "LANDED") & frame.get("ground_safe", empty).eq(True)
    down = frame["outcome"].isin(["LANDED", "TIPPED"])
    missed = pd.to_numeric(frame.get("choice.missed.safe_m2", empty), errors="coerce") > 0.0
    return {
        "safe": safe,
        "unsafe": down & ~safe,
        "missed": (frame["outcome"] == "NO_SITE") & missed,
    }


def curves(
    dial: str, flown: pd.DataFrame, measures: Sequence[str] = (_ERROR,), what: str = "flights"
) -> tuple[Table, Picture, list[str]]:
    """The table, the picture and sentences of one dial. ``flown``: rows as of `dial_frames`, which
    are called ``what``; ``measures``: columns of them that are shown beside."""
    methods = ordered(flown, "estimator")
    fits = {
        (method, event): fit_logistic(own["dial"], own[event], own["unit"])
        for method in methods
        for event in _EVENTS
        if (own := flown[flown["estimator"] == method])["dial"].nunique() >= 2
    }
    table, words = _table(dial, flown, fits, measures, what), []
    if without_effect(flown, measures):
        words.append(
            f"Warning: `{dial}` changed nothing: {what} that differ in it alone are the same. Is "
            "it a key that the scene or the part reads?"
        )
    elif not any(fit.changes() for (_, event), fit in fits.items() if event == "safe"):
        words.append(f"No effect of `{dial}` on safe landings is shown.")
    for other in methods[1:]:
        words += _compared(dial, methods[0], other, fits)
    return table, _picture(dial, flown, fits, measures, what), words


def without_effect(flown: pd.DataFrame, measures: Sequence[str] = (_ERROR,)) -> bool:
    """True if all flights of a scene, a method and a seed are the same at every value."""
    told = [c for c in (*measures, "outcome", "landing.target_offset_m") if c in flown]
    groups = flown.groupby(["scene", "estimator", "seed"])
    several = groups["dial"].nunique() > 1
    return bool(several.any() and (groups[told].nunique(dropna=False)[several] == 1).all(axis=None))


def _table(
    dial: str,
    flown: pd.DataFrame,
    fits: dict[Any, LogisticFit],
    measures: Sequence[str],
    what: str,
) -> Table:
    header = ["method", what, *(f"{100 * level:.0f} % safe" for level in LEVELS),
              "unsafe (%)", *(measure_of(column).plain for column in measures)]  # fmt: skip
    table = Table(f"curve_{dial}", f"Safe landings by `{dial}`", header, [])
    for method in ordered(flown, "estimator"):
        own = flown[flown["estimator"] == method]
        fit, units = fits.get((method, "safe")), own["unit"].nunique()
        unsafe = clustered_fraction(own["unsafe"].to_numpy(), list(own["unit"]))
        at = {level: fit.crossing(level) if fit else None for level in LEVELS}
        table.rows.append([
            name_cell(method), Cell(str(len(own)), f"{units} independent" * (units < len(own))),
            *(_crossing_cell(at[level], fit, level) for level in LEVELS),
            cell(unsafe, scale=100.0),
            *(cell(mean_interval(*values_and_units(own, column))) for column in measures),
        ])  # fmt: skip
        table.numbers[method] = {
            "unsafe": unsafe.as_json(),
            **{f"safe_{level:g}": found.as_json() for level, found in at.items() if found},
            "levels": _levels(own, measures),
        }
    return table


def _levels(own: pd.DataFrame, measures: Sequence[str]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for value, group in own.groupby("dial"):
        units = list(group["unit"])
        found[f"{value:g}"] = {
            event: clustered_fraction(group[event].to_numpy(), units).as_json() for event in _EVENTS
        }
        for column in measures:
            if figure := mean_interval(*values_and_units(group, column)):
                found[f"{value:g}"][column.removesuffix(".mean")] = figure.as_json()
    return found


def _crossing_cell(found: Estimate | None, fit: LogisticFit | None, level: float) -> Cell:
    if fit is None:
        return Cell("–")
    if found is None:
        is_above = fit.band(np.array([fit.low]))[0][0] > level
        return Cell("everywhere" if is_above else "nowhere")
    assert found.low is not None and found.high is not None
    low, high = (
        f"{end:.3g}" if np.isfinite(end) else edge
        for end, edge in ((found.low, f"< {fit.low:g}"), (found.high, f"> {fit.high:g}"))
    )
    return Cell(f"{'up to' if fit.falls else 'from'} {digits(found.value)}", f"[{low}, {high}]")


def _compared(dial: str, first: str, other: str, fits: dict[Any, LogisticFit]) -> list[str]:
    """How far apart two methods pass one half."""
    if (first, "safe") not in fits or (other, "safe") not in fits:
        return []
    found = crossing_difference(fits[first, "safe"], fits[other, "safe"], LEVELS[-1])
    if found is None:
        return [f"`{other}` against `{first}`: one of them does not pass 50 % within `{dial}`."]
    if found.units < NEEDED:
        return [f"`{other}` against `{first}`: n = {found.units} says nothing."]
    assert found.low is not None and found.high is not None
    sign = 1.0 if found.value > 0.0 else -1.0
    low, high = sorted((sign * found.low, sign * found.high))
    told = f"{abs(found.value):.3g} [{low:.3g}, {high:.3g}]"
    if not found.excludes(0.0):
        return [f"`{other}` against `{first}`: no difference is shown ({told}, 50 % safe)."]
    where = "later" if found.value > 0.0 else "earlier"
    passes = "falls" if fits[first, "safe"].falls else "rises"
    return [f"`{other}` {passes} to 50 % safe {where} than `{first}`, by {told} of `{dial}`."]


def _picture(
    dial: str,
    flown: pd.DataFrame,
    fits: dict[Any, LogisticFit],
    measures: Sequence[str],
    what: str,
) -> Picture:
    names = " and ".join(measure_of(column).words for column in measures)
    picture = Picture(
        f"curve_{dial.replace('.', '_')}",
        f"Landings against `{dial}`",
        f"Lines: logistic fits with their pointwise 95 % bands. Marks: fractions of the {what} at "
        f"each value with their 95 % intervals; of the {names} means.",
    )
    methods = ordered(flown, "estimator")
    events = [event for event in _EVENTS if flown[event].any() or event == "safe"]
    with drawn(picture, 2.7 * (len(events) + len(measures)), 3.0) as figure:
        panels = figure.subplots(1, len(events) + len(measures))
        for number, method in enumerate(methods):
            own, colour = flown[flown["estimator"] == method], colour_of(method, methods)
            aside = 0.008 * (number - 0.5 * (len(methods) - 1)) * np.ptp(flown["dial"])
            for axes, event in zip(panels, events, strict=False):
                if fit := fits.get((method, event)):
                    _paint_fit(axes, fit, colour, method)
                paint_levels(axes, own, event, colour, aside)
            for axes, column in zip(panels[len(events) :], measures, strict=True):
                paint_levels(axes, own, column, colour, aside)
        for axes, event in zip(panels, events, strict=False):
            axes.set(title=_EVENTS[event], ylim=(-0.03, 1.03))
            axes.yaxis.set_major_formatter(lambda value, _: f"{100 * value:.0f} %")
        for axes, column in zip(panels[len(events) :], measures, strict=True):
            axes.set(title=measure_of(column).plain)
            axes.set_ylim(0.0, 1.1 * axes.get_ylim()[1])
        figure.supxlabel(dial, fontsize=9)
        add_legend(figure, panels[0], 4)
    return picture


def _paint_fit(axes: Any, fit: LogisticFit, colour: str, method: str) -> None:
    dial = np.linspace(fit.low, fit.high, _POINTS)
    value, low, high = fit.band(dial)
    axes.fill_between(dial, low, high, color=colour, alpha=0.15, linewidth=0)
    axes.plot(dial, value, color=colour, linewidth=1.6, label=method)


def paint_levels(axes: Any, own: pd.DataFrame, column: str, colour: str, aside: float) -> None:
    """Marks of the means of a column at each value of ``dial``, with their intervals."""
    at: list[float] = []
    found: list[Estimate] = []
    for value, group in own.groupby("dial"):
        figure = (
            clustered_fraction(group[column].to_numpy(), list(group["unit"]))
            if column in _EVENTS
            else mean_interval(*values_and_units(group, column))
        )
        if figure is not None:
            at.append(float(value) + aside)  # type: ignore[arg-type]
            found.append(figure)
    axes.errorbar(at, [f.value for f in found], yerr=whiskers(found), fmt="o", markersize=4,
                  color=colour, capsize=2.0, linewidth=0.9)  # fmt: skip
