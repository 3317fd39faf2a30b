"""What a configuration sets beside its profile and preset, as values and as the words of a name."""

import hashlib
import json
import re
from collections.abc import Mapping
from typing import Any

from touchdown.experiments.config.keys import BASES, WITHOUT_EFFECT, flatten
from touchdown.experiments.config.loading import default_values, dump_config
from touchdown.experiments.config.profiles import DEFAULT, WHOLE, chosen_by_hand
from touchdown.experiments.config.schema import Config
from touchdown.experiments.config.slots import MODE_KEY

NAMED = ("scene", "seed", "estimator", "profile", "preset")
"""Keys that are fields of a result."""
_MOST_WORDS, _LONGEST = 3, 60
_SHOWN = 4


def settings_of(config: Config) -> dict[str, Any]:
    """The keys, in the order of the schema, that have other values than profile and preset give
    them, and these values as JSON has them; without `NAMED` and keys that change nothing of a
    flight."""
    values = dict(flatten(json.loads(dump_config(config))))
    chosen = chosen_by_hand(values, dict(default_values()))
    told = (*NAMED, *(key for key, usual in BASES.items() if chosen.get(key) == usual))
    return {k: v for k, v in chosen.items() if k not in told and not k.startswith(WITHOUT_EFFECT)}


def identity_of(config: Config) -> dict[str, Any]:
    """`NAMED` and `settings_of`: what tells one flight from another."""
    return {key: getattr(config, key) for key in NAMED} | settings_of(config)


def name_ending(config: Config, mode: str) -> str:
    """The end of a run directory's name: ``-land-short-mid360``, the mode, then preset, profile and
    settings that are not those by default. Many settings are a digest."""
    words = [mode]
    words += [config.preset] * (config.preset != WHOLE) + [config.profile] * (
        config.profile != DEFAULT
    )
    settings = settings_of(config)
    settings.pop(MODE_KEY, None)
    told = [_word(key, value) for key, value in settings.items()]
    if len(told) > _MOST_WORDS or len("-".join(told)) > _LONGEST:
        told = [hashlib.sha256(json.dumps(settings).encode()).hexdigest()[:8]]
    return "".join(f"-{word}" for word in words + told)


def _word(key: str, value: Any) -> str:
    """Text stands for itself, another value with the last part of its key."""
    items = value if isinstance(value, list) else [value]
    plain = "_".join(i if isinstance(i, str) else _number(i) for i in items)
    text = re.sub(r"[^\w.+@*-]+", ".", plain).strip(".")
    is_text = text and all(isinstance(item, str) for item in items)
    return text if is_text else f"{key.rpartition('.')[2]}={text or 'none'}"


def _number(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else json.dumps(value)


def difference_text(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    """The first keys whose values differ, with both values, and the number of all others:
    ``survey.legs (3, now 5), light (day, now night)``; "" where all are equal."""
    apart = [key for key in {**old, **new} if old.get(key) != new.get(key)]
    texts = [f"{key} ({_shown(old, key)}, now {_shown(new, key)})" for key in apart[:_SHOWN]]
    return ", ".join(texts) + (f" and {len(apart) - _SHOWN} more" if apart[_SHOWN:] else "")


def _shown(values: Mapping[str, Any], key: str) -> str:
    value = values.get(key, "not set")
    return (value if isinstance(value, str) else json.dumps(value))[:60]
