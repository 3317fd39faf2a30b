"""External parts in flight: each is asked as the shipped one is, and its answers are checked.

Errors are those of `touchdown.experiments.external.wrapper.ExternalPart`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from touchdown.controller.api import ControllerRig, Setpoint
from touchdown.estimator.api import Estimate
from touchdown.experiments.external.part_checks import lacks, wrong_command, wrong_sites
from touchdown.experiments.external.wrapper import Defect, ExternalPart, own
from touchdown.landing.api import RankedSites, Selection, SelectorInput, SelectorRig
from touchdown.landing.selection.offered import selection_of
from touchdown.sim.api import Command


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
