"""The command line with a reproduction whose slow parts are short, but honest about files:
``python -m support.reproduce_command reproduce ...``. Processes that it starts are changed, too."""

from __future__ import annotations

import functools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

from touchdown.experiments.config.schema import Config
from touchdown.experiments.io.results import RunResult

from support import reproduce_world
from support.campaign_command import environment
from support.campaign_flights import ROOT

CALLS = "TOUCHDOWN_TEST_CALLS"
"""environment variable: the file in which every call of a slow function is one line"""
_WORK_S = 0.3


def start(*arguments: str | Path, **more: str) -> subprocess.Popen[str]:
    """The command in a process of its own; ``more`` are variables of its environment."""
    command = [sys.executable, "-m", "support.reproduce_command", *map(str, arguments)]
    return subprocess.Popen(
        command, cwd=ROOT, env=environment(more), stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True,
    )  # fmt: skip


def note_call(what: str) -> None:
    with open(os.environ[CALLS], "a", encoding="utf-8") as file:
        file.write(f"{what}\n")


def fly(config: Config, out: Path) -> RunResult:
    """The runner of campaigns."""
    note_call(f"flight {out.parents[3].name} {out.name}")
    time.sleep(_WORK_S)
    return reproduce_world.fly(config, out)


def _working(part: str) -> None:
    note_call(part)
    time.sleep(_WORK_S)


def _calibration(_config: Any, poses: int, out: Path, pictures: Path, _note: Any) -> Any:
    _working("calibration")
    reproduce_world.draw(pictures / "cloud.png", pictures / "boards.png")
    return {"file": str(out), "views": {"used": poses}, "consistency": {"consistent": True}}


def _edges(folder: Path, _seed: int, _model: str, _notes: Any) -> tuple[Path, Path]:
    _working("edges")
    files = folder / "edges.jpg", folder / "smoothness.jpg"
    reproduce_world.draw(*files)
    return files


def _view(_name: str, _seed: int, _view: str, out: Path) -> None:
    _working("world")
    reproduce_world.draw(out)


def _portrait(_scene: Any) -> tuple[Any, Any]:
    import numpy as np

    facts = SimpleNamespace(mass_kg=4.2, footprint_radius_m=0.53)
    return np.zeros((40, 60, 3), np.uint8), facts


def _sites(scenes: tuple[str, ...], pictures: Path, **_options: Any) -> dict[str, Any]:
    _working("sites")
    reproduce_world.draw(*(pictures / f"site_{scene}.jpg" for scene in scenes))
    check = {"seed": 0, "chosen_safe": True, "accepted": 9, "accepted_safe": 8}
    return {"scorer": "risk", "places": [{"scene": scene, **check} for scene in scenes]}


def _speed(**_options: Any) -> dict[str, Any]:
    _working("speed")
    return {"scene": "crossroad", "cells": [300, 400], "stage_ms": {}}


def _report(_done: Any, out: Path) -> None:
    _working("report")
    out.mkdir(exist_ok=True)


def change() -> None:
    """Puts the short functions in the place of the slow ones."""
    from touchdown.experiments.campaign import session

    put = {
        "calibration.evaluate.run_calibration": _calibration,
        "edges.figures.draw_figures": _edges,
        "scene_tools.render.vehicle_portrait": _portrait,
        "scene_tools.render.load_configured_scene": lambda _config: None,
        "scene_tools.render.render_view": _view,
        "benchmarks.site_selection.run": _sites,
        "benchmarks.site_selection_time.bench_landing": _speed,
        "reproduce.report.write_reproduction": _report,
        "campaign.session.fly_campaign": functools.partial(
            session.fly_campaign, runner="support.reproduce_command:fly"
        ),
    }
    for name, made in put.items():
        mock.patch(f"touchdown.experiments.{name}", made).start()


if __name__ in ("__main__", "__mp_main__"):
    change()

if __name__ == "__main__":
    from touchdown.experiments.cli import main as cli

    signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs ignore it
    sys.exit(cli.main())
