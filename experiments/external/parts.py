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
from touchdown.experiments.external.wrapper import Defect, ExternalPart, own, read_only
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
        when = f"at {seen.estimate.time_s:.3f} s"
        offered: RankedSites = self.part.ask("select", seen, when=when)
        if wrong := wrong_sites(offered, seen.map_view):
            raise self.part.error(Defect(wrong.rule, f"{when} select returned {wrong.reason}"))
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
        command: Command = self.part.ask("update", estimate, setpoint, when=when)
        if wrong := wrong_command(command):
            raise self.part.error(Defect(wrong.rule, f"{when} update returned {wrong.reason}"))
        checked: Command = own(command)
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
        found: GroundPrediction = self.part.ask("classify", images)
        if wrong := wrong_prediction(found, len(images), self._classes):
            raise self.part.error(Defect(wrong.rule, f"classify returned {wrong.reason}"))
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
        when = f"at {obs.time_s:.3f} s"
        view: MapView = self.part.ask("update", obs, estimate, when=when)
        if view is not self._given or self._view is None:
            if wrong := wrong_map(view):
                raise self.part.error(Defect(wrong.rule, f"{when} update returned {wrong.reason}"))
            self._given, self._view = view, read_only(view)
        return self._view


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
        setpoint: Setpoint = self.part.ask("update", obs, estimate, map_view, when=self._when)
        self._refuse(wrong_setpoint(setpoint), "update")
        checked: Setpoint = own(setpoint)
        return checked

    def view(self) -> LanderView:
        """The state of the external lander, checked."""
        view: LanderView = self.part.ask("view", when=self._when)
        self._refuse(wrong_view(view), "view")
        return view

    def _refuse(self, wrong: Defect | None, method: str) -> None:
        if wrong is not None:
            text = f"{self._when} {method} returned {wrong.reason}"
            raise self.part.error(Defect(wrong.rule, text))
