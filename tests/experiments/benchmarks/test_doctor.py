"""What `touchdown doctor` says of a machine, and of one that lacks things."""

import importlib.metadata
import json
import re
from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.benchmarks import doctor
from touchdown.experiments.config.schema import Config
from touchdown.experiments.io.results import RunResult

from support.command import RunCli

ROOT = Path(__file__).parents[3]


def fly(_config: Config, out: Path) -> RunResult:
    out.mkdir(parents=True)
    (out / "flight.rrd").write_bytes(b"x")
    timing = {"wall_s": 4.0, "sim_s": 10.0, "real_time_factor": 2.5, "stage_ms": {}}
    return RunResult.model_validate(
        {"outcome": "COMPLETED", "reason": "", "scene": "flat", "seed": 0, "estimator": "livo",
         "renderer": "a card", "timing": timing}
    )  # fmt: skip


def lacks_usb(_config: Config, _out: Path) -> RunResult:
    raise OSError("libusb-1.0.so.0: cannot open shared object file")


def test_what_a_machine_has(monkeypatch: pytest.MonkeyPatch, run_cli: RunCli) -> None:
    monkeypatch.setattr("touchdown.experiments.flight.run.fly_with_usage_errors",
                        lambda config, out, _progress: fly(config, out))  # fmt: skip
    status, text, _ = run_cli("doctor", "--quiet", "--json")
    found = json.loads(text)
    assert status == 0 and found["ready"] and found["versions"]["mujoco"]
    assert found["renderer"]["name"] and found["renderer"]["backend"] == "egl"
    assert found["machine"]["cores"] >= 1 and found["machine"]["memory_gb"] > 1.0
    assert found["flight"]["renderer"] == "a card" and found["flight"]["real_time_factor"] == 2.5
    told = run_cli("doctor", "--quiet")[1]
    assert "10.0 simulated seconds in 4.0 s: real-time factor 2.50, COMPLETED" in told


def test_what_a_flight_lacks_is_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    found = doctor.examine(lacks_usb)
    assert not found["ready"] and "libusb-1.0.so.0" in found["flight"]["error"]

    def nothing(_width: int, _height: int) -> Any:
        raise RuntimeError("no offscreen rendering on this machine (egl: none)")

    monkeypatch.setattr(doctor, "gl_context", nothing)
    found = doctor.examine(fly)
    assert not found["ready"] and found["flight"]["error"].startswith("no offscreen rendering")
    assert found["renderer"]["name"] is None


def test_what_is_missing_and_the_command_that_gets_it(monkeypatch: pytest.MonkeyPatch) -> None:
    script = (ROOT / ".ci" / "system-libraries").read_text(encoding="utf-8")
    assert dict(re.findall(r"^need (\S+) (\S+)$", script, re.M)) == doctor.LIBRARIES
    image = (ROOT / "Dockerfile").read_text(encoding="utf-8").split()
    assert set(doctor.LIBRARIES.values()) <= set(image)
    monkeypatch.setattr(doctor, "LIBRARIES", {"libgone.so.9": "libgone9", "libc.so.6": "libc6"})
    (library,) = doctor.missing_libraries()
    assert library["what"] == "libgone.so.9" and library["command"].endswith("install -y libgone9")

    def version(name: str) -> str:
        if name in ("ray", "torch", "onnx", "dm-control"):
            raise importlib.metadata.PackageNotFoundError(name)
        return "1"

    monkeypatch.setattr(importlib.metadata, "version", version)
    missing = {lack["for"]: lack["command"] for lack in doctor.missing_packages()}
    assert missing.pop("the dm_control suite")
    assert missing == {doctor.EXTRAS["ray"]: "pip install ray",
                       doctor.EXTRAS["train"]: "pip install onnx torch"}  # fmt: skip
