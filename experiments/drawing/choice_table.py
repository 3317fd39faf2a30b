"""The table of a choice as an image: each candidate with the terms that add up to its score."""

from __future__ import annotations

import textwrap

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.drawing.candidate_signs import colour_of
from touchdown.experiments.drawing.map_axes import INK, PAPER
from touchdown.landing.api import Candidate, Decision, ScoreTerm

Image = NDArray[np.uint8]
Colour = tuple[int, int, int]

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_ROW, _MARGIN, _GAP = 24, 54, 28
"""height of a row, width of the left margin and between columns, of a map of 800 pixels"""
_LINE_LETTERS = 92
_WHITE, _FADED = (255, 255, 255), (150, 155, 165)


def choice_table(decision: Decision, width: int, scale: float, *, chosen: bool) -> Image:
    """Returns the reason of the choice above a row per candidate, (H, ``width``, 3) RGB.

    ``chosen``: the first is the chosen site."""
    sentences = textwrap.wrap(decision.why, round(_LINE_LETTERS * width / (800.0 * scale)))
    columns = _columns(decision, chosen)
    height = len(sentences) + len(decision.candidates) + 2.5
    image = np.full((round(height * _ROW * scale), width, 3), PAPER, np.uint8)
    left = round(_MARGIN * scale)
    for line, sentence in enumerate(sentences, start=1):
        _write(image, sentence, left, line, scale, 0.58, _WHITE)
    for column in columns:
        ends = [
            _write(image, text, left, len(sentences) + 1.4 + row, scale, 0.5, colour)
            for row, (text, colour) in enumerate(column)
        ]
        left = max(ends) + round(_GAP * scale)
    return image


def _columns(decision: Decision, chosen: bool) -> list[list[tuple[str, Colour]]]:
    """The texts and colours of each column: its title, then those of the candidates, rank and rule
    in the colour of the candidate's sign."""
    sites = decision.candidates
    terms = next((site.terms for site in sites if site.terms), ())
    names = [("= " if not k else "+ ") + t.name.replace("_", " ") for k, t in enumerate(terms)]
    titles = ["", "score", *names, "ground", "slope, step, clearance", "rule"]
    rows = [_row(number, site, len(terms)) for number, site in enumerate(sites, start=1)]
    signs = [colour_of(site, chosen=chosen and not n) for n, site in enumerate(sites)]
    columns = []
    for index, title in enumerate(titles):
        is_signed = index in (0, len(titles) - 1)
        cells = [
            (row[index], sign if is_signed else INK) for row, sign in zip(rows, signs, strict=True)
        ]
        columns.append([(title, _FADED), *cells])
    return columns


def _row(number: int, site: Candidate, terms: int) -> list[str]:
    shown = [_term(term) for term in site.terms] if np.isfinite(site.value) else []
    ground = "-"
    if site.class_predicted is not None:
        ground = f"{site.class_predicted} {site.class_probability:.2f}"
    shape = ((site.slope_deg, 1, "deg"), (site.step_m, 2, "m"), (site.clearance_m, 1, "m"))
    return [
        str(number),
        f"{site.value:.3f}" if np.isfinite(site.value) else "-",
        *(shown or ["-"] * terms),
        ground,
        ", ".join(f"{v:.{digits}f} {unit}" if np.isfinite(v) else "-" for v, digits, unit in shape),
        site.rule.replace("_", " "),
    ]


def _term(term: ScoreTerm) -> str:
    """Such as "0.080 (2.4 m)"."""
    told = term.unit and np.isfinite(term.quantity)
    quantity = f" ({term.quantity:.1f} {term.unit})" if told else ""
    return f"{term.value:.3f}{quantity}"


def _write(
    image: Image, text: str, left: int, row: float, scale: float, font: float, colour: Colour
) -> int:
    """Writes into a row and returns the column at the end of the text."""
    size, line = font * scale, max(1, round(2.0 * font * scale))
    cv2.putText(image, text, (left, round(row * _ROW * scale)), _FONT, size, colour, line,
                cv2.LINE_AA)  # fmt: skip
    return left + int(cv2.getTextSize(text, _FONT, size, line)[0][0])
