"""Runs all kinds of fuzzed cases, in parts that may be interrupted, and prints a table.

``python tests/fuzz/run_all.py --out DIR`` goes on where an earlier call with that folder stopped.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Self

sys.path.insert(0, str(Path(__file__).parents[1]))

from fuzz.kinds import KINDS

FIRST, COUNT = 10_000, 1_900
"""Number of the first case of each kind, and how many there are."""
Verdicts = list[dict[str, Any]]
"""of `fuzz.cases.Verdict`"""


class Server:
    """A warm process that runs one case after the other in a folder of its own."""

    def __init__(self) -> None:
        self._home = tempfile.TemporaryDirectory(prefix="fuzz-", ignore_cleanup_errors=True)
        script = str(Path(__file__).with_name("run_case.py"))
        self._process = subprocess.Popen(
            [sys.executable, script, "--serve", self._home.name],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self._process.communicate()
        self._home.cleanup()

    def ask(self, kind: str, number: int) -> dict[str, Any]:
        """Runs a case and returns its verdict."""
        assert self._process.stdin is not None and self._process.stdout is not None
        print(kind, number, file=self._process.stdin, flush=True)
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"the process that runs the cases died at {kind} {number}")
        verdict: dict[str, Any] = json.loads(line)
        return verdict


def run_kind(kind: str, numbers: Sequence[int], out: Path) -> Verdicts:
    """Runs the cases that ``out``, a file of one verdict a line, lacks; returns all of them."""
    done = {verdict["number"]: verdict for verdict in read(out)}
    todo = [number for number in numbers if number not in done]
    if todo:
        out.parent.mkdir(parents=True, exist_ok=True)
        with Server() as asked, out.open("a", encoding="utf-8") as file:
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
            again = f"python tests/fuzz/run_case.py {verdict['kind']} {verdict['number']}"
            text = "\n  ".join([again, *(fault[:1000] for fault in verdict["faults"])])
            texts.append(text.encode("utf-8", "backslashreplace").decode("utf-8"))
    return texts


def main() -> int:
    """Returns 1 where there are findings."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of verdicts")
    parser.add_argument("--kinds", default=",".join(KINDS), help="separated by commas")
    parser.add_argument("--count", type=int, default=COUNT, help="cases of each kind")
    parser.add_argument("--again", action="store_true", help="the findings that are there")
    given = parser.parse_args()
    found: Verdicts = []
    for kind in given.kinds.split(","):
        out = given.out / f"{kind}.jsonl"
        if given.again:
            sound = [json.dumps(verdict) + "\n" for verdict in read(out) if not verdict["faults"]]
            out.write_text("".join(sound), encoding="utf-8")
        found += run_kind(kind, range(FIRST, FIRST + given.count), out)
        print(table(found).split("\n")[-2], flush=True)
    print(table(found), *findings(found), sep="\n\n")
    return 1 if findings(found) else 0


if __name__ == "__main__":
    sys.exit(main())
