"""Fakes of all slow parts of a reproduction."""

import dataclasses
import importlib
import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.campaign import worker
from touchdown.experiments.campaign.worker import Task
from touchdown.experiments.config.loading import dump_config
from touchdown.experiments.config.schema import Config
from touchdown.experiments.io.images import write_png
from touchdown.experiments.io.results import RunResult, load_result

from support.report_support import LANDING, write_run

SCORES = {"loss": 0.5, "macro_f1": 0.6, "recall": 0.7, "top1": 0.75, "top1_interval": [0.7, 0.8]}


def fly(config: Config, out: Path) -> RunResult:
    """A flight as a campaign's worker would fly it."""
    landing = None
    if not config.landing.survey_only:
        landing = LANDING | {"touchdown_xy_m": [1.0, 2.0], "site_xy_m": [1.1, 2.0]}
    changes: dict[str, Any] = {
        "outcome": "COMPLETED" if landing is None else "LANDED",
        "landing": landing,
        "trajectory_error_m": 0.1,
        "position_error_m": {"mean": 0.05, "x": 0.03, "y": 0.04, "z": 0.01, "yaw_deg": 0.2},
    }
    run = write_run(out.parent, config.scene, config.estimator, config.seed, **changes)
    run.rename(out)
    (out / "config.json").write_text(dump_config(config))
    return load_result(out / "result.json")


@dataclasses.dataclass
class World:
    """Replaces all slow functions and records their calls."""

    calls: list[str] = dataclasses.field(default_factory=list)
    consistent: bool = True
    broken: str = ""
    course: Callable[[int], float] = lambda _epoch: 0.6
    """macro F1 of each epoch of a training"""
    loss: Callable[[int], float] = lambda _epoch: 1.0
    """of each epoch, on the training images"""
    ended: int = 0
    """epoch after which trainings ended early; 0: none did"""
    top1: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """of trainings, by the name of their folder"""
    interrupted: str = ""

    def ask(self, what: str) -> None:
        self.calls.append(what)
        if what == self.broken:
            raise RuntimeError("a wing\ncame off")
        if what == self.interrupted:
            raise KeyboardInterrupt

    def count(self, what: str) -> int:
        return self.calls.count(what)


def draw(*files: Path) -> None:
    for file in files:
        write_png(file.with_suffix(".png"), np.full((40, 60, 3), 90, np.uint8))
        file.with_suffix(".png").rename(file)


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    found = World()

    def replaced(name: str, what: str) -> Callable[[Callable[..., Any]], None]:
        module, _, function = name.rpartition(".")
        real = inspect.signature(
            getattr(importlib.import_module(f"touchdown.experiments.{module}"), function)
        )

        def put(made: Callable[..., Any]) -> None:
            def asked(*args: Any, **options: Any) -> Any:
                real.bind(*args, **options)
                found.ask(what)
                return made(*args, **options)

            monkeypatch.setattr(f"touchdown.experiments.{name}", asked)

        return put

    @replaced("calibration.calibrate.run_calibration", "calibration")
    def _(config: Config, poses: int, out: Path, pictures: Path, note: Any) -> dict[str, Any]:
        out.write_text("{}")
        draw(pictures / "cloud.png", pictures / "boards.png")
        return {
            "file": str(out),
            "views": {"given": poses, "used": poses},
            "error": {
                "rotation_deg": 0.012,
                "translation_m": 0.003,
                "camera_percent": {"fx": 0.1, "fy": 0.1, "cx": 0.2, "cy": -0.2},
            },
            "stated_sigma": {"rotation_deg": [0.003, 0.004, 0.0], "translation_m": [0.002] * 3},
            "consistency": {"consistent": found.consistent},
        }

    @replaced("edges.scores.draw_figure", "edges")
    def _(folder: Path, seed: int, model: str, notes: Any) -> Path:
        draw(folder / "smoothness.jpg")
        return folder / "smoothness.jpg"

    @replaced("scene_tools.render.vehicle_portrait", "vehicle")
    def _(scene: Any) -> tuple[Any, Any]:
        return np.zeros((40, 60, 3), np.uint8), None

    monkeypatch.setattr(
        "touchdown.experiments.scene_tools.render.load_configured_scene", lambda _: None
    )

    @replaced("scene_tools.render.render_view", "scene")
    def _(name: str, seed: int, view: str, out: Path) -> None:
        draw(out)

    @replaced("benchmarks.selection.sites.run", "sites")
    def _(source: Any, selectors: list[str], drawings: Any, **options: Any) -> dict[str, Any]:
        scenes = source.scenes
        draw(*(drawings.pictures / f"site_{scene}.jpg" for scene in scenes))
        check = {"seed": 0, "chosen_safe": True, "accepted": 9, "accepted_safe": 8}
        return {"selector": "risk", "places": [{"scene": scene, **check} for scene in scenes]}

    @replaced("benchmarks.selection.timing.bench_landing", "speed")
    def _(rounds: int, threads: int, reference: bool) -> dict[str, Any]:
        names = ("down_sampling", "flatness", "smoothness", "distance", "clustering", "selection")
        times = {name: 1.5 for name in names}
        return {"scene": "crossroad", "cells": [300, 400], "stage_ms": times}

    @replaced("classification.render_dataset.render_dataset", "pictures")
    def _(out: Path, params: Any, **options: Any) -> None:
        out.mkdir(parents=True)
        draw(out / "contact_sheet.png")

    @replaced("classification.train.train_network", "training")
    def _(data: list[str], out: Path, options: dict[str, Any], *rest: Any) -> dict[str, Any]:
        out.mkdir(parents=True, exist_ok=True)
        (out / "network.onnx").write_text("weights")
        epochs = range(found.ended or options["epochs"])
        rows = "".join(f"{found.course(epoch)},{found.loss(epoch)}\n" for epoch in epochs)
        (out / "curves.csv").write_text(f"val_macro_f1,train_loss\n{rows}")
        return {"epochs": options["epochs"]}

    @replaced("classification.evaluate.evaluate_network", "scores")
    def _(
        network: Path, data: list[str], split: str, progress: Any, **options: Any
    ) -> dict[str, Any]:
        assert network.is_file()
        own = {"top1": found.top1.get(network.parent.name, SCORES["top1"])}
        return {"split": split, "pictures": 90, "rom_mb": 22.4, "image_ms": 3.0, **SCORES, **own}

    def run(todo: list[Task], limits: Any, report: Callable[[Any], None]) -> None:
        for task in todo:
            found.ask(f"{task.run_id}")
            row = worker.fly(dataclasses.replace(task, runner="support.reproduce_world:fly"))
            report({"event": "finished", "run_id": task.run_id, "row": row})

    engine = SimpleNamespace(name="here", jobs=1, run=run)
    monkeypatch.setattr("touchdown.experiments.campaign.session.make_engine", lambda *_: engine)
    for slow in ("campaign.worker.release_memory", "reproduce.networks._use_one_thread"):
        monkeypatch.setattr(f"touchdown.experiments.{slow}", lambda: None)
    # copies of the sources without git are tested, too
    monkeypatch.setattr("touchdown.experiments.io.provenance.git_revision", lambda: "0123abc")
    monkeypatch.setattr("touchdown.experiments.reproduce.run._check_libraries", lambda parts: None)
    return found


@pytest.fixture
def no_report(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing and resampling take seconds."""
    monkeypatch.setattr(
        "touchdown.experiments.reproduce.report.write_reproduction",
        lambda done, out: out.mkdir(exist_ok=True),
    )
