"""Touchdown: a closed-loop simulation testbed for landing a quadrotor without GPS.

The names below are loaded when they are first used, so that ``import touchdown`` is fast. All other
public names are in ``touchdown.<folder>.api``.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from touchdown.sim.opengl import choose_backend

# Sums over two threads differ in their last bits from sums over one. Flights keep to one themselves
# (`experiments.flight.platform`); this is for all else, where nobody asked for more. NumPy reads it
# when it is loaded, so it is set before.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

choose_backend()

if TYPE_CHECKING:
    from touchdown.estimator.api import Estimate, Estimator
    from touchdown.experiments.config.schema import Config
    from touchdown.experiments.environments import suite as suite
    from touchdown.experiments.errors import UsageError
    from touchdown.experiments.io.results import RunResult
    from touchdown.experiments.python_api import (
        check_estimator,
        fly,
        land,
        load_config,
        load_runs,
        replay,
    )
    from touchdown.experiments.scene_tools import pymjcf as pymjcf
    from touchdown.sim.api import Observation, SensorNeeds, SensorRig
    from touchdown.sim.frames import Pose

    __version__: str

__all__ = [
    "Config",
    "Estimate",
    "Estimator",
    "Observation",
    "Pose",
    "RunResult",
    "SensorNeeds",
    "SensorRig",
    "UsageError",
    "check_estimator",
    "fly",
    "land",
    "load_config",
    "load_runs",
    "replay",
]

_HOMES = {
    "Config": "experiments.config.schema",
    "Estimate": "estimator.api",
    "Estimator": "estimator.api",
    "Observation": "sim.api",
    "Pose": "sim.frames",
    "RunResult": "experiments.io.results",
    "SensorNeeds": "sim.api",
    "SensorRig": "sim.api",
    "UsageError": "experiments.errors",
}
"""Module of each name; the others are in `experiments.python_api`."""
_MODULES = {
    "pymjcf": "experiments.scene_tools.pymjcf",
    "suite": "experiments.environments.suite",
}
"""Modules by name; they need dm_control, and ``import *`` leaves them alone."""


def __getattr__(name: str) -> Any:
    import importlib

    if name == "__version__":
        from importlib.metadata import version

        return version("touchdown-sim")
    if name in _MODULES:
        module = globals()[name] = importlib.import_module(f"touchdown.{_MODULES[name]}")
        return module
    if name not in __all__:
        raise AttributeError(f"module 'touchdown' has no attribute '{name}'")
    home = importlib.import_module(f"touchdown.{_HOMES.get(name, 'experiments.python_api')}")
    value = globals()[name] = getattr(home, name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_MODULES, "__version__"})
