"""The table of a choice as an image: each candidate with the terms that add up to its score."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.drawing.candidate_signs import colour_of
from touchdown.experiments.drawing.map_axes import INK, PAPER
from touchdown.landing.api import Candidate, Decision, ScoreTerm

Image = NDArray[np.uint8]

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_ROW, _MARGIN = 24, 54
"""height of a row and width of the left margin, of a map of 800 pixels"""
_FADED = (150, 155, 165)


def choice_table(decision: Decision, width: int, scale: float, *, chosen: bool) -> Image:
    """Returns the reason of the choice above a row per candidate, (H, ``width``, 3) RGB.

    ``chosen``: the first is the chosen site."""
    font = 0.5 * scale
    sentences = _wrapped(decision.why, width - round(2 * _MARGIN * scale), 1.15 * font)
    header, rows = _cells(decision)
    lines = len(sentences) + len(rows) + 2
    image = np.full((round((lines + 0.5) * _ROW * scale), width, 3), PAPER, np.uint8)
    base = round(_ROW * scale)
    for sentence in sentences:
        _write(image, sentence, round(_MARGIN * scale), base, 1.15 * font, (255, 255, 255))
        base += round(_ROW * scale)
    base += round(0.4 * _ROW * scale)
    edges = _edges([header, *rows], width, scale, font)
    for row, colours in [(header, [_FADED] * len(header)), *_coloured(rows, decision, chosen)]:
        for text, left, colour in zip(row, edges, colours, strict=True):
            _write(image, text, left, base, font, colour)
        base += round(_ROW * scale)
    return image


def _cells(decision: Decision) -> tuple[list[str], list[list[str]]]:
    """Returns the header and the texts of each candidate, by column."""
    terms = next((site.terms for site in decision.candidates if site.terms), ())
    names = [("= " if not k else "+ ") + t.name.replace("_", " ") for k, t in enumerate(terms)]
    header = ["", "score", *names, "ground", "slope, step, clearance", "rule"]
    rows = [
        _row(number, site, len(terms)) for number, site in enumerate(decision.candidates, start=1)
    ]
    return header, rows


def _row(number: int, site: Candidate, terms: int) -> list[str]:
    shown = [_term(term) for term in site.terms] if np.isfinite(site.value) else ["-"] * terms
    ground = "-"
    if site.class_predicted is not None:
        ground = f"{site.class_predicted} {site.class_probability:.2f}"
    return [
        str(number),
        f"{site.value:.3f}" if np.isfinite(site.value) else "-",
        *(shown or ["-"] * terms),
        ground,
        ", ".join(
            f"{figure:.{digits}f} {unit}" if np.isfinite(figure) else "-"
            for figure, digits, unit in (
                (site.slope_deg, 1, "deg"),
                (site.step_m, 2, "m"),
                (site.clearance_m, 1, "m"),
            )
        ),
        site.rule.replace("_", " "),
    ]


def _term(term: ScoreTerm) -> str:
    """Such as "0.080 (2.4 m)"."""
    told = term.unit and np.isfinite(term.quantity)
    quantity = f" ({term.quantity:.1f} {term.unit})" if told else ""
    return f"{term.value:.3f}{quantity}"


def _coloured(
    rows: list[list[str]], decision: Decision, chosen: bool
) -> list[tuple[list[str], list[tuple[int, int, int]]]]:
    """The rows with the colour of each text: rank and rule in that of the candidate's sign."""
    found = []
    for number, (row, site) in enumerate(zip(rows, decision.candidates, strict=True)):
        colour = colour_of(site, chosen=chosen and number == 0)
        found.append((row, [colour, colour, *[INK] * (len(row) - 3), colour]))
    return found


def _edges(table: list[list[str]], width: int, scale: float, font: float) -> list[int]:
    """Left edges of the columns, the free width shared among them."""
    widths = [max(_width(text, font) for text in column) for column in zip(*table, strict=True)]
    margin = round(_MARGIN * scale)
    gap = max((width - 2 * margin - sum(widths)) // max(len(widths) - 1, 1), round(6 * scale))
    gap = min(gap, round(34 * scale))
    edges, at = [], margin
    for wide in widths:
        edges.append(at)
        at += wide + gap
    return edges


def _wrapped(text: str, width: int, font: float) -> list[str]:
    """Lines of words that fit into ``width`` pixels."""
    lines: list[str] = []
    for word in text.split():
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and _width(longer, font) <= width:
            lines[-1] = longer
        else:
            lines.append(word)
    return lines


def _width(text: str, font: float) -> int:
    return int(cv2.getTextSize(text, _FONT, font, max(1, round(2.0 * font)))[0][0])


def _write(
    image: Image, text: str, left: int, base: int, font: float, colour: tuple[int, int, int]
) -> None:
    line = max(1, round(2.0 * font))
    cv2.putText(image, text, (left, base), _FONT, font, colour, line, cv2.LINE_AA)
