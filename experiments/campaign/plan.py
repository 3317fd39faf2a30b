"""The plan of a campaign: a TOML file expanded to runs, each with its configuration."""

import hashlib
import itertools
import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from touchdown.experiments.api import Outcome
from touchdown.experiments.campaign.campaign_file import (
    BOUNDS,
    MAX_RUNS,
    CampaignFile,
    Expect,
    Limits,
    Override,
    Skip,
)
from touchdown.experiments.config.files import check_named_code, read_tree
from touchdown.experiments.config.keys import flatten, renewed
from touchdown.experiments.config.loading import (
    OPTION_KEYS,
    config_of,
    is_key,
    known_keys,
    parse_override,
    parse_seeds,
)
from touchdown.experiments.config.profiles import DEFAULT, PRESET_KEY
from touchdown.experiments.config.schema import Config
from touchdown.experiments.config.slots import SLOTS
from touchdown.experiments.errors import UsageError, nearest, plain_fault
from touchdown.experiments.io.results import columns
from touchdown.experiments.io.untrusted import LONGEST_NAME, is_plain_name, shown
from touchdown.scenes.api import short_name

AXES: Mapping[str, str] = {
    "scene": "scene",
    "estimator": "estimator",
    "seed": "seed",
    "wind_kmh": OPTION_KEYS["wind_kmh"],
    **{kind: slot.key for kind, slot in SLOTS.items() if kind != "estimator"},
}
"""Short names of axes and the keys that they set; any other key is an axis by its own name."""

_OWN_KEYS = {
    "scene": "an axis: [axes] scene",
    "estimator": "an axis: [axes] estimator",
    "seed": "an axis: [axes] seeds",
    "record": "set for the whole campaign: record",
    "landing.survey_only": "set for the whole campaign: mode",
}
"""Keys of a flight that a campaign sets by other means."""

SAME_FLIGHT = ("record", "sim.threads")
"""Keys that do not change a flight."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PlannedRun:
    """``values`` are the dotted keys that differ from the defaults; ``config_sha`` names the whole
    resolved configuration, recording and threads aside."""

    run_id: str
    values: Mapping[str, Any]
    config_sha: str


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan:
    """All runs in the order of flying: every scene and method of one seed before the next seed, so
    that a campaign that is stopped early has compared all of them."""

    name: str
    mode: str
    record: str
    limits: Limits
    runs: tuple[PlannedRun, ...]
    text: str
    """the file as given"""
    expect: tuple[Expect, ...] = ()
    """what runs are to come to"""


def load_plan(
    file: Path,
    *,
    allow_code: bool = False,
    preset: str | None = None,
    overrides: Sequence[str] = (),
) -> Plan:
    """Reads, checks and unrolls a campaign's TOML file. A file that lies in the directory of a
    campaign or a run names an external estimator only with ``allow_code``. ``preset`` and
    ``overrides`` (``key=value``) are of all runs, over those of the file's ``[base]``.

    Every configuration is validated here, so that a mistake shows before the first flight.
    Raises UsageError, one line.
    """
    tree = read_tree(file)
    if file.suffix != ".toml":
        raise UsageError(f"'{file}' is no TOML file; a campaign is described in FILE.toml")
    spec = _parse(tree, str(file))
    axes = _axes(spec.axes, str(file))
    if not allow_code:
        named = [(key, value) for key, values in axes.items() for value in values]
        named += [pair for tree in (spec.base, *(o.set for o in spec.override))
                  for pair in tree.items()]  # fmt: skip
        check_named_code(file, named)
    base = renewed(spec.base, f"[base] of {file}")
    _check_settable(base, axes, f"[base] of {file}")
    if preset is not None:
        _check_settable([PRESET_KEY], axes, f"--preset {preset}")
        base[PRESET_KEY] = preset
    given = renewed(dict(map(parse_override, overrides)), "--set")
    _check_settable(given, axes, "--set")
    base |= given
    changes: list[Override] = []
    for number, override in enumerate(spec.override, start=1):
        source = f"[[override]] {number} of {file}"
        changes.append(override.model_copy(update={"set": renewed(override.set, source)}))
        _check_axes(override.when, axes, source)
        _check_settable(changes[-1].set, axes, source)
    for number, skip in enumerate(spec.skip, start=1):
        _check_axes(skip.when, axes, f"[[skip]] {number} of {file}")
    _check_names(axes, str(file))
    sweep = _sweep(spec.sweep, axes, f"[sweep] of {file}")
    runs = _runs(spec, axes, sweep, base, changes, str(file))
    expect = [_expectation(entry, axes, f"[[expect]] {number} of {file}")
              for number, entry in enumerate(spec.expect, start=1)]  # fmt: skip
    return Plan(
        name=spec.name,
        mode=spec.mode,
        record=spec.record,
        limits=spec.limits,
        runs=tuple(runs),
        text=file.read_text(encoding="utf-8"),
        expect=tuple(expect),
    )


def config_for(values: Mapping[str, Any], source: str) -> Config:
    """The configuration of a run's ``values``. Raises UsageError naming ``source``."""
    values = renewed(values, source)
    return config_of(values, dict.fromkeys(values, source))


def config_sha(config: Config, but: Sequence[str] = SAME_FLIGHT) -> str:
    """Twelve hexadecimal digits that name a configuration but for some of its keys: by default
    those that do not change a flight."""
    return _sha(_values_of(config, but))


def _values_of(config: Config, but: Sequence[str]) -> dict[str, Any]:
    return {k: v for k, v in flatten(json.loads(config.model_dump_json())) if k not in but}


def _sha(values: Mapping[str, Any]) -> str:
    text = json.dumps(values, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def in_shard(run_id: str, shard: tuple[int, int]) -> bool:
    """True if a run belongs to shard (i, n), i from 1: decided by a hash of its name, so that it
    stays in its shard when the campaign grows."""
    index, count = shard
    digest = hashlib.sha256(run_id.encode()).digest()
    return int.from_bytes(digest[:8], "big") % count == index - 1


def matches(when: Mapping[str, Sequence[Any]], values: Mapping[str, Any]) -> bool:
    """True if all ``values`` that ``when`` names are among those that it wants."""
    return all(values.get(key) in wanted for key, wanted in when.items())


def runs_of_shard(plan: Plan, shard: tuple[int, int] | None) -> list[PlannedRun]:
    """The runs of a shard (i, n), all runs where it is None."""
    return [run for run in plan.runs if shard is None or in_shard(run.run_id, shard)]


def _parse(tree: Mapping[str, Any], source: str) -> CampaignFile:
    try:
        return CampaignFile.model_validate(tree)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            known = _siblings(first["loc"])
            raise UsageError(
                f"unknown key '{key}' in {source}"
                f"{nearest(str(first['loc'][-1]), known) or '; known: ' + ', '.join(known)}"
            ) from None
        if first["type"] == "missing":
            raise UsageError(f"{source} lacks '{key}'") from None
        raise UsageError(f"{key} in {source} is wrong: {plain_fault(first['msg'])}") from None


def _siblings(location: tuple[int | str, ...]) -> list[str]:
    """Fields of the table that an unknown key stands in."""
    groups: dict[Any, type[BaseModel]] = {"limits": Limits, "override": Override}
    groups |= {"skip": Skip, "expect": Expect}
    model = groups.get(location[0], CampaignFile) if len(location) > 1 else CampaignFile
    return list(model.model_fields)


def _axes(tree: Mapping[str, Any], source: str) -> dict[str, list[Any]]:
    """Values by axis, keys as in ``AXES`` or of the configuration; the seed comes first."""
    axes: dict[str, list[Any]] = {"seed": [0], "scene": [], "estimator": ["livo"]}
    given = dict(flatten(tree))
    if "seeds" in given:
        if "seed" in given:
            raise UsageError(f"[axes] of {source} has both seed and seeds; give one of them")
        given["seed"] = parse_seeds(given.pop("seeds"), f"seeds in {source}:", MAX_RUNS)
    if "scene" not in given:
        raise UsageError(f"[axes] of {source} lacks scene, such as scene = ['crossroad']")
    for key, values in given.items():
        settable = is_key(key) and key not in _OWN_KEYS
        if key not in AXES and not settable:
            hint = nearest(key, [*AXES, "seeds", *known_keys()])
            raise UsageError(f"unknown axis '{key}' in {source}{hint}")
        if not isinstance(values, list) or not values:
            raise UsageError(f"axis '{key}' in {source} must be a list of one or more values")
        axes[key] = values
    count = math.prod(map(len, axes.values()))
    if count > MAX_RUNS:
        raise UsageError(
            f"[axes] of {source} span {count} runs, more than {MAX_RUNS}; split the campaign"
        )
    for key, values in given.items():
        seen: set[Any] = set()
        for value in values:
            mark = value if not isinstance(value, list | dict) else json.dumps(value, default=str)
            if mark in seen:
                raise UsageError(f"axis '{key}' in {source} names {value} twice")
            seen.add(mark)
    for seed in axes["seed"]:
        if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
            raise UsageError(f"seed {seed!r} in {source} must be a whole number from 0 up")
    return axes


def _sweep(
    tree: Mapping[str, Any], axes: Mapping[str, list[Any]], source: str
) -> list[dict[str, Any]]:
    """What is set beside the axes, run by run; one empty change without a sweep."""
    given = dict(flatten(tree))
    _check_settable(given, axes, source)
    for key, values in given.items():
        if not is_key(key):
            raise UsageError(f"unknown key '{key}' in {source}{nearest(key, known_keys())}")
        if not isinstance(values, list) or not values:
            raise UsageError(f"'{key}' in {source} must be a list of one or more values")
    return [{key: value} for key, values in given.items() for value in values] or [{}]


def _check_axes(when: Mapping[str, list[Any]], axes: Mapping[str, list[Any]], source: str) -> None:
    for key in when:
        if key not in axes:
            hint = nearest(key, axes) or "; axes: " + ", ".join(axes)
            raise UsageError(f"unknown axis '{key}' in when of {source}{hint}")


def _expectation(entry: Expect, axes: Mapping[str, list[Any]], source: str) -> Expect:
    """``entry``, checked, with ``when`` by the keys of runs' values."""
    _check_axes(entry.when, axes, source)
    for axis, wanted in entry.when.items():
        missing = [value for value in wanted if value not in axes[axis]]
        if missing:
            raise UsageError(f"{missing[0]!r} in when of {source} is no value of the axis '{axis}'")
    for outcome in entry.outcome:
        if outcome not in list(Outcome):
            hint = nearest(outcome, list(Outcome)) or "; known: " + ", ".join(Outcome)
            raise UsageError(f"unknown outcome '{outcome}' in {source}{hint}")
    known = [*columns(), "success"]
    for name in BOUNDS:
        for key in getattr(entry, name):
            if key not in known:
                hint = nearest(key, known)
                raise UsageError(f"unknown column '{key}' in {name} of {source}{hint}")
    when = {AXES.get(axis, axis): wanted for axis, wanted in entry.when.items()}
    return entry.model_copy(update={"when": when})


def _check_settable(values: Iterable[str], axes: Iterable[str], source: str) -> None:
    taken = {AXES.get(axis, axis) for axis in axes}
    for key in values:
        if key in _OWN_KEYS:
            raise UsageError(f"'{key}' in {source} is {_OWN_KEYS[key]}")
        if key in taken:
            raise UsageError(f"'{key}' in {source} is an axis already; leave one of them out")


def _check_names(axes: Mapping[str, list[Any]], source: str) -> None:
    """Scenes and estimators exist; scene files can be loaded."""
    from touchdown.experiments.flight.wiring import check_estimator_name, check_scene_name

    for axis in ("scene", "estimator"):
        for name in axes[axis]:
            if not isinstance(name, str):
                raise UsageError(f"{axis} {name!r} in {source} must be text")
    for name in axes["estimator"]:
        check_estimator_name(name)
    for name in axes["scene"]:
        check_scene_name(name, f" in {source}")


def _runs(
    spec: CampaignFile,
    axes: Mapping[str, list[Any]],
    sweep: Sequence[Mapping[str, Any]],
    base: Mapping[str, Any],
    overrides: Sequence[Override],
    source: str,
) -> list[PlannedRun]:
    checked: dict[str, dict[str, Any]] = {}
    runs = []
    if spec.own_seeds and any("seed" in entry.when for entry in spec.expect):
        raise UsageError(
            f"[[expect]] of {source} names seeds of `axes`, and own_seeds changes them"
        )
    apart = max(axes["seed"]) - min(axes["seed"]) + 1 if spec.own_seeds else 0
    points = itertools.product(itertools.product(*axes.values()), enumerate(sweep))
    for point, (number, swept) in points:
        place = dict(zip(axes, point, strict=True))
        if any(matches(entry.when, place) for entry in spec.skip):
            continue
        values: dict[str, Any] = {"sim.threads": 1, "profile": DEFAULT, **base}
        for override in overrides:
            if matches(override.when, place):
                values |= override.set
        place["seed"] += number * apart
        values |= {AXES.get(axis, axis): value for axis, value in place.items()} | swept
        values["record"] = spec.record == "all"
        values["landing.survey_only"] = spec.mode == "fly"
        # Seeds share all the rest: it is validated once.
        rest = json.dumps({k: v for k, v in values.items() if k != "seed"}, default=str)
        if rest not in checked:
            checked[rest] = _values_of(config_for(values, source), SAME_FLIGHT)
        sha = _sha({**checked[rest], "seed": values["seed"]})
        runs.append(PlannedRun(run_id=run_name(place, axes, swept), values=values, config_sha=sha))
    if not runs:
        raise UsageError(f"[[skip]] of {source} leaves nothing to fly")
    names = Counter(run.run_id for run in runs)
    name, count = names.most_common(1)[0]
    if count > 1:
        raise UsageError(f"{count} runs of {source} would both be called '{name}'; rename a scene")
    for name in names:
        if not is_plain_name(name):
            raise UsageError(
                f"a run of {source} would be called {shown(name)}, which is no name of a directory "
                f"or longer than {LONGEST_NAME} bytes; rename the scene, or shorten the values"
            )
    return runs


_LABELS = {
    "wind_kmh": "w", "faults.events": "", "profile": "", "harsh_effects": "", "preset": "",
    "vehicle": "", "rig": "",
    "variant": "", **{name: "" for slot in SLOTS.values() for name in (slot.kind, slot.key)},
}  # fmt: skip
"""Prefixes of the values of an axis in run names, where it is not the last part of its key."""


def run_name(
    place: Mapping[str, Any], axes: Mapping[str, list[Any]], swept: Mapping[str, Any]
) -> str:
    """``crossroad-gps-s3``, then every further axis that has several values, and what is swept."""
    parts = [short_name(str(place["scene"])), str(place["estimator"]), f"s{place['seed']}"]
    for axis, value in {**place, **swept}.items():
        if axis not in ("scene", "estimator", "seed") and (axis in swept or len(axes[axis]) > 1):
            label = _LABELS.get(axis, axis.rpartition(".")[2])
            parts.append(f"{label}{_slug(value) or 'none'}")
    return "-".join(re.sub(r"[^\w.+-]+", ".", part) for part in parts)


def _slug(value: Any) -> str:
    if isinstance(value, list):
        return "_".join(_slug(item) for item in value)
    return f"{value:g}" if isinstance(value, float) else str(value).replace("*", "x")
