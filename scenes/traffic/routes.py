"""Paths of people, animals and vehicles over the ground of a compiled scene."""

import csv
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from touchdown.scenes import api
from touchdown.scenes.authoring.streets import path_length
from touchdown.scenes.traffic import walkers
from touchdown.scenes.traffic.walkers import Part, Speeds
from touchdown.scenes.truth import static_surface

_CELL_M = 0.5
_STEP_M = 0.35
"""between neighbouring cells that one may walk over"""
_WALKED = ("lawn", "field", "path", "road")
_CLEAR_OF_PAD_M = 4.0
_TRIES = 400
_KINDS = ("person", "dog", "bicycle", "car")
_MAX_ROWS = 100_000
_POSES = ("walks", "walks", "runs", "stands", "sits")


_SENT = {"walker": walkers.WALK, "runner": walkers.RUN, "dog": walkers.TROT,
         "bicycle": walkers.RIDE}  # fmt: skip


class Planned(NamedTuple):
    """A walker whose bodies are in the spec and whose path is not drawn yet."""

    kind: str
    parts: list[Part]
    pose: str
    """``walks``, ``runs``, ``stands``, ``sits``, ``rides``; ``sent`` for an intruder"""
    own: api.Array | None = None
    """(K, 3) t, x, y of a path from a file"""


class Traffic:
    """The traffic of one scene: first its bodies, then, on the compiled ground, its paths.

    Raises ValueError for a file of paths that cannot be read or understood.
    """

    def __init__(self, params: api.TrafficParams, intruders: int, scene: str, seed: int) -> None:
        self._params, self._intruders = params, intruders
        self._rng = np.random.default_rng([seed, crc32(f"scenes.traffic.{scene}".encode())])
        self._planned: list[Planned] = []

    def add_bodies(self, spec: Any, surfaces: dict[str, api.Surface]) -> None:
        """Adds the mocap bodies and their surfaces."""
        params, rng = self._params, self._rng
        own = _read_paths(params.paths) if params.paths else {}
        for name, path in own.items():
            kind = next(kind for kind in _KINDS if name.startswith(kind))
            self._add(spec, surfaces, kind, f"traffic/own_{name}", "walks", path)
        counts = (params.people, params.dogs, params.bicycles, params.cars)
        for kind, count in zip(_KINDS, counts, strict=True):
            for index in range(count):
                poses = {"person": _POSES, "dog": ("walks", "walks", "stands")}.get(
                    kind, ("rides",)
                )
                pose = poses[int(rng.integers(len(poses)))]
                self._add(spec, surfaces, kind, f"traffic/{kind}_{index}", pose)
        who = {"walker": "person", "runner": "person"}
        for index in range(self._intruders):
            chosen = params.intruder
            if chosen == "any":
                chosen = ("walker", "runner", "dog", "bicycle")[int(rng.integers(4))]
            name = f"traffic/intruder_{index}_{chosen}"
            self._add(spec, surfaces, who.get(chosen, chosen), name, "sent")

    def _add(
        self, spec: Any, surfaces: dict[str, api.Surface], kind: str, name: str, pose: str,
        own: api.Array | None = None,
    ) -> None:  # fmt: skip
        make: Callable[..., list[Part]] = getattr(walkers, kind)
        if kind == "person":
            stride = 2.3 if pose == "runs" or name.endswith("runner") else 1.45
            parts = make(spec, surfaces, name, self._rng, sits=pose == "sits", stride_m=stride)
        else:
            parts = make(spec, surfaces, name, self._rng)
        self._planned.append(Planned(kind, parts, pose, own))

    def routed(self, scene: api.Scene) -> api.Scene:
        """``scene`` with the paths of what was added."""
        if not self._planned:
            return scene
        placeholders = [
            body for one in self._planned for body in walkers.bodies(one.parts, np.zeros((1, 3)))
        ]
        bare = replace(scene, moving=(*scene.moving, *placeholders))
        ground = _Ground(bare, self._params.radius_m)
        found: list[api.MovingBody] = []
        for one in self._planned:
            found += self._path(one, ground)
        return replace(scene, moving=(*scene.moving, *found))

    def _path(self, one: Planned, ground: "_Ground") -> list[api.MovingBody]:
        rng, alive = self._rng, one.kind != "car"
        if one.own is not None:
            path = ground.lifted(one.own[:, 1:])
            return walkers.bodies(one.parts, path, alive=alive, times_s=one.own[:, 0])
        if one.pose == "sent":
            who = one.parts[0].body_name.rpartition("_")[2]
            speed = float(rng.uniform(*_SENT[who]))
            return walkers.bodies(one.parts, np.zeros((1, 3)), intruder=True, speed_mps=speed)
        if one.pose in ("stands", "sits"):
            place, yaw = ground.lifted(ground.place(rng)[None]), float(rng.uniform(-np.pi, np.pi))
            return walkers.bodies(one.parts, place, yaw=yaw)
        speeds: Speeds = {"runs": walkers.RUN}.get(one.pose) or {
            "person": walkers.WALK, "dog": walkers.TROT, "bicycle": walkers.RIDE,
            "car": walkers.DRIVE,
        }[one.kind]  # fmt: skip
        path = ground.round(rng, on_roads=one.kind == "car")
        return walkers.bodies(
            one.parts, path, alive=alive, speed_mps=float(rng.uniform(*speeds)),
            start_m=float(rng.uniform(0.0, path_length(path))),
        )  # fmt: skip


class _Ground:
    """Where one can walk in the disc about the middle of a scene. ValueError: nowhere."""

    def __init__(self, scene: api.Scene, radius_m: float) -> None:
        self._scene = scene
        middle = scene.bounds_xy_m.mean(axis=0)
        half = np.minimum(0.5 * np.diff(scene.bounds_xy_m, axis=0)[0] - 1.0, radius_m)
        self._origin = middle - half
        cols, rows = np.maximum((2.0 * half / _CELL_M).astype(int), 1)
        heights, geoms = static_surface.cast_down(scene, self._origin, _CELL_M, (rows, cols))
        classes = static_surface.class_ids(scene, self._origin, _CELL_M, heights, geoms)
        y, x = np.mgrid[:rows, :cols] * _CELL_M + 0.5 * _CELL_M
        x, y = x + self._origin[0], y + self._origin[1]
        away = np.hypot(x - middle[0], y - middle[1])
        pad = np.hypot(x - scene.takeoff_xy_m[0], y - scene.takeoff_xy_m[1])
        level = np.ones(heights.shape, bool)
        level[:, 1:] &= np.abs(np.diff(heights, axis=1)) < _STEP_M
        level[1:] &= np.abs(np.diff(heights, axis=0)) < _STEP_M
        walked = np.isin(classes, [api.LAND_CLASSES.index(name) for name in _WALKED])
        free = walked & level & (away < radius_m) & (pad > _CLEAR_OF_PAD_M)
        self._free: NDArray[np.bool_] = binary_erosion(free)
        road = classes == api.LAND_CLASSES.index("road")
        self._road: NDArray[np.bool_] = binary_erosion(free & road, iterations=2)
        if not self._free.any():
            raise ValueError(
                f"traffic: nobody can walk within {radius_m:g} m of the middle of the scene "
                f"'{scene.name}'; set traffic.people and the others to 0, or another radius_m"
            )

    def place(self, rng: np.random.Generator, roads: bool = False) -> api.Array:
        """(2,) a random place."""
        cells = np.argwhere(self._road if roads else self._free)
        row, col = cells[int(rng.integers(len(cells)))]
        return self._origin + (np.array([col, row]) + rng.uniform(0.2, 0.8, 2)) * _CELL_M

    def round(self, rng: np.random.Generator, on_roads: bool) -> api.Array:
        """(K, 3) a closed path of some straight legs, or there and back."""
        roads = on_roads and bool(self._road.any())
        start = here = self.place(rng, roads)
        found = [start]
        for _ in range(_TRIES):
            way = float(rng.uniform(-np.pi, np.pi))
            reach = float(rng.uniform(4.0, 40.0 if on_roads else 14.0))
            there = here + reach * np.array([math.cos(way), math.sin(way)])
            if self._open(here, there, roads):
                found.append(there)
                here = there
            if len(found) == 5:
                break
        if len(found) == 1:  # an island: to and fro
            found.append(start + np.array([0.4 * _CELL_M, 0.0]))
        if not self._open(found[-1], start, roads):
            found += found[-2:0:-1]
        return self._with_relief(np.array(found))

    def lifted(self, xy: api.Array) -> api.Array:
        """(K, 3) places (K, 2) on the ground."""
        heights, _ = static_surface.cast_points(self._scene, xy)
        return np.column_stack([xy, np.nan_to_num(heights)])

    def _open(self, start: api.Array, end: api.Array, roads: bool) -> bool:
        count = max(2, int(np.linalg.norm(end - start) / (0.5 * _CELL_M)))
        line = start + np.linspace(0.0, 1.0, count)[:, None] * (end - start)
        cols, rows = np.floor((line - self._origin) / _CELL_M).astype(int).T
        mask = self._road if roads else self._free
        inside = (rows >= 0) & (cols >= 0) & (rows < mask.shape[0]) & (cols < mask.shape[1])
        return bool(inside.all()) and bool(mask[rows, cols].all())

    def _with_relief(self, corners: api.Array) -> api.Array:
        """The closed path through (K, 2) corners with a vertex each metre, on the ground."""
        legs = []
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            count = max(1, math.ceil(float(np.linalg.norm(end - start))))
            legs.append(start + (np.arange(count) / count)[:, None] * (end - start))
        return self.lifted(np.concatenate(legs))


def _read_paths(file: str) -> dict[str, api.Array]:
    """(K, 3) t, x, y by name."""
    found: dict[str, list[tuple[float, float, float]]] = {}
    try:
        with open(file, newline="") as lines:
            for number, row in enumerate(csv.DictReader(lines), start=2):
                if number > _MAX_ROWS:
                    raise ValueError(f"more than {_MAX_ROWS} rows")
                name = str(row["name"]).strip()
                if not name.startswith(_KINDS):
                    raise ValueError(f"line {number}: '{name}' begins with none of {_KINDS}")
                values = tuple(float(row[key]) for key in ("t", "x", "y"))
                if not all(map(math.isfinite, values)):
                    raise ValueError(f"line {number}: a number is not finite")
                found.setdefault(name, []).append(values)  # type: ignore[arg-type]
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        why = f"column {error} is missing" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"traffic.paths: '{file}': {why}; columns: name,t,x,y") from error
    paths = {name: np.array(rows) for name, rows in found.items()}
    for name, path in paths.items():
        if len(path) < 2 or not (np.diff(path[:, 0]) > 0.0).all():
            raise ValueError(f"traffic.paths: '{file}': {name} needs two rows or more of rising t")
        if not (np.linalg.norm(np.diff(path[:, 1:], axis=0), axis=1) > 1e-6).any():
            raise ValueError(f"traffic.paths: '{file}': {name} goes nowhere")
    return paths
