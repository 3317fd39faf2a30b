"""The lockstep with a scripted PX4 that keeps to it, and with one that does not."""

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from touchdown.controller.api import Setpoint
from touchdown.experiments.api import Px4Params
from touchdown.experiments.px4 import link
from touchdown.experiments.px4.messages import Px4Error
from touchdown.experiments.px4.process import VARIABLE, find_px4
from touchdown.sim.api import SensorNeeds

from support.px4_peer import SILENT_STEPS, make_build
from support.px4_support import (
    all_gone,
    autopilot,
    estimate,
    kill,
    observation,
    rest,
    running,
    setpoint,
)

pytest.importorskip("pymavlink")


@pytest.fixture
def build(tmp_path: Path) -> Iterator[Path]:
    folder = make_build(tmp_path / "build")
    yield folder
    assert all_gone(folder), "PX4 is left"


def test_each_step_has_one_answer_and_what_is_said_becomes_events(
    build: Path, tmp_path: Path
) -> None:
    (tmp_path / "run").mkdir()
    with closing(autopilot(build)) as pilot:
        pilot.keep_in(tmp_path / "run")
        events = rest(pilot, 800, motors_on=True)
        steps, answers = pilot.lockstep
        assert not pilot.waits and len(running(build)) > 0
    assert steps == answers and 700 < steps < 800 - SILENT_STEPS
    assert events == ["PX4: mode mode 0", "PX4: mode OFFBOARD", "PX4: armed"]
    assert [file.name for file in (tmp_path / "run").iterdir()] == ["px4.log"]


def test_an_unhealthy_estimate_is_not_sent_and_its_return_is_a_reset(build: Path) -> None:
    with closing(autopilot(build)) as pilot:
        events = rest(pilot, 700, lost=range(300, 450))
    said = [text for text in events if "vision" in text]
    assert said == ["PX4: no vision", "PX4: vision reset 1"]


class _Asked:
    """A lander that counts."""

    needs = SensorNeeds()
    times = 0

    def update(self, *_seen: Any) -> Setpoint:
        self.times += 1
        return setpoint(motors_on=True)


def test_the_lander_waits_until_px4_has_armed(build: Path) -> None:
    lander, asked = _Asked(), []
    with closing(autopilot(build)) as pilot:
        held: Any = pilot.holding(lander)  # type: ignore[arg-type]
        for step in range(600):
            wanted = held.update(None, None, None)
            pilot.sense(observation(3 * step))
            pilot.update(estimate(3 * step), wanted)
            asked.append(lander.times)
    # Steps before PX4 has connected, 0.5 s to OFFBOARD, 0.5 s to arm, 0.6 s to spool up.
    waited = asked.count(asked[200])
    assert 200 < waited < 450 and asked[-1] == 600 - waited + 1


def test_warnings_that_px4_prints_become_events(
    build: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PEER_FAULT", "deny@1")
    with closing(autopilot(build)) as pilot:
        events = rest(pilot, 600, motors_on=True)
    denied = [text for text in events if "denied" in text]
    assert "PX4: Arming denied: no valid position" in denied
    assert set(denied) == {"PX4: Arming denied: no valid position", "PX4: commander: Arming denied"}
    assert not any("none" in text for text in events)


@pytest.mark.parametrize(("fault", "sentence"), [
    ("silent@100", r"at 0\.\d+ s PX4 gave no answer in 1 s \(px4.answer_s\)"),
    ("silent@1", "PX4 is connected, but gave no answer in 4 s"),
    ("closes@100", r"at 0\.\d+ s PX4 has closed the connection; PX4 has ended with code 3"),
    ("late@100", r"at 0\.\d+ s PX4 gave no answer in 1 s"),
    ("twice@100", r"at 0\.\d+ s PX4 had answered the step before twice"),
    ("nan@100", r"at 0\.\d+ s PX4 gave a control that is not a number"),
    ("time@100", r"at 0\.\d+ s PX4 answered for another time, 0\.\d+ s"),
    ("deny@1", r"PX4 did not arm within 2 s \(px4.arm_s\): Arming denied: no valid position"
     r".*; it printed: commander: Arming denied \(\d+ times\)"),
])  # fmt: skip
def test_a_px4_that_breaks_the_protocol_ends_the_flight_in_one_line(
    build: Path, fault: str, sentence: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PEER_FAULT", fault)
    limits = ("px4.answer_s=1.0", "px4.arm_s=2.0")
    if fault == "silent@1":  # it must connect within that time, on a busy machine as well
        limits = ("px4.start_s=4.0", "px4.arm_s=30.0")
    with (
        closing(autopilot(build, *limits)) as pilot,
        pytest.raises(Px4Error, match=sentence) as raised,
    ):
        rest(pilot, 6000, motors_on=True)
    assert "\n" not in str(raised.value)


def test_the_command_says_it_in_one_line_and_leaves_the_log(
    build: Path, tmp_path: Path, says: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PEER_FAULT", "closes@20")
    out = tmp_path / "runs/one"
    said = says(2, "land", "flat", "--estimator", "oracle", "--controller", "px4", "--px4", build,
                "--preset", "short", "--out", out, "--quiet")  # fmt: skip
    assert said.err.count("\n") == 1 and "has closed the connection" in said.err
    log = tmp_path / "runs/one.px4.log"
    assert list((tmp_path / "runs").iterdir()) == [log] and f"its log is '{log}'" in said.err


def test_where_no_px4_is_the_line_says_what_to_do(
    tmp_path: Path, says: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    flight = ("land", "flat", "--controller", "px4", "--out", tmp_path / "a")
    said = says(2, *flight)
    assert said.err.count("\n") == 1 and "give --px4 PATH" in said.err
    said = says(2, *flight, "--px4", tmp_path)
    assert said.err.count("\n") == 1 and "is no SITL build of PX4" in said.err
    build = make_build(tmp_path / "b")
    said = says(2, *flight, "--px4", build, "--set", "px4.odometry_hz=30")
    assert "px4.odometry_hz = 30 must divide control.control_hz = 200" in said.err
    for place in ("b", "b/bin/px4", "b/bin"):
        assert find_px4(Px4Params(path=str(tmp_path / place)))[0] == tmp_path / "b/bin/px4"
    monkeypatch.setenv(VARIABLE, str(tmp_path / "b"))
    assert find_px4(Px4Params())[1] == tmp_path / "b/etc"


def test_params_are_those_of_a_flight_as_lines_of_the_start_script(says: Any) -> None:
    lines = says(0, "px4", "params", "--set", 'px4.parameters=["MPC_XY_P=1.0"]').out.splitlines()
    assert {"param set CA_ROTOR_COUNT 4", "param set EKF2_EV_CTRL 15"} <= set(lines)
    assert "param set MPC_XY_P 1.0" in lines and len(lines) > 60


def test_taken_ports_are_passed_over_and_a_named_one_is_refused() -> None:
    with (
        closing(link.reserve(4600, exactly=False)) as first,
        closing(link.reserve(4600, exactly=False)) as second,
    ):
        assert second.instance > first.instance
        assert (first.own - 14540, first.of_px4 - 14580) == (first.instance, first.instance)
        with pytest.raises(Px4Error, match="is taken"):
            link.reserve(4560 + first.instance, exactly=True)


def test_one_that_somebody_else_starts_is_joined(build: Path, tmp_path: Path) -> None:
    (tmp_path / "px4-rc.params").write_text("param set IMU_INTEG_RATE 200\n")
    pilot = autopilot(build, "px4.connect=true", "px4.port=4655", "px4.start_s=20.0")
    command = [str(build / "bin/px4"), "-d", "-i", "95"]
    other = subprocess.Popen(command, cwd=tmp_path)
    try:
        rest(pilot, 100)
        assert pilot.lockstep[0] > 50
        pilot.close()
        other.wait(20.0)  # it ends itself when the simulator has closed
    finally:
        other.kill()


AT_REST = """
import sys
sys.path.insert(0, {tests!r})
from pathlib import Path
from support.px4_support import autopilot, rest
pilot = autopilot(Path({build!r}))
print("built", flush=True)
rest(pilot, 10**9, motors_on=True)
"""


def killed_after(build: Path, wait_s: float) -> bool:
    """Kills a program with a PX4 after so long; True where nothing is left of it."""
    tests = str(Path(__file__).parents[2])
    program = subprocess.Popen(
        [sys.executable, "-c", AT_REST.format(tests=tests, build=str(build))],
        stdout=subprocess.PIPE,
    )
    assert program.stdout is not None
    assert program.stdout.readline() == b"built\n"
    time.sleep(wait_s)
    kill(program.pid)
    program.wait()
    return all_gone(build)


def test_a_killed_command_leaves_no_px4(build: Path) -> None:
    seen: list[int] = []
    watch = threading.Thread(target=lambda: seen.extend(_first_running(build)))
    watch.start()
    assert killed_after(build, 1.5)
    watch.join()
    assert seen


def _first_running(build: Path) -> list[int]:
    for _ in range(600):
        if found := running(build):
            return found
        time.sleep(0.02)
    return []
