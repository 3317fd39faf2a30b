"""The card as a table and a figure."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.experiments.drawing.style import FAINT, INK, STYLE, new_figure, write_figure
from touchdown.experiments.errors import UsageError
from touchdown.experiments.gap.card import Compared, compared
from touchdown.experiments.gap.rows import ROWS, WITHOUT_DATA

FIGURE = "gap.png"
_OWN = "#d1495b"


def table(found: Iterable[Compared], missing: Sequence[str]) -> str:
    """Markdown of the rows, and of those without recordings."""
    lines = [
        "| quantity | recordings | distance | bound | holds | use |",
        "|---|---|---|---|---|---|",
    ]
    notes = []
    for one in found:
        row = one.row
        count = f"{len(one.curves.recorded)}: " if len(one.curves.recorded) > 1 else ""
        lines.append(
            f"| {row.name}: {row.y} | {count}{row.source} | {one.distance:.2f} | {one.bound:.2f} | "
            f"{'yes' if one.holds else '**no**'} | "
            f"{'tuned on: ' + row.changed if row.tuned else 'check'} |"
        )
        if not one.holds and row.explained:
            notes.append(f"- **{row.name}**: {row.explained}")
    text = "\n".join(lines) + "\n"
    if notes:
        text += "\n" + "\n".join(notes) + "\n"
    if missing:
        text += f"\nNo recordings for: {', '.join(missing)}.\n"
    return text


def draw(found: Sequence[Compared], file: Path) -> None:
    """A panel for each row: recordings grey, their median black, the simulator red."""
    import matplotlib

    with matplotlib.rc_context(STYLE):
        columns = 3
        rows = -(-len(found) // columns)
        figure = new_figure(11.5, 2.9 * rows)
        for number, one in enumerate(found):
            axes = figure.add_subplot(rows, columns, number + 1)
            x, curves = np.arange(len(one.curves.x)), one.curves
            for curve in curves.recorded[:60]:
                axes.plot(x, curve, color=FAINT, lw=0.5, alpha=0.5)
            axes.plot(x, np.median(curves.recorded, axis=0), color=INK, lw=1.8)
            for curve in curves.simulated:
                axes.plot(x, curve, color=_OWN, lw=0.6, alpha=0.6)
            axes.plot(x, np.median(curves.simulated, axis=0), color=_OWN, lw=1.8)
            ticks = np.linspace(0, len(x) - 1, 5).round().astype(int)
            axes.set_xticks(ticks, [f"{curves.x[k]:.3g}" for k in ticks])
            axes.set_title(f"{one.row.name}: {one.distance:.2f} of {one.bound:.2f}")
            axes.set_xlabel(one.row.x)
            axes.set_ylabel(one.row.y, fontsize=7)
        write_figure(file, figure)


def write_card(data: Path, out: Path, note: Callable[[str], None]) -> dict[str, Any]:
    """Measures all rows whose recordings are in ``data``, and writes ``gap.md`` and the figure into
    ``out``. ``note`` is told the row. Returns the figures. Raises UsageError for a folder without
    recordings."""
    found, missing = [], []
    for row in ROWS:
        note(row.name)
        curves = row.measure(data)
        if curves is None:
            missing.append(row.name)
        else:
            found.append(compared(row, curves))
    if all(one.row.name in WITHOUT_DATA for one in found):
        raise UsageError(f"'{data}' holds no recordings that a row of the card is of")
    out.mkdir(parents=True, exist_ok=True)
    text = table(found, missing)
    (out / "gap.md").write_text(f"{text}\n![Recordings and simulator]({FIGURE})\n", "utf-8")
    draw(found, out / FIGURE)
    return {"rows": [one.plain() for one in found], "missing": missing, "text": text}
