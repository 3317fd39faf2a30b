"""Intruders: people, dogs and cyclists whom a fault sends onto the landing site."""

import math
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from touchdown.scenes.api import MovingBody, Scene
from touchdown.sim.faults.marks import Marks
from touchdown.sim.faults.types import Fault
from touchdown.sim.moving import MovingBodies
from touchdown.sim.noise import random_stream
from touchdown.sim.typing import Array

_WAYS = 16
_PASSABLE_M = 0.35
"""step of the ground over half a metre that one walks over"""
_VERTEX_M = 0.5
_ABOVE_M = 100.0


class Intruders:
    """Sends one intruder of a scene for each fault ``intruder``, from a direction drawn from the
    seed: the first of 16 in which the ground can be walked, else the smoothest."""

    def __init__(self, scene: Scene, faults: Sequence[Fault], marks: Marks, seed: int) -> None:
        self._scene, self._marks = scene, marks
        waiting = [b for b in scene.moving if b.intruder and b.body_name == b.walker]
        called = [fault for fault in faults if fault.kind == "intruder"]
        self._waiting = list(zip(called, waiting, strict=False))
        self._rng = random_stream(seed, "intruders")
        self._records: dict[str, dict[str, Any]] = {
            fault.text: {"fault": fault.text, "acted_s": 0.0, "began_s": None} for fault in called
        }

    def update(self, tick: int, tick_hz: int, data: Any, moving: MovingBodies, site: Array) -> None:
        """Sends whose fault has begun by ``tick`` towards ``site`` (2,) or (3,), world frame."""
        for pair in tuple(self._waiting):
            fault, body = pair
            if tick < self._marks.span(fault)[0]:
                continue
            self._waiting.remove(pair)
            now_s = tick / tick_hz
            moving.send(body.body_name, *self._way(body, site, data, now_s))
            who = body.body_name.rpartition("_")[2]
            self._records[fault.text] |= {"began_s": now_s, "who": who}

    def summary(self, time_s: float) -> list[dict[str, Any]]:
        """Records of the faults at the end of a flight, as `Disturbances.summary`; ``who`` was
        sent."""
        return [
            record | {"acted_s": time_s - record["began_s"]} if "who" in record else record
            for record in self._records.values()
        ]

    def _way(self, body: MovingBody, site: Array, data: Any, now_s: float) -> tuple[Array, Array]:
        """(K, 3) vertices and (K,) times of the way to the site, of the stay there and of the way
        on."""
        traffic = self._scene.traffic
        reach, first = traffic.intruder_from_m, float(self._rng.uniform(0.0, 2.0 * math.pi))
        along = np.linspace(-reach, reach, 2 * math.ceil(reach / _VERTEX_M) + 1)
        best: tuple[float, Array] | None = None
        for angle in first + np.arange(_WAYS) * 2.0 * math.pi / _WAYS:
            xy = site[:2] + along[:, None] * np.array([math.cos(angle), math.sin(angle)])
            heights = self._heights(xy, data)
            known = np.isfinite(heights)
            before = np.where(known, heights, np.nan)[: len(along) // 2 + 1]
            step = float(np.nan_to_num(np.abs(np.diff(before)), nan=np.inf).max())
            # beside the ground one walks on at its height
            heights = np.interp(along, along[known], heights[known]) if known.any() else 0.0 * along
            path = np.column_stack([xy, heights])
            if best is None or step < best[0]:
                best = step, path
            if step < _PASSABLE_M:
                break
        assert best is not None
        path = best[1]
        middle = len(along) // 2
        times_s = now_s + (along + reach) / body.speed_mps
        times_s[middle + 1 :] += traffic.intruder_stays_s
        stay = times_s[middle] + traffic.intruder_stays_s
        return np.insert(path, middle + 1, path[middle], 0), np.insert(times_s, middle + 1, stay)

    def _heights(self, xy: Array, data: Any) -> Array:
        """(K,) heights of the static surface at (K, 2); infinite where there is none."""
        model = self._scene.model
        geom, down, found = np.zeros(1, np.int32), np.array([0.0, 0.0, -1.0]), np.empty(len(xy))
        for index, point in enumerate(xy):
            z = float(data.qpos[2]) + _ABOVE_M
            while True:
                away = mujoco.mj_ray(model, data, np.array([*point, z]), down, None, True, -1, geom)
                if away < 0.0:
                    z = math.inf
                    break
                z -= away
                root = int(model.body_rootid[model.geom_bodyid[geom[0]]])
                if model.body_mocapid[root] < 0 and model.body_jntnum[root] == 0:
                    break
                z -= 1e-3
            found[index] = z
        return found
