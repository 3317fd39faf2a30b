"""The configuration keys that tell the runs of one directory apart."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from touchdown.experiments.config.files import read_tree
from touchdown.experiments.config.keys import flatten
from touchdown.experiments.errors import UsageError

UNTOLD = ("scene", "seed", "estimator", "record", "log.", "sim.threads")
"""Keys, or their beginnings, that every result has, too, or that change nothing of a flight."""


def settings_apart(runs: Sequence[Path]) -> list[dict[str, Any]]:
    """The keys of ``config.json`` in which some of the run directories differ, and their values in
    each; None for a key that a run's file lacks. A run without a readable file has no settings.
    """
    values = [_values(run / "config.json") for run in runs]
    known = [one for one in values if one]
    keys = {key: None for one in known for key in one if not key.startswith(UNTOLD)}
    apart = [key for key in keys if len({json.dumps(one.get(key)) for one in known}) > 1]
    return [{key: one.get(key) for key in apart} if one else {} for one in values]


def _values(file: Path) -> dict[str, Any]:
    try:
        return dict(flatten(read_tree(file)))
    except UsageError:
        return {}
