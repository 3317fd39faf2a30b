"""Commands on one finished flight: ``touchdown view`` and ``touchdown export``."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from touchdown.experiments.cli.common import (
    EXIT_DONE,
    EXIT_FAILED,
    JSON,
    PATH,
    Parsed,
    answer,
    finite_numbers,
)
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.run_directory import whole_file
from touchdown.experiments.terminal import say
from touchdown.experiments.viewing.processes import (
    address_text,
    compacted,
    run_viewer,
    web_viewer,
)
from touchdown.sim.files.opening import no_file
from touchdown.sim.opengl import has_display

if TYPE_CHECKING:
    from touchdown.experiments.export.flown_run import GeodeticPoint


@click.command()
@click.argument("run", type=PATH)
@click.argument("other", type=PATH, required=False)
@click.option("--web", is_flag=True,
              help="Serve the viewer to a browser on this machine; prints its address and the ssh "
              "command that opens it on another machine.")  # fmt: skip
@click.option("--save", type=PATH, metavar="FILE.rrd", help="Write OTHER beside RUN; open nothing.")
def view(run: Path, other: Path | None, web: bool, save: Path | None) -> int:
    """Open the recording of RUN, a run directory, in the Rerun viewer. With OTHER, a flight over
    the same place, both are shown on one time line, and the instant where they part is marked.

    With --web the viewer listens on localhost only, until Ctrl-C.

    Example: touchdown view runs/crossroad-livo-0-land
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
    if not save.exists():
        return
    if reason := no_file(save):
        raise UsageError(f"--save {save}: {reason}; name a file, such as pair.rrd")
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
    if not web:
        return _exit_code([sys.executable, "-m", "rerun", str(recording)])
    with tempfile.TemporaryDirectory() as folder:
        command, page, data = web_viewer(str(compacted(recording, Path(folder))))
        click.echo(address_text(page, data))
        return _exit_code(command)


def _exit_code(command: list[str]) -> int:
    return EXIT_DONE if run_viewer(command) == 0 else EXIT_FAILED


_SCANS = "ply of scans"
_FORMATS_OF_OPTION = {
    "points": ("ply", _SCANS),
    "every": (_SCANS,),
    "poses": ("mcap", _SCANS, "tum", "kitti"),
    "images": ("mcap",),
    "tf": ("mcap",),
    "origin": ("mcap", "plan"),
    "judged": ("tum", "csv"),
}
"""Formats to which an option applies."""


def _origin(text: str) -> GeodeticPoint:
    from touchdown.experiments.export.flown_run import GeodeticPoint

    point = GeodeticPoint(*finite_numbers(text, 3))
    if not (abs(point.latitude_deg) <= 90.0 and abs(point.longitude_deg) <= 180.0):
        raise ValueError
    return point


@click.command()
@click.argument("run", type=PATH)
@click.option("--format", "kind", required=True,
              type=click.Choice(["mcap", "ply", "tum", "csv", "euroc", "kitti", "plan"]),
              help="mcap: a rosbag2 folder; ply: a cloud; tum: a trajectory; csv: a table of time "
              "steps; euroc, kitti: folders of these data sets; plan: "
              "waypoints for QGroundControl.")  # fmt: skip
@click.option("--out", type=PATH, help="The file or folder.  [RUN.FORMAT, RUN-bag, RUN-euroc]")
@click.option("--poses", type=click.Choice(["estimate", "truth", "reference"]), default="estimate",
              show_default=True,
              help="tum: the trajectory; mcap, ply: the poses of the vehicle; kitti: those that "
              "undo its motion within a scan.")  # fmt: skip
@click.option("--points", type=click.Choice(["map", "scans"]), default="map", show_default=True,
              help="ply: the run's map, or all returns of the LIDAR in the camera's "
              "colours.")  # fmt: skip
@click.option("--every", type=click.IntRange(min=1), default=1, show_default=True, metavar="N",
              help="ply of scans: one return of N.")  # fmt: skip
@click.option("--images", type=click.Choice(["compressed", "raw", "none"]), default="compressed",
              show_default=True, help="mcap: PNG, or pixels, or no images.")  # fmt: skip
@click.option("--tf", type=click.Choice(["all", "odom", "none"]), default="all", show_default=True,
              help="mcap: moving transforms; odom leaves out map to odom, which SLAM finds "
              "itself.")  # fmt: skip
@click.option("--origin",
              type=Parsed("LAT,LON,HEIGHT", "degrees and metres, such as 40,116,50", _origin),
              help="mcap, plan: the world's origin.")  # fmt: skip
@click.option("--judged", is_flag=True,
              help="tum, csv: only rows at which the position error is evaluated.")  # fmt: skip
@JSON
def export(run: Path, kind: str, out: Path | None, as_json: bool, **choices: Any) -> int:
    """Write RUN, a run directory, in a format of other tools.

    Sensor data (mcap, euroc, kitti, and ply of scans) needs a flight with --log-sensors.

    Example: touchdown export runs/crossroad-livo-0-land --format mcap
    """
    from touchdown.experiments.export.flown_run import ExportOptions
    from touchdown.experiments.export.run import export as export_run

    options, default = ExportOptions(**choices), ExportOptions()
    form = _SCANS if kind == "ply" and options.points == "scans" else kind
    for name, forms in _FORMATS_OF_OPTION.items():
        if form not in forms and choices[name] != getattr(default, name):
            raise UsageError(f"--{name} is for --format {' or '.join(forms)}, not {form}")
    if kind != "tum" and options.poses == "reference":
        raise UsageError("--poses reference is for --format tum alone")
    done = export_run(run, kind, out, options)

    def show(_figures: Mapping[str, Any]) -> None:
        width = max(len(name) for name in done.counts)
        for name, count in done.counts.items():
            say(f"{name:<{width}}  {count:>9}")
        for note in done.notes:
            say(f"note: {note}")
        say(f"written: {done.out} ({done.facts['bytes'] / 1e6:.1f} MB)")

    figures = {"file": str(done.out), "format": kind, "counts": done.counts}
    return answer({**figures, **done.facts, "notes": done.notes}, as_json, show)
