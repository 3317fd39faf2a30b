"""Lists of seeds as text, such as ``0-9,20``."""

from __future__ import annotations

import re
from typing import Any

from touchdown.experiments.config.files import LARGEST
from touchdown.experiments.errors import UsageError

MAX_SEEDS = 100_000
_MAX_DIGITS = 40
_TOO_LARGE = f"holds a seed above {LARGEST}, the largest; give smaller ones"


def parse_seeds(text: Any, where: str, maximum: int = MAX_SEEDS) -> list[int]:
    """``"0-2, 7"`` gives [0, 1, 2, 7]. ``where`` names the option or key in error messages.

    Raises UsageError for other forms and for more than ``most`` seeds.
    """
    seeds: list[int] = []
    for part in str(text).split(","):
        found = re.fullmatch(r"\s*(\d+)\s*(?:-\s*(\d+)\s*)?", part)
        if not found or not isinstance(text, str):
            raise UsageError(f"{where} {text!r} is not of the form '0-9' or '0-4,7'")
        if max(map(len, found.groups(""))) > _MAX_DIGITS:
            raise UsageError(f"{where} {_shortened(text)!r} {_TOO_LARGE}")
        first, last = int(found[1]), int(found[2] or found[1])
        if last > LARGEST:
            raise UsageError(f"{where} {_shortened(text)!r} {_TOO_LARGE}")
        if last < first:
            raise UsageError(f"{where} {text!r} counts down in '{part.strip()}'")
        if len(seeds) + last + 1 - first > maximum:
            raise UsageError(f"{where} {text!r} are more than {maximum}; give fewer")
        seeds += range(first, last + 1)
    return seeds


def _shortened(text: str) -> str:
    return text if len(text) <= 2 * _MAX_DIGITS else f"{text[: 2 * _MAX_DIGITS]}..."
