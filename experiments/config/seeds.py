"""Owners of seeds: a verdict is worth something on seeds alone that no constant was chosen with."""

import functools
import tomllib
from collections.abc import Iterable
from importlib import resources

USER = "user"
"""owner of all seeds that ``seeds.toml`` does not name"""


def owner_of(seed: int) -> str:
    """``development``, ``regression``, ``short``, ``verdict of edition N`` or ``user``."""
    for owner, (first, last) in _ranges().items():
        if first <= seed <= last:
            return owner
    return USER


def owners(seeds: Iterable[int]) -> str:
    """``20 seeds: 18 development, 2 user``."""
    found: dict[str, int] = {}
    for seed in dict.fromkeys(seeds):
        found[owner_of(seed)] = found.get(owner_of(seed), 0) + 1
    count = sum(found.values())
    told = ", ".join(f"{number} {owner}" for owner, number in found.items())
    return f"{count} seed{'s' * (count != 1)}: " + (next(iter(found)) if len(found) == 1 else told)


@functools.cache
def _ranges() -> dict[str, tuple[int, int]]:
    text = resources.files(__package__).joinpath("seeds.toml").read_text(encoding="utf-8")
    pairs = {owner: span.split("-") for owner, span in tomllib.loads(text).items()}
    return {owner: (int(first), int(last)) for owner, (first, last) in pairs.items()}
