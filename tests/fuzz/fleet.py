"""Processes that run cases, and tables of their verdicts."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fuzz.kinds import KINDS

_SERVER = Path(__file__).with_name("run_case.py")
Verdicts = list[dict[str, Any]]


@contextmanager
def server() -> Iterator[Server]:
    """A warm process that runs one case after the other, with a folder that ends with it."""
    with tempfile.TemporaryDirectory(prefix="fuzz-", ignore_cleanup_errors=True) as home:
        found = Server(Path(home))
        try:
            yield found
        finally:
            found.close()


class Server:
    """See `server`."""

    def __init__(self, home: Path) -> None:
        command = [sys.executable, str(_SERVER), "--serve", str(home)]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def ask(self, kind: str, number: int, *, whole: bool = False) -> dict[str, Any]:
        """Runs a case and returns its verdict (`fuzz.cases.Verdict`)."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(f"{kind} {number}{' whole' if whole else ''}\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"the process that runs the cases died at {kind} {number}")
        verdict: dict[str, Any] = json.loads(line)
        return verdict

    def close(self) -> None:
        """Ends the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(60)


def run_kind(kind: str, numbers: Sequence[int], out: Path, *, whole: bool = False) -> Verdicts:
    """Runs the cases that ``out``, a file of one verdict a line, lacks; returns all of them."""
    done = {verdict["number"]: verdict for verdict in read(out)}
    todo = [number for number in numbers if number not in done]
    if todo:
        out.parent.mkdir(parents=True, exist_ok=True)
        with server() as asked, out.open("a", encoding="utf-8") as file:
            for number in todo:
                verdict = asked.ask(kind, number, whole=whole)
                done[number] = verdict
                file.write(json.dumps(verdict) + "\n")
                file.flush()
    return [done[number] for number in numbers]


def read(path: Path) -> Verdicts:
    """Verdicts of a file; none where there is no file. A last line that was cut is left out."""
    if not path.is_file():
        return []
    found = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            found.append(json.loads(line))
        except ValueError:
            break
    return found


def forget_findings(path: Path) -> None:
    """Takes the findings out of a file of verdicts, so that their cases are run again."""
    sound = [verdict for verdict in read(path) if not verdict["faults"]]
    if path.is_file():
        path.write_text("".join(json.dumps(verdict) + "\n" for verdict in sound), encoding="utf-8")


# ------------------------------------------------------------------------------------------- tables


def table(verdicts: Iterable[dict[str, Any]]) -> str:
    """By kind: cases, how they ended, findings, greatest time and memory."""
    rows = defaultdict(list)
    for verdict in verdicts:
        rows[verdict["kind"]].append(verdict)
    head = ("kind", "cases", "accepted", "refused", "reached", "findings", "max s", "max MB")
    lines = [head, *(_row(kind, rows[kind]) for kind in KINDS if rows[kind])]
    lines.append(_row("all", [verdict for found in rows.values() for verdict in found]))
    widths = [max(len(str(line[at])) for line in lines) for at in range(len(head))]
    return "\n".join(
        "  ".join(
            str(cell).ljust(width) if at == 0 else str(cell).rjust(width)
            for at, (cell, width) in enumerate(zip(line, widths, strict=True))
        )
        for line in lines
    )


def _row(kind: str, found: Verdicts) -> tuple[Any, ...]:
    codes = Counter(verdict["code"] for verdict in found)
    return (
        kind,
        len(found),
        codes[0] + codes[1],
        codes[2],
        codes["reached"],
        sum(bool(verdict["faults"]) for verdict in found),
        f"{max((verdict['cpu_s'] for verdict in found), default=0.0):.1f}",
        max((verdict["memory_mb"] for verdict in found), default=0),
    )


def causes(verdicts: Iterable[dict[str, Any]]) -> dict[str, Verdicts]:
    """Findings by their likely cause, the most frequent first."""
    found = defaultdict(list)
    for verdict in verdicts:
        if verdict["faults"]:
            found[cause(verdict)].append(verdict)
    return dict(sorted(found.items(), key=lambda item: -len(item[1])))


def cause(verdict: dict[str, Any]) -> str:
    """A finding without what differs from case to case."""
    fault = str(verdict["faults"][0])
    where = " ".join(verdict["arguments"][:2]) if "longer" in fault or "GB" in fault else ""
    words = re.sub(r"'[^']*'|\"[^\"]*\"", "'…'", fault)
    words = re.sub(r"(?<![:\w])-?\d[\d.e+-]*", "#", words)
    return f"{words[:160]} {where}".strip()


def finding_text(verdict: dict[str, Any]) -> str:
    """A finding with the command that repeats it."""
    again = f"python tests/fuzz/run_case.py {verdict['kind']} {verdict['number']}"
    text = "\n  ".join([again, *(fault[:1000] for fault in verdict["faults"])])
    return text.encode("utf-8", "backslashreplace").decode("utf-8")
