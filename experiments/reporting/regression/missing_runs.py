"""Losses against a baseline: missing cells and seeds, lost successes, missing errors."""

from __future__ import annotations

from collections.abc import Mapping

from touchdown.experiments.reporting.regression.baseline import Cells, Key, Trial, cell_name

Pairs = Mapping[Key, tuple[Mapping[int, Trial], Mapping[int, Trial]]]
"""flights of a cell by seed, new and old"""


def newly_bad(pairs: Pairs) -> list[str]:
    """Equal seeds that were successful in the baseline and are no longer."""
    return [
        f"{cell_name(key)}, seed {seed}: {old[seed].outcome} before, {new[seed].outcome} now"
        for key, (new, old) in pairs.items()
        for seed in sorted(new.keys() & old.keys())
        if new[seed].bad and not old[seed].bad
    ]


def absent(these: Cells, those: Cells) -> list[str]:
    """Cells, and seeds of common cells, of ``these`` that ``those`` lack."""
    lines = []
    for key, trials in sorted(these.items()):
        if key not in those:
            lines.append(cell_name(key))
            continue
        seeds = sorted(trials.keys() - those[key].keys())
        if seeds:
            lines.append(f"{cell_name(key)}: seed {', '.join(map(str, seeds))}")
    return lines


def vanished(pairs: Pairs) -> dict[Key, str]:
    """Returns the cells that are worse without a test, each with the reason.

    Either no flight has a position error and some had one in the baseline, or more than half of the
    successful flights with an error are lost. Equal seeds are compared; without any, the shares."""
    found = {}
    for key, (new, old) in pairs.items():
        seeds = new.keys() & old.keys()
        now = [new[seed] for seed in seeds] or list(new.values())
        before = [old[seed] for seed in seeds] or list(old.values())
        had, has = (sum(t.error_m is not None for t in trials) for trials in (before, now))
        successes, kept = (sum(_succeeded(t) for t in trials) for trials in (before, now))
        if had and not has:
            found[key] = (
                f"no flight comes to a position error, {had} of {len(before)} did in the baseline"
            )
        elif 2 * kept * len(before) < successes * len(now):
            found[key] = (
                f"{kept} of {len(now)} flights end as they should, "
                f"{successes} of {len(before)} did in the baseline"
            )
    return found


def _succeeded(trial: Trial) -> bool:
    """True if the flight was successful and has a position error."""
    return trial.error_m is not None and not trial.bad
