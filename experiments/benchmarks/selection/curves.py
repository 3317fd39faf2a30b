"""Choices of selectors on kept maps against the dials that the maps were made with."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from touchdown.experiments.reporting.curves import MIN_LEVELS, curves, paint_levels
from touchdown.experiments.reporting.figures import Picture, colour_of, drawn


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


def reliability(places: Mapping[str, Sequence[Mapping[str, Any]]]) -> Picture:
    """The reliability diagram of the selectors that state a probability; ``places`` as for
    `selector_curves`."""
    picture = Picture(
        "reliability",
        "Probability of a safe touchdown",
        "Marks: cells by what the selector states, in ten steps, with the fraction that is safe "
        "and its 95 % interval over maps. Dashed: what it should be.",
    )
    with drawn(picture, 4.0, 5.0) as figure:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
        above.plot([0.0, 1.0], [0.0, 1.0], color="0.6", linestyle="--", linewidth=0.8)
        for number, (name, own) in enumerate(places.items()):
            if all(place["sample"] is not None for place in own):
                cells, colour = _stated(own), colour_of(name, list(places))
                paint_levels(above, cells, "safe", colour, 0.008 * number)
                counts = cells["dial"].value_counts().sort_index()
                below.step(counts.index, counts, where="mid", color=colour, label=name)
        above.set(ylabel="safe by the true ground", xlim=(-0.03, 1.03), ylim=(-0.03, 1.03))
        below.set(xlabel="stated probability", ylabel="cells", yscale="log")
        below.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        figure.legend(loc="outside upper center", ncols=4, fontsize=8)
    return picture


def _stated(places: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """The cells of all samples; ``dial``: the mean of what is stated in the same tenth."""
    samples = [pd.DataFrame({key: place["sample"][key] for key in ("predicted", "safe")})
               for place in places]  # fmt: skip
    cells = pd.concat(samples, keys=range(len(samples)), names=["unit"]).reset_index("unit")
    tenth = np.minimum(10.0 * cells["predicted"], 9.0).astype(int)
    return cells.assign(dial=cells.groupby(tenth)["predicted"].transform("mean"))


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
