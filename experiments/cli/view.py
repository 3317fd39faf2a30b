"""The command `touchdown view`."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from touchdown.experiments.cli.common import (
    EXIT_DONE,
    EXIT_FAILED,
)
from touchdown.experiments.flight.platform import has_display


@click.command()
@click.argument("run", type=click.Path(path_type=Path))
@click.option("--web", is_flag=True, help="Serve the viewer to a browser instead of a window.")
def view(run: Path, web: bool) -> int:
    """Open the recording of RUN, a run directory, in the Rerun viewer.

    Example: touchdown view runs/crossroad-livo-0
    """
    import subprocess

    from touchdown.experiments.errors import UsageError

    recording = run if run.suffix == ".rrd" else run / "flight.rrd"
    if not recording.is_file():
        raise UsageError(
            f"'{recording}' does not exist; name a run directory that was flown without --no-record"
        )
    if not web and sys.platform == "linux" and not has_display():
        raise UsageError(
            f"there is no display to open a window on; give touchdown view {run} --web, or open "
            f"'{recording}' on a machine that has one"
        )
    command = [sys.executable, "-m", "rerun", str(recording), *(["--web-viewer"] if web else [])]
    return EXIT_DONE if subprocess.run(command, check=False).returncode == 0 else EXIT_FAILED
