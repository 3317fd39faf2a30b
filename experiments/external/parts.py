"""External parts in flight: each is asked as the shipped one is, and its answers are checked.

Errors are those of `touchdown.experiments.external.wrapper.ExternalPart`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.controller.api import ControllerRig, Setpoint
from touchdown.estimator.api import Estimate, MapperRig, MapView
from touchdown.experiments.external.loading import imported_code
from touchdown.experiments.external.part_checks import (
    lacks,
    wrong_classifier,
    wrong_command,
    wrong_lander,
    wrong_map,
    wrong_mapper,
    wrong_prediction,
    wrong_setpoint,
    wrong_sites,
    wrong_view,
)
from touchdown.experiments.external.wrapper import ExternalPart, own, read_only
from touchdown.landing.api import (
    ClassifierRig,
    GroundPrediction,
    LanderRig,
    LanderView,
    RankedSites,
    Selection,
    SelectorInput,
    SelectorRig,
)
from touchdown.landing.selection.offered import selection_of
from touchdown.sim.api import Command, Observation, SensorNeeds


class ExternalSelector:
    """Asks a selector for sites and makes candidates of them."""

    def __init__(self, name: str, params: Mapping[str, Any], rig: SelectorRig) -> None:
        self.part = ExternalPart("selector", name, params, rig, lambda part: lacks(part, "select"))
        self._rig = rig

    def offer(self, seen: SelectorInput) -> RankedSites:
        """The sites that it offers, checked."""
        offered: RankedSites = self.part.ask(
            "select", seen, when=f"at {seen.estimate.time_s:.3f} s",
            wrong=lambda offered: wrong_sites(offered, seen.map_view),
        )  # fmt: skip
        return offered

    def select(self, seen: SelectorInput) -> Selection:
        """The selection that these sites make."""
        return selection_of(own(self.offer(seen)), seen, self._rig.landing)


class ExternalController:
    """Asks a controller for rotor speeds."""

    def __init__(self, name: str, params: Mapping[str, Any], rig: ControllerRig) -> None:
        self.part = ExternalPart("controller", name, params, rig, lambda p: lacks(p, "update"))

    def update(self, estimate: Estimate, setpoint: Setpoint) -> Command:
        """The command of the external controller, checked."""
        when = f"at {estimate.time_s:.3f} s"
        checked: Command = own(
            self.part.ask("update", estimate, setpoint, when=when, wrong=wrong_command)
        )
        return checked


class ExternalClassifier:
    """Asks a ground classifier for the classes of images."""

    def __init__(self, name: str, params: Mapping[str, Any], rig: ClassifierRig) -> None:
        self.part = ExternalPart("classifier", name, params, rig, wrong_classifier)
        self.image_size = int(self.part.inner.image_size)
        self.min_probability = float(self.part.inner.min_probability)
        self._classes = len(rig.classes)

    def classify(self, images: NDArray[np.uint8]) -> GroundPrediction:
        """The predictions of the external classifier, checked."""
        found: GroundPrediction = self.part.ask(
            "classify", images,
            wrong=lambda found: wrong_prediction(found, len(images), self._classes),
        )  # fmt: skip
        table = np.array(found.probabilities, np.float64)
        table /= table.sum(axis=1, keepdims=True)
        return GroundPrediction(probabilities=table, in_distribution=found.in_distribution)

    def description(self) -> dict[str, Any]:
        """Name, image size, hash of the code and limit, for a result."""
        return {
            "network": self.part.name,
            "image_size": self.image_size,
            "sha256": imported_code(self.part.name),
            "min_probability": self.min_probability,
        }


class ExternalMapper:
    """Asks a mapper for the map."""

    def __init__(self, name: str, params: Mapping[str, Any], rig: MapperRig) -> None:
        self.part = ExternalPart(
            "mapper", name, params, rig, lambda part: wrong_mapper(part, rig.sensors)
        )
        self.needs: SensorNeeds = self.part.inner.needs
        self._given: MapView | None = None
        self._view: MapView | None = None

    def update(self, obs: Observation, estimate: Estimate) -> MapView:
        """The map of the external mapper, checked whenever it is another one."""
        view: MapView = self.part.ask(
            "update", obs, estimate, when=f"at {obs.time_s:.3f} s",
            wrong=lambda view: None if self._is_known(view) else wrong_map(view),
        )  # fmt: skip
        if not self._is_known(view):
            self._given, self._view = view, read_only(view)
        assert self._view is not None
        return self._view

    def _is_known(self, view: Any) -> bool:
        return self._view is not None and view is self._given


class ExternalLander:
    """Asks a lander for setpoints."""

    def __init__(self, name: str, params: Mapping[str, Any], rig: LanderRig) -> None:
        self.part = ExternalPart(
            "lander", name, params, rig, lambda part: wrong_lander(part, rig.sensors)
        )
        self.needs: SensorNeeds = self.part.inner.needs
        self._when = "at first"

    def update(self, obs: Observation, estimate: Estimate, map_view: MapView) -> Setpoint:
        """The setpoint of the external lander, checked."""
        self._when = f"at {obs.time_s:.3f} s"
        checked: Setpoint = own(
            self.part.ask(
                "update", obs, estimate, map_view, when=self._when, wrong=wrong_setpoint
            )
        )  # fmt: skip
        return checked

    def view(self) -> LanderView:
        """The state of the external lander, checked."""
        view: LanderView = self.part.ask("view", when=self._when, wrong=wrong_view)
        return view


PARTS = {
    "selector": ExternalSelector,
    "controller": ExternalController,
    "classifier": ExternalClassifier,
    "mapper": ExternalMapper,
    "lander": ExternalLander,
}
"""by slot; an estimator is an `ExternalEstimator`"""
