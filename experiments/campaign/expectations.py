"""Verdicts on the expectations of a campaign (``[[expect]]`` in its file)."""

import contextlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from touchdown.experiments.api import Outcome
from touchdown.experiments.campaign.campaign_file import BOUNDS, Expect
from touchdown.experiments.campaign.directory import read_plan_file
from touchdown.experiments.campaign.plan import matches
from touchdown.experiments.campaign.results_table import CRASHED, judged_columns, refresh

_FELL = (Outcome.TIPPED, Outcome.COLLIDED)


@dataclass(slots=True)
class Verdict:
    """The verdict on one ``[[expect]]``. ``failures``: reasons of unexpected runs, by run."""

    name: str
    runs: int = 0
    finished: int = 0
    expected: str = ""
    outcomes: dict[str, int] = field(default_factory=dict)
    largest_error_m: float | None = None
    failures: dict[str, str] = field(default_factory=dict)

    @property
    def word(self) -> str:
        if self.failures:
            return f"{len(self.failures)} not as expected"
        if self.finished < self.runs:
            return f"{self.runs - self.finished} to go"
        return "as expected"


def judge_campaign(directory: Path) -> list[Verdict]:
    """Returns one verdict per expectation, in the order of the file. Raises UsageError where
    ``directory`` is no campaign."""
    document = read_plan_file(directory)
    expectations = document.get("expect") or []
    rows = {row["run_id"]: row for row in refresh(directory)} if expectations else {}
    read = (Expect.model_validate(one, extra="ignore") for one in expectations)
    return [judge(expectation, document["runs"], rows) for expectation in read]


def judge(
    expectation: Expect,
    runs: Sequence[Mapping[str, Any]],
    rows: Mapping[str, Mapping[str, Any]],
) -> Verdict:
    """Returns the verdict on one expectation; ``runs`` as in ``campaign.json``, ``rows`` by run."""
    when = expectation.when
    found: list[Mapping[str, Any]] = []
    verdict = Verdict(expectation.name or _label(when), expected=expected_text(expectation))
    for run in runs:
        if not matches(when, run["values"]):
            continue
        verdict.runs += 1
        row = rows.get(run["run_id"])
        if row is None:
            continue
        verdict.finished += 1
        outcome = row["outcome"]
        verdict.outcomes[outcome] = verdict.outcomes.get(outcome, 0) + 1
        error = row.get("position_error_m.max")
        if error is not None:
            verdict.largest_error_m = max(error, verdict.largest_error_m or 0.0)
        found.append({**row, "variant": run["values"].get("variant")})
        if reason := unexpected(expectation, row):
            verdict.failures[run["run_id"]] = reason
    if verdict.finished == verdict.runs:
        verdict.failures |= _unexpected_means(expectation, found)
    return verdict


def _unexpected_means(expectation: Expect, rows: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Means beyond their bounds, by scene, method and variant. A column without a number in a group
    is one: what was not measured was not shown."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        names = filter(None, (row.get(name) for name in ("scene", "estimator", "variant")))
        groups.setdefault(", ".join(names), []).append(row)
    found: dict[str, str] = {}
    minimum = expectation.success_at_least
    successful = sum(row.get("success") is True for row in rows)
    if minimum is not None and not successful >= minimum * len(rows):
        found["all"] = f"{successful} of {len(rows)} successful, at least {minimum:.0%} expected"
    for name, word, sign in (("mean_at_most", "most", 1.0), ("mean_at_least", "least", -1.0)):
        for key, bound in getattr(expectation, name).items():
            for group, members in groups.items():
                numbers = [float(row[key]) for row in members if row.get(key) is not None]
                mean = sum(numbers) / len(numbers) if numbers else math.nan
                if not sign * mean <= sign * bound:
                    text = f"mean of {key} {mean:.3g}, at {word} {bound:g} expected"
                    found[group] = ", ".join(filter(None, (found.get(group), text)))
    return found


def unexpected(expectation: Expect, row: Mapping[str, Any]) -> str:
    """Returns the reasons why a run is not as expected; "" where it is."""
    outcome, limit = row["outcome"], expectation.position_error_m_max
    if outcome == CRASHED:
        return f"crashed: {row['reason']}"
    reasons = []
    if expectation.outcome and outcome not in expectation.outcome:
        reasons.append(f"{outcome} ({row['reason']})")
    if not expectation.unsafe and touched_unsafely(row):
        reasons.append("unsafe touchdown")
    error = row.get("position_error_m.max")
    if limit is not None and (error is None or error > limit):
        found = "unknown" if error is None else f"{error:.2f} m"
        reasons.append(f"position error {found}, at most {limit:g} m expected")
    for key, bound in expectation.at_most.items():
        value = row.get(key)
        if value is None or not value <= bound:
            text = "unknown" if value is None else f"{value:.3g}"
            reasons.append(f"{key} {text}, at most {bound:g} expected")
    reasons += not_happened(expectation.happened, row)
    return ", ".join(reasons)


def conditions_of(row: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The verdicts on the conditions of a run, as in ``result.json``; a table has them as JSON
    text. Empty for rows of versions without them and for damaged ones."""
    found = row.get("conditions")
    with contextlib.suppress(ValueError):
        found = json.loads(found) if isinstance(found, str) else found
    known = found if isinstance(found, list) else []
    return [one for one in known if isinstance(one, dict) and isinstance(one.get("name"), str)]


def not_happened(wanted: bool | Sequence[str], row: Mapping[str, Any]) -> list[str]:
    """Reasons why demanded conditions of a run did not happen. ``wanted``: all that it names, or
    these of them. A run without any record of conditions has none that happened."""
    if wanted is False:
        return []
    known = {one["name"]: one for one in conditions_of(row)}
    names = [*known] if wanted is True else wanted
    if row.get("conditions") is None:
        return ["no record of what happened"]
    return [
        f"'{name}' did not happen ({known[name].get('text', '')})"
        for name in names
        if name in known and known[name].get("happened") is not True
    ]


def idle_conditions(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """One line for each condition that did not happen in some of the runs that name it."""
    runs: dict[str, int] = {}
    idle: dict[str, list[str]] = {}
    for row in rows:
        for one in conditions_of(row):
            runs[one["name"]] = runs.get(one["name"], 0) + 1
            if one.get("happened") is not True:
                text = f"{row['run_id']}, {one.get('text', one['name'])}"
                idle.setdefault(one["name"], []).append(text)
    return [
        f"condition '{name}' did not happen in {len(texts)} of {runs[name]} runs, "
        f"such as {texts[0]}"
        for name, texts in idle.items()
    ]


def demanded(expectations: Sequence[Expect], values: Mapping[str, Any]) -> Literal[True] | set[str]:
    """Conditions that expectations demand of a run with these ``values``; True: all of them."""
    names: set[str] = set()
    for expectation in expectations:
        wanted = expectation.happened
        if wanted and matches(expectation.when, values):
            if wanted is True:
                return True
            names |= set(wanted)
    return names


def touched_unsafely(row: Mapping[str, Any]) -> bool:
    """True if a flight touched ground that is not known to be safe, tipped over or collided."""
    if row.get("landing.touchdown_xy_m") is None:
        return row["outcome"] in _FELL
    return row["outcome"] in _FELL or judged_columns(row)["ground_safe"] is not True


def expected_text(expectation: Expect) -> str:
    """``LANDED or ABORTED, error at most 0.3 m, no unsafe touchdown``."""
    parts = [" or ".join(expectation.outcome) or "any outcome"]
    if expectation.position_error_m_max is not None:
        parts.append(f"error at most {expectation.position_error_m_max:g} m")
    for name in BOUNDS:
        word = name.replace("_", " ").replace("at ", "{} at ")
        for key, bound in getattr(expectation, name).items():
            parts.append(f"{word.format(key)} {bound:g}")
    if expectation.success_at_least is not None:
        parts.append(f"{expectation.success_at_least:.0%} successful")
    if wanted := expectation.happened:
        parts.append("its conditions" if wanted is True else ", ".join(wanted))
        parts[-1] += " happened"
    if not expectation.unsafe:
        parts.append("no unsafe touchdown")
    return ", ".join(parts)


def as_json(verdicts: Sequence[Verdict]) -> list[dict[str, Any]]:
    return [{**asdict(verdict), "verdict": verdict.word} for verdict in verdicts]


def verdict_of(plain: Mapping[str, Any]) -> Verdict:
    """The verdict of an object of `as_json`."""
    return Verdict(**{key: value for key, value in plain.items() if key != "verdict"})


def lines(verdicts: Sequence[Verdict]) -> list[str]:
    """Returns the verdicts as lines of text, each followed by its unexpected runs, below a heading;
    none without verdicts."""
    if not verdicts:
        return []
    width = max(len(verdict.name) for verdict in verdicts)
    found = ["expectations:"]
    for verdict in verdicts:
        counts = ", ".join(f"{name} {count}" for name, count in sorted(verdict.outcomes.items()))
        error = verdict.largest_error_m
        worst = "" if error is None else f", error up to {error:.2f} m"
        found.append(f"  {verdict.name:{width}}  {verdict.word}: {counts or 'nothing yet'}{worst}")
        found += [f"    {run_id}: {reason}" for run_id, reason in verdict.failures.items()]
    return found


def all_as_expected(verdicts: Sequence[Verdict]) -> bool:
    """True if every finished run is as expected."""
    return not any(verdict.failures for verdict in verdicts)


def _label(when: Mapping[str, Sequence[Any]]) -> str:
    """The label of an expectation without a name."""
    parts = []
    for values in when.values():
        texts = (" ".join(map(str, v)) if isinstance(v, list) else str(v) for v in values)
        parts.append("/".join(text or "none" for text in texts))
    return ", ".join(parts) or "all runs"
