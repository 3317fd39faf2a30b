"""The order of candidate sites, and why the first one won, in one sentence."""

import dataclasses
import math
from collections import Counter
from collections.abc import Sequence

from touchdown.landing.api import RULE_KEYS, Candidate, ScoreTerm

_BETTER: dict[str, str] = {
    "probability": "higher probability of a safe touchdown",
    "flatness": "flatter",
    "smoothness": "more uniform",
    "distance": "nearer",
    "clearance": "more clearance",
    "slope": "more level",
    "traffic": "not near traffic",
    "plants": "not among plants",
    "ground": "surer kind of ground",
}
_YES_OR_NO = ("traffic", "plants")
_NOTABLE = 0.002
"""difference of a term's value from which it is stated"""
_MAX_TERMS = 3


def ranked(sites: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """Returns ``sites``, which are in the order of their value, with accepted ones first, and names
    the rule by which each accepted one has its place."""
    order = sorted(sites, key=lambda site: not site.accepted)  # stable: by value within both
    return tuple(
        dataclasses.replace(site, rule="lower_value" if number else "highest_value")
        if site.accepted and site.rule in ("highest_value", "lower_value")
        else site
        for number, site in enumerate(order)
    )


def why_chosen(sites: Sequence[Candidate]) -> str:
    """Returns why the first of ``sites`` (in the order of `ranked`) won, or why none did."""
    if not sites:
        return "No site: nothing is mapped"
    first, others = sites[0], list(enumerate(sites[1:], start=2))
    if not first.accepted:
        return f"No site: {_refused(sites)}"
    if first.rule == "least_bad":
        return f"Site 1 won as {first.reason}"
    if first.rule in ("commanded", "commanded_unchecked"):
        return f"Site 1 was commanded: {first.reason}"
    rival = next(((n, site) for n, site in others if site.accepted), None)
    if rival is None:
        won = f"Site 1 won: the only one accepted of {len(sites)}, score {first.value:.3f}"
    else:
        number, second = rival
        won = f"Site 1 won: score {first.value:.3f} against {second.value:.3f} of site {number}"
        won = "; ".join([won, *_advantages(first, second)])
    higher = [(n, site) for n, site in others if not site.accepted and site.value > first.value]
    if higher:
        numbers = _listed([str(n) for n, _ in higher])
        what = "site {} scores" if len(higher) == 1 else "sites {} score"
        verb = "is" if len(higher) == 1 else "are"
        won += f"; {what.format(numbers)} higher but {verb} refused: "
        won += _listed([_words(rule) for rule in Counter(site.rule for _, site in higher)])
    return won


def _advantages(first: Candidate, second: Candidate) -> list[str]:
    """The terms in which ``first`` is better than ``second`` by more than rounding, the largest
    difference first."""
    pairs = [(a, b) for a, b in zip(first.terms, second.terms, strict=True)]
    pairs.sort(key=lambda pair: pair[1].value - pair[0].value)
    texts = [_advantage(a, b) for a, b in pairs[:_MAX_TERMS] if a.value - b.value >= _NOTABLE]
    return list(filter(None, texts))


def _advantage(a: ScoreTerm, b: ScoreTerm) -> str:
    """Such as "more clearance (3.0 against 1.2 m)"; "" where both quantities are written alike."""
    if a.name in _YES_OR_NO:
        return _BETTER[a.name]
    better = _BETTER.get(a.name, f"better {a.name.replace('_', ' ')}")
    if math.isnan(a.quantity):
        return better
    digits = 1 if a.unit else 3
    unit = f" {a.unit}" if a.unit else ""
    own, other = (f"{term.quantity:.{digits}f}" for term in (a, b))
    return f"{better} ({own} against {other}{unit})" if own != other else ""


def _refused(sites: Sequence[Candidate]) -> str:
    """Such as "12 candidates refused: 7 step, 5 near refused site; keys: landing.max_step_m"."""
    if len(sites) == 1:
        return f"the only candidate is {sites[0].reason}"
    rules = Counter(site.rule for site in sites)
    counts = ", ".join(f"{count} {_words(rule)}" for rule, count in rules.most_common())
    told = dict.fromkeys(RULE_KEYS[rule] for rule, _ in rules.most_common() if rule in RULE_KEYS)
    keys = f"; keys: {', '.join(told)}" if told else ""
    return f"{len(sites)} candidates refused: {counts}{keys}"


def _words(rule: str) -> str:
    return rule.replace("_", " ")


def _listed(names: Sequence[str]) -> str:
    """Such as "4, 7 and 9"."""
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
