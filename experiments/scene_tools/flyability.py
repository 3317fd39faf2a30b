"""Checks of scenes: a survey can be flown over an MJCF file; seeds of a scene build and differ."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from touchdown.experiments.config.loading import load_config
from touchdown.experiments.config.schema import Config
from touchdown.experiments.flight.survey_fit import CLEARANCE_M, GROUND_FRACTION, Fit, fit_survey
from touchdown.experiments.flight.wiring import build_scene
from touchdown.experiments.scene_tools.render import load_configured_scene
from touchdown.landing.api import SurveyParams
from touchdown.scenes.truth.survey_facts import (
    layout_difference,
    layout_rasters,
    scene_facts,
    survey_facts,
)

STEP_M = 1.0
"""Height difference of the take-off spot to the ground around it that gives a remark"""
SAME_HEIGHT_M = 0.01
SAME_CLASS_FRACTION = 0.005
SAME_GREY = 2.0
"""Two seeds count as the same scene when they differ by less than all three of these."""
_ODD_TAKEOFF = ("building", "trees", "water")


def check_scene_file(
    file: str, overrides: Sequence[str] = (), *, as_is: bool | None = None,
    classes: str | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Builds the scene of an MJCF file once and checks the requirements of the configured survey.

    ``place``: the file; ``problems``: reasons why it cannot be flown, one sentence each;
    ``remarks``: probable mistakes; ``facts``: `scenes.truth.survey_facts.SceneFacts` and the safe
    ground of `scenes.truth.survey_facts.SurveyFacts`. Raises UsageError for a file that cannot be
    read.
    """
    config = load_config(
        None, list(overrides), scene=file, profile_default="ideal", as_is=as_is, classes=classes
    )
    scene = load_configured_scene(config)
    fit = fit_survey(config, scene)
    if fit is not None:
        config = config.model_copy(update={"survey": fit.survey})
    reach = survey_reach(config.survey)
    facts = {
        **dataclasses.asdict(scene_facts(scene, *reach)),
        **dataclasses.asdict(survey_facts(scene, *reach)),
    }
    return {
        "place": file,
        "problems": _problems(facts, config),
        "remarks": _fit_remark(fit) + _remarks(facts),
        "facts": facts,
    }


def survey_reach(survey: SurveyParams) -> tuple[float, float, float, float]:
    """Length and width of the rectangle of the legs, and the reach of the sensors beyond it along
    and across. A Livox Horizon sees 81.7 x 25.1 degrees: from 30 m, 26 m aside and 6.7 m ahead."""
    ahead, aside = survey.height_m * np.tan(0.5 * np.deg2rad([25.1, 81.7]))
    width = (survey.legs - 1) * survey.leg_spacing_m
    return survey.leg_length_m, width, float(ahead), float(aside)


def _fit_remark(fit: Fit | None) -> list[str]:
    if fit is None or not fit.changed:
        return []
    keys = " ".join(f"--set {key}={value:g}" for key, value in fit.changed.items())
    return [f"the survey is fitted to the ground, as by {keys}"]


def _problems(facts: dict[str, Any], config: Config) -> list[str]:
    survey, found = config.survey, list[str]()
    if facts["legs_fraction"] < GROUND_FRACTION:
        found.append(
            f"there is ground under {facts['legs_fraction']:.0%} of the survey, {_size(survey)} "
            "ahead "
            "and to the left of the take-off; enlarge it, move or turn the site 'takeoff', or make "
            "the survey smaller (survey.leg_length_m, survey.legs, survey.leg_spacing_m)"
        )
    if facts["highest_m"] > survey.height_m - CLEARANCE_M:
        found.append(
            f"something below the survey is {facts['highest_m']:.1f} m higher than the take-off, "
            f"and the legs are flown at {survey.height_m:g} m; raise survey.height_m"
        )
    if not facts["safe_sites"]:
        found.append(
            "no safe ground where the survey looks: none is level, free and of a safe class "
            "(lawn, field, path)" + _key_for_class(facts)
        )
    return found


def _key_for_class(facts: dict[str, Any]) -> str:
    fraction = facts["safe_geometry_fraction"]
    if fraction <= 0.0:
        return ""
    return (
        f"; {fraction:.0%} is level and free: give its class by --classes, or land on roads and "
        "roofs "
        "with landing.allow_risky=true"
    )


def _remarks(facts: dict[str, Any]) -> list[str]:
    found = []
    above, land_class = facts["takeoff_above_m"], facts["takeoff_class"]
    if abs(above) > STEP_M or land_class in _ODD_TAKEOFF:
        found.append(
            f"the take-off is on '{facts['takeoff_geom']}' ({land_class}), {abs(above):.1f} m "
            f"{'above' if above >= 0.0 else 'below'} the ground around it; heights of the survey "
            "count from there"
        )
    if facts["legs_fraction"] >= GROUND_FRACTION > facts["seen_fraction"]:
        found.append(
            f"there is ground under {facts['seen_fraction']:.0%} of what LIDAR and camera see: "
            "beyond "
            "its edge an estimator has nothing to hold on to"
        )
    if untouchable := facts["untouchable"]:
        found.append(
            f"{', '.join(untouchable[:4])}: seen below the legs, but not touched (contype 0): the "
            "vehicle sinks through; let them collide, or leave them out"
        )
    return found


def _size(survey: SurveyParams) -> str:
    return f"{survey.leg_length_m:g} x {(survey.legs - 1) * survey.leg_spacing_m:g} m"


def check_scene(
    name: str, seeds: int, progress: Callable[[str], None], overrides: Sequence[str] = ()
) -> dict[str, Any]:
    """Builds seeds 0 to ``seeds`` - 1 of a scene under ``overrides``, ``key=value`` each.

    ``built``: how many; ``failed``: the message of each that did not build; ``closest``: the two
    most alike seeds and their differences in height (mean absolute, m), class (fraction of cells)
    and grey (mean absolute, of 255); ``differ``: no two are the same scene; ``without_safe_site``:
    the seeds without a safe site in the area that the survey sees; ``seeds``: the facts of each.
    """
    started = time.perf_counter()
    facts: dict[int, dict[str, Any]] = {}
    failed: dict[int, str] = {}
    pairs: list[dict[str, Any]] = []
    layouts: dict[int, Any] = {}
    for seed in range(seeds):
        progress(f"{name} seed {seed}")
        config = load_config(None, overrides, scene=name, seed=seed, profile_default="ideal")
        try:
            scene = build_scene(config)
        except (ValueError, OSError) as error:
            failed[seed] = " ".join(str(error).split())
            continue
        judged = survey_facts(scene, *survey_reach(config.survey))
        facts[seed] = {
            **dataclasses.asdict(judged),
            **({"ground": scene.facts} if scene.facts else {}),
        }
        layout = layout_rasters(scene)
        pairs += [
            {
                "seeds": [other, seed],
                **dataclasses.asdict(layout_difference(layouts[other], layout)),
            }
            for other in layouts
        ]
        layouts[seed] = layout
    closest = min(pairs, key=_likeness, default=None)
    fractions = [fact["safe_fraction"] for fact in facts.values()]
    return {
        "scene": name,
        "built": len(facts),
        "failed": failed,
        "closest": closest,
        "differ": closest is None or _likeness(closest) >= 1.0,
        "safe_fraction_min": min(fractions, default=None),
        "safe_fraction_median": float(np.median(fractions)) if fractions else None,
        "without_safe_site": [s for s, fact in facts.items() if fact["safe_sites"] == 0],
        "seconds_per_seed": (time.perf_counter() - started) / max(seeds, 1),
        "seeds": facts,
    }


def passed(rows: Sequence[dict[str, Any]]) -> bool:
    """True if every seed builds and no two of a scene are the same. A seed without a safe site is
    reported but does not fail: some scenes have none by design."""
    return all(row["differ"] and not row["failed"] for row in rows)


def _likeness(pair: dict[str, Any]) -> float:
    """Largest of the three differences over its threshold; below 1: the same scene."""
    return max(
        pair["height_m"] / SAME_HEIGHT_M,
        pair["class_fraction"] / SAME_CLASS_FRACTION,
        pair["grey"] / SAME_GREY,
    )
