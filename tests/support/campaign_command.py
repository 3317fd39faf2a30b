"""The command line with campaigns of fake flights: ``python -m support.campaign_command ...``."""

import functools
import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from touchdown.experiments.campaign import session

from support.campaign_flights import ROOT, RUNNER


def start(*arguments: str | Path, **more: Any) -> subprocess.Popen[str]:
    """The command in a process of its own; ``more`` are variables of its environment."""
    command = [sys.executable, "-m", "support.campaign_command", *map(str, arguments)]
    return subprocess.Popen(
        command, cwd=ROOT, env=environment(more), stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True,
    )  # fmt: skip


def environment(more: Mapping[str, str]) -> dict[str, str]:
    path = os.pathsep.join((str(ROOT / "src"), str(ROOT / "tests")))
    return {**os.environ, "PYTHONPATH": path, **more}


if __name__ == "__main__":
    from touchdown.experiments.cli import main as cli

    signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs ignore it
    session.fly_campaign = functools.partial(session.fly_campaign, runner=RUNNER)  # type: ignore[assignment]
    sys.exit(cli.main())
