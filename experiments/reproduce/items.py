"""The paper's tables and figures: what a reproduction measures of each, and what it compares."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from touchdown.experiments.reporting.tables import MISSING, Cell, Table
from touchdown.experiments.reproduce.state import PartState
from touchdown.experiments.reproduce.steps import PARTS

_WITHOUT_NUMBERS = "no: the paper prints it without numbers, of other scenes"
_OTHER_IMAGES = "no: trained and tested on other images than the paper's"
_V_Z = "v_z is set by `landing.touchdown_speed_mps`"


@dataclass(frozen=True, slots=True)
class Item:
    """A table or figure of the paper. ``comparable``: its figures with the paper's, in part or not,
    and why; ``measured``: False for a drawing; ``settings``: its figures that the configuration
    sets."""

    name: str
    content: str
    comparable: str
    measured: bool = True
    settings: str = ""


ITEMS: tuple[Item, ...] = (
    Item("Fig. 2", "a coloured cloud of camera and LIDAR",
         "no: the paper prints no errors of its calibration"),
    Item("Fig. 4", "edge energy of an image, and smoothness of the returns by it",
         _WITHOUT_NUMBERS, measured=False),
    Item("Fig. 5", "images of the kinds of ground", "no: rendered images, not the paper's",
         measured=False),
    Item("Fig. 7", "the vehicle", "no: a model, not the paper's vehicle", measured=False),
    Item("Fig. 8", "the simulated vehicle and four scenes", "no: other scenes", measured=False),
    Item("Table 1", "scan time, density and levelness of the maps",
         "in part: levelness of other scenes, and the paper does not define its ±; its T_total and "
         "ρ_map cannot be told apart", settings="T_total is set by `survey.duration_s`"),
    Item("Fig. 9 a", "trajectories of surveys", _WITHOUT_NUMBERS),
    Item("Table 2", "mean and variance of the deviation from the path, by method",
         "in part: the same measure over another crossroad scene in another simulator, without "
         "`gps`", settings="the error of `gps` is set by `gps.preset`"),
    Item("Fig. 10", "paths by method, and errors by axis", _WITHOUT_NUMBERS),
    Item("Fig. 9 b", "trajectories of landings", _WITHOUT_NUMBERS),
    Item("Table 3", "scores of networks under two label schemes", _OTHER_IMAGES),
    Item("Table 4", "cost of networks, and scores on the test images",
         f"{_OTHER_IMAGES}; times on another processor"),
    Item("Table 5", "landings on a designated spot, by method",
         "in part: d_L, a_z and α_L of simulated flights; the paper's are five of a real vehicle",
         settings=_V_Z),
    Item("Fig. 12", "touchdown points", _WITHOUT_NUMBERS),
    Item("Fig. 11", "the steps to a site on five kinds of sites", _WITHOUT_NUMBERS),
    Item("Table 6", "landings on five kinds of sites",
         "in part: sites made to be alike; the paper's are real places", settings=_V_Z),
    Item("Table 7", "time of each step of site selection",
         "in part: the same steps on another processor and another map"),
)  # fmt: skip
"""Tables and figures of the paper by part; its Figs. 1, 3 and 6 are concept drawings."""


def measured(item: Item, state: PartState | None) -> str:
    """ "yes", or how far not and why: what was measured by the part that shows ``item``; ``state``
    is None where it was left out."""
    if state is None:
        return "no: its part was left out"
    if state.error:
        return f"no: its part ended with an error, {state.error}"
    if not item.measured:
        return "no: a drawing, nothing to measure"
    quick = "quick edition, one seed of few scenes" * (state.edition == "quick")
    lacking = [text for text in (item.settings, quick, state.why) if text]
    return f"in part: {'; '.join(lacking)}" if lacking else "yes"


def item_table(states: Mapping[str, PartState]) -> Table:
    """A line for each item of the paper: where it is, and how far it is measured and comparable."""
    rows = []
    for item in ITEMS:
        part = next(part for part in PARTS if item.name in part.shows)
        own = measured(item, states.get(part.name))
        beside = "no: not measured" if own.startswith("no") and item.measured else item.comparable
        where = part.title if part.name in states else MISSING
        texts = (item.name, item.content, where, own, beside)
        rows.append([Cell(text, kind="name") for text in texts])
    header = ["item of the paper", "content", "section here", "measured",
              "comparable with the paper"]  # fmt: skip
    notes = ["Figs. 1, 3 and 6 of the paper are concept drawings; they hold nothing to measure."]
    return Table("items", "Item by item", header, rows, notes)
