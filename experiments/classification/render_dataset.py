"""`touchdown dataset render`: a folder of labelled patches by scene and seed, `manifest.csv` and a
contact sheet."""

import csv
import multiprocessing
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.classification.data_sets import (
    SPLITS,
    rendered_meaning,
    split_of_layout,
)
from touchdown.experiments.classification.patches import NewLooks, scene_patches
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.errors import UsageError, nearest
from touchdown.experiments.io.images import read_picture, write_png
from touchdown.experiments.io.run_directory import run_directory
from touchdown.scenes.api import LAND_CLASSES
from touchdown.scenes.registry import RUGGED, scene_names

MANIFEST = "manifest.csv"
SHEET = "contact_sheet.png"
COLUMNS = (
    "file", "d_land", "d_scene", "scene", "seed", "split", "height_m", "side_m", "fraction",
)  # fmt: skip
PER_SEED = 40
Progress = Callable[[int, int, str], None]
FIRST_SEED = 1000
"""above the seeds of flights, so that no flight is over ground that was trained on"""
_SEED_SPACING = 100_000
"""between the first seeds of two data sets"""
_MAX_ROUNDS = 10
"""rounds of further seeds where layouts did not show enough ground of one class"""
_SHEET_COLUMNS = 10
_SHEET_PX, _NAME_PX, _GAP = 96, 110, 4


@dataclass(frozen=True, kw_only=True, slots=True)
class DatasetParams:
    """Size and content of a data set of rendered patches."""

    images: int
    seed: int = 0
    """of the layouts, poses and light"""
    scenes: Sequence[str] = ()
    """names; all scenes where there are none"""
    pixels: int = 128
    """across a patch"""
    per_seed: int = PER_SEED
    """patches of each seed of a scene"""
    new_colours: float = 0.0
    """fraction of views in colours that the scene does not have"""
    new_materials: float = 0.0
    """fraction of seeds with ground of other materials of the same class"""
    settings: Sequence[str] = ()
    """``KEY=VALUE`` of the configuration, such as the dials of ``rugged``"""


@dataclass(frozen=True, slots=True)
class _Layout:
    """One seed of a scene, and the number of patches to render of it into ``folder``."""

    scene: str
    place: str
    """as `place_of`"""
    seed: int
    count: int
    params: DatasetParams
    folder: Path


def render_dataset(
    out: Path,
    params: DatasetParams,
    *,
    jobs: int = 1,
    progress: Progress = lambda done, total, note: None,
) -> dict[str, Any]:
    """Renders labelled patches into the new folder ``out``, in ``jobs`` processes.

    Each scene is rendered with as many seeds as it takes at ``params.per_seed`` patches a seed. The
    same ``params`` give the same bytes, whatever ``jobs``. The folder appears when it is complete.
    Raises UsageError where ``out`` is not empty, a scene is unknown or a setting does not fit.
    """
    known = scene_names()
    for name in set(params.scenes).difference(known):
        raise UsageError(f"unknown scene '{name}'{nearest(name, known)}; known: {', '.join(known)}")
    names = tuple(dict.fromkeys(params.scenes)) or tuple(known)
    scenes = {name: place_of(name, params.settings) for name in names}
    if out.is_file() or (out.is_dir() and any(out.iterdir())):
        raise UsageError(f"--out: '{out}' is a file or not empty; name a new folder")
    with run_directory(out, own=()) as partial:
        rows = _render(partial, scenes, params, jobs, progress)
        with (partial / MANIFEST).open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
        write_png(partial / SHEET, contact_sheet(_samples(partial, rows)))
    return {"directory": str(out), "images": len(rows), **_counts(rows)}


def place_of(scene: str, settings: Sequence[str]) -> str:
    """Returns the scene's name, of `rugged` with its preset: each is a place of its own."""
    preset = load_config(None, settings, scene=scene).rugged.preset
    return f"{scene}-{preset}" if scene == RUGGED else scene


def _render(
    folder: Path, scenes: Mapping[str, str], params: DatasetParams, jobs: int, progress: Progress
) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    first = FIRST_SEED + _SEED_SPACING * params.seed
    with _workers(jobs) as run:
        for _ in range(_MAX_ROUNDS):
            missing = params.images - len(rows)
            seeds = -(-missing // (len(scenes) * params.per_seed))
            places = [(*both, first + number) for number in range(seeds) for both in scenes.items()]
            # numbers that differ by at most one
            counts = [len(part) for part in np.array_split(np.arange(missing), len(places))]
            layouts = [
                _Layout(*place, count, params, folder)
                for place, count in zip(places, counts, strict=True)
                if count
            ]
            first += seeds
            for layout, found in zip(layouts, run(_render_layout, layouts), strict=True):
                rows += found
                progress(len(rows), params.images, f"{layout.place}, seed {layout.seed}")
            if len(rows) == params.images:
                return rows
    raise UsageError(f"these scenes show only {len(rows)} patches of one kind of ground")


@contextmanager
def _workers(jobs: int) -> Iterator[Callable[..., Iterator[list[dict[str, Any]]]]]:
    """Yields ``map``, over worker processes for more than one job; results in order."""
    if jobs == 1:
        yield map
        return
    fresh = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=fresh) as pool:
        yield pool.map


def _render_layout(layout: _Layout) -> list[dict[str, Any]]:
    """Writes the images of one layout. Returns their rows of the manifest."""
    cv2.setNumThreads(1)
    params, name = layout.params, f"{layout.place}-{layout.seed}"
    (layout.folder / name).mkdir()
    looks = NewLooks(params.new_colours, params.new_materials)
    patches = scene_patches(
        layout.scene, layout.seed, layout.count, params.pixels, params.seed, looks, params.settings
    )
    rows = []
    for number, patch in enumerate(patches):
        file = f"{name}/{number:04d}.png"
        write_png(layout.folder / file, patch.rgb)
        meaning = rendered_meaning(layout.scene, patch.land_class)
        rows.append({
            "file": file,
            "d_land": meaning.d_land,
            "d_scene": meaning.d_scene or "",
            "scene": layout.place,
            "seed": layout.seed,
            "split": split_of_layout(layout.place, layout.seed),
            "height_m": f"{patch.height_m:.2f}",
            "side_m": f"{patch.side_m:.2f}",
            "fraction": f"{patch.fraction:.3f}",
        })  # fmt: skip
    return rows


def _counts(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, int]]:
    """Returns the number of patches of each class and in each split."""
    found: dict[str, dict[str, int]] = {}
    for key, names in (("classes", LAND_CLASSES), ("splits", SPLITS)):
        column = "d_land" if key == "classes" else "split"
        found[key] = {name: sum(row[column] == name for row in rows) for name in names}
    return found


def _samples(folder: Path, rows: Sequence[dict[str, Any]]) -> dict[str, list[NDArray[np.uint8]]]:
    """Returns a few images of each class, spread over the layouts."""
    samples: dict[str, list[NDArray[np.uint8]]] = {}
    for name in LAND_CLASSES:
        files = [row["file"] for row in rows if row["d_land"] == name]
        spread = np.linspace(0, len(files) - 1, min(_SHEET_COLUMNS, len(files)))
        samples[name] = [read_picture(folder / files[index]) for index in spread.astype(int)]
    return samples


def contact_sheet(samples: dict[str, list[NDArray[np.uint8]]]) -> NDArray[np.uint8]:
    """Returns a contact sheet (H, W, 3): a row of images for each class, as the paper's Fig. 5."""
    pitch = _SHEET_PX + _GAP
    sheet = np.full(
        (pitch * len(samples) + _GAP, _NAME_PX + pitch * _SHEET_COLUMNS, 3), 255, np.uint8
    )
    for number, (name, images) in enumerate(samples.items()):
        top = _GAP + number * pitch
        cv2.putText(sheet, name, (_GAP + 4, top + _SHEET_PX // 2 + 5), cv2.FONT_HERSHEY_SIMPLEX,
                    0.6, (30, 30, 30), 1, cv2.LINE_AA)  # fmt: skip
        for column, image in enumerate(images[:_SHEET_COLUMNS]):
            left = _NAME_PX + column * pitch
            small = cv2.resize(image, (_SHEET_PX, _SHEET_PX), interpolation=cv2.INTER_AREA)
            sheet[top : top + _SHEET_PX, left : left + _SHEET_PX] = small
    return sheet
