"""Lists of seeds as text, such as ``0-9,20``."""

from __future__ import annotations

import re
from typing import Any

from touchdown.experiments.errors import UsageError

MOST_SEEDS = 100_000


def parse_seeds(text: Any, where: str, most: int = MOST_SEEDS) -> list[int]:
    """``"0-2, 7"`` gives [0, 1, 2, 7]. ``where`` names the option or key in error messages.

    Raises UsageError for other forms and for more than ``most`` seeds.
    """
    seeds: list[int] = []
    for part in str(text).split(","):
        found = re.fullmatch(r"\s*(\d+)\s*(?:-\s*(\d+)\s*)?", part)
        if not found or not isinstance(text, str):
            raise UsageError(f"{where} {text!r} is not of the form '0-9' or '0-4,7'")
        first, last = int(found[1]), int(found[2] or found[1])
        if last < first:
            raise UsageError(f"{where} {text!r} counts down in '{part.strip()}'")
        if len(seeds) + last + 1 - first > most:
            raise UsageError(f"{where} {text!r} are more than {most}; give fewer")
        seeds += range(first, last + 1)
    return seeds
