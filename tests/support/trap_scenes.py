"""MJCF scenes with misleading ground for a site selector, surveyed by posed sensors."""

from pathlib import Path

import numpy as np

from touchdown.estimator.api import Estimate, MapView
from touchdown.experiments.benchmarks.posed_survey import Surveyed, observe, posed_survey
from touchdown.experiments.config.schema import Config
from touchdown.landing.mission.trajectory import PiecewiseTrajectory, State, through
from touchdown.sim.typing import Array

from support.worlds import load_ideal_config as load_config

SHORT_SURVEY = (
    "sim.threads=1", "survey.legs=1", "survey.leg_length_m=30.0", "survey.duration_s=9.0",
    "camera.width=424", "camera.height=240",
)  # fmt: skip


def box(name: str, low: tuple[float, ...], high: tuple[float, ...], more: str = "") -> str:
    """An upright box between two corners."""
    centre, half = np.add(low, high) / 2.0, np.subtract(high, low) / 2.0
    middle = " ".join(f"{value:g}" for value in centre)
    size = " ".join(f"{value:g}" for value in half)
    return f'<geom name="{name}" type="box" pos="{middle}" size="{size}" {more}/>'


LAWN = box("lawn", (-40, -40, -1), (70, 40, 0), 'rgba="0.25 0.5 0.2 1"')


def ground_with_gap(gap: tuple[float, float, float, float]) -> str:
    """Lawn at height 0 except the rectangle x0, x1, y0, y1, which has no ground."""
    x0, x1, y0, y1 = gap
    green = 'rgba="0.25 0.5 0.2 1"'
    return "".join([
        box("lawn_west", (-40, -40, -1), (x0, 40, 0), green),
        box("lawn_east", (x1, -40, -1), (70, 40, 0), green),
        box("lawn_south", (x0, -40, -1), (x1, y0, 0), green),
        box("lawn_north", (x0, y1, -1), (x1, 40, 0), green),
    ])  # fmt: skip


def write(folder: Path, name: str, geoms: str) -> Path:
    path = folder / f"{name}.xml"
    path.write_text(
        '<mujoco><worldbody><light pos="0 0 60" dir="0 0 -1"/>'
        f'<site name="takeoff" pos="0 0 0"/>{geoms}</worldbody></mujoco>'
    )
    return path


def config_for(path: Path, *more: str) -> Config:
    return load_config(
        None,
        [*SHORT_SURVEY, *more],
        scene=str(path),
        seed=100,
        estimator="oracle",
        record=False,
        as_is=True,
    )


def survey(path: Path, *more: str) -> Surveyed:
    return posed_survey(config_for(path, *more), period_s=0.2)


def hover_over(surveyed: Surveyed, xy: Array, height_m: float, seconds: float) -> MapView:
    """Returns the map after a hover above ``xy`` with a sweep of 1 m, as the lander flies it."""
    end = np.array([xy[0], xy[1], height_m])
    ahead = end + [1.0, 0.0, 0.0]
    path: PiecewiseTrajectory = through(
        [State(end), State(ahead), State(2.0 * end - ahead), State(end)],
        [0.25 * seconds, 0.5 * seconds, 0.25 * seconds],
    )
    view: MapView | None = None
    for estimate, seen in observe(surveyed.survey, path, start_s=100.0, period_s=0.1):
        assert isinstance(estimate, Estimate)
        view = seen
    assert view is not None
    return view
