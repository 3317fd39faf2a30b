"""Runs fuzzed cases: ``python tests/fuzz/run.py KIND NUMBER`` repeats one and keeps its folder."""

import argparse
import dataclasses
import json
import os
import shlex
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from fuzz import worker
from fuzz.kinds import KINDS

FIRST, COUNT = 10_000, 1_900
"""Number of the first case of each kind, and how many there are."""
Verdicts = list[dict[str, Any]]
"""of `fuzz.cases.Verdict`"""
_ENVIRONMENT = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"),
    "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl"),
    "PYTHONUTF8": "1",  # cases that are not UTF-8 text are seen by the command's own check
}


class Server:
    """A warm process that runs one case after the other in a folder of its own."""

    def __init__(self, home: Path) -> None:
        self._home = home
        os.environ.update(_ENVIRONMENT)
        self._pool = ProcessPoolExecutor(1, mp_context=get_context("spawn"))

    def ask(self, kind: str, number: int, keep: bool = False) -> dict[str, Any]:
        """Runs a case and returns its verdict."""
        found = self._pool.submit(worker.answer, kind, number, self._home, keep).result()
        return dataclasses.asdict(found)


@contextmanager
def server() -> Iterator[Server]:
    """A server in a folder that is removed."""
    with tempfile.TemporaryDirectory(prefix="fuzz-", ignore_cleanup_errors=True) as home:
        asked = Server(Path(home))
        with asked._pool:
            yield asked


def run_kind(kind: str, numbers: Sequence[int], out: Path) -> Verdicts:
    """Runs the cases that ``out``, a file of one verdict a line, lacks; returns all of them."""
    done = {verdict["number"]: verdict for verdict in read(out)}
    if todo := [number for number in numbers if number not in done]:
        out.parent.mkdir(parents=True, exist_ok=True)
        with server() as asked, out.open("a", encoding="utf-8") as file:
            for number in todo:
                done[number] = asked.ask(kind, number)
                print(json.dumps(done[number]), file=file, flush=True)
    return [done[number] for number in numbers]


def read(path: Path) -> Verdicts:
    """Verdicts of a file; none where there is no file. A last line that was cut is left out."""
    lines = path.read_text(encoding="utf-8").splitlines(True) if path.exists() else []
    return [json.loads(line) for line in lines if line.endswith("}\n")]


def table(verdicts: Iterable[dict[str, Any]]) -> str:
    """By kind: cases, how they ended, findings, maximum time and memory."""
    rows = defaultdict(list)
    for verdict in verdicts:
        rows[verdict["kind"]].append(verdict)
        rows["all"].append(verdict)
    head = ("kind", "cases", "accepted", "refused", "reached", "findings", "max s", "max MB")
    lines = [head, *(_row(kind, rows[kind]) for kind in (*KINDS, "all") if rows[kind])]
    return "\n".join("".join(f"{cell:>12}" for cell in line) for line in lines)


def _row(kind: str, found: Verdicts) -> tuple[Any, ...]:
    codes = Counter(verdict["code"] for verdict in found)
    faulty = sum(bool(verdict["faults"]) for verdict in found)
    maximum = (max(verdict[key] for verdict in found) for key in ("cpu_s", "memory_mb"))
    return (kind, len(found), codes[0] + codes[1], codes[2], codes["reached"], faulty, *maximum)


def findings(verdicts: Verdicts) -> list[str]:
    """A text of each finding, with the command that repeats it."""
    texts = []
    for verdict in verdicts:
        if verdict["faults"]:
            again = f"python tests/fuzz/run.py {verdict['kind']} {verdict['number']}"
            text = "\n  ".join([again, *(fault[:1000] for fault in verdict["faults"])])
            texts.append(text.encode("utf-8", "backslashreplace").decode("utf-8"))
    return texts


def show(kind: str, number: int) -> int:
    """Repeats one case and prints what it did; returns 1 for a finding."""
    home = Path(tempfile.mkdtemp(prefix="fuzz-"))
    verdict = Server(home).ask(kind, number, keep=True)
    folder = home / f"{kind}-{number}"
    print(f"cd {folder}/watched/a/b/work && touchdown {shlex.join(verdict['arguments'])}")
    print(f"ended: {verdict['code']} after {verdict['cpu_s']:g} s, {verdict['memory_mb']} MB")
    for name in ("stdout", "stderr"):
        text = (folder / "log" / name).read_text(errors="backslashreplace")
        print(f"{name}:\n{text[-4000:]}")
    print(*(f"FINDING {fault}" for fault in verdict["faults"]), sep="\n")
    return 1 if verdict["faults"] else 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", choices=list(KINDS))
    parser.add_argument("number", type=int)
    given = parser.parse_args()
    sys.exit(show(given.kind, given.number))
