"""The key that somebody means who gives one that there is not: by its words, then by spelling."""

import difflib
import functools
import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping

from touchdown.experiments.config.ranges import UNITS, types_of_keys
from touchdown.experiments.config.reference import meaning_of

_TYPING_ERROR = 0.85
"""similarity above which two keys differ by slips of the fingers"""
_SAME_WORD = 0.8
_OF_MEANING = 0.5
"""weight of a word in the text of a key, beside 1 in the key itself"""
_ENOUGH = 0.5
_UNIT_WORDS = {end.strip("_") for end in UNITS}
_FILLERS = {"a", "and", "at", "by", "for", "from", "in", "is", "of", "on", "or", "the", "to"}
_ALIKE: Mapping[str, frozenset[str]] = {
    "altitude": frozenset({"height"}),
    "fps": frozenset({"hz"}),
    "frequency": frozenset({"hz"}),
    **dict.fromkeys(("attitude", "pitch", "roll", "tilt", "yaw"), frozenset({"mount"})),
    "noise": frozenset({"density", "sigma"}),
    "rate": frozenset({"hz"}),
    "resolution": frozenset({"width"}),
    "speed": frozenset({"kmh", "mps"}),
    "velocity": frozenset({"kmh", "mps", "speed"}),
}
"""words of keys that say what another word asks for"""


def suggestion(key: str, keys: Iterable[str]) -> str:
    """The hint `` (did you mean 'x'?)`` for a key that is unknown; "" where nothing is near.
    ``keys``: those that there are."""
    known = list(keys)
    if found := difflib.get_close_matches(key, known, n=1, cutoff=_TYPING_ERROR):
        return f" (did you mean '{found[0]}'?)"
    asked = _words(key)
    scores = {known_key: _score(asked, known_key) for known_key in known}
    best = max(known, key=lambda k: (scores[k], difflib.SequenceMatcher(None, key, k).ratio()))
    return f" (did you mean '{best}'?)" if scores[best] >= _ENOUGH else ""


def _words(text: str) -> list[str]:
    return [word for word in re.split(r"[\W_]+", text.lower()) if word and word not in _FILLERS]


@functools.cache
def _vocabulary() -> tuple[Mapping[str, tuple[frozenset[str], frozenset[str]]], Mapping[str, int]]:
    """The words of each key and of its meaning, and the number of keys that have a word."""
    keys = {key: (frozenset(_words(key)), frozenset(_words(meaning_of(key))))
            for key in types_of_keys()}  # fmt: skip
    return keys, Counter(word for own, told in keys.values() for word in own | told)


def _score(asked: list[str], key: str) -> float:
    """The fraction of the asked words that a key and its meaning have; rare ones weigh more, the
    first of several, a group, twice, and those of units little."""
    keys, counts = _vocabulary()
    own, told = keys.get(key, (frozenset(_words(key)), frozenset[str]()))
    found = total = 0.0
    for number, word in enumerate(asked):
        weight = math.log(1.0 + len(keys) / (1.0 + counts[word]))
        weight *= 0.2 if word in _UNIT_WORDS else 2.0 if number == 0 < len(asked) - 1 else 1.0
        wanted = _ALIKE.get(word, frozenset()) | {word}
        if not counts[word]:  # a slip
            wanted |= {*difflib.get_close_matches(word, own, n=1, cutoff=_SAME_WORD)}
        total += weight
        found += weight * (1.0 if own & wanted else _OF_MEANING * bool(told & wanted))
    return found / (total or 1.0)
