"""Candidate sites on a map: a sign at each site, and its rank beside it."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.landing.api import Candidate

Image = NDArray[np.uint8]
"""(H, W, 3) RGB"""

CHOSEN_RGB, ACCEPTED_RGB, REFUSED_RGB = (80, 255, 80), (120, 230, 255), (255, 80, 80)
_DARK_RGB = (16, 18, 24)


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
) -> None:
    """Writes the rank of each of ``candidates`` above and right of its pixel among ``spots``, with
    a dark rim. ``chosen``: the first is the chosen site."""
    line = max(1, round(1.4 * scale))
    for number, ((x, y), candidate) in enumerate(zip(spots, candidates, strict=True), start=1):
        is_chosen = chosen and number == 1
        away = round((18 if is_chosen else 8) * scale)
        left = min(x + away, image.shape[1] - round(24 * scale))
        base = max(y - away, round(16 * scale))
        for shade, width in ((_DARK_RGB, line + 3), (colour_of(candidate, chosen=is_chosen), line)):
            cv2.putText(image, str(number), (left, base), cv2.FONT_HERSHEY_SIMPLEX, 0.62 * scale,
                        shade, width, cv2.LINE_AA)  # fmt: skip
