"""How surely people are found: recall and false boxes by kind, distance and light."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from touchdown.experiments.people.images import SHOWN, Labelled
from touchdown.landing.watch.people import PeopleDetector, Person
from touchdown.sim.typing import Float32

_INSIDE = 0.5
"""of a box's size around its middle, within which a found middle counts as found"""
DISTANCES_M = (0.0, 4.0, 8.0, 12.0, 19.0)
_LEAST_PX = 4.0
"""of a box's sides, as far as that is asked"""


@dataclass(frozen=True, slots=True)
class Found:
    """One who is in an image: his kind, his distance, the light, and the score that he was found
    with; 0 for one who was missed."""

    kind: str
    metres: float
    light: str
    score: float


@dataclass(frozen=True, slots=True)
class Figures:
    """Of some images: who was in them, and the scores of boxes with nobody inside."""

    found: tuple[Found, ...]
    false: tuple[float, ...]
    images: int

    seconds: tuple[float, ...]
    """of a processor that each image took"""

    def recall(self, least: float, asked: Callable[[Found], bool] = lambda one: True
               ) -> tuple[int, int]:  # fmt: skip
        """How many of those ``asked`` for were found with a score of ``least``, and of how many."""
        scores = [one.score for one in self.found if asked(one)]
        return sum(score >= least for score in scores), len(scores)

    def false_boxes(self, least: float) -> float:
        """False boxes in a hundred images."""
        return 100.0 * sum(score >= least for score in self.false) / max(self.images, 1)


def measured(detector: PeopleDetector, images: Iterable[Labelled]) -> Figures:
    """Figures of a detector, which should find with a low score. Somebody is found by the surest
    box whose middle lies in his. Of whom less than `images.SHOWN` is shown, or who is farther
    away than the corners of an image from 15 m, need not be found, but a box on him is not
    false."""
    found: list[Found] = []
    false: list[float] = []
    seconds: list[float] = []
    for one in images:
        begun = time.thread_time()
        boxes = list(detector.find(one.image, one.metres_per_pixel))
        seconds.append(time.thread_time() - begun)
        taken: set[int] = set()
        for box, kind, metres, shown in zip(
            one.boxes, one.kinds, one.metres, one.shown, strict=True
        ):
            inside = [i for i, other in enumerate(boxes) if _meets(other, box)]
            taken.update(inside)
            score = max((boxes[i].score for i in inside), default=0.0)
            if shown >= SHOWN and metres <= DISTANCES_M[-1]:
                found.append(Found(kind, float(metres), one.light, score))
        false += [box.score for i, box in enumerate(boxes) if i not in taken]
    return Figures(tuple(found), tuple(false), len(seconds), tuple(seconds))


def _meets(found: Person, box: Float32) -> bool:
    x0, y0, x1, y1 = box.tolist()
    w, h = max(x1 - x0, _LEAST_PX), max(y1 - y0, _LEAST_PX)
    x, y = 0.5 * (found.x0 + found.x1), 0.5 * (found.y0 + found.y1)
    return abs(x - 0.5 * (x0 + x1)) <= _INSIDE * w and abs(y - 0.5 * (y0 + y1)) <= _INSIDE * h


def summary(figures: Figures, least: float) -> dict[str, Any]:
    """The figures at a score in the form of ``--json``."""
    rows = []

    def row(what: str, asked: Callable[[Found], bool]) -> None:
        found, there = figures.recall(least, asked)
        if there:
            rows.append({"what": what, "found": found, "there": there})

    def row_of_people(what: str, asked: Callable[[Found], bool]) -> None:
        row(f"person, {what}", lambda one: one.kind.startswith("person") and asked(one))

    row("all", lambda one: True)
    for kind in ("person", *sorted({one.kind for one in figures.found})):
        row(kind, partial(_is_of, kind))
    for light in sorted({one.light for one in figures.found}):
        row_of_people(light, partial(_in_light, light))
    for near, far in pairwise(DISTANCES_M):
        row_of_people(f"{near:g} to {far:g} m", partial(_between, near, far))
    return {
        "least_score": least, "images": figures.images, "rows": rows,
        "false_boxes": figures.false_boxes(least),
        "ms": 1000.0 * float(np.mean(figures.seconds or [0.0])),
        "worst_ms": 1000.0 * max(figures.seconds, default=0.0),
    }  # fmt: skip


def _is_of(kind: str, one: Found) -> bool:
    return one.kind.startswith(kind)


def _in_light(light: str, one: Found) -> bool:
    return one.light == light


def _between(near: float, far: float, one: Found) -> bool:
    return near <= one.metres < far
