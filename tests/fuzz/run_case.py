"""Runs fuzzed cases: ``python tests/fuzz/run_case.py KIND NUMBER`` repeats one, keeps its folder.

``--serve`` reads ``KIND NUMBER`` lines from stdin and answers each with its verdict in JSON.
"""

import argparse
import contextlib
import dataclasses
import gc
import json
import os
import shlex
import shutil
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_name] = "1"
os.environ.setdefault("MUJOCO_GL", "egl")
# Cases that are not UTF-8 text are seen by the command's own check.
os.environ["PYTHONUTF8"] = "1"

from fuzz import grounding, kinds, worker  # noqa: E402


def prepare(kind: str) -> None:
    """Imports what the cases of a kind need, once."""
    if kind in kinds.LEARNING:
        grounding.load(*grounding.LEARNING)
        import torch

        torch.set_num_threads(1)
    grounding.load(*grounding.SLOW_TO_LOAD.get(kind, ()))
    import cv2

    cv2.setNumThreads(0)  # threads of a pool are not there after a fork
    grounding.install()
    gc.freeze()


def serve(home: Path) -> None:
    """Answers lines of stdin until it ends."""
    prepared: set[str] = set()
    shared = home / "shared"
    shared.mkdir(exist_ok=True)
    for line in sys.stdin:
        kind, number = line.split()
        if kind not in prepared:
            prepare(kind)
            prepared.add(kind)
        folder = home / f"{kind}-{number}"
        verdict = worker.run(kind, int(number), folder, shared)
        # what one case imports, the next ones need not
        grounding.load(*worker.text_of(folder / "log" / "modules").split())
        gc.freeze()
        shutil.rmtree(folder, ignore_errors=True)
        print(json.dumps(dataclasses.asdict(verdict)), flush=True)


def show(kind: str, number: int) -> int:
    """Repeats one case, prints what it did, and keeps its folder."""
    home = Path(tempfile.mkdtemp(prefix=f"fuzz-{kind}-{number}-"))
    (home / "shared").mkdir()
    prepare(kind)
    verdict = worker.run(kind, number, home / "case", home / "shared")
    print(f"cd {home}/case/watched/a/b/work && touchdown {shlex.join(verdict.arguments)}")
    print(f"ended: {verdict.code} after {verdict.cpu_s:g} s, {verdict.memory_mb} MB")
    for name in ("stdout", "stderr"):
        text = (home / "case" / "log" / name).read_text(errors="backslashreplace")
        print(f"{name}: {text[-4000:]!r}" if len(text) < 200 else f"{name}:\n{text[-4000:]}")
    for fault in verdict.faults:
        print(f"FINDING {fault}")
    return 1 if verdict.faults else 0


def main() -> int:
    """Returns 1 for a finding."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", nargs="?", choices=list(kinds.KINDS))
    parser.add_argument("number", nargs="?", type=int)
    parser.add_argument("--serve", metavar="FOLDER", type=Path, help="for cases; made anew")
    given = parser.parse_args()
    if given.serve is not None:
        with contextlib.suppress(BrokenPipeError):
            serve(given.serve)
        return 0
    if given.kind is None or given.number is None:
        parser.error("give KIND and NUMBER")
    return show(given.kind, given.number)


if __name__ == "__main__":
    sys.exit(main())
