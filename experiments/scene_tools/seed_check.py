"""Check that the seeds of a scene build, differ, and offer a safe site."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from touchdown.experiments.config.loading import load_config
from touchdown.experiments.flight.wiring import build_scene
from touchdown.experiments.scene_tools.flyability import survey_reach
from touchdown.scenes.truth.survey_facts import layout_difference, layout_rasters, survey_facts

SAME_HEIGHT_M = 0.01
SAME_CLASS_SHARE = 0.005
SAME_GREY = 2.0
"""Two seeds count as the same scene when they differ by less than all three of these."""


def check_scenes(
    names: Sequence[str], seeds: int, progress: Callable[[str], None]
) -> list[dict[str, Any]]:
    """One row for each scene, see `check_scene`."""
    return [check_scene(name, seeds, progress) for name in names]


def check_scene(name: str, seeds: int, progress: Callable[[str], None]) -> dict[str, Any]:
    """Builds seeds 0 to ``seeds`` - 1 of a scene.

    ``built``: how many; ``failed``: the message of each that did not build; ``closest``: the two
    most alike seeds and their differences in height (mean absolute, m), class (share of cells) and
    grey (mean absolute, of 255); ``differ``: no two are the same scene; ``without_safe_site``: the
    seeds without a safe site in the area that the survey sees; ``seeds``: the facts of each.
    """
    started = time.perf_counter()
    facts: dict[int, dict[str, Any]] = {}
    failed: dict[int, str] = {}
    pairs: list[dict[str, Any]] = []
    layouts: dict[int, Any] = {}
    for seed in range(seeds):
        progress(f"{name} seed {seed}")
        config = load_config(scene=name, seed=seed, profile_default="ideal")
        try:
            scene = build_scene(config)
        except (ValueError, OSError) as error:
            failed[seed] = " ".join(str(error).split())
            continue
        facts[seed] = dataclasses.asdict(survey_facts(scene, *survey_reach(config.survey)))
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
    shares = [fact["safe_share"] for fact in facts.values()]
    return {
        "scene": name,
        "built": len(facts),
        "failed": failed,
        "closest": closest,
        "differ": closest is None or _likeness(closest) >= 1.0,
        "safe_share_min": min(shares, default=None),
        "safe_share_median": float(np.median(shares)) if shares else None,
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
        pair["class_share"] / SAME_CLASS_SHARE,
        pair["grey"] / SAME_GREY,
    )
