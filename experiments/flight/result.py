"""The result of a flight."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import GridMap
from touchdown.experiments.config.schema import Config
from touchdown.experiments.external.loading import flown_code
from touchdown.experiments.flight.metrics import levelness_error_deg
from touchdown.experiments.flight.referee import FlightResult
from touchdown.experiments.flight.stage_timer import StageClock
from touchdown.experiments.flight.truth_lookup import TruthLookup
from touchdown.experiments.flight.wiring import (
    Flight,
)
from touchdown.experiments.io.provenance import git_revision, versions


def _result(
    config: Config, flight: Flight, outcome: FlightResult, clock: StageClock, maps: list[GridMap]
) -> dict[str, Any]:
    wall_s = clock.wall_s()
    return {
        "outcome": str(outcome.outcome),
        "reason": outcome.reason,
        "scene": config.scene,
        "seed": config.seed,
        "estimator": config.estimator,
        **flown_code(config.estimator),
        "wind_kmh": config.wind.mean_kmh,
        "position_error_m": outcome.position_error.summary(),
        "span_s": outcome.span_s,
        **outcome.deviation.summary(),
        "nees": outcome.consistency.summary(),
        "landing": _landing(outcome, config.landing.site_xy_m),
        "classifier": flight.network or "off",
        "map": _map_figures(flight, outcome, maps, config.seed),
        "timing": {
            "wall_s": wall_s,
            "sim_s": outcome.sim_s,
            "real_time_factor": outcome.sim_s / wall_s,
            "stage_ms": clock.stage_ms(outcome.sim_s),
        },
        "versions": versions(),
        "git_revision": git_revision(),
    }


def _landing(
    outcome: FlightResult, commanded_xy_m: tuple[float, float] | None
) -> dict[str, Any] | None:
    """What the referee found, and which spot was commanded, if any was."""
    if outcome.landing is None:
        return None
    return {"commanded_xy_m": commanded_xy_m, **outcome.landing}


def _map_figures(
    flight: Flight, outcome: FlightResult, maps: list[GridMap], seed: int
) -> dict[str, Any]:
    """``density_per_m2``: returns per square metre of the mapped area at the end of the survey."""
    grid = maps[0]
    seen = grid.count > 0
    area = float(seen.sum()) * grid.cell_m**2
    errors: NDArray[np.float64] = levelness_error_deg(
        grid, TruthLookup(flight.scene).surface_points, seed
    )
    return {
        "duration_s": outcome.survey_s,
        "density_per_m2": float(grid.count[seen].sum()) / area if area > 0 else 0.0,
        "levelness_error_deg": {
            "mean": float(errors.mean()) if errors.size else None,
            "max": float(errors.max()) if errors.size else None,
            "places": int(errors.size),
        },
    }
