"""Commands that run code of others: whatever it does to its process, one line and a failure."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from touchdown.experiments.external.processes import runs_external_code

from support.command import python, without_display

PROGRAM = """
import os, signal, sys, time
from touchdown.experiments.external import processes
processes._SIGNAL_TIMEOUT_S = 1
def command():
    exec(sys.argv[1])
    return 3
code, fault = processes.run_in_child(command)
sys.stderr.write(fault)
sys.exit(code)
"""
STUCK = """
signal.signal(signal.SIGINT, signal.SIG_IGN)
print("stuck", flush=True)
while True: time.sleep(1.0)
"""
SOFT = """
try:
    print("stuck", flush=True)
    time.sleep(600.0)
except KeyboardInterrupt: print("interrupted", flush=True); os._exit(9)
"""
ENDINGS = {
    "pass": (3, ""),
    "os._exit(0)": (1, "ended in the middle (exit code 0)"),
    "os.kill(os.getpid(), signal.SIGSEGV)": (1, "ended in the middle (SIGSEGV)"),
    "raise ValueError('x')": (1, "ValueError: x"),
    "if os.fork() == 0: time.sleep(600.0)": (3, ""),
    "if os.fork() == 0: time.sleep(600.0)\nos._exit(0)": (1, "in the middle (exit code 0)"),
}


@pytest.mark.parametrize("code", ENDINGS)
def test_a_process_that_ends_in_the_middle_is_a_failure(code: str) -> None:
    expected, words = ENDINGS[code]
    done = python("-c", PROGRAM, code)
    assert done.returncode == expected and words in done.stderr


@pytest.mark.parametrize(("code", "output"), [(STUCK, "stuck\n"), (SOFT, "stuck\ninterrupted\n")])
def test_ctrl_c_ends_what_does_not_listen(code: str, output: str) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM, code],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    ) as process:  # fmt: skip
        assert process.stdout and process.stdout.readline() == "stuck\n"
        process.send_signal(signal.SIGINT)
        rest, err = process.communicate(timeout=500)
    assert (process.returncode, f"stuck\n{rest}", err) == (130, output, "")


def test_the_command_that_checks_estimators_says_that_its_process_has_ended(tmp_path: Path) -> None:
    (tmp_path / "leaver.py").write_text("import os\ndef build(params, rig): os._exit(0)\n")
    done = python("-m", "touchdown", "check-estimator", "leaver:build", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("touchdown: error: ") and done.stderr.count("\n") == 1
    assert "ended in the middle (exit code 0)" in done.stderr


@pytest.mark.parametrize(("words", "external"), [
    ("fly flat --estimator my.lab:build", True),
    ("land flat --set estimator=my.lab:build", True), ("land flat --config mine.toml", True),
    ("land flat --config=mine.toml", True), ("check-estimator my.lab:build", True),
    ("check-estimator livo", False), ("fly flat --estimator livo", False),
    ("report runs:today", False), ("fly", False), ("", False),
])  # fmt: skip
def test_which_commands_run_external_code(words: str, external: bool) -> None:
    assert runs_external_code(words.split()) == external


def test_a_machine_that_cannot_render_is_one_line(tmp_path: Path) -> None:
    command = ("-m", "touchdown", "fly", "flat", "--out", str(tmp_path / "out"))
    done = python(*command, env={**os.environ, "MUJOCO_GL": "bogus"})
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert "bogus" in done.stderr and "set MUJOCO_GL to egl, osmesa or glfw" in done.stderr


def test_a_backend_that_fails_says_nothing_beside_the_error() -> None:
    code = (
        "from touchdown.sim.camera.gl_contexts import gl_context\n"
        "try: gl_context(8, 8)\n"
        "except RuntimeError as error: print(error)\n"
    )
    done = python("-c", code, env=without_display(MUJOCO_GL="glfw"))
    assert done.stdout.startswith("no offscreen rendering on this machine (glfw: ")
    assert (done.returncode, done.stderr) == (0, "")
