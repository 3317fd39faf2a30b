"""What the numbers say, in sentences made from them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from touchdown.experiments.campaign.results_table import is_successful
from touchdown.experiments.reporting import published
from touchdown.experiments.reporting.flights import (
    Row,
    cell,
    methods_of,
    number,
    scenes_of,
    values,
)
from touchdown.experiments.reporting.statistics import Estimate, holm, mean_interval, sign_flip_p
from touchdown.experiments.reporting.tables import digits, interval_text, trajectory_variance

CHANCE = 0.05
ERROR_FLOOR_M = 1e-4
"""Errors below a tenth of a millimetre count as that: logarithms of nothing say nothing."""


def with_interval(estimate: Estimate, unit: str) -> str:
    return f"{digits(estimate.value)} {unit} {interval_text(estimate)}".rstrip()


def summary_words(rows: Sequence[Row]) -> list[str]:
    """How much was flown and how it ended."""
    scenes, methods = scenes_of(rows), methods_of(rows)
    bad = [row for row in rows if not is_successful(row)]
    lines = [
        f"{_count(len(rows), 'flight')}: {_count(len(methods), 'method')} over "
        f"{_count(len(scenes), 'scene')}, {_count(len({row['seed'] for row in rows}), 'seed')}."
    ]
    if not bad:
        lines.append("All ended as they should.")
        return lines
    by_method = [
        f"`{method}` {len(own)}"
        for method in methods
        if (own := [row for row in bad if row["estimator"] == method])
    ]
    measured = [row for row in bad if number(row, "position_error_m.mean") is not None]
    line = f"{len(bad)} did not end as they should ({', '.join(by_method)})"
    if measured:
        line += "; their errors up to the loss are in all figures"
    if len(measured) < len(bad):
        line += f"; {len(bad) - len(measured)} of them have no figures"
    lines.append(f"{line}.")
    return lines


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' * (number != 1)}"


# --------------------------------------------------------------------------------------- who leads


def leading_words(rows: Sequence[Row]) -> list[str]:
    """Per scene: the order by E_tra, whether the lead is chance, where the paper's order fails."""
    rivals = [row for row in rows if row["estimator"] != "oracle"]
    ranked = {scene: _ranking(rivals, scene) for scene in scenes_of(rivals)}
    contests = {s: order for s, order in ranked.items() if len(order) > 1}
    raw = {s: _lead_p(rivals, s, order[0][1], order[1][1]) for s, order in contests.items()}
    tested = [scene for scene, p in raw.items() if p is not None]
    adjusted = dict(zip(tested, holm([raw[s] or 0.0 for s in tested]), strict=True))
    lines = []
    for scene, order in contests.items():
        (_, first, lead), (_, second, next_) = order[:2]
        line = (
            f"{scene}: `{first}` is ahead by E_tra with {with_interval(lead, 'm')}, then "
            f"`{second}` with {with_interval(next_, 'm')}"
        )
        line += "".join(f", `{m}` {digits(e.value)} m" for _, m, e in order[2:])
        lines.append(f"{line}. {_lead_words(first, second, adjusted.get(scene))}")
    lines += _absence_words(rivals, ranked)
    return lines + _order_words({s: [m for _, m, _ in order] for s, order in contests.items()})


def _absence_words(
    rows: Sequence[Row], ranked: dict[str, list[tuple[float, str, Estimate]]]
) -> list[str]:
    """Methods that were to fly where others flew, and came to no figure."""
    lines = []
    for scene, order in ranked.items():
        flown = {method for _, method, _ in order}
        absent = [m for m in methods_of(cell(rows, scene)) if m not in flown]
        if order and absent:
            names = ", ".join(f"`{method}`" for method in absent)
            lines.append(f"{scene}: no flight with a figure to compare of {names}.")
    return lines


def _ranking(rows: Sequence[Row], scene: str) -> list[tuple[float, str, Estimate]]:
    found = []
    for method in methods_of(rows):
        measured = mean_interval(values(cell(rows, scene, method), "trajectory_error_m"))
        if measured is not None:
            found.append((measured.value, method, measured))
    return sorted(found, key=lambda item: item[:2])


def _lead_p(rows: Sequence[Row], scene: str, first: str, second: str) -> float | None:
    """Two-sided sign-flip p on the logarithms of E_tra at equal seeds and winds."""
    a, b = (_by_trial(cell(rows, scene, method)) for method in (first, second))
    common = sorted(a.keys() & b.keys(), key=str)
    if len(common) < 2:
        return None
    difference = np.array([b[trial] - a[trial] for trial in common])
    p = min(float(sign_flip_p(difference)), float(sign_flip_p(-difference)))
    return min(1.0, 2.0 * p)


def _by_trial(rows: Sequence[Row]) -> dict[tuple[object, object], float]:
    return {
        (row["seed"], row.get("wind_kmh")): float(np.log(max(error, ERROR_FLOOR_M)))
        for row in rows
        if (error := number(row, "trajectory_error_m")) is not None
    }


def _lead_words(first: str, second: str, p: float | None) -> str:
    if p is None:
        return f"`{first}` and `{second}` share too few seeds to tell whether the lead is chance."
    verdict = "is beyond chance" if p <= CHANCE else "may be chance"
    return f"The lead {verdict} (adjusted p = {p:.2g}, equal seeds)."


def _order_words(orders: dict[str, list[str]]) -> list[str]:
    """Where the paper's methods come in another order than in its Table 2."""
    same, lines = [], []
    for scene, order in orders.items():
        ours = [method for method in order if method in published.ORDER]
        theirs = [method for method in published.ORDER if method in ours]
        if len(ours) < 2:
            continue
        if ours == theirs:
            same.append(scene)
            continue
        lines.append(
            f"{scene}: the paper's methods come in the order {_chain(ours)}; in its Table 2 it is "
            f"{_chain(theirs)}."
        )
    if same:
        lines.append(f"The paper's methods come in the order of its Table 2 in {', '.join(same)}.")
    return lines


def _chain(methods: Sequence[str]) -> str:
    return " < ".join(f"`{method}`" for method in methods)


# ------------------------------------------------------------------------------- beside the paper


def published_words(rows: Sequence[Row]) -> list[str]:
    """Each measured figure that the paper prints too, and by how much they differ."""
    scene = published.ANALYSED_SCENE
    lines = []
    for method in published.ORDER:
        own = cell(rows, scene, method)
        comparisons = (
            ("E_tra", "m", published.TRAJECTORY_ERROR_M, _mean(own, "trajectory_error_m")),
            ("σ²_tra", "m²", published.TRAJECTORY_VARIANCE_M2, trajectory_variance(own)),
        )
        for name, unit, printed, measured in comparisons:
            if measured is not None:
                lines.append(_comparison(name, unit, method, measured, printed[method]))
    if lines:
        lines.append(
            f"The paper's figures are of a crossroad scene in Gazebo, 10 flights per method; "
            f"`{scene}` here is another place, flown by another simulation."
        )
    else:
        lines.append(f"No flight over `{scene}` with a method of the paper: nothing to set beside.")
    return lines + _levelness_words(rows)


def _mean(rows: Sequence[Row], key: str) -> Estimate | None:
    return mean_interval(values(rows, key))


def _comparison(
    name: str, unit: str, method: str, measured: Estimate, printed: published.Published
) -> str:
    text = (
        f"{name} of `{method}` on {published.ANALYSED_SCENE}: {with_interval(measured, unit)} "
        f"measured, {printed.value:g} {unit} printed ({printed.where}, "
        f'"{published.METHOD_NAMES[method]}")'
    )
    if measured.low is None:
        return f"{text}; one flight has no interval."
    if not measured.excludes(printed.value):
        return f"{text}: no difference beyond the interval."
    if measured.value <= 0:
        return f"{text}: smaller."
    ratio = printed.value / measured.value
    if ratio > 1:
        return f"{text}: {digits(ratio)} times smaller here."
    return f"{text}: {digits(1 / ratio)} times larger here."


def _levelness_words(rows: Sequence[Row]) -> list[str]:
    parts = []
    bound = published.LEVELNESS_BOUND_DEG
    for method in methods_of(rows):
        found = {
            scene: measured.value
            for scene in scenes_of(rows)
            if (measured := _mean(cell(rows, scene, method), "map.levelness_error_deg.mean"))
        }
        if found:
            worst = max(found, key=lambda scene: found[scene])
            verdict = "within" if found[worst] <= bound else "beyond"
            parts.append(f"`{method}` {digits(found[worst])}° ({worst}, {verdict})")
    if not parts:
        return []
    return [
        f"Levelness of the map in the worst scene of each method, beside the paper's bound of "
        f"{bound:g}°: {', '.join(parts)}."
    ]
