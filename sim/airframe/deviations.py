"""The true vehicle: deviations from the nominal model, and the telemetry of its rotors."""

import copy
import ctypes
import mmap
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from zlib import crc32

import mujoco
import numpy as np

from touchdown.sim.airframe.vehicle import vehicle_body_id
from touchdown.sim.api import VehicleErrorParams
from touchdown.sim.typing import Array

_DRAWN = 64
_SHOWN_GROUP = 2


@dataclass(frozen=True, kw_only=True, slots=True)
class Deviations:
    """Drawn once a flight; see ``VehicleErrorParams``."""

    mass: float = 1.0
    """true over nominal"""
    center_of_mass_m: Array
    """(3,) body axes, from the body origin"""
    thrust: Array
    """(R,) true over nominal coefficient of each rotor"""
    torque: Array
    """(R,)"""
    drag: float = 1.0
    """of the rotors in their plane, true over nominal"""

    @property
    def of_the_body(self) -> bool:
        """True if mass or centre of mass deviate."""
        return self.mass != 1.0 or bool(self.center_of_mass_m.any())

    def sizes(self) -> dict[str, float]:
        """Absolute deviations: relative of the mass, metres of the centre of mass, relative of the
        rotor that differs most from the mean of all."""
        single = self.thrust / self.thrust.mean() - 1.0
        return {
            "mass_fraction": abs(self.mass - 1.0),
            "center_of_mass_m": float(np.linalg.norm(self.center_of_mass_m)),
            "rotor_fraction": float(np.abs(single).max()),
        }


def nominal(rotors: int = 4) -> Deviations:
    """No deviation of a vehicle with so many rotors."""
    return Deviations(center_of_mass_m=np.zeros(3), thrust=np.ones(rotors), torque=np.ones(rotors))


def draw_deviations(params: VehicleErrorParams, seed: int, rotors: int = 4) -> Deviations:
    """The deviations of one flight of a vehicle with so many rotors. Each quantity has a stream
    of its own, so that a bound of 0 leaves the draws of the others alone."""
    single = params.rotor_fraction * _uniform(seed, b"rotors", rotors)
    drag = 1.0 + params.drag_fraction * _uniform(seed, b"drag", 1).item()
    return Deviations(
        mass=1.0 + params.mass_fraction * _uniform(seed, b"mass", 1).item(),
        center_of_mass_m=params.center_of_mass_m * _uniform(seed, b"center of mass", 3),
        thrust=(1.0 + params.thrust_fraction * _uniform(seed, b"thrust", 1)) * (1.0 + single),
        torque=(1.0 + params.torque_fraction * _uniform(seed, b"torque", 1)) * (1.0 + single),
        drag=drag,
    )


def _uniform(seed: int, name: bytes, count: int) -> Array:
    return np.random.default_rng([seed, crc32(b"vehicle error " + name)]).uniform(-1.0, 1.0, count)


def true_model(model: Any, deviations: Deviations, drawn: bool = False) -> Any:
    """MuJoCo's model of the scene with the true vehicle: a copy, or ``model`` itself where the body
    does not deviate. The inertia grows with the mass; its axes pass through the centre of mass. The
    copy's textures are undefined: it moves, and is not drawn. ``drawn``: always a copy, with its
    textures and with the vehicle in a geom group that MuJoCo's viewers show."""
    if not (deviations.of_the_body or drawn):
        return model
    true = copy.copy(model)
    body = vehicle_body_id(true)
    if drawn:
        true.geom_group[true.body_rootid[true.geom_bodyid] == body] = _SHOWN_GROUP
    else:
        give_back_textures(true)
    true.body_mass[body] *= deviations.mass
    true.body_inertia[body] *= deviations.mass
    true.body_ipos[body] += deviations.center_of_mass_m
    mujoco.mj_setConst(true, mujoco.MjData(true))
    return true


class SpeedTelemetry:
    """Rotor speeds as the speed controllers report them, with noise and resolution. A rotor that
    stands still reports 0: its controller sees no commutation."""

    def __init__(self, params: VehicleErrorParams, seed: int, rotors: int = 4) -> None:
        self._rotors = rotors
        self._sigma, self._step = params.telemetry_sigma_radps, params.telemetry_step_radps
        self._rng = np.random.default_rng([seed, crc32(b"rotor telemetry")])
        self._noise = self._draw()

    def read(self, speeds: Array) -> Array:
        """(R,) rad/s, a new array."""
        reported = speeds.copy()
        # Scalars: at every control step, numpy's calls on few numbers are most of what they cost.
        if self._sigma > 0.0:
            noise = next(self._noise)
            for i, speed in enumerate(speeds.tolist()):
                reported[i] = max(speed + noise[i], 0.0) if speed > 0.0 else 0.0
        if self._step > 0.0:
            reported[:] = [self._step * round(w / self._step) for w in reported.tolist()]
        return reported

    def _draw(self) -> Iterator[list[float]]:
        """Noise of one reading after the other; drawn for many at a time, which costs less."""
        while True:
            yield from (self._sigma * self._rng.standard_normal((_DRAWN, self._rotors))).tolist()


def give_back_textures(model: Any) -> None:
    """Returns the memory of an MjModel's textures to the system, 100 MB, where the system knows
    how: levels are undefined then, and whoever draws the model anew sees wrong colours."""
    advise = getattr(ctypes.CDLL(None), "madvise", None)
    if advise is None or not hasattr(mmap, "MADV_DONTNEED"):
        return
    levels = model.tex_data
    first = -(-levels.ctypes.data // mmap.PAGESIZE) * mmap.PAGESIZE
    size = (levels.ctypes.data + levels.nbytes - first) // mmap.PAGESIZE * mmap.PAGESIZE
    if size > 0:
        advise(ctypes.c_void_p(first), ctypes.c_size_t(size), mmap.MADV_DONTNEED)
