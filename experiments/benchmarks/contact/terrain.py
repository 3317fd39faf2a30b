"""Ground of the touchdown bench: a slope, or level ground with a step or rocks under the legs."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import mujoco
import numpy as np

from touchdown.scenes.api import VEHICLE_BODY, Scene, Surface
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.compose import VEHICLE_XML, compile_scene, prepare_spec
from touchdown.sim.airframe.vehicle import foot_positions
from touchdown.sim.frames import rotation_from_yaw
from touchdown.sim.typing import Array

_HALF_M = 30.0
"""half the width of the ground: nothing slides farther before its trial ends"""
_THICK_M = 1.0
_PAD_XY_M = np.array([-80.0, 0.0])
"""where the vehicle stands before it is lifted over the target"""
_EDGE_M = 0.03
"""least horizontal distance of a step's edge from a foot, twice the radius of one"""
_ROCK_OFFSET = 0.5
"""largest distance of a rock's top from the foot, over its height"""
_GROUND = Surface(land_class="field", reflectivity=0.3)


@dataclass(frozen=True, slots=True)
class Terrain:
    """``slope``: an inclined plane; ``step``: a ledge that some legs come down on; ``rock``: half
    spheres under some legs. The target is at the origin, where the undisturbed ground has height
    0."""

    kind: str
    legs: int
    """number of legs on the step or on rocks; 0 for a slope"""
    size: float
    """degrees, or height in metres"""

    @property
    def name(self) -> str:
        """Such as ``step under 2 legs``."""
        plural = "s" * (self.legs > 1)
        return f"{self.kind} under {self.legs} leg{plural}" if self.legs else self.kind


@cache
def bare_vehicle() -> Any:
    """MuJoCo's model of the vehicle alone, names without a prefix."""
    return mujoco.MjSpec.from_file(str(VEHICLE_XML)).compile()


def feet_xy() -> Array:
    """(F, 2) m: the feet of the vehicle, body frame."""
    return foot_positions(bare_vehicle(), prefix="")[:, :2]


def terrain_scene(terrain: Terrain, friction: float | None, rng: np.random.Generator) -> Scene:
    """The scene of one contact, with the heading of the vehicle along x. ``rng`` draws the azimuth,
    the legs and the place under them. ``friction``: of the feet, in place of the vehicle's own; its
    other parts have theirs in proportion."""
    spec = mujoco.MjSpec()
    _box(spec, "pad", _PAD_XY_M, 0.0)
    _DRAWN[terrain.kind](spec, terrain, rng)
    draft = SceneDraft(
        spec=spec,
        takeoff_xy_m=_PAD_XY_M,
        takeoff_yaw=0.0,
        bounds_xy_m=np.array([[-110.0, -30.0], [30.0, 30.0]]),
        surfaces={geom.name: _GROUND for geom in spec.geoms},
        ground=None,
    )
    prepare_spec(draft)
    scene = compile_scene(spec, draft, "touchdown", 0, "touchdown")
    if friction is not None:
        set_friction(scene.model, friction)
    return scene


def set_friction(model: Any, friction: float) -> None:
    """Gives the feet of the vehicle in ``model`` this coefficient of sliding friction. The
    vehicle's holds whatever the ground's is: its geoms have the higher priority."""
    own = model.body_rootid[model.geom_bodyid] == model.body(VEHICLE_BODY).id
    feet = model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE
    model.geom_friction[own, 0] *= friction / model.geom_friction[own & feet, 0].max()


def _box(
    spec: Any, name: str, middle_xy: Array, top_m: float, azimuth: float = 0.0, tilt: float = 0.0
) -> None:
    """A block of which the middle of the top lies at ``middle_xy`` and ``top_m``; it rises by
    ``tilt`` (rad) towards ``azimuth`` (rad)."""
    up = rotation_from_yaw(azimuth)
    lean = np.array([[np.cos(tilt), 0.0, -np.sin(tilt)], [0.0, 1.0, 0.0],
                     [np.sin(tilt), 0.0, np.cos(tilt)]])  # fmt: skip
    rotation = up @ lean
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, rotation.ravel())
    half = np.array([_HALF_M, _HALF_M, 0.5 * _THICK_M])
    top = np.array([*middle_xy, top_m])
    spec.worldbody.add_geom(
        name=f"ground_{name}", type=mujoco.mjtGeom.mjGEOM_BOX, size=half, quat=quat,
        pos=top - rotation[:, 2] * half[2],
    )  # fmt: skip


def _slope(spec: Any, terrain: Terrain, rng: np.random.Generator) -> None:
    azimuth = rng.uniform(-np.pi, np.pi)
    _box(spec, "slope", np.zeros(2), 0.0, azimuth, np.radians(terrain.size))


def _step(spec: Any, terrain: Terrain, rng: np.random.Generator) -> None:
    _box(spec, "level", np.zeros(2), 0.0)
    while True:
        azimuth = rng.uniform(-np.pi, np.pi)
        across = np.array([np.cos(azimuth), np.sin(azimuth)])
        along = np.sort(feet_xy() @ across)[::-1]
        high, low = along[terrain.legs - 1] - _EDGE_M, along[terrain.legs] + _EDGE_M
        if high > low:
            break
    middle = (rng.uniform(low, high) + _HALF_M) * across
    _box(spec, "step", middle, terrain.size, azimuth)


def _rock(spec: Any, terrain: Terrain, rng: np.random.Generator) -> None:
    _box(spec, "level", np.zeros(2), 0.0)
    feet = feet_xy()
    first = int(rng.integers(len(feet)))
    for foot in feet[(first + np.arange(terrain.legs)) % len(feet)]:
        away = terrain.size * _ROCK_OFFSET * np.sqrt(rng.uniform())
        azimuth = rng.uniform(-np.pi, np.pi)
        top = foot + away * np.array([np.cos(azimuth), np.sin(azimuth)])
        spec.worldbody.add_geom(
            name=f"ground_rock_{len(spec.geoms)}", type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[max(terrain.size, 1e-3), 0.0, 0.0], pos=[*top, 0.0],
        )  # fmt: skip


_DRAWN = {"slope": _slope, "step": _step, "rock": _rock}
