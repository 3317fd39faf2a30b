"""Parts of a result: the choice of a site, and what a flight missed."""

from __future__ import annotations

from typing import Annotated

from pydantic import AliasChoices, BaseModel, ConfigDict, Field

from touchdown.experiments.io.measured import Figure

PointXY = Annotated[tuple[float, float] | None, Field(strict=False)]
"""World x and y in metres; None where the run has no such point."""

PointXYZ = Annotated[tuple[float, float, float] | None, Field(strict=False)]
"""x, y and z in metres; None where the run has no such point."""


class Part(BaseModel):
    """Part of a result. Keys of other versions and of other tools are kept as they are."""

    model_config = ConfigDict(extra="allow", frozen=True, strict=True)


class SiteTerm(Part):
    """A term of a site's value; see `landing.api.ScoreTerm`."""

    name: str
    value: Figure = None
    quantity: Figure = None
    unit: str = ""


class CandidateSite(Part):
    """A candidate site; see `landing.api.Candidate`."""

    rank: int
    position_m: PointXYZ = None
    """world frame, by the estimate of the decision's moment; None where its height is unknown"""
    accepted: bool
    rule: str
    reason: str
    value: Figure = None
    terms: list[SiteTerm] = []
    cluster_bonus: Figure = None
    c_sum: Figure = None
    slope_deg: Figure = None
    roughness_m: Figure = None
    step_m: Figure = None
    clearance_m: Figure = None
    safe_probability: Figure = None
    class_predicted: str | None = None
    class_probability: Figure = None


class EarlierDecision(Part):
    """A decision that led to no landing."""

    time_s: float
    candidates: int
    rules: dict[str, int] = {}
    """number of candidates that each rule refused"""
    why: str = ""
    given_up: str = ""
    """reason why its site was given up; empty where it had none"""


class RefusingRule(Part):
    """A rule that refused candidates of a flight."""

    rule: str
    candidates: int
    safe: int
    """of these, by the truth"""
    key: str | None = None
    """of the configuration, that decides what the rule refuses"""


class GivenUpSite(Part):
    """A site that a closer look refused."""

    time_s: float
    reason: str
    safe: bool
    """by the truth"""


class MissedGround(Part):
    """What a flight that found no site, or gave one up, refused."""

    safe_m2: Figure = None
    """area that the survey mapped and that is safe by the truth, class included"""
    rules: list[RefusingRule] = []
    """of all decisions, most candidates first"""
    given_up: list[GivenUpSite] = []

    def sentence(self) -> str:
        """Such as ``120 m2 of mapped ground were safe; refused: 9 uncertain ground (7 safe,
        landing.unknown_ground); given up: a safe site, at 10 m: ...``."""
        rules = [
            f"{one.candidates} {one.rule.replace('_', ' ')} ({one.safe} safe"
            + (f", {one.key})" if one.key else ")")
            for one in self.rules
        ]
        looks = [f"{'a safe' if one.safe else 'an unsafe'} site, {one.reason}"
                 for one in self.given_up]  # fmt: skip
        parts = [f"{self.safe_m2 or 0.0:.0f} m2 of mapped ground were safe"]
        parts += [f"refused: {', '.join(rules)}"] if rules else []
        parts += [f"given up: {'; '.join(looks)}"] if looks else []
        return "; ".join(parts)


class Choice(Part):
    """The last decision of a flight, and those before it."""

    time_s: float
    selector: str = Field(validation_alias=AliasChoices("selector", "scorer"))
    """``scorer`` in results of earlier versions"""
    why: str
    """why the first candidate won, or why there was none"""
    given_up: str = ""
    """reason why the site was given up from closer; empty where it was not"""
    candidates: list[CandidateSite] = []
    """in the order of rank"""
    earlier: list[EarlierDecision] = []
    missed: MissedGround | None = None
    """of a flight without a site, or that gave one up"""
