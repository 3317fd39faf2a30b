"""Maps of surveys kept with their true ground, one small file each, for selectors to be tried on.

A survey without a flight makes a map in seconds; a selector needs milliseconds on it.
"""

import dataclasses
import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_cdt

from touchdown.estimator.api import Estimate, GridMap, MapView
from touchdown.experiments.benchmarks.posed_survey import (
    build_posed_survey,
    observe,
    true_estimate,
)
from touchdown.experiments.config.schema import Config
from touchdown.experiments.errors import UsageError
from touchdown.experiments.flight.wiring import build_scene
from touchdown.experiments.io.provenance import git_revision
from touchdown.experiments.io.run_directory import whole_file
from touchdown.landing.api import CostmapView
from touchdown.scenes.api import Scene, short_name
from touchdown.scenes.truth.maps import truth_maps
from touchdown.sim.api import VehicleModel
from touchdown.sim.files.opening import no_file
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array, Indices, Mask

SUFFIX = ".map.npz"
TRUTH_CELL_M = 0.1
AROUND_M = 15.0
"""width of the judged area beside the path: more than the field of view ahead, less than half of it
aside"""
_MARGIN_CELLS = 8
"""kept around what was seen"""
_BARREN_M = 10.0
"""side of the smallest square without safe ground"""
_AROUND_CELLS, _SEEN = 9, 0.5
"""side of a square about a cell, and fraction of it with returns from which it counts as seen"""
_STEPS = {
    "count": 1e-3, "missing": 1e-3, "last_seen_s": 0.1, "rgb": 1.0, "intensity": 1.0,
    "height_m": 1e-3, "height_std_m": 1e-3, "min_height_m": 1e-3, "max_height_m": 1e-3,
    "histogram_base_m": 1e-3,
}  # fmt: skip
"""Layers that are kept as whole numbers of these; the noise of the LIDAR is 20 mm."""
_UNKNOWN = np.int32(-(2**31))
_VERSION = 1
_MAX_BYTES = 1 << 29
"""of the layers of one file, unpacked"""


@dataclass(frozen=True, kw_only=True, slots=True)
class SafeGround:
    """Where a touchdown is safe by the true geometry, world frame, which is the odom frame here."""

    origin_xy_m: Array
    """(2,) lower left corner"""
    cell_m: float
    safe: Mask
    """(rows, cols)"""


@dataclass(frozen=True, kw_only=True, slots=True)
class KeptMap:
    """One place as a survey at true poses mapped it, and its true ground."""

    scene: str
    seed: int
    profile: str
    revision: str | None
    map_view: MapView
    estimate: Estimate
    """at the end of the survey"""
    vehicle: VehicleModel
    truth: SafeGround
    dials: Mapping[str, float] = field(default_factory=dict)
    """keys of numbers that were varied between maps, with the value here"""


def make_map(config: Config, dials: Mapping[str, float] | None = None) -> KeptMap:
    """Surveys the configured scene without a flight; ``dials`` are those of ``config`` that are
    kept by name. Raises ValueError as `build_scene`, and where nothing was mapped."""
    scene = build_scene(config)
    survey = build_posed_survey(config, scene)
    *_, (estimate, view) = observe(survey, survey.path, start_s=0.0)
    if not view.coarse.count.any():
        raise ValueError(f"scene '{config.scene}': the survey mapped nothing")
    track = np.array(
        [survey.path.sample(t)[0][:2] for t in np.linspace(0.0, survey.path.duration_s, 73)]
    )
    return KeptMap(
        scene=config.scene,
        seed=config.seed,
        profile=config.profile,
        revision=git_revision(),
        map_view=MapView(version=view.version, coarse=_cropped(view.coarse), fine=None),
        estimate=true_estimate(estimate.tick, estimate.time_s, estimate.odom_from_body),
        vehicle=survey.rig.vehicle,
        truth=_safe_ground(scene, track),
        dials=dials or {},
    )


def write_map(kept: KeptMap, folder: Path) -> Path:
    """Writes ``SCENE-SEED.map.npz`` into ``folder``, with ``-KEY=VALUE`` of its dials; returns its
    path."""
    grid, truth = kept.map_view.coarse, kept.truth
    layers: dict[str, Any] = {
        name: _whole(layer, step)
        for name, step in _STEPS.items()
        if (layer := getattr(grid, name)) is not None
    }
    if grid.histogram is not None:
        layers["histogram"] = grid.histogram
    pose = kept.estimate.odom_from_body
    about = {
        "version": _VERSION,
        **{key: getattr(kept, key) for key in ("scene", "seed", "profile", "revision")},
        "map": {"origin_xy_m": grid.origin_xy_m.tolist(), "cell_m": grid.cell_m},
        "truth": {
            "origin_xy_m": truth.origin_xy_m.tolist(), "cell_m": truth.cell_m,
            "shape": truth.safe.shape,
        },
        "pose": {"rotation": pose.rotation.tolist(), "translation": pose.translation.tolist()},
        "time": [kept.estimate.tick, kept.estimate.time_s],
        "dials": dict(kept.dials),
        "vehicle": {
            field.name: np.asarray(getattr(kept.vehicle, field.name)).tolist()
            for field in dataclasses.fields(kept.vehicle)
        },
    }  # fmt: skip
    packed = np.packbits(truth.safe)
    dials = "".join(f"-{key}={value:g}" for key, value in kept.dials.items())
    file = folder / f"{short_name(kept.scene)}-{kept.seed}{dials}{SUFFIX}"
    with whole_file(file) as partial, partial.open("wb") as opened:
        np.savez_compressed(opened, about=np.array(json.dumps(about)), safe=packed, **layers)
    return file


def read_map(file: Path) -> KeptMap:
    """Reads a file of `write_map`. Raises UsageError, one line, where it is none."""
    if reason := no_file(file):
        raise UsageError(f"'{file}' {reason}")
    try:
        with zipfile.ZipFile(file) as archive:
            if sum(part.file_size for part in archive.infolist()) > _MAX_BYTES:
                raise ValueError("it is too large")
        with np.load(io.BytesIO(file.read_bytes()), allow_pickle=False) as layers:
            return _kept(json.loads(str(layers["about"])), {k: layers[k] for k in layers.files})
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise UsageError(
            f"'{file}' is no map of `touchdown maps make`: {' '.join(str(error).split())}"
        ) from error


def map_files(folder: Path) -> list[Path]:
    """The maps in ``folder``, by name. Raises UsageError where there is none."""
    found = sorted(folder.glob(f"*{SUFFIX}")) if folder.is_dir() else []
    if not found:
        raise UsageError(
            f"'{folder}' holds no map; make some by `touchdown maps make --out {folder}`"
        )
    return found


def _kept(about: dict[str, Any], layers: dict[str, NDArray[Any]]) -> KeptMap:
    if about["version"] != _VERSION:
        raise ValueError(f"it is of version {about['version']}, and {_VERSION} is read")
    shape = layers["count"].shape
    if len(shape) != 2:
        raise ValueError("its layers are no rasters")
    for name, layer in layers.items():
        if name not in ("about", "safe") and layer.shape[:2] != shape:
            raise ValueError(f"its layer {name} has another size")
    grid = GridMap(
        origin_xy_m=np.array(about["map"]["origin_xy_m"], dtype=float).reshape(2),
        cell_m=float(about["map"]["cell_m"]),
        histogram=layers.get("histogram"),
        **{name: _floats(layers[name], step) for name, step in _STEPS.items() if name in layers},
    )
    rows, cols = (int(n) for n in about["truth"]["shape"])
    safe = np.unpackbits(layers["safe"], count=rows * cols).reshape(rows, cols).astype(bool)
    pose = Pose(
        np.array(about["pose"]["rotation"], dtype=float).reshape(3, 3),
        np.array(about["pose"]["translation"], dtype=float).reshape(3),
    )
    vehicle: dict[str, Any] = {
        key: np.array(value, dtype=float) if isinstance(value, list) else float(value)
        for key, value in about["vehicle"].items()
    }
    tick, time_s = about["time"]
    return KeptMap(
        scene=str(about["scene"]),
        seed=int(about["seed"]),
        profile=str(about["profile"]),
        revision=about["revision"],
        map_view=MapView(version=1, coarse=grid, fine=None),
        estimate=true_estimate(int(tick), float(time_s), pose),
        vehicle=VehicleModel(**vehicle),
        truth=SafeGround(
            origin_xy_m=np.array(about["truth"]["origin_xy_m"], dtype=float).reshape(2),
            cell_m=float(about["truth"]["cell_m"]),
            safe=safe,
        ),
        dials={str(key): float(value) for key, value in about.get("dials", {}).items()},
    )


def _whole(layer: NDArray[np.float32], step: float) -> NDArray[np.int32]:
    known = np.isfinite(layer)
    return np.where(known, np.round(np.where(known, layer, 0.0) / step), _UNKNOWN).astype(np.int32)


def _floats(layer: NDArray[np.int32], step: float) -> NDArray[np.float32]:
    return np.where(layer == _UNKNOWN, np.nan, layer * step).astype(np.float32)


def _cropped(grid: GridMap) -> GridMap:
    """The part of the map that was seen, with a margin."""
    seen = np.argwhere((grid.count > 0) | (grid.missing > 0))
    low = np.maximum(seen.min(axis=0) - _MARGIN_CELLS, 0)
    high = seen.max(axis=0) + 1 + _MARGIN_CELLS
    return _part(grid, low, high)


def _part(grid: GridMap, low: Indices, high: Indices) -> GridMap:
    """The cells from ``low`` to before ``high``, each (2,) row and column."""
    box = (slice(low[0], high[0]), slice(low[1], high[1]))
    layers = {
        field.name: getattr(grid, field.name)[box].copy()
        for field in dataclasses.fields(grid)
        if isinstance(getattr(grid, field.name), np.ndarray) and field.name != "origin_xy_m"
    }
    origin = grid.origin_xy_m + grid.cell_m * low[::-1]
    return dataclasses.replace(grid, origin_xy_m=origin, **layers)


def _safe_ground(scene: Scene, track_xy: Array) -> SafeGround:
    bounds = np.asarray(scene.bounds_xy_m)
    low = np.maximum(track_xy.min(axis=0) - AROUND_M, bounds[0])
    high = np.minimum(track_xy.max(axis=0) + AROUND_M, bounds[1])
    truth = truth_maps(scene, TRUTH_CELL_M, np.array([low, high]))
    return SafeGround(
        origin_xy_m=np.asarray(truth.origin_xy_m), cell_m=truth.cell_m, safe=truth.safe_geometry
    )


def without_safe_ground(kept: KeptMap) -> KeptMap | None:
    """Returns the largest square that was seen and holds no safe ground, as a map of its own; None
    where that is less than 10 m wide."""
    grid = kept.map_view.coarse
    wider = binary_dilation(kept.truth.safe, np.ones((3, 3)))  # a cell here is two of the truth's
    truth = dataclasses.replace(kept.truth, safe=wider)
    safe, judged = on_grid(truth, grid, grid.count.shape)
    returned = (grid.count > 0.0).astype(np.float32)
    seen = cv2.blur(returned, (_AROUND_CELLS, _AROUND_CELLS)) >= _SEEN
    barren = judged & seen & ~safe
    reach = distance_transform_cdt(np.pad(barren, 1), "chessboard")[1:-1, 1:-1]
    middle = np.array(np.unravel_index(reach.argmax(), reach.shape))
    aside = int(reach.max()) - 1
    if (2 * aside + 1) * grid.cell_m < _BARREN_M:
        return None
    coarse = _part(grid, middle - aside, middle + aside + 1)
    view = MapView(version=kept.map_view.version, coarse=coarse, fine=None)
    return dataclasses.replace(kept, map_view=view)


def is_judged(truth: SafeGround, position: Array) -> bool:
    """True for a point of the true ground, which ends before the map does."""
    ends = np.array(truth.safe.shape[::-1]) * truth.cell_m
    offset = position[:2] - truth.origin_xy_m
    return bool((offset >= 0.0).all() and (offset < ends).all())


def value_at(truth: SafeGround, raster: NDArray[Any], position: Array) -> Any:
    """Returns the raster's value at a point of the true ground."""
    col, row = np.floor((position[:2] - truth.origin_xy_m) / truth.cell_m).astype(int)
    return raster[row, col]


def on_grid(
    ground: SafeGround, grid: GridMap | CostmapView, shape: tuple[int, ...]
) -> tuple[Mask, Mask]:
    """Returns ``ground.safe`` at the centres of the cells of ``grid``, rows and columns ``shape``,
    and the mask where it is known."""
    rows, cols = shape
    x = grid.origin_xy_m[0] + (np.arange(cols) + 0.5) * grid.cell_m
    y = grid.origin_xy_m[1] + (np.arange(rows) + 0.5) * grid.cell_m
    col = np.floor((x - ground.origin_xy_m[0]) / ground.cell_m).astype(int)
    row = np.floor((y - ground.origin_xy_m[1]) / ground.cell_m).astype(int)
    height, width = ground.safe.shape
    inside = ((row >= 0) & (row < height))[:, None] & ((col >= 0) & (col < width))[None, :]
    near = np.ix_(np.clip(row, 0, height - 1), np.clip(col, 0, width - 1))
    return ground.safe[near] & inside, inside
