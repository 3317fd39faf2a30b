"""PX4 as a process: found, started in a folder of its own, ended always."""

import contextlib
import os
import re
import shutil
import signal
import subprocess
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from touchdown.experiments.api import Px4Params
from touchdown.experiments.errors import visible
from touchdown.experiments.external.processes import guarded
from touchdown.experiments.px4.airframe import parameter_lines
from touchdown.experiments.px4.link import Ports
from touchdown.experiments.px4.messages import Px4Error

VARIABLE = "TOUCHDOWN_PX4"
"""environment variable that names a build where no option does"""
LOG_FILE, ULOG_FILE = "px4.log", "px4.ulg"
_MODEL = "none_iris"
"""PX4's airframe for a quadrotor X of a simulator that it does not start itself"""
_END_TIMEOUT_S = 5.0
_LOG_BYTES = 1 << 20
_MOST = 2
"""warnings that a failure names"""
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_WARNING = re.compile(r"(?:WARN|ERROR)\s+\[(\w+)\] (.*)")
_OF_START = ("param", "simulator_mavlink")
"""modules of PX4 whose warnings are of parameters that a build lacks, and of waiting for us"""


def find_px4(params: Px4Params) -> tuple[Path, Path]:
    """The program px4 of a SITL build and the folder of its start scripts. Raises Px4Error, with
    what to do."""
    named = params.path or os.environ.get(VARIABLE)
    if not named:
        raise Px4Error(
            "controller px4: no PX4 is named; give --px4 PATH, the folder of a SITL build such as "
            f"PX4-Autopilot/build/px4_sitl_default, or set {VARIABLE} (docs/px4.md)"
        )
    place = Path(named).expanduser()
    folders = [place, place / "build/px4_sitl_default", place.parent, place.parent.parent]
    for folder in folders:
        program, scripts = folder / "bin/px4", folder / "etc"
        if os.access(program, os.X_OK) and (scripts / "init.d-posix/rcS").is_file():
            return program.resolve(), scripts.resolve()
    raise Px4Error(
        f"controller px4: '{named}' is no SITL build of PX4: it has no bin/px4 with an "
        "etc/init.d-posix/rcS beside it (docs/px4.md)"
    )


class Px4Process:
    """A PX4 that runs in ``folder``, under a guard that ends it with this process. It starts with
    ``parameters``, and with one MAVLink connection, that of an onboard computer."""

    def __init__(
        self, params: Px4Params, ports: Ports, folder: Path, parameters: Mapping[str, float | int]
    ) -> None:
        program, scripts = find_px4(params)
        folder.mkdir(parents=True)
        self._folder = folder
        self._read = 0
        self._printed: Counter[str] = Counter()
        # PX4's start script reads both from the first folder of PATH that has them.
        (folder / "px4-rc.params").write_text("\n".join(parameter_lines(parameters)) + "\n")
        (folder / "px4-rc.mavlink").write_text(
            f"mavlink start -x -u {ports.of_px4} -r 4000000 -m onboard -o {ports.own}\n"
        )
        command, environment = guarded(
            [str(program), "-d", "-i", str(ports.instance), str(scripts)]
        )
        environment = {k: v for k, v in environment.items() if not k.startswith("PX4_")} | {
            "PATH": f"{folder.resolve()}:{os.environ.get('PATH', os.defpath)}",
            "PX4_SIM_MODEL": _MODEL,
        }
        with open(folder / LOG_FILE, "wb") as log:
            self._process = subprocess.Popen(
                command,
                cwd=folder,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def ended(self, wait_s: float) -> str:
        """The reason why it has ended, with the last line that it printed; "" where it still runs
        after ``wait_s``."""
        try:
            self._process.wait(wait_s)
        except subprocess.TimeoutExpired:
            return ""
        lines = [line.strip() for line in self._log().splitlines() if line.strip()]
        last = f": {lines[-1][:200]}" if lines else ""
        return f"PX4 has ended with code {self._process.returncode}{last}"

    def warnings(self) -> list[str]:
        """What PX4 has printed as a warning or an error since the last call, in flight: the reasons
        of failsafes are there, and in no MAVLink message that is text."""
        lines = self._log(self._read).split("\n")
        self._read += sum(len(line.encode()) + 1 for line in lines[:-1])
        found = (_WARNING.match(_COLOUR.sub("", line)) for line in lines[:-1])
        said = [f"{m[1]}: {visible(m[2].strip())}" for m in found if m and m[1] not in _OF_START]
        self._printed.update(said)
        return said

    def printed(self) -> str:
        """The warnings and errors that PX4 has printed most often, and how often; "" without."""
        self.warnings()
        most = self._printed.most_common(_MOST)
        return "; ".join(f"{text} ({n} times)" if n > 1 else text for text, n in most)

    def keep_log(self, file: Path) -> None:
        """Writes what PX4 has printed to ``file``."""
        file.write_text(self._log(), encoding="utf-8")

    def close(self, keep_in: Path | None, ulog: bool) -> None:
        """Ends it and removes its folder; its log goes to ``keep_in``, with ``ulog`` its own log of
        the flight too."""
        # The guard ends all that PX4 has started.
        for number in (signal.SIGTERM, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError):
                self._process.send_signal(number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_END_TIMEOUT_S)
                break
        if keep_in is not None:
            self.keep_log(keep_in / LOG_FILE)
            newest = max(self._folder.glob("log/*/*.ulg"), default=None)
            if ulog and newest is not None:
                shutil.move(newest, keep_in / ULOG_FILE)
        shutil.rmtree(self._folder, ignore_errors=True)

    def _log(self, start: int = 0) -> str:
        with contextlib.suppress(OSError), open(self._folder / LOG_FILE, "rb") as log:
            log.seek(start)
            return log.read(_LOG_BYTES).decode("utf-8", errors="replace")
        return ""
