"""The networks of a reproduction: pictures, trainings side by side, one score after the other."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from touchdown.experiments.campaign.worker import die_with_parent
from touchdown.experiments.io.run_directory import write_text
from touchdown.experiments.reproduce.plans import Recognition

PICTURES, NETWORKS, SCORES, SETTINGS = "pictures", "networks", "scores.json", "settings.json"

Notes = Callable[[str], None]

_KEPT = ("network", "labels", "split", "pictures", "loss", "macro_f1", "recall", "top1",
         "top1_interval", "rom_mb", "peak_ram_mb", "image_ms")  # fmt: skip
_LOOK_S = 5.0
"""between two looks at how far the trainings are"""


@dataclass(frozen=True, slots=True)
class Training:
    """Picklable: one goes to each worker."""

    network: str
    labels: str
    folder: Path
    data: tuple[str, ...]
    image_size: int
    epochs: int

    @property
    def name(self) -> str:
        return f"{self.network}, {self.labels}"

    @property
    def options(self) -> dict[str, Any]:
        return {
            "network": self.network,
            "labels": self.labels,
            "image_size": self.image_size,
            "epochs": self.epochs,
        }


def train_and_score(
    home: Path,
    size: Recognition,
    photographs: Sequence[str],
    settings: dict[str, Any],
    jobs: int,
    notes: Notes,
) -> list[dict[str, Any]]:
    """A row for every network and label scheme; whatever is in ``home`` already is kept.

    Every training has one thread, however many of them there are at a time, so that what comes out
    does not depend on ``jobs``. Scores are taken when all are trained: time and memory are measured
    with nothing beside them. Pictures and trainings of other ``settings`` are begun anew.
    """
    _start_over_if_changed(home, settings)
    if not (home / PICTURES).is_dir():
        _render(home / PICTURES, size, jobs, notes)
    data = (str(home / PICTURES), *photographs)
    wanted = [
        Training(network, labels, home / NETWORKS / f"{network}-{labels}", data,
                 size.image_size, size.epochs)
        for network in size.networks
        for labels in size.labels
    ]  # fmt: skip
    _train([one for one in wanted if not (one.folder / SCORES).is_file()], jobs, notes)
    return [_score(training, notes) for training in wanted]


def _start_over_if_changed(home: Path, settings: dict[str, Any]) -> None:
    """A training goes on only with the pictures and options that it began with."""
    file, text = home / SETTINGS, json.dumps(settings, indent=1) + "\n"
    if file.is_file() and file.read_text(encoding="utf-8") != text:
        shutil.rmtree(home)
    home.mkdir(parents=True, exist_ok=True)
    write_text(file, text)


def _render(folder: Path, size: Recognition, jobs: int, notes: Notes) -> None:
    from touchdown.experiments.classification.render_dataset import DatasetParams, render_dataset

    render_dataset(
        folder,
        DatasetParams(
            images=size.images, scenes=size.scenes, pixels=size.pixels, per_seed=size.per_place
        ),
        jobs=jobs,
        progress=lambda done, total, note: notes(f"picture {done} of {total}: {note}"),
    )


# --------------------------------------------------------------------------------------- training


def _train(todo: Sequence[Training], jobs: int, notes: Notes) -> None:
    """Trains what is not trained yet; goes on with what was stopped."""
    if jobs == 1 or len(todo) <= 1 or _on_gpu():
        for training in todo:
            notes(f"training {training.name}")
            _trained(training, notes)
        return
    fresh = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(
        min(jobs, len(todo)), fresh, initializer=_begin_worker, initargs=(os.getpid(),)
    )
    try:
        _watch(
            {pool.submit(_trained, training, _say_nothing): training for training in todo}, notes
        )
    except BaseException:
        for process in multiprocessing.active_children():
            process.terminate()  # each epoch is kept; a training may be minutes from its next
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _watch(trainings: dict[Future[None], Training], notes: Notes) -> None:
    """Returns when all have ended; raises what the first that failed did."""
    waiting = set(trainings)
    while waiting:
        done, waiting = wait(waiting, timeout=_LOOK_S, return_when=FIRST_COMPLETED)
        for future in done:
            future.result()
        under_way = [trainings[future] for future in waiting if trainings[future].folder.is_dir()]
        parts = [f"{training.name}: epoch {_epochs(training)}" for training in under_way]
        notes(f"{len(trainings) - len(waiting)} of {len(trainings)} trained; " + "; ".join(parts))


def _epochs(training: Training) -> str:
    from touchdown.experiments.classification.train import CURVES

    curves = training.folder / CURVES
    ended = len(curves.read_text(encoding="utf-8").splitlines()) - 1 if curves.is_file() else 0
    return f"{min(ended + 1, training.epochs)} of {training.epochs}"


def _begin_worker(parent: int) -> None:
    """Two processes must not write to one training: without its parent a worker is gone. Ctrl-C is
    for the parent."""
    die_with_parent(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _trained(training: Training, notes: Notes) -> None:
    from touchdown.experiments.classification.train import train_network

    _use_one_thread()
    train_network(training.data, training.folder, training.options, "auto", _count_nothing, notes)


def _use_one_thread() -> None:
    import torch

    torch.set_num_threads(1)


def _on_gpu() -> bool:
    import torch

    return torch.cuda.is_available()


def _say_nothing(_note: str) -> None:
    pass


def _count_nothing(_done: int, _total: int, _note: str) -> None:
    pass


# ---------------------------------------------------------------------------------------- scoring


def _score(training: Training, notes: Notes) -> dict[str, Any]:
    """Of the network that was trained, on pictures that it was not trained on."""
    from touchdown.experiments.classification.evaluate import evaluate_network

    file = training.folder / SCORES
    if file.is_file():
        known: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        return known
    notes(f"scoring {training.name}")
    scores: dict[str, Any] = {"network": training.network, "labels": training.labels}
    for split in ("val", "test"):
        found = evaluate_network(
            training.folder / "network.onnx",
            training.data,
            split=split,
            measure=split == "test",
            engine="onnx",
            threads=1,
            progress=_count_nothing,
        )
        scores[split] = {key: found[key] for key in _KEPT if key in found}
    write_text(file, json.dumps(scores, indent=1) + "\n")
    return scores
