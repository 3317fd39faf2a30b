"""Trainings that are killed at random moments and started again, forked from a process that has
loaded torch: ``python -m support.killed_trainings DATA FOLDER SIGNAL KILLS``."""

import csv
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

EPOCHS = 4


def killed_trainings(data: Path, folder: Path, name: str, kills: int) -> dict[str, Any]:
    """Runs the process of this module and returns its figures."""
    done = subprocess.run(
        [sys.executable, "-m", "support.killed_trainings", str(data), str(folder), name,
         str(kills)],
        cwd=Path(__file__).parents[1], stdout=subprocess.PIPE, text=True, check=True,
    )  # fmt: skip
    figures: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return figures


def _start(data: Path, out: Path) -> int:
    """Process id of ``touchdown train``, the leader of its group."""
    if pid := os.fork():
        return pid
    os.setpgid(0, 0)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with open(os.devnull, "wb") as nothing, (out.parent / "err").open("ab") as err:
        os.dup2(nothing.fileno(), 1)
        os.dup2(err.fileno(), 2)
    from touchdown.experiments.cli.main import main

    code = 70
    try:
        code = main(["train", "--network", "mobilenet_v3_large", "--data", str(data), "--out",
                     str(out), "--epochs", str(EPOCHS), "--image-size", "32", "--threads", "1",
                     "--quiet"])  # fmt: skip
    finally:
        os._exit(code)


def _epochs(out: Path) -> int:
    """Number of finished epochs. Fails for any file that is not whole."""
    import torch

    from touchdown.landing.classification.weights import read_network

    if (out / "network.onnx").exists():
        read_network(out / "network.onnx")
    if (out / "training.json").exists():
        json.loads((out / "training.json").read_text())
    epochs = 0
    for name in ("best.pt", "last.pt"):
        if (out / name).exists():
            state = torch.load(out / name, weights_only=True)
            epochs = len(state["history"]) if name == "last.pt" else 0
    if (out / "curves.csv").exists():
        rows = list(csv.DictReader((out / "curves.csv").open()))
        assert 0 <= epochs - len(rows) <= 1 and all(None not in row.values() for row in rows)
    return epochs


def serve() -> None:
    import torch

    import touchdown.experiments.classification.train
    import touchdown.landing.classification.learning.export  # noqa: F401

    torch.set_num_threads(1)
    data, folder, name = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]
    folder.mkdir(parents=True)
    undisturbed, number = folder / "undisturbed", getattr(signal, name)
    begin = time.monotonic()
    assert os.waitpid(_start(data, undisturbed), 0)[1] == 0
    whole_s = time.monotonic() - begin
    expected = hashlib.sha256((undisturbed / "network.onnx").read_bytes()).hexdigest()
    draw = random.Random(name)
    kills, trainings, ends, lost, left = 0, 0, [], 0, 0
    while kills < int(sys.argv[4]) or ends[-1:] != [0]:
        out = folder / f"killed{trainings}"
        before = _epochs(out) if out.exists() else 0
        pid = _start(data, out)
        if kills < int(sys.argv[4]):
            time.sleep(draw.uniform(0.0, 0.6 * whole_s))
            os.kill(pid, number)
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        kills += code != 0
        ends.append(code)
        try:
            os.killpg(pid, 0)
            left += 1
        except ProcessLookupError:
            pass
        lost += out.exists() and _epochs(out) < before
        if code == 0:
            trainings += 1
            assert hashlib.sha256((out / "network.onnx").read_bytes()).hexdigest() == expected
            assert {path.name for path in out.iterdir()} == {
                path.name for path in undisturbed.iterdir()
            }
    print(json.dumps({"kills": kills, "trainings": trainings, "lost": lost, "left": left,
                      "ends": sorted(set(ends)), "err": (folder / "err").read_text()}))  # fmt: skip


if __name__ == "__main__":
    serve()
