"""Extent of a reproduction, whole or quick, and the cost of its flights."""

from __future__ import annotations

import functools
import hashlib
import importlib.util
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from touchdown.experiments.campaign.forecast import stated_core_s
from touchdown.experiments.campaign.plan import Plan, PlannedRun, config_for, load_plan
from touchdown.experiments.reporting.published import ANALYSED_SCENE, NETWORK_NAMES

PLANS = Path(__file__).parent / "plans"
EditionName = Literal["quick", "whole", "whole-gpu"]
PAPER_SCENES = ("crossroad", "lake", "houses", "forest")


@dataclass(frozen=True, slots=True)
class Recognition:
    """Size of the rendered data set, and the networks trained on it."""

    images: int
    """0: none are rendered"""
    pixels: int
    per_seed: int
    scenes: tuple[str, ...]
    """empty: all scenes"""
    networks: tuple[str, ...]
    labels: tuple[str, ...]
    image_size: int
    epochs: int
    """at most; the learning rate falls to 0 over so many"""
    patience: int = 8
    """epochs without a better macro F1 on the validation images after which a network has
    converged"""
    learning_rates: tuple[tuple[str, float], ...] = ()
    """of networks that do not learn at the common one"""
    image_sizes: tuple[tuple[str, int], ...] = ()
    """of networks that the common one is too small for"""
    repeated: tuple[str, ...] = ()
    """networks that are trained with each of ``seeds`` under ``d_land``, the others with the first
    alone"""
    seeds: tuple[int, ...] = (0,)


@dataclass(frozen=True, slots=True, kw_only=True)
class Extent:
    """Requested extent of a reproduction."""

    quick: bool
    photographs: tuple[str, ...] = ()
    """labelled images of the part ``photographs``, as ``--data`` of `touchdown train`"""

    @property
    def edition(self) -> Edition:
        """The edition for this machine."""
        if self.quick:
            return QUICK
        return WHOLE_ON_GPU if on_gpu() else WHOLE


@dataclass(frozen=True, slots=True)
class Edition:
    """Sizes of the trainings of a reproduction."""

    name: EditionName
    recognition: Recognition
    photographs: Recognition
    """trained on photographs alone"""


# Without normalisation VGG19 does not begin to learn at the rate of the others. Inception has no
# input left below 75 pixels.
PHOTOGRAPHS = Recognition(
    images=0,
    pixels=0,
    per_seed=0,
    scenes=(),
    networks=tuple(NETWORK_NAMES),
    labels=("d_scene", "d_land"),
    image_size=64,
    epochs=80,
    patience=20,
    learning_rates=(("vgg19", 2e-4),),
    image_sizes=(("inception_v4", 80),),
    repeated=("resnet50", "resnet50_cbam"),
    seeds=(0, 1, 2),
)
WHOLE = Edition(
    name="whole",
    recognition=Recognition(
        images=4000,
        pixels=128,
        per_seed=40,
        scenes=(),
        networks=tuple(NETWORK_NAMES),
        labels=("d_scene", "d_land"),
        image_size=96,
        epochs=6,
    ),
    photographs=PHOTOGRAPHS,
)
# A separate name: results of CPU and GPU trainings are never in one table.
WHOLE_ON_GPU = replace(
    WHOLE,
    name="whole-gpu",
    recognition=replace(WHOLE.recognition, images=12000, image_size=128, epochs=30),
)
# Five seeds of each scene are the fewest that give all three splits.
QUICK = Edition(
    name="quick",
    recognition=Recognition(
        images=200,
        pixels=64,
        per_seed=8,
        scenes=("crossroad", "lake", "houses", "forest", "cottage"),
        networks=("resnet18",),
        labels=("d_land",),
        image_size=64,
        epochs=6,
    ),
    photographs=replace(PHOTOGRAPHS, networks=("resnet18",), labels=("d_land",), repeated=(),
                        seeds=(0,), epochs=6),
)  # fmt: skip


@functools.cache
def on_gpu() -> bool:
    if importlib.util.find_spec("torch") is None:
        return False
    import torch

    return bool(torch.cuda.is_available())


_QUICK_SCENES = {"zou2024_sites": "rooftop_parking", "real_sites": "footbridge"}
"""Scenes of the quick edition by campaign, where it is not the one that the paper analyses."""


@functools.cache
def plan_of(campaign: str, *, quick: bool) -> Plan:
    """Plan of a campaign from its file; for the quick edition, some runs of the first seed.

    The whole edition has all runs of the quick one, with the same names, and continues it.
    """
    plan = load_plan(PLANS / f"{campaign}.toml")
    if not quick:
        return plan
    wanted = {
        "scene": _QUICK_SCENES.get(campaign, ANALYSED_SCENE),
        "seed": min(run.values["seed"] for run in plan.runs),
    }
    if campaign == "zou2024":
        wanted["landing.flatness_form"] = "corrected"
    runs = [run for run in plan.runs if wanted.items() <= run.values.items()]
    # The longest run first, so that the workers end at nearly the same time.
    runs.sort(key=lambda run: -_cost(plan.mode, run))
    return replace(plan, runs=tuple(runs), record="none")


def digest(plan: Plan) -> str:
    """Twelve hexadecimal digits that identify the flights of a plan."""
    text = "\n".join(sorted(f"{run.run_id} {run.config_sha}" for run in plan.runs))
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def core_seconds(plan: Plan) -> float:
    """CPU time of the flights of a plan on one core, by `experiments.campaign.forecast`."""
    return sum(_cost(plan.mode, run) for run in plan.runs)


def _cost(mode: str, run: PlannedRun) -> float:
    return stated_core_s(mode, config_for(run.values, f"run {run.run_id}"))
