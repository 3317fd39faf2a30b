"""Scenes and vehicle as PyMJCF models: ``touchdown.pymjcf.scene("crossroad")``.

Needs dm_control, which the project brings on Python 3.11 and 3.12.
"""

import tempfile
from pathlib import Path
from typing import Any

import mujoco

from touchdown.experiments.errors import require_dm_control, usage_errors
from touchdown.scenes.compose import VEHICLE_XML, bare_spec
from touchdown.scenes.export import export_spec

require_dm_control("touchdown.pymjcf")

from dm_control import composer, mjcf  # noqa: E402


def scene(name: str, seed: int = 0) -> mjcf.RootElement:
    """Returns a scene without the vehicle, with its textures, height fields and meshes in memory.

    name: a scene's name or the path of an MJCF file. seed: of the layout, from 0. Lengths are
    metres, z is up; the site ``takeoff`` lies at height 0. Time step and air are those of a flight.
    Raises UsageError for a name or a file that cannot be read.
    """
    root = _read(usage_errors(lambda: bare_spec(name, seed)))
    root.model = Path(name).stem
    return root


class SceneArena(composer.Arena):  # type: ignore[misc]
    """A scene as a Composer arena, to which entities are attached; takes the arguments of
    `scene`."""

    def _build(self, name: str, seed: int = 0) -> None:
        self._mjcf_root = scene(name, seed)


def vehicle() -> mjcf.RootElement:
    """Returns the quadrotor. Attached to a scene, its body is ``vehicle/quadrotor``, as in a
    flight; the frame that ``attach`` returns needs a free joint. Its rotors are no actuators:
    a flight pushes the body (`sim.airframe.rotors`)."""
    root = _read(mujoco.MjSpec.from_file(str(VEHICLE_XML)))
    root.model = "vehicle"
    return root


def _read(spec: Any) -> mjcf.RootElement:
    """As MuJoCo writes it: angles in radians, as in Composer's own models."""
    with tempfile.TemporaryDirectory(prefix="touchdown-") as folder:
        return mjcf.from_path(str(export_spec(spec, Path(folder) / "scene")))
