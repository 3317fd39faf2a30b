"""Profiles and presets: named sets of keys, in files of the form of a user's configuration.

A profile says how kind the simulated world is: ``ideal`` is the defaults of the schema; ``field``,
which is flown where nothing else is named, and ``harsh`` are files. A preset says how much is
flown: ``whole`` is what profile and defaults say, ``short`` a file. A preset takes precedence over
the profile, any other source of a key over both.
"""

import fnmatch
import functools
import tomllib
from collections.abc import Mapping
from importlib import resources
from typing import Any

from touchdown.experiments.config.keys import BASES, base_in, flatten
from touchdown.experiments.config.rigs import rig_values
from touchdown.experiments.config.vehicles import vehicle_values
from touchdown.experiments.errors import UsageError, nearest

KEY = "profile"
"""The key that names the profile."""
DEFAULT = BASES[KEY]
"""The profile of a flight that names none."""
BEFORE_PROFILES = "ideal"
"""The profile of files that the program wrote before there were profiles."""
_LAYERS: Mapping[str, tuple[str, ...]] = {
    "ideal": (),
    "field": ("field",),
    "harsh": ("field", "harsh"),
}
"""Files of each profile, later ones over earlier ones."""
_ASSUMED = ("livo.", "zou2024.", "flown_imu.", "calibration_prior.", "stereo_vo.")
"""Keys of a profile that say what estimators assume."""
PROFILES = tuple(_LAYERS)
PRESET_KEY = "preset"
"""The key that names the preset."""
WHOLE = BASES[PRESET_KEY]
"""The preset of a flight that names none; it sets nothing."""
PRESETS = (WHOLE, "short", "park")


@functools.cache
def profile_values(name: str) -> Mapping[str, Any]:
    """The values by dotted key of the profile ``name``; none for a name that is no profile."""
    values: dict[str, Any] = {}
    for layer in _LAYERS.get(name, ()):
        values |= flatten(_table("profiles", layer))
    return values


def _table(folder: str, name: str) -> dict[str, Any]:
    file = resources.files(__package__).joinpath(folder, f"{name}.toml")
    return tomllib.loads(file.read_text(encoding="utf-8"))


@functools.cache
def effects() -> Mapping[str, Mapping[str, Any]]:
    """The groups of keys of the world that `harsh` changes, by the name of the effect, with the
    values of `harsh`. Raises ValueError for a pattern without a key, and a key in no group."""
    values = flatten(_table("profiles", "harsh"))
    groups: dict[str, dict[str, Any]] = {}
    left = {key: value for key, value in values if not key.startswith(_ASSUMED)}
    for name, patterns in _table("profiles", "effects").items():
        groups[name] = {}
        for pattern in patterns:
            found = fnmatch.filter(left, pattern)
            if not found:
                raise ValueError(f"effect {name}: no key left for '{pattern}'")
            groups[name] |= {key: left.pop(key) for key in found}
    if left:
        raise ValueError(f"no effect has {', '.join(left)}")
    return groups


def effect_values(names: Any) -> dict[str, Any]:
    """The values by dotted key of effects at the level of `harsh`. Raises UsageError for a name
    that is none."""
    values: dict[str, Any] = {}
    for name in names if isinstance(names, list | tuple) else ():
        if name not in effects():
            raise UsageError(
                f"harsh_effects: unknown effect '{str(name)[:40]}'{nearest(str(name), effects())}; "
                f"known: {', '.join(effects())}"
            )
        values |= effects()[name]
    return values


@functools.cache
def preset_values(name: str) -> Mapping[str, Any]:
    """The values by dotted key of the preset ``name``; none for a name that is no preset."""
    if name == WHOLE or name not in PRESETS:
        return {}
    return dict(flatten(_table("presets", name)))


def base_values(values: Mapping[str, Any]) -> dict[str, Any]:
    """The values that profile, effects, preset, scene, vehicle and rig of ``values`` set. Raises
    UsageError for a vehicle that cannot fly, and a rig that is none."""
    lower = {
        **profile_values(base_in(values, KEY)),
        **effect_values(values.get("harsh_effects")),
        **preset_values(base_in(values, PRESET_KEY)),
    }
    lower |= scene_values(values)
    lower |= vehicle_values(values, lower)
    return {**lower, **rig_values(values, lower)}


def base_sources(values: Mapping[str, Any]) -> dict[str, str]:
    """The source of each of the `base_values`, for error messages."""
    profile, preset, vehicle, rig = (base_in(values, key) for key in BASES)
    return {
        **dict.fromkeys(base_values(values), f"profile {profile}"),
        **dict.fromkeys(preset_values(preset), f"preset {preset}"),
        **dict.fromkeys(scene_values(values), "scene deck"),
        **dict.fromkeys(vehicle_values(values, {}), f"vehicle {vehicle}"),
        **dict.fromkeys(rig_values(values, {}), f"rig {rig}"),
    }


_DECK: Mapping[str, Any] = {
    "landing.moving_site": True,
    "landing.classifier": "off",
    "survey.height_m": 26.0,
    "survey.legs": 1,
    "survey.leg_length_m": 15.0,
    "survey.duration_s": 8.0,
    "referee.divergence_m": 1000.0,
}
"""keys of the scene ``deck``: all of a deck is in view where it comes by, and the position may
drift"""


def scene_values(values: Mapping[str, Any]) -> Mapping[str, Any]:
    """The values that the scene of ``values`` sets over those of profile and preset."""
    if values.get("scene") != "deck":
        return {}
    return {**_DECK, "landing.deck_tag_m": values.get("deck.tag_m", 0.0)}


def chosen_by_hand(values: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """``values`` of a whole configuration without those that its own profile and preset set.

    A ``config.json`` holds every key. Where a command names another profile or preset, only what
    departs from those of the file was chosen by its author and stays. ``defaults`` are those of all
    keys.
    """
    own = {**defaults, **base_values(values)}
    return {k: v for k, v in values.items() if k in BASES or k not in own or own[k] != v}
