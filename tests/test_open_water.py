"""Out of sight of any shore: what five seconds cost, what the covariance says, and the way back.

`pytest -m slow -s tests/test_open_water.py` prints the figures of docs/faults.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.build import build_flight, build_scene
from experiments.config import load_config
from experiments.flight import limit_threads, make_referee
from experiments.loop import run_flight

CONFIG = Path(__file__).parent.parent / "configs" / "open_water.toml"
SPAN_S = 5.0
OUT_OF_SIGHT_M = 40.0
"""from the take-off spot: the LIDAR's half width of 26 m and the largest islet"""


@dataclass(slots=True)
class Watch:
    """A recorder that keeps errors, standard deviations and events at 20 Hz."""

    rows: list[Any] = field(default_factory=list)
    events: list[str] = field(default_factory=list)

    def tick(self, truth: Any, obs: Any, estimate: Any, *_others: Any) -> None:
        self.events.extend(estimate.events)
        if truth.tick % 30:
            return
        position = truth.world_from_body.translation
        error = estimate.world_from_body.translation - position
        sigma = np.sqrt(np.trace(estimate.position_covariance))
        self.rows.append([truth.time_s, *error, sigma, np.hypot(*position[:2])])

    def close(self) -> None:
        pass


@dataclass(frozen=True, slots=True)
class Figures:
    outcome: str
    out_of_sight_s: float
    growth_m: float
    """largest change of the error within five seconds out of sight"""
    sigma_before_m: float
    sigma_after_m: float
    """standard deviation of the position at both ends of them"""
    largest_out_m: float
    back_m: float
    """error at the end, over the shore"""
    sigma_back_m: float
    worst_sigmas: float
    """largest error out of sight, in standard deviations"""


def fly(seed: int, estimator: str, faults: tuple[str, ...] = ()) -> tuple[Figures, Watch]:
    limit_threads()
    config = load_config(
        CONFIG, ["sim.threads=1"], scene="open_water", seed=seed, estimator=estimator,
        record=False, fault=faults or None,
    )  # fmt: skip
    flight = build_flight(config, build_scene(config))
    watch = Watch()
    referee = make_referee(config, flight.scene, lambda: None)
    try:
        result = run_flight(
            world=flight.world, estimator=flight.estimator, mapper=flight.mapper,
            lander=flight.lander, controller=flight.controller, recorder=watch, referee=referee,
        )  # fmt: skip
    finally:
        flight.world.close()
    return figures(str(result.outcome), np.array(watch.rows)), watch


def figures(outcome: str, rows: Any) -> Figures:
    times, errors, sigmas, distances = rows[:, 0], rows[:, 1:4], rows[:, 4], rows[:, 5]
    out = np.flatnonzero(distances > OUT_OF_SIGHT_M)
    assert (np.diff(out) == 1).all(), "the shore came into view in between"
    steps = round(SPAN_S / (times[1] - times[0]))
    starts = out[:-steps]
    growth = np.linalg.norm(errors[starts + steps] - errors[starts], axis=1)
    worst = starts[np.argmax(growth)]
    size = np.linalg.norm(errors, axis=1)
    return Figures(
        outcome=outcome,
        out_of_sight_s=float(times[out[-1]] - times[out[0]]),
        growth_m=float(growth.max()),
        sigma_before_m=float(sigmas[worst]),
        sigma_after_m=float(sigmas[worst + steps]),
        largest_out_m=float(size[out].max()),
        back_m=float(size[-1]),
        sigma_back_m=float(sigmas[-1]),
        worst_sigmas=float((size[out] / sigmas[out]).max()),
    )


if __name__ == "__main__":
    import sys

    print(fly(int(sys.argv[1]), sys.argv[2], tuple(sys.argv[3:])))
