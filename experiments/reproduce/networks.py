"""Networks of a reproduction: images rendered, trainings in parallel, scores one after another."""

import csv
import functools
import importlib.util
import json
import math
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from touchdown.experiments.io.run_directory import move_beside, write_text
from touchdown.experiments.io.untrusted import read_object
from touchdown.sim.files.child import die_with_parent
from touchdown.sim.files.opening import no_file

PICTURES, NETWORKS, SCORES, SETTINGS = "pictures", "networks", "scores.json", "settings.json"

Notes = Callable[[str], None]

_KEPT = ("network", "labels", "split", "pictures", "loss", "macro_f1", "recall", "top1",
         "top1_interval", "rom_mb", "peak_ram_mb", "image_ms")  # fmt: skip
_LEVEL = 0.01
"""gain of macro F1 that is none"""
_FALLING = 0.05
"""relative fall of the training loss from one tenth of the epochs to the next of a network that is
still learning"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recognition:
    """The networks of a part, and the size of the data set that is rendered for them."""

    images: int = 0
    """0: none are rendered"""
    pixels: int = 0
    per_seed: int = 0
    scenes: tuple[str, ...] = ()
    """empty: all scenes"""
    networks: tuple[str, ...]
    labels: tuple[str, ...]
    image_size: int
    epochs: int
    """at most; the learning rate falls to 0 over so many"""
    patience: int = 8
    """epochs without a better macro F1 on the validation images after which a network has
    converged"""
    learning_rates: tuple[tuple[str, float], ...] = ()
    """of networks that do not learn at the common one"""
    image_sizes: tuple[tuple[str, int], ...] = ()
    """of networks that the common one is too small for"""
    repeated: tuple[str, ...] = ()
    """networks that are trained with each of ``seeds`` under ``d_land``, the others with the first
    alone"""
    seeds: tuple[int, ...] = (0,)


@functools.cache
def on_gpu() -> bool:
    if importlib.util.find_spec("torch") is None:
        return False
    import torch

    return bool(torch.cuda.is_available())


@dataclass(frozen=True, slots=True)
class Training:
    """One training of a network, picklable for the worker processes."""

    folder: Path
    data: tuple[str, ...]
    options: Mapping[str, Any]
    """fields of ``TrainParams``"""

    @property
    def network(self) -> str:
        return str(self.options["network"])

    @property
    def labels(self) -> str:
        return str(self.options["labels"])

    @property
    def name(self) -> str:
        return f"{self.network}, {self.labels}, seed {self.options['seed']}"


def train_and_score(
    home: Path,
    size: Recognition,
    photographs: Sequence[str],
    settings: Mapping[str, Any],
    jobs: int,
    notes: Notes,
) -> list[dict[str, Any]]:
    """Returns the scores of every network under every label scheme; results in ``home`` are reused.

    Every training uses one thread, so that results do not depend on ``jobs``. Networks are scored
    after all trainings, so that time and memory are measured with nothing else running. Images and
    trainings made with other ``settings`` are set aside and made again.
    """
    _start_over_if_changed(home, settings)
    if size.images and not (home / PICTURES).is_dir():
        _render(home / PICTURES, size, jobs, notes)
    data = (*([str(home / PICTURES)] if size.images else []), *photographs)
    wanted = list(_trainings(home / NETWORKS, size, data))
    _train([one for one in wanted if _known_scores(one.folder / SCORES, one) is None], jobs, notes)
    return [_score(training, notes) for training in wanted]


def _trainings(home: Path, size: Recognition, data: tuple[str, ...]) -> Iterator[Training]:
    """Every network under every label scheme; those repeated once more for each further seed."""
    rates, sizes = dict(size.learning_rates), dict(size.image_sizes)
    for network in size.networks:
        for labels in size.labels:
            again = network in size.repeated and labels == "d_land"
            for seed in size.seeds if again else size.seeds[:1]:
                options = {
                    "network": network, "labels": labels, "seed": seed,
                    "image_size": size.image_size,
                    "epochs": size.epochs, "patience": size.patience,
                }  # fmt: skip
                if network in rates:
                    options["learning_rate"] = rates[network]
                if network in sizes:
                    options["image_size"] = sizes[network]
                name = f"{network}-{labels}" + (f"-{seed}" if seed != size.seeds[0] else "")
                yield Training(home / name, data, options)


def _start_over_if_changed(home: Path, settings: Mapping[str, Any]) -> None:
    """Sets ``home`` aside if its images and trainings were made with other settings."""
    file, text = home / SETTINGS, json.dumps(settings, indent=1) + "\n"
    if not no_file(file) and file.read_text(encoding="utf-8") != text:
        move_beside(home, home)
    home.mkdir(parents=True, exist_ok=True)
    write_text(file, text)


def _render(folder: Path, size: Recognition, jobs: int, notes: Notes) -> None:
    from touchdown.experiments.classification.render_dataset import DatasetParams, render_dataset

    render_dataset(
        folder,
        DatasetParams(
            images=size.images, scenes=size.scenes, pixels=size.pixels, per_seed=size.per_seed
        ),
        jobs=jobs,
        progress=lambda done, total, note: notes(f"image {done} of {total}: {note}"),
    )


def _train(todo: Sequence[Training], jobs: int, notes: Notes) -> None:
    """Trains the given networks; resumes interrupted trainings."""
    if jobs == 1 or len(todo) <= 1 or on_gpu():
        for training in todo:
            notes(f"training {training.name}")
            _trained(training, notes)
        return
    fresh = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(
        min(jobs, len(todo)), fresh, initializer=_begin_worker, initargs=(os.getpid(),)
    )
    try:
        trainings = {pool.submit(_trained, training, _ignore): training for training in todo}
        for number, future in enumerate(as_completed(trainings), start=1):
            future.result()
            notes(f"{number} of {len(todo)} trained: {trainings[future].name}")
    except BaseException:
        for process in multiprocessing.active_children():
            process.terminate()  # each epoch is kept; a training may be minutes from its next
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _begin_worker(parent: int) -> None:
    """Prepares a worker process: it ends with its parent, since two processes must not write to one
    training, and it leaves Ctrl-C to the parent."""
    die_with_parent(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _trained(training: Training, notes: Notes) -> None:
    from touchdown.experiments.classification.train import train_network

    _use_one_thread()
    train_network(training.data, training.folder, training.options, "auto", _ignore, notes)


def _use_one_thread() -> None:
    import torch

    torch.set_num_threads(1)


def _ignore(*_progress: object) -> None:
    pass


def _known_scores(file: Path, training: Training) -> dict[str, Any] | None:
    """The scores in ``file``; None where there are none of this training."""
    try:
        known = read_object(file)
    except (OSError, ValueError):
        return None
    named = ("network", "labels", "seed")
    same = all(known.get(key, 0) == training.options[key] for key in named)
    whole = all(isinstance(known.get(split), dict) for split in ("val", "test"))
    return known if same and whole else None


def _score(training: Training, notes: Notes) -> dict[str, Any]:
    """Returns the validation and test scores of a trained network."""
    from touchdown.experiments.classification.evaluate import EvaluateParams, evaluate_network

    file = training.folder / SCORES
    if (known := _known_scores(file, training)) is not None:
        return known
    notes(f"scoring {training.name}")
    scores: dict[str, Any] = {key: training.options[key] for key in ("network", "labels", "seed")}
    scores |= _course(training)
    for split in ("val", "test"):
        found = evaluate_network(
            training.folder / "network.onnx",
            training.data,
            split,
            _ignore,
            options=EvaluateParams(measure=split == "test"),
        )
        scores[split] = {key: found[key] for key in _KEPT if key in found}
    write_text(file, json.dumps(scores, indent=1) + "\n")
    return scores


def _course(training: Training) -> dict[str, Any]:
    """Epochs of a training, and whether it converged.

    It did where it ended early, or macro F1 on the validation images rose by less than 0.01 from
    the last but one tenth of its epochs to the last; but not while the loss on the training images
    still fell by a twentieth between the two: few validation images make patience end by chance."""
    from touchdown.experiments.classification.train import CURVES

    with (training.folder / CURVES).open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    tenth = math.ceil(training.options["epochs"] / 10)
    means = {
        key: [fmean(float(row[key]) for row in part) for part in _parts(rows, tenth)]
        for key in ("val_macro_f1", "train_loss")
    }
    early, long = len(rows) < training.options["epochs"], len(rows) > tenth
    level = long and means["val_macro_f1"][1] - means["val_macro_f1"][0] < _LEVEL
    learning = long and means["train_loss"][1] < (1.0 - _FALLING) * means["train_loss"][0]
    return {"epochs": len(rows), "converged": (early or level) and not learning}


def _parts(rows: Sequence[Any], count: int) -> tuple[Sequence[Any], Sequence[Any]]:
    """The last but one ``count`` rows, and the last."""
    return rows[-2 * count : -count] or rows, rows[-count:]
