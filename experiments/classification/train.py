"""`touchdown train`: training of a network on labelled images, its file and learning curves."""

import contextlib
import csv
import fcntl
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from touchdown.experiments.classification.evaluate import training_libraries
from touchdown.experiments.classification.image_folders import (
    load_images,
    of_classes,
    read_catalogue,
)
from touchdown.experiments.errors import UsageError
from touchdown.experiments.flight.platform import set_malloc
from touchdown.experiments.io.run_directory import whole_file, write_text
from touchdown.landing.classification.decision import fitted_limits
from touchdown.landing.classification.engine import apply_miss_costs
from touchdown.landing.classification.labels import SCHEMES
from touchdown.landing.classification.scores import summary
from touchdown.landing.classification.weights import NetworkFacts

CURVES, RECORDING, REPORT, NETWORK = "curves.csv", "curves.rrd", "training.json", "network.onnx"
Progress = Callable[[int, int, str], None]


def train_network(
    data: Sequence[str],
    out: Path,
    options: Mapping[str, Any],
    device: str,
    progress: Progress,
    notes: Callable[[str], None],
    *,
    start: Path | None = None,
) -> dict[str, Any]:
    """Trains to the end; an interrupted training in ``out`` is resumed. Returns the report.

    ``options``: fields of ``landing.classification.learning.training.TrainParams``. Raises
    UsageError for bad input, before anything is written."""
    if out.exists() and not out.is_dir():
        raise UsageError(f"--out: '{out}' is a file; name a folder")
    with training_libraries():
        from touchdown.landing.classification.learning import export, training
        from touchdown.landing.classification.networks.registry import check_network
    params = training.TrainParams(**options)
    check_network(params.network, params.image_size)
    facts = NetworkFacts(
        network=params.network,
        labels=params.labels,
        image_size=params.image_size,
        classes=SCHEMES[params.labels],
        miss_costs=params.miss_costs,
    )
    chosen = training.chosen_device(device)
    if chosen.type == "cpu":
        keep_freed_memory()
    catalogues = [read_catalogue(argument, params.labels, params.left_out) for argument in data]
    train, seen = (
        load_images(catalogues, split, params.labels, params.image_size, progress, others=True)
        for split in ("train", "val")
    )
    val = of_classes(seen)
    with _new_folder(out), training_libraries():
        lock = _locked(out)
        trainer = training.Trainer(params, train, val, out, chosen, start=start)
    if trainer.history:
        notes(f"resuming after epoch {len(trainer.history)}")
    while not trainer.finished:
        row = trainer.run_epoch(progress)
        write_curves(out / CURVES, trainer.history)
        notes(
            "epoch {epoch:3.0f}  loss {train_loss:.3f}  validation: loss {val_loss:.3f}  "
            "F1 {val_macro_f1:.3f}  top-1 {val_top1:.3f}".format(**row)
        )
    best = trainer.best()
    weighted = apply_miss_costs(best.scores, facts)
    if params.labels == "d_land":
        claims = training.predict(best.network, seen.images, training.chosen_device("cpu"))
        scaled = apply_miss_costs((claims / best.temperature).astype("f4"), facts)
        limits = fitted_limits(scaled, seen.labels)
        facts = replace(facts, limits=limits)
    export.export_network(out / NETWORK, best.network, best.temperature, facts)
    record_curves(out / RECORDING, best.history)
    found = summary(weighted, val.labels, val.classes)
    report = {
        "network_file": str(out / NETWORK),
        "parameters": asdict(params),
        "device": str(chosen),
        "pictures": {"train": len(train.labels), "val": len(val.labels)},
        "left_out": sum(catalogue.left_out for catalogue in catalogues),
        "epochs": len(best.history),
        "best_epoch": best.best_epoch + 1,
        "temperature": best.temperature,
        "limits": asdict(facts.limits) if params.labels == "d_land" else None,
        "validation": best.history[best.best_epoch],
        "written": {name: found[name] for name in ("loss", "macro_f1", "recall", "top1", "ece")},
        "bytes": (out / NETWORK).stat().st_size,
    }
    write_text(out / REPORT, json.dumps(report, indent=2) + "\n")
    os.close(lock)
    return report


@contextlib.contextmanager
def _new_folder(out: Path) -> Iterator[None]:
    """Makes a folder; where the block raises, what was made is removed, as long as it is empty."""
    missing = [folder for folder in (out, *out.parents) if not folder.exists()]
    out.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        with contextlib.suppress(OSError):
            for folder in missing:
                folder.rmdir()
        raise


def _locked(out: Path) -> int:
    """A descriptor whose lock keeps others from training in ``out`` until it is closed, or this
    process has ended. Raises UsageError where another one trains there."""
    lock = os.open(out, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(lock)
        raise UsageError(
            f"--out: another process is training in '{out}'; wait for it, or name another folder"
        ) from None
    except OSError:
        pass  # a file system without locks of directories
    return lock


def keep_freed_memory() -> None:
    """Makes this process keep freed memory.

    Every step of a training needs the same memory. glibc returns large blocks to the system and
    allocates them again, zeroed page by page, which took a third of the time on a CPU.
    """
    set_malloc(max_mappings=0, trim_bytes=-1)


def write_curves(path: Path, history: Sequence[Mapping[str, float]]) -> None:
    """Writes the learning curves as CSV, one row an epoch."""
    with whole_file(path) as partial, partial.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(history[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: f"{value:.6g}" for key, value in row.items()} for row in history)


def record_curves(path: Path, history: Sequence[Mapping[str, float]]) -> None:
    """Writes the learning curves for the Rerun viewer: `touchdown view FILE`."""
    import rerun as rr

    with whole_file(path) as partial:
        stream = rr.RecordingStream("touchdown training", recording_id=str(path.parent.name))
        stream.save(partial)
        epochs = [int(row["epoch"]) for row in history]
        for name in history[0]:
            if name != "epoch":
                group = "loss" if name.endswith("loss") else name
                stream.send_columns(
                    f"{group}/{name}",
                    [rr.TimeColumn("epoch", sequence=epochs)],
                    rr.Scalars.columns(scalars=[row[name] for row in history]),
                )
        stream.flush()
        stream.disconnect()
