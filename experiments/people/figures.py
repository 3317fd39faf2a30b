"""How surely people are found: recall and false boxes by kind, distance and light."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from touchdown.experiments.people.images import Labelled
from touchdown.landing.watch.people import PeopleDetector, Person

_INSIDE = 0.5
"""of a box's size around its middle, within which a found middle counts as found"""


@dataclass(frozen=True, slots=True)
class Found:
    """One who is in an image: his kind, his distance, and the score that he was found with; 0 for
    one who was missed."""

    kind: str
    metres: float
    score: float


@dataclass(frozen=True, slots=True)
class Figures:
    """Of some images: who was in them, and the scores of boxes with nobody inside."""

    found: tuple[Found, ...]
    false: tuple[float, ...]
    images: int

    def recall(self, least: float, *, near_m: float = 0.0, far_m: float = 1e9,
               kind: str = "") -> tuple[int, int]:  # fmt: skip
        """How many were found with a score of ``least``, and of how many."""
        asked = [
            one for one in self.found
            if near_m <= one.metres < far_m and (not kind or one.kind == kind)
        ]  # fmt: skip
        return sum(one.score >= least for one in asked), len(asked)

    def false_boxes(self, least: float) -> float:
        """False boxes in a hundred images."""
        return 100.0 * sum(score >= least for score in self.false) / max(self.images, 1)


def measured(detector: PeopleDetector, images: Iterable[Labelled]) -> Figures:
    """Figures of a detector, which should find with a low score. Somebody is found by the surest
    box whose middle lies in the inner part of his."""
    found: list[Found] = []
    false: list[float] = []
    count = 0
    for one in images:
        count += 1
        boxes = list(detector.find(one.image))
        taken: set[int] = set()
        for (x0, y0, x1, y1), kind, metres in zip(one.boxes, one.kinds, one.metres, strict=True):
            w, h = max(x1 - x0, 4.0), max(y1 - y0, 4.0)
            inside = [
                i for i, box in enumerate(boxes)
                if abs(_middle(box)[0] - 0.5 * (x0 + x1)) <= _INSIDE * w
                and abs(_middle(box)[1] - 0.5 * (y0 + y1)) <= _INSIDE * h
            ]  # fmt: skip
            taken.update(inside)
            score = max((boxes[i].score for i in inside), default=0.0)
            found.append(Found(kind, float(metres), score))
        false += [box.score for i, box in enumerate(boxes) if i not in taken]
    return Figures(tuple(found), tuple(false), count)


def _middle(box: Person) -> tuple[float, float]:
    return 0.5 * (box.x0 + box.x1), 0.5 * (box.y0 + box.y1)


DISTANCES_M = (0.0, 4.0, 8.0, 12.0, 17.0)


def summary(figures: Figures, least: float) -> dict[str, Any]:
    """The figures at a score in the form of ``--json``."""
    rows = []
    for kind in ("", "person", "bicycle", "dog"):
        found, there = figures.recall(least, kind=kind)
        rows.append({"what": kind or "all", "found": found, "there": there})
    for near, far in pairwise(DISTANCES_M):
        found, there = figures.recall(least, near_m=near, far_m=far, kind="person")
        rows.append({"what": f"person, {near:g} to {far:g} m", "found": found, "there": there})
    return {
        "least_score": least, "images": figures.images, "rows": rows,
        "false_boxes": figures.false_boxes(least),
    }  # fmt: skip
