"""Where a vehicle takes off in the scene of a file that names no place for it.

Sizes are those of the standard survey and of its fit to a place (`SurveyParams` and
`experiments.flight.survey_fit`, which are layers above; a test compares them).
"""

from __future__ import annotations

import numpy as np

from touchdown.scenes.api import Array
from touchdown.scenes.importers.top_view import TopView, grounds, largest, level_cells

_AHEAD_M, _LEFT_M = 52.0, 42.0
"""The rectangle of the standard survey's legs, and a margin."""
_LENGTHS_M, _WIDTHS_M = (40.0, 32.0, 24.0, 16.0, 8.0), (0.0, 20.0, 40.0)
"""of the legs of smaller surveys"""
_TURN_M = 13.0
"""ground that turns between legs need beyond their ends"""
_SEEN_AHEAD_M, _SEEN_ASIDE_M = 12.0, 20.0
"""what LIDAR and camera see beyond the legs at 30 m"""
_ROOM = 0.95
"""least share of legs with ground below"""
_FREE_M, _LEVEL_M = 1.5, 0.12
"""Radius around a take-off that is level, and the heights within it."""
_FAR = 0.0003
"""Share of the survey that a metre's distance from the origin weighs."""


def takeoff_spot(seen: TopView, wish_xy_m: Array) -> Array:
    """The point (2,) ``wish_xy_m`` where it is level, free and leaves room for the survey, else the
    spot on the widest ground that does and is nearest. Where none leaves room for the standard
    survey, the one from which a smaller one sees most of the ground."""
    label = grounds(seen)
    usable = level_cells(seen, _FREE_M, _LEVEL_M) & (label == largest(label))
    if not usable.any():
        return wish_xy_m
    known = np.isfinite(seen.height_m)
    total = np.zeros((known.shape[0] + 1, known.shape[1] + 1))
    total[1:, 1:] = known.cumsum(axis=0).cumsum(axis=1) * seen.cell_m**2
    room = _below(total, seen.cell_m, (0.0, _AHEAD_M), (0.0, _LEFT_M)) / (_AHEAD_M * _LEFT_M)
    if room[usable].max() < _ROOM:
        room = _seen_by_smaller(total, seen.cell_m)
    here = seen.cell_of(wish_xy_m)
    if usable[here] and room[here] >= _ROOM:
        return wish_xy_m
    centres = seen.centres()
    away = np.hypot(*np.moveaxis(centres - wish_xy_m, -1, 0))
    cost = np.where(usable, 1.0 - room + _FAR * away, np.inf)
    return np.asarray(centres[np.unravel_index(int(np.argmin(cost)), cost.shape)], np.float64)


def _seen_by_smaller(total: Array, cell_m: float) -> Array:
    """(rows, cols) share of all ground, or of what the standard survey would see, that the best of
    the smaller surveys from a cell sees; 0 where there is no room for any."""
    best = np.zeros((total.shape[0] - 1, total.shape[1] - 1))
    for width in _WIDTHS_M:
        turn = _TURN_M if width else 0.0
        for length in _LENGTHS_M:
            legs = (-turn, length + max(turn, cell_m)), (-cell_m, width + cell_m)
            share = _below(total, cell_m, *legs) / _area(*legs)
            ground = _below(
                total, cell_m,
                (-_SEEN_AHEAD_M, length + _SEEN_AHEAD_M), (-_SEEN_ASIDE_M, width + _SEEN_ASIDE_M),
            )  # fmt: skip
            best = np.maximum(best, np.where(share >= _ROOM, ground, 0.0))
    most = (_AHEAD_M + 2.0 * _SEEN_AHEAD_M) * (_LEFT_M + 2.0 * _SEEN_ASIDE_M)
    return np.minimum(best / min(float(total[-1, -1]), most), 1.0)


def _below(
    total: Array, cell_m: float, ahead_m: tuple[float, float], left_m: tuple[float, float]
) -> Array:
    """(rows, cols) area of the ground in a rectangle ahead and to the left of a cell, heading east.
    ``total`` (rows + 1, cols + 1): sums of the ground's area up to a cell."""
    rows, cols = total.shape[0] - 1, total.shape[1] - 1
    bottom, top = (np.clip(np.arange(rows) + round(y / cell_m), 0, rows) for y in left_m)
    left, right = (np.clip(np.arange(cols) + round(x / cell_m), 0, cols) for x in ahead_m)
    return np.asarray(
        total[np.ix_(top, right)] - total[np.ix_(bottom, right)]
        - total[np.ix_(top, left)] + total[np.ix_(bottom, left)]
    )  # fmt: skip


def _area(ahead_m: tuple[float, float], left_m: tuple[float, float]) -> float:
    return (ahead_m[1] - ahead_m[0]) * (left_m[1] - left_m[0])
