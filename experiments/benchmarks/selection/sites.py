"""Benchmark of site selection without flights: the maps of surveys, judged by the true ground."""

import contextlib
import functools
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from touchdown.experiments.benchmarks.processes import mapped
from touchdown.experiments.benchmarks.selection.curves import Drawings, reliability, selector_curves
from touchdown.experiments.benchmarks.selection.maps import (
    KeptMap,
    SafeGround,
    is_judged,
    make_map,
    map_files,
    on_grid,
    read_map,
    value_at,
    without_safe_ground,
    write_map,
)
from touchdown.experiments.config.loading import load_config, parse_seeds
from touchdown.experiments.config.schema import Config
from touchdown.experiments.config.slots import SLOTS, names_code, params_of
from touchdown.experiments.errors import UsageError
from touchdown.experiments.external.wrapper import ExternalSelector
from touchdown.experiments.flight.slots import check_parts_available
from touchdown.experiments.flight.wiring import check_scene_name
from touchdown.landing.api import Selection, SelectorInput, SelectorRig
from touchdown.landing.classification.scores import calibration
from touchdown.landing.selection import probability as risk
from touchdown.landing.selection.selector import select_sites
from touchdown.scenes.api import short_name
from touchdown.sim.api import VehicleModel
from touchdown.sim.typing import Mask

Report = Callable[[dict[str, Any]], None]

SCENES = (
    "cottage", "crossroad", "footbridge", "forest", "houses", "lake", "pools", "rooftop_parking",
    "turf",
)  # fmt: skip
"""all scenes except ``flat`` and ``open_water``, which offer no choice"""
SAMPLES = 4000
"""cells of a scene by which calibration is judged"""
CLEARANCE_CAP_M = 3.0
"""distance to unsafe ground from which the clearance no longer rises"""


def check_map(kept: KeptMap, config: Config) -> dict[str, Any]:
    """Judges the configured selector on one map by its true ground. Returns:

    ``chosen_safe`` (None where nothing was accepted), ``accepted`` and ``accepted_safe`` sites, of
    those on judged ground;
    ``cells``: numbers of surveyed cells that are safe, allowed, and both; ``clearance_m`` of the
    chosen site and ``best_clearance_m``: distance to the nearest unsafe ground, at most 3 m;
    ``barren_accepted``: sites accepted in the largest square without safe ground, None without one;
    ``seconds`` of processor time; ``sample``: predicted probabilities and truth of evenly spread
    cells, with what is allowed and their features, None for a selector that states no probability.
    """
    choose = chooser(config, kept.vehicle)
    started = time.process_time()
    selection = choose(kept)
    seconds = time.process_time() - started
    costmap, truth = selection.costmap, kept.truth
    if costmap is None:
        raise ValueError(f"scene '{kept.scene}': the selector shows no costmap")
    accepted = [site for site in selection.candidates
                if site.accepted and is_judged(truth, site.position_odom)]  # fmt: skip
    verdicts = [value_at(truth, truth.safe, site.position_odom) for site in accepted]
    barren, grid = without_safe_ground(kept), kept.map_view.coarse
    offered = None if barren is None else choose(barren).candidates
    clearance = np.minimum(distance_transform_edt(truth.safe) * truth.cell_m, CLEARANCE_CAP_M)
    safe, judged = on_grid(truth, costmap, costmap.total.shape)
    returned = SafeGround(origin_xy_m=grid.origin_xy_m, cell_m=grid.cell_m, safe=grid.count > 0)
    seen = judged & on_grid(returned, costmap, costmap.total.shape)[0]
    return {
        "scene": kept.scene,
        "seed": kept.seed,
        "dials": dict(kept.dials),
        "chosen_safe": bool(verdicts[0]) if verdicts else None,
        "accepted": len(accepted),
        "accepted_safe": sum(map(bool, verdicts)),
        "cells": {
            "safe": int((safe & seen).sum()),
            "allowed": int((selection.allowed & seen).sum()),
            "both": int((safe & selection.allowed & seen).sum()),
        },
        "clearance_m": float(value_at(truth, clearance, accepted[0].position_odom))
        if accepted
        else 0.0,
        "best_clearance_m": float(clearance.max()),
        "barren_accepted": None if offered is None else sum(site.accepted for site in offered),
        "seconds": seconds,
        "sample": _sample(kept, config, selection, safe & seen),
    }


def _sample(
    kept: KeptMap, config: Config, selection: Selection, safe: Mask
) -> dict[str, Any] | None:
    costmap = selection.costmap
    assert costmap is not None
    if _from_outside(config) and "probability" not in [term.name for term in costmap.terms]:
        return None
    features = risk.features_of(kept.map_view, kept.estimate, config.landing)
    _, judged = on_grid(kept.truth, costmap, costmap.total.shape)
    rows, cols = np.nonzero(judged & np.isfinite(selection.probability) & features.open)
    spread = np.s_[:: max(1, rows.size // SAMPLES)]
    rows, cols = rows[spread], cols[spread]
    return {
        "predicted": selection.probability[rows, cols],
        "safe": safe[rows, cols],
        "allowed": selection.allowed[rows, cols],
        "features": features.values[rows, cols],
    }


def _from_outside(config: Config) -> bool:
    return names_code(SLOTS["selector"], config.landing.selector)


def chooser(config: Config, vehicle: VehicleModel) -> Callable[[KeptMap], Selection]:
    """The configured selector as it is asked at the end of a survey. One from outside is built
    once for each configuration."""
    rig = SelectorRig(vehicle=vehicle, landing=config.landing)
    choose: Callable[[SelectorInput], Selection] = partial(select_sites, rig=rig)
    if _from_outside(config):
        key = config.model_dump_json()
        if key not in _BUILT:
            params = params_of(config, "selector")
            _BUILT[key] = ExternalSelector(config.landing.selector, params, rig)
        choose = _BUILT[key].select
    return lambda kept: choose(SelectorInput(map_view=kept.map_view, estimate=kept.estimate))


_BUILT: dict[str, ExternalSelector] = {}


def summary(places: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Returns figures over many scenes.

    ``precision``: fraction of chosen sites that are safe; ``precision_sites``: of all accepted
    ones; ``precision_cells`` and ``recall_cells`` of the cells; ``found``: fraction of scenes with
    safe ground where a site was accepted; ``barren``: number of squares without safe ground;
    ``refused``: fraction of them where none was; ``regret_m``: mean loss of clearance relative to
    the best safe site; ``ms``: mean processor time of a choice; ``calibration_error`` and
    ``reliability``: see `landing.classification.scores.calibration`, and the error over what is
    allowed alone; None for a selector that states no probability."""
    chosen = [place["chosen_safe"] for place in places if place["chosen_safe"] is not None]
    offered = [place for place in places if place["best_clearance_m"] > 0.0]
    barren = [n for place in places if (n := place["barren_accepted"]) is not None]
    cells = {
        key: sum(place["cells"][key] for place in places) for key in ("safe", "allowed", "both")
    }
    error, rows, error_allowed = None, None, None
    if all(place["sample"] is not None for place in places):
        names = ("predicted", "safe", "allowed")
        predicted, safe, allowed = (_gathered(places, name) for name in names)
        error, rows = calibration(predicted, safe)
        error_allowed = calibration(predicted[allowed], safe[allowed])[0]
    regrets = [_regret(place) for place in offered]
    return {
        "places": len(places),
        "precision": _fraction(sum(chosen), len(chosen)),
        "precision_sites": _fraction(
            sum(place["accepted_safe"] for place in places),
            sum(place["accepted"] for place in places),
        ),
        "precision_cells": _fraction(cells["both"], cells["allowed"]),
        "recall_cells": _fraction(cells["both"], cells["safe"]),
        "found": _fraction(sum(place["accepted"] > 0 for place in offered), len(offered)),
        "barren": len(barren),
        "refused": _fraction(barren.count(0), len(barren)),
        "regret_m": float(np.mean(regrets)) if regrets else None,
        "ms": 1e3 * float(np.mean([place["seconds"] for place in places])),
        "calibration_error": error,
        "calibration_error_allowed": error_allowed,
        "reliability": rows,
    }


def _regret(place: dict[str, Any]) -> float:
    chosen = place["clearance_m"] if place["chosen_safe"] else 0.0
    return float(place["best_clearance_m"]) - float(chosen)


def fit(places: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Returns ``weights`` fitted to all samples, and ``calibration_error`` and ``reliability`` by
    two-fold cross-validation over seeds. Raises ValueError for fewer than two seeds."""
    seeds = sorted({place["seed"] for place in places})
    if len(seeds) < 2:
        raise ValueError(
            "a fit needs at least two seeds, since it is judged on data that it was not fitted to"
        )
    halves = [
        [place for place in places if seeds.index(place["seed"]) % 2 == parity] for parity in (0, 1)
    ]
    predicted, truth = [], []
    for ours, others in (halves, halves[::-1]):
        weights = risk.fit_weights(_gathered(ours, "features"), _gathered(ours, "safe"))
        predicted.append(risk.predict(_gathered(others, "features"), weights))
        truth.append(_gathered(others, "safe"))
    error, rows = calibration(np.concatenate(predicted), np.concatenate(truth))
    weights = risk.fit_weights(_gathered(places, "features"), _gathered(places, "safe"))
    return {"weights": list(weights), "calibration_error": error, "reliability": rows}


def _gathered(places: Sequence[dict[str, Any]], key: str) -> NDArray[Any]:
    return np.concatenate([place["sample"][key] for place in places])


def _fraction(part: int, whole: int) -> float | None:
    return part / whole if whole else None


@dataclass(frozen=True, slots=True)
class Posed:
    """Surveys without a flight, made for this comparison, in ``profile``."""

    scenes: tuple[str, ...]
    seeds: str
    profile: str = "ideal"

    def places(self) -> Iterator[tuple[str, int]]:
        """Scene and seed of each. Raises UsageError for an unknown scene and invalid seeds."""
        for scene in self.scenes:
            check_scene_name(scene)
        yield from ((s, n) for s in self.scenes for n in parse_seeds(self.seeds, "--seeds"))


def make_maps(
    source: Posed,
    out: Path,
    jobs: int,
    overrides: Sequence[str],
    report: Callable[[Path], None],
    dials: Mapping[str, Sequence[float]] | None = None,
) -> list[Path]:
    """Makes a map of each place and keeps it in the folder ``out``; calls ``report`` with each
    file. With ``dials`` a map of each place at each value of each of them, the others as they are.
    Raises UsageError."""
    settings = [{key: value} for key, values in (dials or {}).items() for value in values] or [{}]
    tasks = []
    for scene, seed in source.places():
        for one in settings:
            given = (*overrides, *(f"{key}={value!r}" for key, value in one.items()))
            tasks.append((config_of(source.profile, None, given, scene, seed), out, one))
    out.mkdir(parents=True, exist_ok=True)
    files = []
    for file in mapped(_make_and_write, tasks, jobs):
        report(file)
        files.append(file)
    return files


def _make_and_write(task: tuple[Config, Path, dict[str, float]]) -> Path:
    config, out, dials = task
    return write_map(make_map(config, dials), out)


def run(
    source: Posed | Path,
    selectors: Sequence[str],
    *,
    jobs: int = 1,
    fit_model: bool = False,
    overrides: Sequence[str] = (),
    report: Report,
    drawings: Drawings | None = None,
) -> dict[str, Any]:
    """Checks the selectors on every place of ``source``: surveys to be made, or a folder of maps.

    A survey's map is judged as it is kept: in whole millimetres and steps of colour.
    Returns ``{"selector", "places": [...], "summary", "beside", "fit", "curves"}``: the first three
    of the first selector, `summary` of the others by name, with ``fit_model`` the fit, and curves
    where the maps have dials.
    Raises UsageError for bad input, and as `load_config`."""
    pictures, worst, curves = drawings or Drawings()
    names: tuple[str | None, ...] = tuple(selectors) or (None,)
    given = tuple(overrides)
    for name in names:
        check_parts_available(config_of("field", name, given, "flat", 0))
    for option, folder in (("--pictures", pictures), ("--curves", curves)):
        try:
            if folder is not None:
                folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"{option}: '{folder}' cannot be created: {error.strerror}") from error
    with contextlib.ExitStack() as stack:
        tasks: list[_Task]
        if isinstance(source, Path):
            tasks = [*map_files(source)]
        else:
            home = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            tasks = [
                (config_of(source.profile, None, given, *place), home / str(number))
                for number, place in enumerate(source.places())
            ]
        check = partial(_checked, selectors=names, overrides=given)
        files: list[Path] = []
        found: list[list[dict[str, Any]]] = []
        for file, results in mapped(check, tasks, jobs):
            report(results[0])
            files.append(file)
            found.append(results)
        mine = [results[0] for results in found]
        if pictures is not None:
            order = sorted(range(len(files)), key=lambda n: _regret(mine[n]), reverse=True)
            several = len({place["seed"] for place in mine}) > 1
            draw = partial(_draw, selector=names[0], overrides=given, folder=pictures,
                           several=several)  # fmt: skip
            list(mapped(draw, [files[n] for n in order[:worst]], jobs))
    chosen = names[0] or config_of("field", None, given, "flat", 0).landing.selector
    figures: dict[str, Any] = {"selector": chosen, "summary": summary(mine)}
    if len(names) > 1:
        figures["beside"] = {
            str(name): summary([results[n] for results in found])
            for n, name in enumerate(names[1:], start=1)
        }
    if fit_model:
        figures["fit"] = fit(mine)
    named = dict(zip([chosen, *map(str, names[1:])], zip(*found, strict=True), strict=True))
    if found_curves := selector_curves(named):
        figures["curves"] = {dial: told for dial, (told, _) in found_curves.items()}
    if curves is not None:
        for picture in (reliability(named), *(picture for _, picture in found_curves.values())):
            (curves / f"{picture.name}.svg").write_text(picture.svg, encoding="utf-8")
    figures["places"] = [
        {key: value for key, value in place.items() if key != "sample"} for place in mine
    ]
    return figures


_Task = Path | tuple[Config, Path]
"""The file of a map; or the configuration of a survey and a new folder for its map."""


def _checked(
    task: _Task, selectors: tuple[str | None, ...], overrides: tuple[str, ...]
) -> tuple[Path, list[dict[str, Any]]]:
    """The file of a map, made first where there is none, and `check_map` of it by each selector."""
    if isinstance(task, Path):
        file = task
    else:
        config, folder = task
        folder.mkdir()
        file = write_map(make_map(config), folder)
    kept = read_map(file)
    return file, [
        check_map(kept, config_of(kept.profile, name, overrides, kept.scene, kept.seed))
        for name in selectors
    ]


def _draw(
    file: Path, selector: str | None, overrides: tuple[str, ...], folder: Path, several: bool
) -> None:
    """Draws the steps of one choice as site_SCENE.jpg, with the seed where there are several."""
    from touchdown.experiments.benchmarks.selection.figures import write_steps

    kept = read_map(file)
    config = config_of(kept.profile, selector, overrides, kept.scene, kept.seed)
    seed = f"_{kept.seed}" if several else ""
    selection = chooser(config, kept.vehicle)(kept)
    write_steps(
        folder / f"site_{short_name(kept.scene)}{seed}.jpg",
        f"{kept.scene}, seed {kept.seed}",
        selection,
    )


@functools.lru_cache(maxsize=256)
def config_of(
    profile: str, selector: str | None, overrides: tuple[str, ...], scene: str, seed: int
) -> Config:
    """Returns the configuration of one place, of which nothing is recorded. Raises as
    `load_config`."""
    chosen = [] if selector is None else [f"landing.selector={selector}"]
    if not names_code(SLOTS["selector"], selector):  # parameters are for the one that is compared
        overrides = tuple(one for one in overrides if not one.startswith("external.selector."))
    return load_config(
        None,
        ["sim.threads=1", *overrides, *chosen],
        profile_default=profile,
        scene=scene,
        seed=seed,
        estimator="oracle",
        record=False,
    )


def row(place: dict[str, Any]) -> str:
    """Returns the result of one scene as a line of text."""
    verdict = {True: "safe", False: "UNSAFE", None: "no site"}[place["chosen_safe"]]
    cells = place["cells"]
    precision, recall = (_fraction(cells["both"], cells[whole]) for whole in ("allowed", "safe"))
    return (
        f"{place['scene']:16} seed {place['seed']:4}  {verdict:8}"
        f" sites {place['accepted_safe']}/{place['accepted']}"
        f"  cells precision {_percent(precision)} recall {_percent(recall)}"
        f"  clearance {place['clearance_m']:.1f} of {place['best_clearance_m']:.1f} m"
    )


def text(figures: dict[str, Any]) -> str:
    """Returns the summary as text."""
    rows = {figures["selector"]: figures["summary"], **figures.get("beside", {})}
    width = max(map(len, (*rows, "selector")))
    lines = [
        f"{'selector':{width}}  places  chosen safe  sites safe  cells safe  recall  found  "
        "refused  regret m    ms"
    ]
    for name, total in rows.items():
        fractions = ("precision", "precision_sites", "precision_cells", "recall_cells", "found",
                     "refused")  # fmt: skip
        cells = [_percent(total[key]) for key in fractions]
        lines.append(
            f"{name:{width}}  {total['places']:6}  {cells[0]:>11}  {cells[1]:>10}  {cells[2]:>10}"
            f"  {cells[3]:>6}  {cells[4]:>5}  {cells[5]:>7}"
            f"  {total['regret_m'] or 0.0:8.2f}  {total['ms']:4.0f}"
        )
    for name, total in rows.items():
        if total["calibration_error"] is not None:
            errors = (total[f"calibration_error{part}"] for part in ("", "_allowed"))
            lines.append("calibration error of {} {:.4f}, of what it allows {:.4f}".format(
                name, *errors))  # fmt: skip
            lines += [f"  predicted {mean:.3f}  safe {fraction:.3f}  ({number})"
                      for mean, fraction, number in total["reliability"]]  # fmt: skip
    if "fit" in figures:
        weights = ", ".join(f"{weight:.2f}" for weight in figures["fit"]["weights"])
        lines.append(f"landing.risk_weights=[{weights}]")
        lines.append(f"calibration error held out: {figures['fit']['calibration_error']:.4f}")
    for told in figures.get("curves", {}).values():
        lines += ["", *told["lines"], *told["words"]]
    return "\n".join(lines)


def _percent(fraction: float | None) -> str:
    return "-" if fraction is None else f"{100.0 * fraction:.1f}%"
