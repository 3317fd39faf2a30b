"""Structured forests on disk: gzipped YAML in the form that OpenCV's edge detector loads."""

from __future__ import annotations

import gzip
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.zou2024.structured_edges.detector import OPTIONS, SECTIONS
from touchdown.experiments.edges import forest

Int32 = NDArray[np.int32]

_LINE = 24
"""numbers on a line; OpenCV's reader wants lines of moderate length"""


def check_target(path: Path) -> None:
    """Raises ValueError for a folder that does not exist, or a name that OpenCV would not read."""
    if not path.parent.is_dir():
        raise ValueError(f"folder '{path.parent}' does not exist: create it, or name another file")
    if not path.name.endswith(".yml.gz"):
        raise ValueError(f"model '{path}' must be named *.yml.gz: OpenCV goes by the ending")


def write_model(
    path: Path,
    trees: Sequence[forest.Tree],
    params: forest.ForestParams,
    notes: Mapping[str, str] | None = None,
) -> None:
    """Writes a forest. The same forest gives the same bytes. ``notes`` become comments at the top.

    Raises ValueError as `check_target`.
    """
    check_target(path)
    text = "\n".join(_document(trees, params, notes or {})) + "\n"
    draft = path.with_name(path.name + ".part")
    draft.write_bytes(gzip.compress(text.encode("ascii"), 9, mtime=0))
    draft.replace(path)


def _document(
    trees: Sequence[forest.Tree], params: forest.ForestParams, notes: Mapping[str, str]
) -> list[str]:
    values = (params.stride, forest.PATCH, forest.INNER, forest.SHRINK, len(trees),
              params.trees_evaluated, forest.GRID, forest.ORIENTATIONS,
              forest.NORMALISATION_RADIUS, forest.GRADIENT_SMOOTHING, forest.REGULAR_SMOOTHING,
              forest.PAIR_SMOOTHING)  # fmt: skip
    lines = ["%YAML:1.0", *(f"# {name}: {note}" for name, note in notes.items()), "---", "options:"]
    lines += [f"   {name}: {value}" for name, value in zip(OPTIONS, values, strict=True)]
    nodes = max(len(tree.child) for tree in trees)
    bounds, bins = _leaf_tables(trees, nodes)
    tables: dict[str, Sequence[NDArray[Any]]] = {
        "childs": [_padded(tree.child, nodes) for tree in trees],
        "featureIds": [_padded(tree.feature, nodes) for tree in trees],
        "thresholds": [_padded(tree.threshold, nodes) for tree in trees],
        "edgeBoundaries": bounds,
        "edgeBins": bins,
    }
    for section in SECTIONS:
        lines.append(f"{section}:")
        for values_of_tree in tables[section]:
            lines += _sequence(values_of_tree)
    return lines


def _padded(values: NDArray[Any], nodes: int) -> NDArray[Any]:
    """OpenCV wants trees of one size; what is added is never reached."""
    return np.pad(values, (0, nodes - len(values)))


def _leaf_tables(trees: Sequence[forest.Tree], nodes: int) -> tuple[list[Int32], list[Int32]]:
    """Start of each node's boundary pixels in the concatenated row, with one more entry at the end,
    and these pixels, counted along columns first."""
    bounds, bins, start = [], [], 0
    for tree in trees:
        counts = np.zeros(nodes, np.int64)
        counts[: len(tree.leaf_bins)] = [len(leaf) for leaf in tree.leaf_bins]
        ends = start + np.cumsum(counts)
        bounds.append(np.concatenate([[start], ends[:-1]]).astype(np.int32))
        flat = np.concatenate([np.zeros(0, np.int32), *tree.leaf_bins])
        bins.append((flat % forest.INNER * forest.INNER + flat // forest.INNER).astype(np.int32))
        start = int(ends[-1])
    bounds[-1] = np.append(bounds[-1], np.int32(start))
    return bounds, bins


def _sequence(values: NDArray[Any]) -> list[str]:
    """A YAML sequence within a sequence, in lines of a few numbers."""
    floating = np.issubdtype(values.dtype, np.floating)
    # YAML of OpenCV knows a real number by its point
    words = [_real(float(v)) for v in values] if floating else [str(int(v)) for v in values]
    rows = [", ".join(words[at : at + _LINE]) for at in range(0, len(words), _LINE)]
    joined = ",\n      ".join(rows)
    return f"   - [ {joined} ]".split("\n")


def _real(value: float) -> str:
    text = np.format_float_scientific(np.float32(value), precision=6, trim="0")
    return str(text)
