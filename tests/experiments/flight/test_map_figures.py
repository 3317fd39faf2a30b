from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.flight import result
from touchdown.experiments.flight.metrics import GroundMap
from touchdown.experiments.flight.result import _map_figures

from support.landing_support import grid_of_returns


def test_levelness_is_that_of_the_ground_under_plants(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows of a meadow a metre wide, on level ground."""
    rng = np.random.default_rng(2)
    rows = np.where(np.arange(60) // 5 % 2 == 0, 0.25, 0.0)
    leaves = np.maximum(1.0 + np.log(rng.random((30, 60, 60))) / 0.85, 0.0)
    grid = grid_of_returns(leaves * rows + 0.025 * rng.standard_normal((30, 60, 60)))

    def level(_lookup: object, xy: Any, radius: float) -> Any:
        across = np.linspace(-radius, radius, 9)
        x, y = np.meshgrid(xy[0] + across, xy[1] + across)
        return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])

    monkeypatch.setattr(result.TruthLookup, "surface_points", level)
    stack: Any = SimpleNamespace(scene=None)
    judgement: Any = SimpleNamespace(survey_s=36.0)
    before = result.levelness_error_deg(grid, lambda xy, r: level(None, xy, r), 3)
    found = _map_figures(stack, judgement, GroundMap.of(grid), 3)
    assert before.mean() > 1.0
    assert found.levelness_error_deg.mean is not None and found.levelness_error_deg.mean < 0.4
    assert found.density_per_m2 == pytest.approx(30 / 0.04)
