"""What `touchdown evaluate` prints of a report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from touchdown.experiments.terminal import make_console, make_table


def print_evaluation(report: Mapping[str, Any]) -> None:
    """Prints tables: scores overall, by data set, scene and height, and the confusion matrix."""
    console = make_console()
    title = f"{report['network']}, {report['labels']}, {report['split']}"
    heads = ("n", "loss", "macro F1", "recall", "top-1", "95 %", "ECE", "weight")
    table = make_table(title, "images of", *heads)
    rows = {"all": report} | (report["by_source"] if len(report["by_source"]) > 1 else {})
    rows |= report["by_scene"] | report["by_height"]
    for name, row in rows.items():
        low, high = row["top1_interval"]
        numbers = [f"{row[key]:.3f}" for key in ("loss", "macro_f1", "recall", "top1")]
        table.add_row(
            name, str(row["pictures"]), *numbers, f"{low:.3f}-{high:.3f}", f"{row['ece']:.3f}",
            f"{row['weight']:.2f}",
        )  # fmt: skip
    console.print(table)
    console.print(_confusion_table(report))
    if "decision" in report:
        console.print(decision_text(report["decision"]))
    cost = [f"ROM {report['rom_mb']:.1f} MB"]
    if "image_ms" in report:
        cost += [
            f"peak RAM {report['peak_ram_mb']:.0f} MB",
            f"{report['image_ms']:.1f} ms an image on one thread ({report['engine']})",
        ]
    console.print(", ".join(cost))


def decision_text(decision: Mapping[str, Any]) -> str:
    """Returns the counts of unsafe images taken for safe and of safe ones refused, as text."""
    parts = []
    for kind, wrong, text in (
        ("unsafe", "unsafe_taken_for_safe", "images of unsafe ground taken for safe"),
        ("safe", "safe_refused", "of safe ground refused"),
    ):
        count, of = decision[wrong], decision[kind]
        part = f" ({count / of:.2%})" if of else ""
        parts.append(f"{count} of {of} {text}{part}")
    unknown = f"{decision['unsafe_unknown']} and {decision['safe_unknown']} more are unknown"
    return f"at {decision['min_probability']:.3f}: {', '.join(parts)}; {unknown}"


def _confusion_table(report: Mapping[str, Any]) -> Any:
    """Returns the confusion matrix of classes that occur or are predicted."""
    counts = np.array(report["confusion"])
    shown = np.flatnonzero(counts.sum(axis=0) + counts.sum(axis=1))
    names = [report["classes"][number] for number in shown]
    title = "true class by row, predicted class by column"
    table = make_table(title, "", *names, "recall")
    for number in shown:
        name = report["classes"][number]
        recall = report["recall_of"].get(name)
        cells = [str(count) if count else "·" for count in counts[number, shown]]
        table.add_row(name, *cells, "" if recall is None else f"{recall:.3f}")
    return table
