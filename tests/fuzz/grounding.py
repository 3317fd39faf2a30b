"""Stops commands where long work would begin: flights, renderings, trainings, other programs.

All readers run: scenes are compiled, networks loaded, images decoded, queries executed.
"""

import contextlib
import functools
import importlib
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

LEARNING = (
    "onnx", "onnxruntime.quantization", "touchdown.experiments.classification.derived",
    "touchdown.experiments.classification.train",
    "touchdown.landing.classification.learning.training",
    "touchdown.landing.classification.learning.export",
)  # fmt: skip
SLOW_TO_LOAD = {"asset": ("control",), "campaign": ("pandas",), "argv": ("rerun",)}
"""By kind, what the first case that needs it would load, and then the process that forks it."""

SOUND_NETWORKS: set[str] = set()
"""Checksums of networks that need no trial."""


class Reached(BaseException):
    """The input is valid: a flight, a rendering or a training would begin now."""


def _reach(*_arguments: Any, **_options: Any) -> Any:
    raise Reached


def _compose_spec(name_or_path: str, seed: int, ready: Any = None, *others: Any) -> Any:
    """Composes scenes of files; built-in ones take seconds and read nothing."""
    from touchdown.scenes import compose

    if name_or_path.endswith(".xml") or "/" in name_or_path or seed < 0:
        return _REAL["touchdown.scenes.compose", "compose_spec"](name_or_path, seed, ready)
    compose.scene_generator(name_or_path)
    raise Reached


def _check_loads(path: Path, sha256: str) -> None:
    """Tries a network in a process of its own, but for the one that all cases share."""
    if sha256 not in SOUND_NETWORKS:
        _REAL["touchdown.landing.classification.network_check", "check_loads"](path, sha256)


def _fly_some(_engine: Any, todo: Sequence[Any], _limits: Any, report: Any) -> None:
    """Takes the first tasks as a worker does, with `fly_nowhere` for the flight."""
    import dataclasses

    from touchdown.experiments.campaign.worker import fly

    for task in todo[:3]:
        row = fly(dataclasses.replace(task, runner="fuzz.grounding:fly_nowhere"))
        report({"event": "finished", "run_id": task.run_id, "row": row})


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


def _no_revision() -> str:
    return "abc"


_COARSE_TEXEL_M = 0.3
"""Of ground that is dressed: what is read does not depend on how finely it is painted"""
_STOPS: dict[str, dict[str, Any]] = {
    "concurrent.futures.process": {"ProcessPoolExecutor.__init__": _reach},
    "touchdown.scenes.importers.ground_texturing": {"TEXEL_M": _COARSE_TEXEL_M},
    "touchdown.scenes.compose": {"compose_spec": _compose_spec},
    "touchdown.sim.posed_sensors": {"PosedSensors.__init__": _reach},
    "touchdown.landing.classification.network_check": {"check_loads": _check_loads},
    "touchdown.experiments.io.provenance": {"git_revision": _no_revision},
    "touchdown.experiments.flight.run": {"fly_and_judge": _reach},
    "touchdown.experiments.flight.replay": {"git_revision": _no_revision},
    "touchdown.experiments.campaign.executor": {"LocalEngine.run": _fly_some},
    "touchdown.experiments.external.conformance": {"check_estimator": _reach},
    "touchdown.experiments.cli.view": {"run_viewer": _reach},
    "touchdown.experiments.classification.evaluate": {"measured_footprint": _reach},
    "touchdown.experiments.benchmarks.all_measures": {"_run": _reach},
    "touchdown.experiments.reproduce.run": {"_do": _reach},
    "touchdown.landing.classification.learning.training": {"Trainer.run_epoch": _reach},
}
"""By module, what is replaced in it; a module stands before those that import from it."""
_REAL: dict[tuple[str, str], Callable[..., Any]] = {}


def install(learning: bool) -> None:
    """Replaces the beginnings of long work, for the rest of the process; those of training, which
    need torch, only where ``learning``."""
    for name, parts in _STOPS.items():
        if name in LEARNING and not learning:
            continue
        module = importlib.import_module(name)
        for path, new in parts.items():
            if (name, path) not in _REAL:
                *parents, last = path.split(".")
                owner = functools.reduce(getattr, parents, module)
                _REAL[name, path] = getattr(owner, last)
                setattr(owner, last, new)


def load(*names: str) -> None:
    """Imports modules once for all cases."""
    for name in names:
        if name not in sys.modules:
            with contextlib.suppress(Exception):
                importlib.import_module(name)
