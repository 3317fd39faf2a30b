"""Sentences of a report, generated from its figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from touchdown.experiments.campaign.results_table import is_successful
from touchdown.experiments.reporting import published
from touchdown.experiments.reporting.flights import (
    Row,
    cell,
    flies_paper_methods,
    methods_of,
    number,
    scenes_of,
)
from touchdown.experiments.reporting.measures import (
    TRAJECTORY_VARIANCE,
    estimates,
    is_marked,
    mean_of,
    setting_notes,
    setting_of,
)
from touchdown.experiments.reporting.queries import CellKey, count_by_method, flown_cells
from touchdown.experiments.reporting.statistics import (
    Array,
    Estimate,
    holm,
    seeds_needed,
    sign_flip_p,
)
from touchdown.experiments.reporting.tables import digits, interval_text

CHANCE = 0.05
_PATH = "trajectory_error_m"
ERROR_FLOOR_M = 1e-4
"""Smaller errors count as a tenth of a millimetre, so that logarithms stay finite."""


def with_interval(estimate: Estimate, unit: str) -> str:
    return f"{digits(estimate.value)} {unit} {interval_text(estimate)}".rstrip()


def summary_sentences(rows: Sequence[Row]) -> list[str]:
    """Number of flights and of unsuccessful ones."""
    scenes, methods = scenes_of(rows), methods_of(rows)
    failed = [row for row in rows if not is_successful(row)]
    lines = [
        f"{_count(len(rows), 'flight')}: {_count(len(methods), 'method')} over "
        f"{_count(len(scenes), 'scene')}, {_count(len({row['seed'] for row in rows}), 'seed')}."
    ]
    if not failed:
        lines.append("All were successful.")
        return lines
    failures = count_by_method(failed)
    by_method = [f"`{method}` {failures[method]}" for method in methods if method in failures]
    measured = [row for row in failed if number(row, "position_error_m.mean") is not None]
    line = f"{len(failed)} were not successful ({', '.join(by_method)})"
    if measured:
        line += "; their errors up to the loss are in all figures"
    if len(measured) < len(failed):
        line += f"; {len(failed) - len(measured)} of them have no figures"
    lines.append(f"{line}.")
    return lines


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' * (number != 1)}"


# ----------------------------------------------------------------------------------------- ranking


class Rank(NamedTuple):
    """A method and its E_tra in a scene."""

    method: str
    error: Estimate


def leading_sentences(rows: Sequence[Row]) -> list[str]:
    """Returns, per scene, the order by E_tra, the test of the lead, and the paper's order. Methods
    whose error is set do not compete."""
    rivals = [
        row
        for row in rows
        if row["estimator"] != "oracle" and not is_marked(_PATH, row["estimator"])
    ]
    measured = estimates(rivals, mean_of(_PATH))
    ranked = {scene: _ranking(measured, scene) for scene in scenes_of(rivals)}
    contests = {s: order for s, order in ranked.items() if len(order) > 1}
    pairs = {
        s: _differences(rivals, s, first.method, second.method)
        for s, (first, second, *_) in contests.items()
    }
    tested = [scene for scene, difference in pairs.items() if len(difference) > 1]
    adjusted = dict(zip(tested, holm([_two_sided_p(pairs[s]) for s in tested]), strict=True))
    lines = []
    for scene, order in contests.items():
        first, second, *others = order
        line = (
            f"{scene}: `{first.method}` is ahead by E_tra with {with_interval(first.error, 'm')}, "
            f"then `{second.method}` with {with_interval(second.error, 'm')}"
        )
        line += "".join(f", `{rank.method}` {digits(rank.error.value)} m" for rank in others)
        lead_m, alpha = second.error.value - first.error.value, CHANCE / max(1, len(tested))
        verdict = _lead_text(lead_m, pairs[scene], adjusted.get(scene), alpha)
        lines.append(f"{line}. {verdict}")
    lines += _absence_sentences(rivals, ranked)
    return lines + _order_sentences({s: [r.method for r in order] for s, order in contests.items()})


def _absence_sentences(rows: Sequence[Row], ranked: Mapping[str, Sequence[Rank]]) -> list[str]:
    """Methods without a figure in scenes where others have one."""
    lines, flown = [], flown_cells(rows)
    for scene, order in ranked.items():
        missing = flown - {CellKey(rank.method, scene) for rank in order}
        absent = [m for m in methods_of(rows) if CellKey(m, scene) in missing]
        if order and absent:
            names = ", ".join(f"`{method}`" for method in absent)
            lines.append(f"{scene}: no flight with a figure to compare of {names}.")
    return lines


def _ranking(measured: Mapping[CellKey, Estimate], scene: str) -> list[Rank]:
    """The methods of a scene, smallest figure first."""
    found = [Rank(key.method, error) for key, error in measured.items() if key.scene == scene]
    return sorted(found, key=lambda rank: (rank.error.value, rank.method))


def _differences(rows: Sequence[Row], scene: str, first: str, second: str) -> Array:
    """Differences (pairs,) of the logarithms of E_tra, second less first, at equal seeds and
    winds."""
    a, b = (_by_trial(cell(rows, scene, method)) for method in (first, second))
    common = sorted(a.keys() & b.keys(), key=str)
    return np.array([b[trial] - a[trial] for trial in common])


def _two_sided_p(differences: Array) -> float:
    """p of the two-sided sign-flip test."""
    p = min(float(sign_flip_p(differences)), float(sign_flip_p(-differences)))
    return min(1.0, 2.0 * p)


def _by_trial(rows: Sequence[Row]) -> dict[tuple[object, object], float]:
    return {
        (row["seed"], row.get("wind_kmh")): float(np.log(max(error, ERROR_FLOOR_M)))
        for row in rows
        if (error := number(row, "trajectory_error_m")) is not None
    }


def _lead_text(lead_m: float, differences: Array, p: float | None, alpha: float) -> str:
    """The verdict of the test, and the number of seeds that would show an undecided lead."""
    seeds = len(differences)
    if p is None:
        shared = f"{seeds} equal seed{'s' * (seeds != 1)}" if seeds else "no equal seeds"
        return f"The two share {shared}; a test needs at least two."
    if p <= CHANCE:
        return f"The lead is beyond chance (adjusted p = {p:.2g}, {seeds} equal seeds)."
    text = (
        f"With {seeds} equal seeds a difference of {digits(lead_m)} m may be due to chance "
        f"(adjusted p = {p:.2g})"
    )
    needed = seeds_needed(differences, alpha)
    if needed is None:
        return f"{text}."
    return f"{text}; {max(needed, seeds + 1)} seeds per method would show it with 80 % power."


def _order_sentences(orders: dict[str, list[str]]) -> list[str]:
    """The order of the paper's methods compared with that of its Table 2."""
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


# ----------------------------------------------------------------------- comparison with the paper


def published_sentences(rows: Sequence[Row]) -> list[str]:
    """Each measured figure that the paper prints too, with the ratio of both; none where no method
    of the paper flew."""
    if not flies_paper_methods(rows):
        return []
    scene = published.ANALYSED_SCENE
    own = cell(rows, scene)
    error = estimates(own, mean_of(_PATH))
    variance = estimates(own, TRAJECTORY_VARIANCE)
    comparisons = (
        ("E_tra", "m", published.TRAJECTORY_ERROR_M, error),
        ("σ²_tra", "m²", published.TRAJECTORY_VARIANCE_M2, variance),
    )
    lines = []
    for method in (m for m in published.ORDER if setting_of(_PATH, m) is None):
        for name, unit, printed, found in comparisons:
            if (measured := found.get(CellKey(method, scene))) is not None:
                lines.append(_comparison(name, unit, method, measured, printed[method]))
    if lines:
        lines.append(
            f"The paper's figures are of a crossroad scene in Gazebo, 10 flights per method; "
            f"`{scene}` here is another scene in another simulator."
        )
    return lines + _levelness_sentences(rows) + setting_notes([_PATH], methods_of(own))


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


def _levelness_sentences(rows: Sequence[Row]) -> list[str]:
    parts = []
    bound = published.LEVELNESS_BOUND_DEG
    levelness, scenes = estimates(rows, mean_of("map.levelness_error_deg.mean")), scenes_of(rows)
    for method in methods_of(rows):
        found = {
            scene: measured.value
            for scene in scenes
            if (measured := levelness.get(CellKey(method, scene))) is not None
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
