"""Flight out of sight of any shore: error growth in five seconds, covariance, and recovery.

`pytest -m slow -s tests/closed_loop/test_open_water.py` prints the figures.
"""

from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.flight.loop import run_flight
from touchdown.experiments.flight.platform import limit_threads
from touchdown.experiments.flight.run import make_referee
from touchdown.experiments.flight.wiring import build_flight_stack, build_scene

from support.worlds import load_ideal_config as load_config

CONFIG = Path(__file__).parents[2] / "configs" / "open_water.toml"
SPAN_S = 5.0
OUT_OF_SIGHT_M = 40.0
"""from the take-off point: the LIDAR's half width of 26 m and the largest islet"""


@dataclass(slots=True)
class Watch:
    """A recorder that keeps errors and standard deviations at 20 Hz."""

    rows: list[Any] = field(default_factory=list)

    def tick(self, step: Any) -> None:
        truth, estimate = step.truth, step.estimate
        if truth.tick % 30:
            return
        position = truth.world_from_body.translation
        error = estimate.world_from_body.translation - position
        sigma = np.sqrt(np.trace(estimate.position_covariance))
        self.rows.append([truth.time_s, *error, sigma, np.hypot(*position[:2])])

    def close(self) -> None:
        pass


def fly(seed: int) -> SimpleNamespace:
    limit_threads()
    config = load_config(CONFIG, ["sim.threads=1"], scene="open_water", seed=seed, record=False)
    flight = build_flight_stack(config, build_scene(config))
    watch = Watch()
    referee = make_referee(config, flight.scene, lambda: None)
    try:
        result = run_flight(
            world=flight.world, estimator=flight.estimator, mapper=flight.mapper,
            lander=flight.lander, controller=flight.controller, recorder=watch, referee=referee,
        )  # fmt: skip
    finally:
        flight.world.close()
    return figures(str(result.outcome), np.array(watch.rows))


def figures(outcome: str, rows: Any) -> SimpleNamespace:
    """Largest growth of the error in five seconds out of sight; ``back``: at the end, over the
    shore."""
    times, errors, sigmas, distances = rows[:, 0], rows[:, 1:4], rows[:, 4], rows[:, 5]
    out = np.flatnonzero(distances > OUT_OF_SIGHT_M)
    assert (np.diff(out) == 1).all(), "the shore came into view in between"
    steps = round(SPAN_S / (times[1] - times[0]))
    starts = out[:-steps]
    size = np.linalg.norm(errors, axis=1)
    growth = size[starts + steps] - size[starts]
    return SimpleNamespace(
        outcome=outcome, out_of_sight_s=float(times[out[-1]] - times[out[0]]),
        growth_m=float(growth.max()), sigma_largest_m=float(sigmas[out].max()),
        back_m=float(size[-1]), sigma_back_m=float(sigmas[-1]),
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_five_seconds_without_shore_cost_little(seed: int) -> None:
    """The ripples of the scene are static, so that the camera can track them."""
    found = fly(seed)
    print(f"\nopen_water {seed}: {found}")
    assert found.outcome == "COMPLETED" and found.out_of_sight_s >= SPAN_S
    assert found.growth_m <= 0.3
    assert found.sigma_back_m < found.sigma_largest_m
    assert found.back_m < 0.1
