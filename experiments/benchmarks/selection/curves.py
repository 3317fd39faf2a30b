"""Choices of selectors on kept maps against the dials that the maps were made with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from touchdown.experiments.reporting.curves import MIN_LEVELS, curves
from touchdown.experiments.reporting.figures import Picture


class Drawings(NamedTuple):
    """Folders for figures that are wanted, None where not."""

    pictures: Path | None = None
    """steps to the sites of the first selector, of all places or of the ``worst`` by regret"""
    worst: int | None = None
    curves: Path | None = None
    """curves against the dials of the maps"""


MEASURES = ("precision", "recall")
"""of the cells that a selector allows"""


def selector_curves(
    places: Mapping[str, Sequence[Mapping[str, Any]]],
) -> dict[str, tuple[dict[str, Any], Picture]]:
    """For each dial of three or more values what its curves say, words and numbers, and their
    picture. ``places``: results of `sites.check_map` by selector, of the same maps in the same
    order. A choice counts as a landing at the chosen site."""
    frame = pd.DataFrame([_row(name, p) for name, own in places.items() for p in own])
    dials = list(dict.fromkeys(key for p in frame.get("dials", ()) for key in p))
    found = {}
    for dial in dials:
        of_dial = frame[[dial in given for given in frame["dials"]]]
        shown = of_dial.assign(dial=[given[dial] for given in of_dial["dials"]])
        if shown["dial"].nunique() >= MIN_LEVELS:
            table, picture, words = curves(dial, shown, MEASURES, "maps")
            found[dial] = ({"words": words, "lines": table.lines, **table.numbers}, picture)
    return found


def _row(selector: str, place: Mapping[str, Any]) -> dict[str, Any]:
    chosen, cells = place["chosen_safe"], place["cells"]
    missed = chosen is None and cells["safe"] > 0
    return {
        "estimator": selector,
        "scene": place["scene"],
        "seed": place["seed"],
        "unit": f"{place['scene']}, seed {place['seed']}",
        "dials": place["dials"],
        "outcome": "NO_SITE" if chosen is None else "LANDED",
        "safe": chosen is True,
        "unsafe": chosen is False,
        "missed": missed,
        "precision": cells["both"] / cells["allowed"] if cells["allowed"] else None,
        "recall": cells["both"] / cells["safe"] if cells["safe"] else None,
    }
