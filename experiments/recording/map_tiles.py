"""Square tiles of the growing map, and the selection of those to record again."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import GridMap

_TILE_M = 16.0
_GROWTH = 1.5
"""A tile is recorded again once it holds this many times the returns it held before."""
_MIN_CELLS = 20


class MapTiles:
    """Number of returns and of coloured cells of each tile when it was last recorded."""

    def __init__(self) -> None:
        self._recorded: dict[tuple[int, int], tuple[float, int]] = {}

    def changed(self, grid: GridMap, *, everything: bool = False) -> Iterator[tuple[slice, slice]]:
        """Rows and columns of the tiles that have grown by `_GROWTH` since they were last returned;
        ``everything``: of all tiles that have grown."""
        side = max(1, round(_TILE_M / grid.cell_m))
        growth = 1.0 if everything else _GROWTH
        returns = _tile_sums(grid.count, side)
        coloured = _tile_sums(np.isfinite(grid.rgb[:, :, 0]) & (grid.count > 0), side)
        cells = _tile_sums(grid.count > 0, side)
        for row, col in np.argwhere(cells >= _MIN_CELLS):
            had_returns, had_coloured = self._recorded.get((row, col), (0.0, 0))
            now_returns, now_coloured = (float(returns[row, col]), int(coloured[row, col]))
            if now_returns > growth * had_returns or now_coloured > growth * had_coloured:
                self._recorded[(row, col)] = (now_returns, now_coloured)
                yield (slice(row * side, (row + 1) * side), slice(col * side, (col + 1) * side))


def _tile_sums(cells: NDArray[np.generic], side: int) -> NDArray[np.float64]:
    rows = np.arange(0, cells.shape[0], side)
    cols = np.arange(0, cells.shape[1], side)
    summed = np.add.reduceat(cells.astype(np.float32), rows, axis=0)
    return np.add.reduceat(summed, cols, axis=1, dtype=np.float64)
