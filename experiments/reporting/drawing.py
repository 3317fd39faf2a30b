"""Drawings of a report as SVG text whose colours follow the page, light or dark."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import matplotlib
from matplotlib.figure import Figure
from matplotlib.text import Text

from touchdown.experiments.drawing.style import GRID, STYLE, new_figure
from touchdown.experiments.errors import visible
from touchdown.experiments.reporting.flights import ORDER

_STYLE: Any = {
    **STYLE,
    "svg.fonttype": "none",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
}


@dataclass(slots=True)
class Picture:
    """``name`` is its file name without the ending."""

    name: str
    title: str
    caption: str
    svg: str = ""

    @property
    def on_page(self) -> str:
        """The SVG element alone."""
        text = self.svg[self.svg.index("<svg") :]
        head, rest = text.split(">", 1)
        width = re.search(r'width="([\d.]+)pt"', head)
        head = re.sub(r' (width|height)="[^"]*"', "", head)
        # Small figures keep their size, wide ones shrink to the page.
        widest = f"{4.0 / 3.0 * float(width[1]):.0f}px" if width else "100%"
        return f'{head} style="max-width: {widest}">{rest}'


def colour_of(method: str, methods: Sequence[str]) -> str:
    """The colour of a method among ``methods``; the project's own have always the same."""
    known = list(dict.fromkeys([*ORDER["estimator"], *methods]))
    return f"C{known.index(method) % 10}"


@contextmanager
def drawn(picture: Picture, width: float, height: float) -> Iterator[Figure]:
    """Gives a figure, in inches, to be filled, which becomes the SVG of ``picture``. The same data
    give the same text."""
    style: Any = {**_STYLE, "svg.hashsalt": picture.name}
    with matplotlib.rc_context(style):
        figure = new_figure(width, height)
        yield figure
        for words in figure.findobj(Text):
            words.set_text(visible(words.get_text(), keep="\n"))
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    picture.svg = text.getvalue()
