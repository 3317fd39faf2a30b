"""A folder of labelled patches: pictures by place, `manifest.csv`, a contact sheet."""

from __future__ import annotations

import csv
import io
import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.classification.optional_import import recognition
from touchdown.experiments.classification.patches import Patch, scene_patches
from touchdown.experiments.classification.splits import SPLITS, split_of_place
from touchdown.experiments.errors import UsageError, nearest
from touchdown.experiments.io.images import read_picture, write_png
from touchdown.experiments.io.run_directory import run_directory
from touchdown.scenes.api import LAND_CLASSES
from touchdown.scenes.registry import scene_names

MANIFEST = "manifest.csv"
SHEET = "contact_sheet.png"
COLUMNS = (
    "file", "d_land", "d_scene", "scene", "seed", "split", "height_m", "side_m", "share",
)  # fmt: skip
PER_PLACE = 40
FIRST_SEED = 1000
"""far from the seeds of flights: no flight is over a place that was trained on"""
_SEEDS_APART = 100_000
"""between the first seeds of two data sets"""
_MOST_ROUNDS = 10
"""of further seeds when places did not show enough"""
_SHEET_COLUMNS = 10
_SHEET_PX, _NAME_PX, _GAP = 96, 110, 4


@dataclass(frozen=True, slots=True)
class _Place:
    scene: str
    seed: int
    count: int
    pixels: int
    variation: int
    new_colours: float
    folder: str

    @property
    def name(self) -> str:
        return f"{self.scene}-{self.seed}"


def render_dataset(
    out: Path,
    images: int,
    seed: int,
    scenes: Sequence[str] = (),
    pixels: int = 128,
    per_place: int = PER_PLACE,
    jobs: int = 1,
    new_colours: float = 0.0,
    progress: Callable[[int, int, str], None] = lambda done, total, note: None,
) -> dict[str, Any]:
    """Renders ``images`` patches of ``pixels`` across into the new folder ``out``.

    Each scene is seen with as many seeds as it takes at ``per_place`` patches a seed, a share of
    ``new_colours`` of the views in colours that the scene does not have. The same
    arguments give the same bytes, whatever ``jobs``. The folder appears when it is complete.
    Raises UsageError: ``out`` is not empty, an unknown scene.
    """
    names = _checked_scenes(scenes)
    _check_target(out)
    with run_directory(out) as partial:
        rows = _render(partial, names, images, seed, pixels, per_place, jobs, new_colours, progress)
        (partial / MANIFEST).write_text(_csv(rows), encoding="utf-8")
        write_png(partial / SHEET, contact_sheet(_samples(partial, rows)))
    return {"directory": str(out), "images": len(rows), **_counts(rows)}


def _checked_scenes(scenes: Sequence[str]) -> tuple[str, ...]:
    known = scene_names()
    for name in scenes:
        if name not in known:
            raise UsageError(
                f"unknown scene '{name}'{nearest(name, known)}; known: {', '.join(known)}"
            )
    return tuple(dict.fromkeys(scenes)) or tuple(known)


def _check_target(out: Path) -> None:
    if out.is_file():
        raise UsageError(f"--out: '{out}' is a file; name a new folder")
    if out.is_dir() and any(out.iterdir()):
        raise UsageError(f"--out: '{out}' is not empty; name a new folder")


def _render(
    folder: Path,
    scenes: Sequence[str],
    images: int,
    seed: int,
    pixels: int,
    per_place: int,
    jobs: int,
    new_colours: float,
    progress: Callable[[int, int, str], None],
) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    first = FIRST_SEED + _SEEDS_APART * seed
    with _workers(jobs) as run:
        for _ in range(_MOST_ROUNDS):
            wanted = images - len(rows)
            seeds = -(-wanted // (len(scenes) * per_place))
            counts = _even(wanted, seeds * len(scenes))
            places = [
                _Place(name, first + number, counts.pop(), pixels, seed, new_colours, str(folder))
                for number in range(seeds)
                for name in scenes
            ]
            first += seeds
            for place, found in zip(places, run(_render_place, places), strict=True):
                rows += found
                progress(len(rows), images, f"{place.scene}, seed {place.seed}")
            if len(rows) == images:
                return rows
    raise UsageError(f"these scenes show only {len(rows)} patches of one kind of ground")


def _even(total: int, parts: int) -> list[int]:
    """``parts`` numbers that differ by at most one and add up to ``total``."""
    return [total // parts + (number < total % parts) for number in range(parts)][::-1]


@contextmanager
def _workers(jobs: int) -> Iterator[Callable[..., Iterator[list[dict[str, Any]]]]]:
    """``map``, over worker processes where there is more than one job; results in order."""
    if jobs == 1:
        yield map
        return
    fresh = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=fresh) as pool:
        yield pool.map


def _render_place(place: _Place) -> list[dict[str, Any]]:
    """Writes the pictures of one place; their rows of the manifest."""
    cv2.setNumThreads(1)
    if place.count == 0:
        return []
    labels = recognition("labels")
    folder = Path(place.folder) / place.name
    folder.mkdir()
    rows = []
    patches = scene_patches(
        place.scene, place.seed, place.count, place.pixels, place.variation, place.new_colours
    )
    for number, patch in enumerate(patches):
        file = f"{place.name}/{number:04d}.png"
        write_png(Path(place.folder) / file, patch.rgb)
        rows.append(
            _row(file, place, patch, labels.rendered_meaning(place.scene, patch.land_class))
        )
    return rows


def _row(file: str, place: _Place, patch: Patch, meaning: Any) -> dict[str, Any]:
    return {
        "file": file,
        "d_land": meaning.d_land,
        "d_scene": meaning.d_scene or "",
        "scene": place.scene,
        "seed": place.seed,
        "split": split_of_place(place.scene, place.seed),
        "height_m": f"{patch.height_m:.2f}",
        "side_m": f"{patch.side_m:.2f}",
        "share": f"{patch.share:.3f}",
    }


def _csv(rows: Sequence[dict[str, Any]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _counts(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, int]]:
    """How many patches there are of each class and in each split."""
    found: dict[str, dict[str, int]] = {}
    for key, names in (("classes", LAND_CLASSES), ("splits", SPLITS)):
        column = "d_land" if key == "classes" else "split"
        found[key] = {name: sum(row[column] == name for row in rows) for name in names}
    return found


def _samples(folder: Path, rows: Sequence[dict[str, Any]]) -> dict[str, list[NDArray[np.uint8]]]:
    """A few pictures of each class, from as many places as there are."""
    samples: dict[str, list[NDArray[np.uint8]]] = {}
    for name in LAND_CLASSES:
        files = [row["file"] for row in rows if row["d_land"] == name]
        spread = np.linspace(0, len(files) - 1, min(_SHEET_COLUMNS, len(files)))
        samples[name] = [read_picture(folder / files[place]) for place in spread.astype(int)]
    return samples


def contact_sheet(samples: dict[str, list[NDArray[np.uint8]]]) -> NDArray[np.uint8]:
    """(H, W, 3): a row of pictures for each class, as the paper's Fig. 5."""
    pitch = _SHEET_PX + _GAP
    sheet = np.full(
        (pitch * len(samples) + _GAP, _NAME_PX + pitch * _SHEET_COLUMNS, 3), 255, np.uint8
    )
    for number, (name, pictures) in enumerate(samples.items()):
        top = _GAP + number * pitch
        cv2.putText(sheet, name, (_GAP + 4, top + _SHEET_PX // 2 + 5), cv2.FONT_HERSHEY_SIMPLEX,
                    0.6, (30, 30, 30), 1, cv2.LINE_AA)  # fmt: skip
        for place, picture in enumerate(pictures[:_SHEET_COLUMNS]):
            left = _NAME_PX + place * pitch
            small = cv2.resize(picture, (_SHEET_PX, _SHEET_PX), interpolation=cv2.INTER_AREA)
            sheet[top : top + _SHEET_PX, left : left + _SHEET_PX] = small
    return sheet
