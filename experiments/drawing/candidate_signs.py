"""Candidate sites on a map: a sign at each site, and its rank beside it on a free spot."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.landing.api import Candidate

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
"""(H, W, 3) RGB"""

CHOSEN_RGB, ACCEPTED_RGB, REFUSED_RGB = (80, 255, 80), (120, 230, 255), (255, 80, 80)
_DARK_RGB = (16, 18, 24)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


@dataclass(frozen=True, slots=True)
class Box:
    """A rectangle of pixels."""

    left: int
    top: int
    width: int
    height: int

    def meets(self, other: Box) -> bool:
        """True if the two overlap."""
        return (
            self.left < other.left + other.width
            and other.left < self.left + self.width
            and self.top < other.top + other.height
            and other.top < self.top + self.height
        )


def colour_of(candidate: Candidate, *, chosen: bool) -> tuple[int, int, int]:
    """Returns the RGB colour of a candidate's sign."""
    if chosen:
        return CHOSEN_RGB
    return ACCEPTED_RGB if candidate.accepted else REFUSED_RGB


def draw_sign(image: Image, at: tuple[int, int], candidate: Candidate, size: int) -> None:
    """Draws a ring at an accepted site and a cross at a refused one, with a dark rim."""
    colour, line = colour_of(candidate, chosen=False), max(2, size // 4)
    for shade, width in ((_DARK_RGB, line + 4), (colour, line)):
        if candidate.accepted:
            cv2.circle(image, at, size, shade, width, cv2.LINE_AA)
        else:
            for dx, dy in ((size, size), (size, -size)):
                ends = (at[0] - dx, at[1] - dy), (at[0] + dx, at[1] + dy)
                cv2.line(image, *ends, shade, width, cv2.LINE_AA)


def draw_winner(image: Image, at: tuple[int, int], size: int) -> None:
    """Draws two rings and a cross hair at the chosen site."""
    line = max(3, size // 4)
    for shade, width in ((_DARK_RGB, line + 4), (CHOSEN_RGB, line)):
        for radius in (size, 2 * size):
            cv2.circle(image, at, radius, shade, width, cv2.LINE_AA)
        for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            inner = (at[0] + dx * 2 * size, at[1] + dy * 2 * size)
            outer = (at[0] + dx * 3 * size, at[1] + dy * 3 * size)
            cv2.line(image, inner, outer, shade, width, cv2.LINE_AA)


def draw_ranks(
    image: Image,
    spots: Sequence[tuple[int, int]],
    candidates: Sequence[Candidate],
    *,
    scale: float,
    chosen: bool,
    rules: bool,
) -> None:
    """Writes the rank of each of ``candidates`` beside its pixel among ``spots``.

    ``chosen``: the first is the chosen site; ``rules``: with the rule that refused it."""
    size = round(9 * scale)
    taken = [Box(x - size, y - size, 2 * size, 2 * size) for x, y in spots]
    if chosen and spots:
        x, y = spots[0]
        taken[0] = Box(x - 3 * size, y - 3 * size, 6 * size, 6 * size)
    for number, (spot, candidate) in enumerate(zip(spots, candidates, strict=True), start=1):
        text = str(number)
        if rules and not candidate.accepted:
            text += f" {candidate.rule.replace('_', ' ')}"
        (wide, tall), _ = cv2.getTextSize(text, _FONT, 0.62 * scale, max(1, round(1.4 * scale)))
        pad = round(4 * scale)
        width, height = max(wide, tall) + 2 * pad, tall + 2 * pad
        box = _free_box(image, spot, (width, height), taken, size)
        taken.append(box)
        colour = colour_of(candidate, chosen=chosen and number == 1)
        _badge(image, spot, box, text, colour, scale)


def _free_box(
    image: Image, spot: tuple[int, int], size: tuple[int, int], taken: list[Box], sign: int
) -> Box:
    """Returns the nearest place for a box of ``size`` around ``spot`` that is free and within the
    image; the first one, moved into the image, where none is."""
    width, height = size
    most_x, most_y = image.shape[1] - width, image.shape[0] - height
    boxes = [Box(spot[0] + x, spot[1] + y, width, height) for x, y in _offsets(size, sign)]
    for box in boxes:
        within = 0 <= box.left <= most_x and 0 <= box.top <= most_y
        if within and not any(box.meets(other) for other in taken):
            return box
    left, top = min(max(boxes[0].left, 0), most_x), min(max(boxes[0].top, 0), most_y)
    return Box(left, top, width, height)


def _offsets(size: tuple[int, int], sign: int) -> Iterator[tuple[int, int]]:
    """Offsets of a box's corner from the sign, in rings of growing distance, right first."""
    width, height = size
    for ring in range(1, 7):
        for degrees in (0, 45, -45, 180, 135, -135, 90, -90):
            angle = np.deg2rad(degrees)
            reach = 1.6 * ring * sign
            x = np.cos(angle) * (reach + 0.5 * width) - 0.5 * width
            y = -np.sin(angle) * (reach + 0.5 * height) - 0.5 * height
            yield round(x), round(y)


def _badge(
    image: Image,
    spot: tuple[int, int],
    box: Box,
    text: str,
    colour: tuple[int, int, int],
    scale: float,
) -> None:
    """Fills ``box``, joins it to the sign at ``spot`` and writes the text into it."""
    near = (
        min(max(spot[0], box.left), box.left + box.width),
        min(max(spot[1], box.top), box.top + box.height),
    )
    width = max(1, round(1.4 * scale))
    for shade, line in ((_DARK_RGB, width + 3), (colour, width)):
        cv2.line(image, spot, near, shade, line, cv2.LINE_AA)
    corner = (box.left + box.width, box.top + box.height)
    cv2.rectangle(image, (box.left, box.top), corner, colour, cv2.FILLED)
    cv2.rectangle(image, (box.left, box.top), corner, _DARK_RGB, width)
    (wide, tall), _ = cv2.getTextSize(text, _FONT, 0.62 * scale, width)
    left = box.left + (box.width - wide) // 2
    base = box.top + (box.height + tall) // 2
    cv2.putText(image, text, (left, base), _FONT, 0.62 * scale, _DARK_RGB, width, cv2.LINE_AA)
