"""The examination of a part of any kind beside the estimator."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from touchdown.experiments.external import (
    trial_classifier,
    trial_controller,
    trial_lander,
    trial_mapper,
    trial_selector,
)
from touchdown.experiments.external.conformance import RULES as ESTIMATOR_RULES
from touchdown.experiments.external.conformance_report import Findings
from touchdown.experiments.external.loading import Build

EXAMINERS: Mapping[str, Callable[[Build, Any, Mapping[str, Any]], Findings]] = {
    "selector": trial_selector.examine_selector,
    "controller": trial_controller.examine_controller,
    "classifier": trial_classifier.examine_classifier,
    "mapper": trial_mapper.examine_mapper,
    "lander": trial_lander.examine_lander,
}
"""By kind: the findings about ``build`` with a rig and parameters."""

RULES: Mapping[str, Mapping[str, str]] = {
    "estimator": ESTIMATOR_RULES,
    "selector": trial_selector.RULES,
    "controller": trial_controller.RULES,
    "classifier": trial_classifier.RULES,
    "mapper": trial_mapper.RULES,
    "lander": trial_lander.RULES,
}
"""Checked rules of each kind, by name."""
