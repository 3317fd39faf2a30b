"""Command lines, each in a process of its own with limits of memory and time, forked from one that
has loaded the libraries."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

MEMORY_BYTES, TIME_S = 4 << 30, 30


@dataclass(frozen=True, slots=True)
class Ended:
    """The end of a command. ``code`` is negative where a signal ended it: SIGXCPU or SIGALRM when
    it took too long."""

    code: int
    err: str

    def finding(self) -> str:
        """What is wrong with it; "" if nothing is."""
        errors = [line for line in self.err.splitlines() if not line.startswith(_WARNING)]
        if self.code not in (0, 1, 2):
            return f"exit code {self.code}: {self.err[-600:]}"
        if len(errors) != (self.code == 2) or not all(e.startswith(_ERROR) for e in errors):
            return f"exit code {self.code} with: {self.err[-600:]}"
        if any(ord(c) < 32 and c != "\n" for c in self.err) or len(self.err) > 4000:
            return f"characters: {self.err[-600:]!r}"
        return ""


_ERROR, _WARNING = "touchdown: error: ", "touchdown: warning: "


def run_all(
    commands: Sequence[Sequence[str]], folder: Path, first: Sequence[Sequence[str]] = ()
) -> list[Ended]:
    """Runs commands in ``folder``, one after another. ``first``: sound commands that the process
    runs itself before, so that those forked from it find all modules loaded and all kernels
    compiled."""
    given = [[list(command) for command in some] for some in (first, commands)]
    done = subprocess.run(
        [sys.executable, "-m", "support.limited_commands", str(folder)],
        input=json.dumps(given), text=True,
        stdout=subprocess.PIPE, cwd=Path(__file__).parents[1], check=True,
    )  # fmt: skip
    return [Ended(code, err) for code, err in json.loads(done.stdout.splitlines()[-1])]


def _child(arguments: list[str], err: Path) -> None:
    with err.open("wb") as file, open(os.devnull, "wb") as nothing:
        os.dup2(file.fileno(), 2)
        os.dup2(nothing.fileno(), 1)
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CPU, (TIME_S, TIME_S + 1))
    signal.alarm(20 * TIME_S)  # of a machine that is busy
    from touchdown.experiments.cli.main import main

    code = 70
    try:
        code = main(arguments)
    except SystemExit as error:
        code = int(error.code or 0)
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)


def serve() -> None:
    import touchdown.experiments.flight.replay
    import touchdown.experiments.flight.wiring  # noqa: F401
    from touchdown.experiments.cli.main import main

    folder = Path(sys.argv[1])
    os.chdir(folder)
    first, commands = json.load(sys.stdin)
    for arguments in first:
        assert main(arguments) in (0, 1), arguments
    found = []
    for arguments in commands:
        err = folder / "stderr"
        if (pid := os.fork()) == 0:
            _child(arguments, err)
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        found.append((code, err.read_text(encoding="utf-8", errors="replace")))
    print(json.dumps(found))


if __name__ == "__main__":
    serve()
