"""The command `touchdown view`."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import click

from touchdown.experiments.cli.common import EXIT_DONE, EXIT_FAILED, PATH
from touchdown.experiments.errors import UsageError
from touchdown.experiments.flight.platform import has_display
from touchdown.experiments.io.run_directory import whole_file
from touchdown.experiments.viewing.processes import address_text, run_viewer, web_viewer
from touchdown.sim.files.opening import no_file


@click.command()
@click.argument("run", type=PATH)
@click.argument("other", type=PATH, required=False)
@click.option(
    "--web",
    is_flag=True,
    help="Serve the viewer to a browser on this machine; prints its address and the ssh command "
    "that opens it on another machine.",
)
@click.option("--save", type=PATH, metavar="FILE.rrd", help="Write OTHER beside RUN; open nothing.")
def view(run: Path, other: Path | None, web: bool, save: Path | None) -> int:
    """Open the recording of RUN, a run directory, in the Rerun viewer. With OTHER, a flight over
    the same place, both are shown on one time line, and the instant where they part is marked.

    With --web the viewer listens on localhost only, until Ctrl-C.

    Example: touchdown view runs/crossroad-livo-0
    """
    if other is None:
        if save is not None:
            raise UsageError("--save writes two flights; name OTHER, the second run directory")
        return _open(run, run if run.suffix == ".rrd" else run / "flight.rrd", web)
    from touchdown.experiments.viewing.two_flights import write_two_flights

    if save is not None:
        _check_recording(save)
        with whole_file(save) as partial:
            write_two_flights((run, other), partial)
        return EXIT_DONE
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "two_flights.rrd"
        write_two_flights((run, other), recording)
        return _open(run, recording, web)


def _check_recording(save: Path) -> None:
    """Raises UsageError where ``save`` exists and is no recording, which would be lost."""
    if save.is_dir():
        raise UsageError(f"--save {save}: is a directory; name a file, such as pair.rrd")
    if not save.exists():
        return
    with save.open("rb") as file:
        if file.read(3) != b"RRF":
            raise UsageError(f"--save {save}: is no recording, and would be lost; name another")


def _open(run: Path, recording: Path, web: bool) -> int:
    if reason := no_file(recording):
        raise UsageError(
            f"'{recording}' {reason}; name a run directory that was flown without --no-record"
        )
    if not web and sys.platform == "linux" and not has_display():
        raise UsageError(
            f"there is no display to open a window on; give touchdown view {run} --web, or open "
            f"'{recording}' on a machine that has one"
        )
    command = [sys.executable, "-m", "rerun", str(recording)]
    if web:
        command, page, data = web_viewer(str(recording))
        click.echo(address_text(page, data))
    return EXIT_DONE if run_viewer(command) == 0 else EXIT_FAILED
