"""What fills the slots of a flight from outside, and the rigs that it is built with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from touchdown.controller.api import ControllerRig
from touchdown.estimator.api import Estimate, Estimator, MapperRig
from touchdown.experiments.config.schema import Config
from touchdown.experiments.config.slots import external_parts, params_of
from touchdown.landing.api import (
    ClassifierRig,
    GroundClassifier,
    LanderRig,
    Selection,
    SelectorInput,
    SelectorRig,
    Watch,
    WatchRig,
)
from touchdown.landing.selection.selector import select_sites
from touchdown.scenes.api import LAND_CLASSES
from touchdown.sim.api import Observation, SensorRig

if TYPE_CHECKING:
    from touchdown.experiments.external.wrapper import ExternalPart


class Overheard:
    """An estimator whose observations a controller gets as well, before it is asked."""

    def __init__(self, inner: Estimator, hear: Callable[[Observation], object]) -> None:
        self._inner, self._hear = inner, hear
        self.needs = inner.needs

    def update(self, obs: Observation) -> Estimate:
        """The estimate of the estimator."""
        self._hear(obs)
        return self._inner.update(obs)


def lander_rig(
    config: Config,
    sensors: SensorRig,
    select: Callable[[SelectorInput], Selection] | None,
    classifier: GroundClassifier | None,
    watch: Watch | None,
) -> LanderRig:
    """The rig of a lander; without ``select`` with the shipped selector."""
    shipped = partial(select_sites, rig=RIGS["selector"](config, sensors))
    return LanderRig(
        sensors=sensors,
        landing=config.landing,
        survey=config.survey,
        select=select or shipped,
        classifier=classifier,
        watch=watch,
    )


RIGS: Mapping[str, Callable[[Config, SensorRig], Any]] = {
    "estimator": lambda _config, sensors: sensors,
    "selector": lambda config, sensors: SelectorRig(
        vehicle=sensors.vehicle, landing=config.landing
    ),
    "controller": lambda config, sensors: ControllerRig(
        vehicle=sensors.vehicle, control_hz=config.control.control_hz, control=config.control
    ),
    "classifier": lambda config, _sensors: ClassifierRig(
        classes=LAND_CLASSES, patch_m=config.landing.classifier_patch_m, landing=config.landing
    ),
    "mapper": lambda config, sensors: MapperRig(sensors=sensors, mapper=config.mapper),
    "lander": lambda config, sensors: lander_rig(config, sensors, None, None, None),
    "watch": lambda config, sensors: WatchRig(sensors=sensors, landing=config.landing),
}
"""What a part of each kind is built with, from the configuration and the rig as the estimator knows
it."""


def external_name(config: Config, kind: str) -> str | None:
    """MODULE:FUNCTION that fills a slot; None where a shipped part does, or where the part would
    have nothing to do: selector, classifier and watch in a survey alone, a classifier without the
    gate ``class``, a mapper where no map is wanted."""
    landing = config.landing
    idle = {
        "selector": landing.survey_only,
        "watch": landing.survey_only,
        "classifier": landing.survey_only or "class" not in landing.chosen_selector.gates,
        "mapper": not config.mapper.enabled,
    }
    return None if idle.get(kind) else dict(external_parts(config)).get(kind)


def external_part(
    config: Config,
    kind: str,
    sensors: SensorRig,
    rig: Any = None,
) -> Any:
    """The part from outside in a slot, built with ``rig`` or else with that of `RIGS`; None where
    `external_name` is."""
    name = external_name(config, kind)
    if name is None:
        return None
    from touchdown.experiments.external.wrapper import PARTS

    return PARTS[kind](name, params_of(config, kind), rig or RIGS[kind](config, sensors))


def external_of(*built: Any) -> tuple[ExternalPart, ...]:
    """The external parts among ``built``."""
    return tuple(one.part for one in built if hasattr(one, "part"))


def check_parts_available(config: Config) -> None:
    """Raises UsageError unless all external parts import; `wiring` knows the estimators' names."""
    for kind, name in external_parts(config):
        from touchdown.experiments.external.loading import check_external

        check_external(name, kind)
