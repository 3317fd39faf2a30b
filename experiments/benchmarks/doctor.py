"""What this machine has of what flights need: ``touchdown doctor``."""

import ctypes
import importlib.metadata
import os
import platform
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil

from touchdown.experiments.benchmarks.loop import measure_loop
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.config.schema import Config
from touchdown.experiments.io.provenance import DISTRIBUTION, git_revision, versions
from touchdown.experiments.io.results import RunResult
from touchdown.sim.camera.gl_contexts import gl_context, put_back, renderer_name

LIBRARIES = {
    "libEGL.so.1": "libegl1",
    "libEGL_mesa.so.0": "libegl-mesa0",
    "libGL.so.1": "libgl1",
    "libOpenGL.so.0": "libopengl0",
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libgomp.so.1": "libgomp1",
    "libX11.so.6": "libx11-6",
}
"""Libraries of the system and the packages of Debian that hold them, as in .ci/system-libraries."""
EXTRAS = {
    "px4": "PX4 as the controller",
    "ray": "campaigns on a Ray cluster",
    "rl": "the Gymnasium environment and its policies",
    "train": "training of ground classifiers",
    "tune": "tuning of estimators",
    "bench": "comparison with other LIDAR simulators",
}
"""Extras of the distribution and what they are for."""
TEN_SECONDS = (
    "survey.legs=1", "survey.leg_length_m=5.0", "survey.duration_s=5.0", "survey.height_m=4.0",
    "landing.survey_only=true",
)  # fmt: skip
"""Settings of a flight of about ten simulated seconds."""
_SOFTWARE = ("llvmpipe", "softpipe", "swrast")
Fly = Callable[[Config, Path], RunResult]


def examine(fly: Fly) -> dict[str, Any]:
    """Figures of the machine, what is missing on it, and a flight of ten seconds by ``fly``.

    ``renderer``: its ``name`` (None where nothing can be drawn), ``backend`` and ``in_software``.
    ``missing``: ``what``, ``for`` and ``command``, which gets it. ``flight``: the figures of
    `measure_loop`, or an ``error``. ``ready``: a flight can be drawn, and completed its survey."""
    renderer, fault = _renderer()
    flight = {"error": fault} if fault else _flight(fly)
    return {
        "versions": {"python": platform.python_version(), **versions()},
        "git_revision": git_revision(),
        "machine": {
            "system": f"{platform.platform()} {platform.machine()}",
            "cores": len(os.sched_getaffinity(0)),
            "memory_gb": psutil.virtual_memory().total / 1e9,
            "available_gb": psutil.virtual_memory().available / 1e9,
        },
        "renderer": renderer,
        "missing": [*missing_libraries(), *missing_packages()],
        "flight": flight,
        "ready": flight.get("outcome") == "COMPLETED",
    }


def _renderer() -> tuple[dict[str, Any], str]:
    """What draws here, and the reason why nothing does ("" where something does)."""
    try:
        context = gl_context(8, 8)
    except RuntimeError as error:
        return {"name": None, "backend": None, "in_software": None}, str(error)
    name = renderer_name()
    put_back(context)
    software = name.startswith(_SOFTWARE)
    return {"name": name, "backend": os.environ["MUJOCO_GL"], "in_software": software}, ""


def _flight(fly: Fly) -> dict[str, Any]:
    config = load_config(None, TEN_SECONDS, scene="flat", record=True)
    try:
        figures: dict[str, Any] = measure_loop(config, fly)["figures"]
    except (OSError, ImportError, ValueError, RuntimeError) as error:  # a library lacks a library
        return {"error": f"{type(error).__name__}: {error}"}
    return figures


def missing_libraries() -> list[dict[str, str]]:
    """Libraries of the system that do not load."""
    return [
        {"what": name, "for": "flights", "command": f"apt-get install -y {package}"}
        for name, package in LIBRARIES.items()
        if not _loads(name)
    ]


def _loads(name: str) -> bool:
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True


def missing_packages() -> list[dict[str, str]]:
    """Python packages of extras, and dm_control, that are not installed."""
    needed: dict[str, list[str]] = {}
    for requirement in importlib.metadata.requires(DISTRIBUTION) or []:
        found = re.match(r"([\w.-]+).*extra == ['\"](\w+)", requirement)
        if found and found[2] in EXTRAS and not _installed(found[1]):
            needed.setdefault(found[2], []).append(found[1])
    missing = [
        {"what": " ".join(names), "for": EXTRAS[extra], "command": f"pip install {' '.join(names)}"}
        for extra, names in needed.items()
    ]
    if not _installed("dm-control"):
        how = "pip install dm-control" if sys.version_info < (3, 13) else "Python 3.11 or 3.12"
        missing.append({"what": "dm_control", "for": "the dm_control suite", "command": how})
    return missing


def _installed(name: str) -> bool:
    try:
        importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True
