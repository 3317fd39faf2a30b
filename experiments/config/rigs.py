"""Rigs: the cameras and LIDARs of a vehicle, as files of keys; a shipped one by its name.

A rig stands over profile, preset and vehicle, and below all other sources of a key.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from touchdown.experiments.config.files import read_tree
from touchdown.experiments.config.keys import base_in, flatten
from touchdown.experiments.errors import UsageError, nearest
from touchdown.landing.api import SurveyParams

_FOLDER = Path(__file__).parent / "rigs"
RIGS = tuple(sorted(file.stem for file in _FOLDER.glob("*.toml")))
_GROUPS = ("lidar", "camera", "lamp", "imu")
_DOWN = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""body from a sensor that looks straight down"""
_STEEPEST = math.cos(math.radians(60.0))
"""cosine of the incidence on level ground up to which a LIDAR maps it well"""
_PULSES = 20_000
_SHARE = 99.0
"""percentile of the pulses, that counts as the edge of a swath"""


def rig_values(values: Mapping[str, Any], lower: Mapping[str, Any]) -> dict[str, Any]:
    """The values by dotted key that the rig of ``values`` sets over ``lower``, those of profile,
    preset and vehicle. A LIDAR with a narrower swath than the default's has the legs of the survey
    nearer to one another, and more of them, at the same speed. Raises UsageError for a rig that is
    none."""
    name = base_in(values, "rig")
    if not name:
        return {}
    own = _own(name)
    lidar = {**lower, **own}
    turns = [lidar.get("lidar.mount_deg"), lidar.get("lidar.second_mount_deg")]
    swath = max(
        _swath(lidar.get("lidar.preset", "horizon"), turn)
        for turn in (turns[0] or (0.0, 0.0, 0.0), turns[1])
        if turn is not None
    )
    return {**_survey(min(swath / _swath("horizon", (0.0, 0.0, 0.0)), 1.0), lower), **own}


def _own(name: str) -> dict[str, Any]:
    file = _FOLDER / f"{name}.toml" if name in RIGS else Path(name)
    if not file.is_file():
        raise UsageError(
            f"unknown rig '{name[:80]}'{nearest(name, RIGS)}; give one of {', '.join(RIGS)} or a "
            "TOML file of keys"
        )
    found = dict(flatten(read_tree(file)))
    for key in found:
        if key.partition(".")[0] not in _GROUPS:
            raise UsageError(
                f"'{key[:80]}' in {file} is not of a rig's groups {', '.join(_GROUPS)}; leave "
                "it out"
            )
    return found


def _survey(narrower: float, lower: Mapping[str, Any]) -> dict[str, Any]:
    """Legs of a survey whose swath is ``narrower`` than the default's by a factor."""
    usual = SurveyParams()
    legs, spacing, length, seconds = (
        lower.get(f"survey.{key}", getattr(usual, key))
        for key in ("legs", "leg_spacing_m", "leg_length_m", "duration_s")
    )
    if narrower > 0.99 or legs == 1:
        return {}
    nearer = round(max(narrower, 0.25) * spacing, 1)
    more = math.ceil((legs - 1) * spacing / nearer) + 1
    way = (more * length + (more - 1) * nearer) / (legs * length + (legs - 1) * spacing)
    return {
        "survey.legs": more,
        "survey.leg_spacing_m": nearer,
        "survey.duration_s": float(math.ceil(way * seconds)),
    }


def _swath(preset: Any, turn: Any) -> float:
    """Half the width of level ground that a LIDAR under a vehicle maps, over its height."""
    from touchdown.sim.lidar.patterns import PATTERNS

    if preset not in PATTERNS or np.shape(turn) != (3,):
        return 1.0  # refused where keys are checked
    turned = Rotation.from_euler("xyz", np.asarray(turn, float), degrees=True).as_matrix() @ _DOWN
    beams = PATTERNS[preset].directions(0, _PULSES) @ turned.T
    down = beams[beams[:, 2] < -_STEEPEST]
    if not len(down):
        return 0.0
    return float(np.percentile(np.abs(down[:, 1] / down[:, 2]), _SHARE))
