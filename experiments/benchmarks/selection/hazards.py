"""Rocks and steps that the maps of a landing show: recall and precision against their size, in the
survey's map and in the fine map of both rechecks, at true poses."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy import ndimage

from touchdown.experiments.benchmarks.posed_survey import (
    SCAN_PERIOD_S,
    PosedSurvey,
    build_posed_survey,
    observe,
)
from touchdown.experiments.benchmarks.processes import mapped
from touchdown.experiments.config.schema import Config
from touchdown.experiments.flight.wiring import build_scene
from touchdown.experiments.reporting.curves import paint_levels
from touchdown.experiments.reporting.figures import Picture, drawn
from touchdown.experiments.reporting.statistics import clustered_fraction
from touchdown.landing.api import LandingParams
from touchdown.landing.mission.site_recheck import MIN_RETURNS, fine_window
from touchdown.landing.mission.trajectory import State, through
from touchdown.landing.selection.ground.elevation_raster import (
    ElevationRaster,
    fit_planes,
    observed_raster,
)
from touchdown.landing.selection.ground.landable import (
    Defect,
    assess,
    ground_planes,
    max_step_m,
)
from touchdown.landing.selection.ground.plants import standing_plants, without_plants
from touchdown.scenes.api import Scene
from touchdown.scenes.truth.static_surface import cast_down
from touchdown.sim.typing import Array, Mask

RADIUS_M = 2.5
"""of the ground around a place that is judged: what a touchdown beside it would need"""
SIZES_M = (0.1, 0.15, 0.2, 0.3, 0.45, 0.7, 1.0, 1.5, 10.0)
_CELL_M = 0.05
"""of the true ground"""
_PLANE_M = 1.0
"""half the window of the plane that things rise over"""
_ABOVE_M = 14.0
"""height from which the fine map is made"""
_HAZARDS = (Defect.ROUGH, Defect.STEP, Defect.OBSTACLE)


class Things(NamedTuple):
    """What rises over the true ground, on one raster (n, n) of 5 cm cells."""

    label: Any
    """number of the thing that a cell belongs to, 0 for none; it rises more than half a step"""
    rise_m: Array
    """(k,) highest point over the plane"""
    size_m: Array
    """(k,) diameter of the circle of the same area"""
    level: Mask
    """cells whose plane is less steep than ``landing.max_slope_deg``"""
    step: Mask
    """cells around which the ground itself rises by more than the limit of the map's rule"""


def true_things(heights: Array, params: LandingParams) -> Things:
    """Finds what stands on true ``heights`` (n, n) metres, cells of 5 cm."""
    plane = fit_planes(heights.astype(np.float32), _CELL_M, _PLANE_M)
    rise = np.nan_to_num(heights - plane.level)
    label, count = ndimage.label(rise > 0.5 * params.max_step_m, np.ones((3, 3)))
    numbers = np.arange(1, count + 1)
    area = ndimage.sum_labels(np.ones_like(rise), label, numbers) * _CELL_M**2
    window = 2 * round(params.ground.step_half_width_m / _CELL_M) + 1
    span = ndimage.maximum_filter(heights, window) - ndimage.minimum_filter(heights, window)
    return Things(
        label=label,
        rise_m=np.asarray(ndimage.maximum(rise, label, numbers)).reshape(-1),
        size_m=np.sqrt(4.0 / np.pi * np.asarray(area)).reshape(-1),
        level=np.rad2deg(plane.angle_rad) <= params.max_slope_deg,
        step=span > max_step_m(params, margins=True),
    )


def compared(
    things: Things, origin_xy: Array, raster: ElevationRaster, flags: Mask, params: LandingParams
) -> list[dict[str, Any]]:
    """One row for each thing that rises more than ``landing.max_step_m``, which is ``hit`` where a
    cell of ``flags`` (rows, cols) lies within a cell of it; and one for each flagged cell, ``hit``
    where it is that near to such a thing or to a step of the ground, or has the thing in the window
    of a step; its size is that of the flagged area. Both where the ground is near and not too
    steep. What rises between half of that and the whole counts as neither missed nor falsely
    found."""
    side = things.label.shape[0]
    at = np.arange(side) * _CELL_M + 0.5 * _CELL_M
    col, row = (np.floor((o + at - r) / raster.cell_m).astype(int)
                for o, r in zip(origin_xy, raster.origin_xy_m, strict=True))  # fmt: skip
    inside = ((row >= 0) & (row < flags.shape[0]))[:, None] & ((col >= 0) & (col < flags.shape[1]))
    spot = np.ix_(np.clip(row, 0, flags.shape[0] - 1), np.clip(col, 0, flags.shape[1] - 1))
    middle = 0.5 * side * _CELL_M
    near = np.hypot(*np.meshgrid(at - middle, at - middle)) <= RADIUS_M
    groups = np.where(inside, ndimage.label(flags, np.ones((3, 3)))[0][spot], 0)
    reach = round(raster.cell_m / _CELL_M)
    flagged_near = ndimage.maximum_filter(groups > 0, size=2 * reach + 1)
    judged = near & things.level
    hazard = np.concatenate([[False], things.rise_m > params.max_step_m])
    rows = []
    for number in np.unique(things.label[judged & hazard[things.label]]):
        hit = bool(flagged_near[things.label == number].any())
        rows.append({"of": "recall", "size_m": float(things.size_m[number - 1]), "hit": hit})
    window = reach + round(params.ground.step_half_width_m / _CELL_M)
    seen, close = (ndimage.maximum_filter(layer, size=2 * window + 1)
                   for layer in (things.label > 0, hazard[things.label]))  # fmt: skip
    close |= ndimage.maximum_filter(things.step, size=2 * reach + 1)
    for number in np.unique(groups[judged & (groups > 0)]):
        own = groups == number
        size = float(np.sqrt(4.0 / np.pi * own.sum()) * _CELL_M)
        cells = close[own & judged & (close | ~seen)][:: reach**2]
        rows += [{"of": "precision", "size_m": size, "hit": bool(hit)} for hit in cells]
    return rows


def flagged(raster: ElevationRaster, params: LandingParams, *, survey: bool) -> Mask:
    """Cells of a map that are refused as rough, a step or an object."""
    margin, returns = params.low_margin_m, MIN_RETURNS
    if survey:
        raster = without_plants(raster, standing_plants(raster, params.ground), params.ground)
        margin, returns = params.map_margin_m, params.min_returns
    planes = ground_planes(raster, params)
    found = assess(raster, planes, params, margin_m=margin, min_returns=returns)
    return np.isin(found.defect, _HAZARDS)


def look_at(task: tuple[Config, int]) -> list[dict[str, Any]]:
    """Surveys one scene and looks at so many places below the way: rows of `compared` with the
    height of the look, each place a ``unit``."""
    config, count = task
    scene, params = build_scene(config), config.landing
    survey = build_posed_survey(config, scene)
    *_, (_, view) = observe(survey, survey.path, start_s=0.0)
    times = np.linspace(0.0, survey.path.duration_s, count + 2)[1:-1]
    places = [_place(scene, survey.path.sample(float(t))[0][:2], params) for t in times]
    maps = [("survey", n, observed_raster(view.coarse, p.xy, RADIUS_M + 2.0))
            for n, p in enumerate(places)]  # fmt: skip
    rows = []
    for number, place in enumerate(places):
        rows += _compared(maps[number], place, config)
        clock, top = (number + 1) * (survey.path.duration_s + 60.0), _ABOVE_M
        for height in (params.look_height_m, params.commit_height_m):
            path = _look(survey, place, top, height, params)
            seen = observe(survey, path, start_s=clock, period_s=SCAN_PERIOD_S, images=False)
            *_, (_, view) = seen
            clock, top = clock + path.duration_s + 1.0, height
            raster = fine_window(view, place.position, RADIUS_M, params)
            rows += _compared((f"{height:g} m", number, raster), place, config)
    return rows


class _Place(NamedTuple):
    """A place and the true ground around it."""

    position: Array
    """(3,) on the ground"""
    origin: Array
    """(2,) corner of ``things``"""
    things: Things

    @property
    def xy(self) -> Array:
        return self.position[:2]


def _place(scene: Scene, xy: Array, params: LandingParams) -> _Place:
    cells = round(2.0 * (RADIUS_M + _PLANE_M) / _CELL_M)
    origin = np.asarray(xy) - 0.5 * cells * _CELL_M
    heights, _ = cast_down(scene, origin, _CELL_M, (cells, cells))
    position = np.array([*xy, heights[cells // 2, cells // 2]])
    return _Place(position, origin, true_things(heights, params))


def _compared(
    seen: tuple[str, int, ElevationRaster | None], place: _Place, config: Config
) -> list[dict[str, Any]]:
    name, number, raster = seen
    if raster is None:
        return []
    flags = flagged(raster, config.landing, survey=name == "survey")
    unit = f"{config.scene}, seed {config.seed}, place {number}"
    rows = compared(place.things, place.origin, raster, flags, config.landing)
    return [{"from": name, "unit": unit, **row} for row in rows]


def _look(
    survey: PosedSurvey, place: _Place, top_m: float, height_m: float, params: LandingParams
) -> Any:
    """The way from ``top_m`` to ``height_m`` over a place and what the lander does there: at the
    commitment height the sweep, then the hover."""
    up = np.array([0.0, 0.0, survey.rig.vehicle.leg_height_m])
    stops = [place.position + up + [0.0, 0.0, top_m], place.position + up + [0.0, 0.0, height_m]]
    seconds = [(top_m - height_m) / params.descent_speed_mps * 1.9]
    if height_m == params.commit_height_m:
        ahead = params.sweep_m * np.array([np.cos(survey.yaw), np.sin(survey.yaw), 0.0])
        stops += [stops[1] + ahead, stops[1] - ahead, stops[1]]
        seconds += [1.6, 2.4, 1.6]
    return through([State(stop) for stop in (*stops, stops[-1])], [*seconds, params.look_s])


def measure(configs: Sequence[Config], places: int, jobs: int, out: Path | None) -> dict[str, Any]:
    """Recall and precision from each height, in all and by size, with 95 % intervals over places.
    Draws them into ``out`` as hazards.svg."""
    found = mapped(look_at, [(config, places) for config in configs], jobs)
    frame = pd.DataFrame([row for rows in found for row in rows])
    if frame.empty:
        return {"levels": []}
    edges = np.array(SIZES_M)
    frame["bin"] = np.clip(np.searchsorted(edges, frame["size_m"], "right") - 1, 0, len(edges) - 2)
    levels = []
    for (of, name), whole in frame.groupby(["of", "from"]):
        sizes = [(edges[size : size + 2], own) for size, own in whole.groupby("bin")]
        for ends, own in [(edges[[0, -1]], whole), *sizes]:
            value = clustered_fraction(own["hit"].to_numpy(), list(own["unit"]))
            levels.append({"from": name, "of": of, "size_m": ends.tolist(),
                           **value.as_json(), "count": len(own)})  # fmt: skip
    if out is not None:
        (out / "hazards.svg").write_text(_drawing(frame).svg, encoding="utf-8")
    return {"levels": levels}


def _drawing(frame: pd.DataFrame) -> Picture:
    picture = Picture(
        "hazards",
        "Rocks and steps by size",
        "Marks: fraction of the things of a size that are found, and of the finds of a size that "
        "are right, with 95 % intervals over places.",
    )
    middle = np.sqrt(np.array(SIZES_M[:-1]) * np.minimum(SIZES_M[1:], 2.0))
    shown = frame.assign(dial=np.log10(middle[frame["bin"]]), hit=frame["hit"].astype(float))
    with drawn(picture, 7.0, 3.0) as figure:
        for axes, of in zip(figure.subplots(1, 2), ("recall", "precision"), strict=True):
            for number, name in enumerate(dict.fromkeys(frame["from"])):
                own = shown[(shown["of"] == of) & (shown["from"] == name)]
                paint_levels(axes, own, "hit", f"C{number}", 0.01 * number)
                axes.plot([], [], "o", color=f"C{number}", label=f"from {name}" * (of == "recall"))
            axes.set(title=of, ylim=(-0.03, 1.03), xlabel="diameter (m)")
            axes.xaxis.set_major_formatter(lambda value, _: f"{10.0**value:.2g}")
        figure.legend(loc="outside upper center", ncols=3, fontsize=8)
    return picture


def table(figures: dict[str, Any]) -> str:
    """Returns the curves as text."""
    lines = ["what       from    diameter (m)   share  95 % interval    number"]
    for row in figures["levels"]:
        low, high = row["size_m"]
        ends = " to ".join(f"{end:.2f}" for end in (row["low"], row["high"]) if end is not None)
        lines.append(f"{row['of']:10} {row['from']:7} {low:5.2f} to {high:5.2f} "
                     f" {row['value']:6.3f}  {ends:15}  {row['count']:6}")  # fmt: skip
    return "\n".join(lines)
