"""All measures of speed of one checkout, and those of two side by side.

Each command runs in a process of its own on the sources of its checkout; two checkouts take turns,
command by command, so that both meet the same machine.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from touchdown.experiments.errors import UsageError

TOUCHDOWN = ("-m", "touchdown")
COMMANDS: Mapping[str, tuple[str, ...]] = {
    "flights": (str(Path(__file__).with_name("flights_probe.py")),),
    "loop": (*TOUCHDOWN, "bench", "loop", "--no-ratio", "--quiet", "--json"),
    "lidar": (*TOUCHDOWN, "bench", "lidar", "--json"),
    "landing": (*TOUCHDOWN, "bench", "landing", "--no-reference", "--json"),
}
"""arguments of the interpreter, whose last output is one JSON object"""


@dataclass(frozen=True, slots=True)
class Measure:
    """A figure of what a command of `COMMANDS` prints; ``path``: of keys."""

    title: str
    unit: str
    command: str
    path: tuple[str, ...]
    more_is_better: bool = False


MEASURES = (
    Measure("landing in a worker", "core-s per s", "flights", ("core_s_per_s",)),
    Measure("picture and film", "ms a frame", "flights", ("picture_ms",)),
    Measure("LIDAR", "ms a scan", "flights", ("scan_ms",)),
    Measure("estimator livo", "ms per 0.1 s", "flights", ("estimator_ms",)),
    Measure("set-up of a worker's second flight", "s", "flights", ("set_up_s",)),
    Measure("memory of a worker, first flight", "MB", "flights", ("first_mb",)),
    Measure("memory of a worker, second flight", "MB", "flights", ("second_mb",)),
    Measure("real-time factor, recording on", "", "loop", ("real_time_factor",), True),
    Measure("LIDAR over bare Embree", "", "lidar", ("ratio", "embree"), True),
    Measure("LIDAR over mujoco-lidar", "", "lidar", ("ratio", "mujoco_lidar"), True),
    Measure("choice of a site", "ms", "landing", ("stage_ms", "sum")),
    Measure("ten patches by the network", "ms", "landing", ("classifier_ms", "ten_patches")),
)


@dataclass(frozen=True, slots=True)
class Figures:
    """Medians over the rounds, by title, of each checkout; None where a checkout does not print a
    figure."""

    measure: Measure
    values: tuple[float | None, ...]

    @property
    def ratio(self) -> float | None:
        """The last over the first."""
        first, last = self.values[0], self.values[-1]
        return last / first if first and last is not None else None


def measure_all(trees: Sequence[Path], rounds: int = 1) -> Iterator[tuple[str, list[Figures]]]:
    """Runs the commands in turns on the sources below ``trees`` and gives each one's name and
    figures as it ends. Raises UsageError for a folder that is no checkout and for a command that
    fails."""
    for tree in trees:
        if not (tree / "src" / "touchdown" / "__init__.py").is_file():
            raise UsageError(f"'{tree}' is no checkout of touchdown: it has no src/touchdown")
    for name, arguments in COMMANDS.items():
        found: list[list[object]] = [[] for _ in trees]
        for _ in range(rounds):
            for tree, printed in zip(trees, found, strict=True):
                printed.append(_run(tree, arguments))
        measures = [measure for measure in MEASURES if measure.command == name]
        yield name, [Figures(m, tuple(_median(p, m.path) for p in found)) for m in measures]


def _run(tree: Path, arguments: Sequence[str]) -> object:
    environment = os.environ | {"PYTHONPATH": str(tree.resolve() / "src")}
    done = subprocess.run(
        [sys.executable, *arguments], env=environment, capture_output=True, text=True, check=False
    )
    # A landing that does not land ends with 1 and its figures.
    if done.returncode not in (0, 1) or not done.stdout.strip():
        last = (done.stderr.strip().splitlines() or ["it printed nothing"])[-1]
        raise UsageError(f"'{' '.join(arguments)}' on '{tree}' failed: {last}")
    return json.loads(done.stdout[done.stdout.index("{") :])


def _median(printed: Sequence[object], path: Sequence[str]) -> float | None:
    values = [value for one in printed if (value := _at(one, path)) is not None]
    return median(values) if values else None


def _at(printed: object, path: Sequence[str]) -> float | None:
    for key in path:
        printed = printed.get(key) if isinstance(printed, Mapping) else None
    return float(printed) if isinstance(printed, int | float) else None
