"""All measures of speed of one checkout, and those of two side by side.

Each command runs in a process of its own on the sources of its checkout; two checkouts take turns,
command by command, so that both meet the same machine.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from touchdown.experiments.errors import UsageError

COMMANDS: Mapping[str, tuple[str, ...]] = {
    "profile": ("profile", "crossroad", "--full"),
    "loop": ("loop", "--quiet"),
    "lidar": ("lidar",),
    "landing": ("landing", "--no-reference"),
}
"""arguments of ``touchdown bench``, which prints one JSON object"""
Printed = Mapping[str, Any]
"""that object, and ``peak_mb``, the most memory that its process had"""


@dataclass(frozen=True, slots=True)
class Measure:
    """A figure of what a command of `COMMANDS` prints; ``read`` raises KeyError without it."""

    title: str
    unit: str
    command: str
    read: Callable[[Printed], float]


def stage_ms(of: Sequence[str], call: str) -> Callable[[Printed], float]:
    """Milliseconds of processor time a call of the stage ``call``, of all stages whose names begin
    with one of the words ``of``."""

    def read(printed: Printed) -> float:
        stages = printed["stages"]
        spent = [
            row["calls"] * row["ms"] for name, row in stages.items() if name.startswith(tuple(of))
        ]
        return float(sum(spent) / max(stages[call]["calls"], 1))

    return read


MEASURES = (
    Measure("landing", "core-s per s", "profile", lambda p: p["core_s_per_sim_s"]),
    Measure("picture and film", "ms a frame", "profile",
            stage_ms(("picture", "film", "camera"), "camera")),
    Measure("LIDAR", "ms a scan", "profile", stage_ms(("lidar",), "lidar")),
    Measure("estimator livo", "ms per 0.1 s", "profile",
            lambda p: p["stages"]["estimator"]["ms_per_scan"]),
    Measure("scene and set-up", "ms", "profile", stage_ms(("scene", "set-up"), "scene")),
    Measure("memory of a landing", "MB", "profile", lambda p: p["peak_mb"]),
    Measure("real-time factor, recording on", "", "loop", lambda p: p["real_time_factor"]),
    Measure("LIDAR over bare Embree", "", "lidar", lambda p: p["ratio"]["embree"]),
    Measure("LIDAR over mujoco-lidar", "", "lidar", lambda p: p["ratio"]["mujoco_lidar"]),
    Measure("choice of a site", "ms", "landing", lambda p: p["stage_ms"]["sum"]),
    Measure("ten patches by the network", "ms", "landing",
            lambda p: p["classifier_ms"]["ten_patches"]),
)  # fmt: skip


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
        found: list[list[Printed]] = [[] for _ in trees]
        for _ in range(rounds):
            for tree, printed in zip(trees, found, strict=True):
                printed.append(_run(tree, ("-m", "touchdown", "bench", *arguments, "--json")))
        measures = [measure for measure in MEASURES if measure.command == name]
        yield name, [Figures(m, tuple(_median(p, m.read) for p in found)) for m in measures]


def _run(tree: Path, arguments: Sequence[str]) -> Printed:
    environment = os.environ | {"PYTHONPATH": str(tree.resolve() / "src")}
    command = [sys.executable, *arguments]
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        with subprocess.Popen(command, env=environment, stdout=out, stderr=err) as process:
            _, status, usage = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
        texts = []
        for file in (out, err):
            file.seek(0)
            texts.append(file.read().strip())
    # A landing that does not land ends with 1 and its figures.
    if process.returncode not in (0, 1) or not texts[0]:
        last = (texts[1].splitlines() or ["it printed nothing"])[-1]
        raise UsageError(f"'{' '.join(arguments)}' on '{tree}' failed: {last}")
    printed: dict[str, Any] = json.loads(texts[0][texts[0].index("{") :])
    return printed | {"peak_mb": usage.ru_maxrss / 1e3}


def _median(printed: Sequence[Printed], read: Callable[[Printed], float]) -> float | None:
    values = []
    for one in printed:
        try:
            values.append(float(read(one)))
        except KeyError:
            continue
    return median(values) if values else None
