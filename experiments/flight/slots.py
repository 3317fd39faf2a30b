"""What fills the slots of a flight from outside, and the rigs that it is built with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from touchdown.controller.api import ControllerRig
from touchdown.experiments.config.schema import Config
from touchdown.experiments.config.slots import external_parts, params_of
from touchdown.experiments.external.loading import check_external
from touchdown.experiments.external.parts import ExternalController, ExternalSelector
from touchdown.experiments.external.wrapper import ExternalPart
from touchdown.landing.api import SelectorRig
from touchdown.sim.api import SensorRig


def _selector_rig(config: Config, sensors: SensorRig) -> SelectorRig:
    return SelectorRig(vehicle=sensors.vehicle, landing=config.landing)


def _controller_rig(config: Config, sensors: SensorRig) -> ControllerRig:
    return ControllerRig(
        vehicle=sensors.vehicle, control_hz=config.control.control_hz, control=config.control
    )


RIGS: Mapping[str, Callable[[Config, SensorRig], Any]] = {
    "estimator": lambda _config, sensors: sensors,
    "selector": _selector_rig,
    "controller": _controller_rig,
}
"""What a part of each kind is built with, from the configuration and the rig as the estimator knows
it."""


def external_name(config: Config, kind: str) -> str | None:
    """MODULE:FUNCTION that fills a slot; None where a shipped part does."""
    return dict(external_parts(config)).get(kind)


def external_selector(config: Config, sensors: SensorRig) -> ExternalSelector | None:
    """The configured selector; None for a shipped one, and for a survey alone."""
    name = external_name(config, "selector")
    if name is None or config.landing.survey_only:
        return None
    return ExternalSelector(name, params_of(config, "selector"), _selector_rig(config, sensors))


def external_controller(config: Config, sensors: SensorRig) -> ExternalController | None:
    """The configured controller; None for a shipped one."""
    name = external_name(config, "controller")
    if name is None:
        return None
    return ExternalController(
        name, params_of(config, "controller"), _controller_rig(config, sensors)
    )


def external_of(*built: Any) -> tuple[ExternalPart, ...]:
    """The external parts among ``built``."""
    return tuple(one.part for one in built if isinstance(getattr(one, "part", None), ExternalPart))


def check_parts_available(config: Config) -> None:
    """Raises UsageError unless all external parts import; `wiring` knows the estimators' names."""
    for kind, name in external_parts(config):
        check_external(name, kind)
