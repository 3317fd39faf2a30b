"""Stops commands where long work would begin: flights, renderings, trainings, other programs.

All readers run: scenes are compiled, networks loaded, images decoded, queries executed.
"""

from __future__ import annotations

import contextlib
import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest import mock

LEARNING = (
    "onnx",
    "onnxruntime.quantization",
    "touchdown.experiments.classification.quantize",
    "touchdown.experiments.classification.train",
    "touchdown.landing.classification.learning.training",
    "touchdown.landing.classification.learning.export",
)
_STOPS = (
    "touchdown.experiments.flight.run.fly_and_judge",
    "touchdown.experiments.external.conformance.check_estimator",
    "touchdown.experiments.reproduce.run._do",
    "touchdown.experiments.cli.view.run_viewer",
    "touchdown.sim.posed_sensors.PosedSensors.__init__",
    "concurrent.futures.ProcessPoolExecutor.__init__",
    "touchdown.experiments.classification.evaluate.measured_footprint",
)
_SPECS = ("touchdown.scenes.compose.compose_spec", "touchdown.scenes.export.compose_spec")
_REVISIONS = (
    "touchdown.experiments.io.provenance.git_revision",
    "touchdown.experiments.flight.replay.git_revision",
)
_TRAINER = "touchdown.landing.classification.learning.training"


class Reached(BaseException):
    """The input is valid: a flight, a rendering or a training would begin now."""


def load(*names: str) -> None:
    """Imports modules once for all cases."""
    for name in names:
        if name not in sys.modules:
            with contextlib.suppress(Exception):
                importlib.import_module(name)


def install() -> None:
    """Replaces the beginnings of long work by raising `Reached`, for the rest of the process."""
    from touchdown.scenes import compose

    real_spec, generator = compose.compose_spec, compose.scene_generator

    def compose_spec(name_or_path: str, seed: int) -> Any:
        if name_or_path.endswith(".xml") or "/" in name_or_path or seed < 0:
            return real_spec(name_or_path, seed)
        generator(name_or_path)
        raise Reached(f"build {name_or_path}")

    for name in _STOPS:
        mock.patch(name, _reach).start()
    for name in _SPECS:
        mock.patch(name, compose_spec).start()
    for name in _REVISIONS:
        mock.patch(name, return_value="abc").start()
    mock.patch("touchdown.experiments.campaign.executor.LocalEngine.run", _fly_some).start()
    if _TRAINER in sys.modules:
        mock.patch(f"{_TRAINER}.Trainer.run_epoch", _reach).start()


def _reach(*_arguments: Any, **_options: Any) -> Any:
    raise Reached


def _fly_some(_engine: Any, todo: Sequence[Any], _limits: Any, report: Any) -> None:
    """Takes the first tasks as a worker does, with `fly_nowhere` for the flight."""
    import dataclasses

    from touchdown.experiments.campaign.worker import execute

    for task in todo[:3]:
        mine = dataclasses.replace(task, runner="fuzz.grounding:fly_nowhere")
        execute(mine, lambda event, run_id=task.run_id: report({**event, "run_id": run_id}))


def fly_nowhere(config: Any, out: Path) -> Any:
    """Fills a run directory as a flight does."""
    from touchdown.experiments.config.loading import dump_config
    from touchdown.experiments.io.results import RunResult

    from support.campaign_fakes import fake_result

    out.mkdir()
    (out / "truth.tum").write_text("0 0 0 0 0 0 0 1\n")
    result = RunResult.model_validate(fake_result(config, "COMPLETED"))
    (out / "config.json").write_text(dump_config(config))
    (out / "result.json").write_text(result.to_json())
    return result


def main() -> int:
    """A whole command, in a process of its own."""
    from fuzz.cases import REACHED

    if sys.argv[1] in ("train", "quantize"):
        load(*LEARNING)
    install()
    from touchdown.experiments.cli.main import main as run

    try:
        return run(sys.argv[1:])
    except Reached:
        return REACHED


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    sys.exit(main())
