"""The schema of a campaign's TOML file."""

import math
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from touchdown.experiments.config.keys import flatten

MAX_RUNS = 100_000
"""of one campaign: its plan is one file"""


def _flat(tree: Any) -> Any:
    return dict(flatten(tree)) if isinstance(tree, dict) else tree


def unrolled(tree: Any) -> Any:
    """``tree`` with each ``{ from = a, to = b, steps = n }`` as a list of n values. Raises
    ValueError for another range."""
    if not isinstance(tree, dict):
        return tree
    if set(tree) != {"from", "to", "steps"}:
        return {key: unrolled(value) for key, value in tree.items()}
    low, high, steps = tree["from"], tree["to"], tree["steps"]
    numbers = all(isinstance(n, int | float) and math.isfinite(n) for n in (low, high))
    if not numbers or not isinstance(steps, int) or not 2 <= steps <= MAX_RUNS or low == high:
        raise ValueError("a range is { from = NUMBER, to = ANOTHER, steps = 2 or more }")
    found = [float(f"{low + (high - low) * k / (steps - 1):.6g}") for k in range(steps)]
    whole = isinstance(low, int) and all(value.is_integer() for value in found)
    return [int(value) for value in found] if whole else found


def _lists(tree: Any) -> Any:
    flat = _flat(tree)
    if not isinstance(flat, dict):
        return flat
    return {key: value if isinstance(value, list) else [value] for key, value in flat.items()}


When = Annotated[dict[str, list[Any]], BeforeValidator(_lists)]
"""wanted values by axis"""
Bounds = Annotated[dict[str, Annotated[float, Field(gt=-1e300, lt=1e300)]], BeforeValidator(_flat)]
"""by column of the results"""


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class Limits(_Strict):
    """Limits of one run; beyond them it is ended and recorded as crashed."""

    run_timeout_s: float = Field(default=1800.0, gt=0)
    """wall time"""
    memory_gb: float = Field(default=6.0, gt=0)
    """anonymous and shared memory of the worker and of what it starts"""
    retries: int = Field(default=1, ge=0)
    """more attempts at a run that crashed; an outcome, however bad, is never retried"""


class Skip(_Strict):
    """Runs that are not flown: those whose axes have one of the values in ``when``."""

    when: When


class Override(_Strict):
    """Keys for the runs whose axes have one of the values in ``when``."""

    when: When
    set: Annotated[dict[str, Any], BeforeValidator(_flat)]


class Expect(_Strict):
    """The expected results of the runs in ``when``; of all runs without it. In a `Plan` and in
    ``campaign.json``, ``when`` has the dotted keys of runs' values."""

    name: str = ""
    when: When = {}
    outcome: list[str] = Field(default_factory=list)
    """any of these; none: any outcome but a crash of the program"""
    position_error_m_max: float | None = Field(default=None, gt=0, lt=1e300)
    """largest position error up to the end of the survey"""
    at_most: Bounds = {}
    """for each run"""
    mean_at_most: Bounds = {}
    """for the mean over the runs of each scene with each method and variant"""
    mean_at_least: Bounds = {}
    """the same from below"""
    success_at_least: float | None = Field(default=None, ge=0, le=1)
    """fraction of the runs that land on safe ground, or complete the survey"""
    happened: bool | list[str] = False
    """conditions that must have happened in each run: all that it names, or these of them"""
    unsafe: bool = False
    """whether touching down on unsafe ground, or not on the legs, is as expected"""


BOUNDS = ("at_most", "mean_at_most", "mean_at_least")
"""Fields of ``Expect`` that bound columns of the results."""


class CampaignFile(_Strict):
    """The schema of a campaign's TOML file."""

    name: str = Field(min_length=1)
    mode: Literal["fly", "land"] = "fly"
    record: Literal["failures", "all", "none"] = "failures"
    """of which runs the Rerun recording is kept"""
    axes: Annotated[dict[str, Any], BeforeValidator(unrolled)]
    sweep: Annotated[dict[str, Any], BeforeValidator(unrolled)] = {}
    """values of keys, each flown alone over all of ``axes``, all else as in ``base``"""
    own_seeds: bool = False
    """whether the seeds of ``axes`` are those of the first value of ``sweep``, and the next ones
    those of the others: flights at different values share no draws"""
    base: Annotated[dict[str, Any], BeforeValidator(_flat)] = {}
    override: list[Override] = []
    skip: list[Skip] = []
    expect: list[Expect] = []
    limits: Limits = Limits()
