"""Guard of a worker, or of another program: a small process that starts it, and ends with it all
that it started.

It is the parent of every process that the worker leaves behind, in whatever session, so that none
outlives the worker, nor the supervisor of the worker.
"""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

from touchdown.experiments.external.processes import adopt_orphans, end_descendants
from touchdown.sim.files.child import die_with_parent

SUPERVISOR = "TOUCHDOWN_SUPERVISOR"
"""environment variable: the process whose end a guard, or a worker, does not survive"""

_SERVE = (
    "import sys; sys.path.sort(key=lambda entry: entry == ''); "  # here comes last: hides nothing
    "from touchdown.experiments.campaign.worker import serve; serve()"
)


def guard(command: Sequence[str] = (sys.executable, "-c", _SERVE)) -> None:
    """Starts a program, by default a worker, on the same pipes and ends as it ends, by the same
    signal or exit code, when no process of it is left. SIGTERM, or the end of the supervisor, ends
    them all at once."""
    signal.signal(signal.SIGTERM, _end)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the supervisor decides
    die_with_parent(int(os.environ.get(SUPERVISOR, os.getppid())), signal.SIGTERM)
    adopt_orphans()
    worker = subprocess.Popen(command, env={**os.environ, SUPERVISOR: str(os.getpid())})
    for pipe in (0, 1):
        os.close(pipe)  # they close when the worker's ends do
    code = None
    while code is None:
        pid, status = os.waitpid(-1, 0)
        if pid == worker.pid:
            code = os.waitstatus_to_exitcode(status)
    end_descendants(os.getpid())
    if code < 0:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if code not in (-signal.SIGKILL, -signal.SIGSTOP):
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    os._exit(code)


def _end(_signal: int, _frame: Any) -> None:
    end_descendants(os.getpid())
    os._exit(128 + signal.SIGTERM)


if __name__ == "__main__":
    guard(sys.argv[1:])
