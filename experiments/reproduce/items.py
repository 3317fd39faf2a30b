"""The paper's tables and figures: what a reproduction has of each, and what it compares."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from touchdown.experiments.reporting.tables import MISSING, Cell, Table
from touchdown.experiments.reproduce.steps import PARTS

if TYPE_CHECKING:
    from touchdown.experiments.reproduce.state import PartState

YES, IN_PART, NO = "yes", "in part", "no"
_WITHOUT_NUMBERS = "the paper prints it without numbers, of other scenes"
_OTHER_IMAGES = "trained and tested on other images than the paper's"


@dataclass(frozen=True, slots=True)
class Item:
    """A table or figure of the paper. ``pictured``: why there is nothing to measure in it, empty
    where there is; ``settings``: of its figures those that the configuration sets; ``comparable``:
    `YES`, `IN_PART` or `NO` for its figures beside the paper's, and ``why`` not wholly."""

    name: str
    content: str
    comparable: str
    why: str
    pictured: str = ""
    settings: str = ""


ITEMS: tuple[Item, ...] = (
    Item("Fig. 2", "a coloured cloud of camera and LIDAR", NO,
         "the paper prints no errors of its calibration"),
    Item("Fig. 4", "edge energy of an image, and smoothness of the returns by it", NO,
         _WITHOUT_NUMBERS, pictured="a drawing of intermediate results"),
    Item("Fig. 5", "images of the kinds of ground", NO, "rendered images, not the paper's",
         pictured="images"),
    Item("Fig. 7", "the vehicle", NO, "a model, not the paper's vehicle", pictured="an image"),
    Item("Fig. 8", "the simulated vehicle and four scenes", NO, "other scenes",
         pictured="images"),
    Item("Table 1", "scan time, density and levelness of the maps", IN_PART,
         "levelness of other scenes, and the paper does not define its ±; its T_total and ρ_map "
         "cannot be told apart", settings="T_total is set by `survey.duration_s`"),
    Item("Fig. 9 a", "trajectories of surveys", NO, _WITHOUT_NUMBERS),
    Item("Table 2", "mean and variance of the deviation from the path, by method", IN_PART,
         "the same measure over another crossroad scene in another simulator, without `gps`",
         settings="the error of `gps` is set by `gps.preset`"),
    Item("Fig. 10", "paths by method, and errors by axis", NO, _WITHOUT_NUMBERS),
    Item("Fig. 9 b", "trajectories of landings", NO, _WITHOUT_NUMBERS),
    Item("Table 3", "scores of networks under two label schemes", NO, _OTHER_IMAGES),
    Item("Table 4", "cost of networks, and scores on the test images", NO,
         f"{_OTHER_IMAGES}; times on another processor"),
    Item("Table 5", "landings on a designated spot, by method", IN_PART,
         "d_L, a_z and α_L of simulated flights; the paper's are five of a real vehicle",
         settings="v_z is set by `landing.touchdown_speed_mps`"),
    Item("Fig. 12", "touchdown points", NO, _WITHOUT_NUMBERS),
    Item("Fig. 11", "the steps to a site on five kinds of sites", NO, _WITHOUT_NUMBERS),
    Item("Table 6", "landings on five kinds of sites", IN_PART,
         "sites made to be alike; the paper's are real places",
         settings="v_z is set by `landing.touchdown_speed_mps`"),
    Item("Table 7", "time of each step of site selection", IN_PART,
         "the same steps on another processor and another map"),
)  # fmt: skip
"""Tables and figures of the paper by part; its Figs. 1, 3 and 6 are concept drawings."""


@dataclass(frozen=True, slots=True)
class Grade:
    """``word``: `YES`, `IN_PART` or `NO`; ``why`` not wholly."""

    word: str
    why: str = ""

    @property
    def text(self) -> str:
        return f"{self.word}: {self.why}" if self.why else self.word


def measured(item: Item, state: PartState | None) -> Grade:
    """The grade of what was measured by the part that shows ``item``; ``state`` is None where it
    was left out."""
    if state is None:
        return Grade(NO, "its part was left out")
    if state.error:
        return Grade(NO, f"its part ended with an error, {state.error}")
    if item.pictured:
        return Grade(NO, f"{item.pictured}, nothing to measure")
    lacking = [item.settings] if item.settings else []
    if state.edition == "quick":
        lacking.append("quick edition, one seed of few scenes")
    if state.why:
        lacking.append(state.why)
    return Grade(IN_PART, "; ".join(lacking)) if lacking else Grade(YES)


def comparable(item: Item, found: Grade) -> Grade:
    """The grade of its figures beside the paper's: none without a measurement."""
    if found.word == NO and not item.pictured:
        return Grade(NO, "not measured")
    return Grade(item.comparable, item.why)


def grades(states: Mapping[str, PartState]) -> list[tuple[Item, Grade, Grade]]:
    """Each item with its grades *measured* and *comparable with the paper*."""
    found = []
    for item in ITEMS:
        part = next(part for part in PARTS if item.name in part.shows)
        own = measured(item, states.get(part.name))
        found.append((item, own, comparable(item, own)))
    return found


def item_table(states: Mapping[str, PartState]) -> Table:
    """A line for each item of the paper with its three grades."""
    rows = []
    for item, own, beside in grades(states):
        part = next(part for part in PARTS if item.name in part.shows)
        where = part.title if part.name in states else MISSING
        texts = (item.name, item.content, where, YES, own.text, beside.text)
        rows.append([Cell(text, kind="name") for text in texts])
    header = ["item of the paper", "content", "section here", "implemented", "measured",
              "comparable with the paper"]  # fmt: skip
    notes = [
        "Implemented: the program makes the table or figure. Figs. 1, 3 and 6 of the paper are "
        "concept drawings; they hold nothing to measure."
    ]
    return Table("items", "Item by item", header, rows, notes)


def item_sentence(states: Mapping[str, PartState]) -> str:
    """The numbers of items by grade."""
    found = grades(states)
    own = Counter(grade.word for _, grade, _ in found)
    beside = Counter(grade.word for _, _, grade in found)
    return (
        f"{len(found)} tables and figures of the paper, all implemented. Measured: {_counts(own)}. "
        f"Comparable with the paper: {_counts(beside)}. The reasons are in the table of items."
    )


def _counts(words: Mapping[str, int]) -> str:
    return ", ".join(f"{words[word]} {word}" for word in (YES, IN_PART, NO) if words.get(word))
