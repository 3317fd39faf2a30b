"""The sets of flights that README and the results pages print, and their plans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from touchdown.experiments.campaign.plan import Plan, load_plan
from touchdown.experiments.errors import UsageError, nearest

ROOT = Path(__file__).resolve().parents[2]
"""the source tree with its plans and pages"""
DEFAULT_PROFILE = "field"


@dataclass(frozen=True, slots=True)
class FlightSet:
    """Flights of one profile; ``file``: their campaign, relative to the source tree."""

    name: str
    profile: str
    file: str

    @property
    def key(self) -> str:
        """``field/landings``: directory below ``--out``, and name in the file of results."""
        return f"{self.profile}/{self.name}"

    @property
    def command(self) -> str:
        """The command that flies the sets of its profile."""
        profile = "" if self.profile == DEFAULT_PROFILE else f" PROFILE={self.profile}"
        return f"make results{profile}"

    def plan(self, root: Path = ROOT) -> Plan:
        """The runs of the campaign in this profile. Raises UsageError without a source tree."""
        file = root / self.file
        if not file.is_file():
            raise UsageError(
                f"'{file}' does not exist: the flights of the results pages are planned in the "
                "source tree of Touchdown; call the command of a git checkout"
            )
        plan = load_plan(file)
        runs = [run for run in plan.runs if run.values.get("profile") == self.profile]
        return replace(plan, runs=tuple(runs))


SETS = (
    FlightSet("landings", "field", "configs/results_landings.toml"),
    FlightSet("positioning", "field", "configs/results_positioning.toml"),
    FlightSet("blind", "field", "configs/field_blind.toml"),
    FlightSet("short", "field", "configs/results_short.toml"),
    FlightSet("landings", "ideal", "configs/results_landings.toml"),
    FlightSet("positioning", "ideal", "configs/results_positioning.toml"),
)


def chosen(profile: str, only: Sequence[str] = ()) -> list[FlightSet]:
    """The sets of a profile; those called ``only`` where any are named. Raises UsageError for an
    unknown name."""
    of_profile = [found for found in SETS if found.profile == profile]
    names = [found.name for found in of_profile]
    for name in only:
        if name not in names:
            raise UsageError(
                f"--only {name}: no set of profile '{profile}'{nearest(name, names)}; "
                f"known: {', '.join(names)}"
            )
    return [found for found in of_profile if not only or found.name in only]
