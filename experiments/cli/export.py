"""``touchdown export``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from touchdown.experiments.cli.common import EXIT_DONE, JSON, PATH
from touchdown.experiments.terminal import say

if TYPE_CHECKING:
    from touchdown.experiments.export.flown_run import GeodeticPoint

_ONLY: dict[str, tuple[tuple[str, ...], Any]] = {
    "points": (("ply",), "map"),
    "every": (("ply",), 1),
    "images": (("mcap",), "compressed"),
    "tf": (("mcap",), "all"),
    "origin": (("mcap",), None),
    "judged": (("tum", "csv"), False),
}
"""Formats to which an option applies, and its default."""


class OriginType(click.ParamType):
    """``LATITUDE,LONGITUDE,HEIGHT``: degrees and metres."""

    name = "LAT,LON,HEIGHT"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> GeodeticPoint:
        from touchdown.experiments.export.flown_run import GeodeticPoint

        if isinstance(value, GeodeticPoint):
            return value
        try:
            latitude, longitude, height = (float(part) for part in str(value).split(","))
        except ValueError:
            self.fail(f"'{value}' is not of the form LAT,LON,HEIGHT, such as 40,116,50", param, ctx)
        if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and abs(height) <= 1e5):
            self.fail(f"'{value}' is no point on Earth in degrees and metres", param, ctx)
        return GeodeticPoint(latitude, longitude, height)


@click.command()
@click.argument("run", type=PATH)
@click.option(
    "--format",
    "kind",
    type=click.Choice(["mcap", "ply", "tum", "csv", "euroc", "kitti"]),
    required=True,
    help="mcap: a rosbag2 folder; ply: a cloud; tum: a trajectory; csv: a table of time steps; "
    "euroc, kitti: folders of these data sets.",
)
@click.option("--out", type=PATH, help="The file or folder.  [RUN.FORMAT, RUN-bag, RUN-euroc]")
@click.option(
    "--poses",
    type=click.Choice(["estimate", "truth", "reference"]),
    default="estimate",
    show_default=True,
    help="tum: the trajectory; mcap, ply: the poses of the vehicle; kitti: those that undo its "
    "motion within a scan.",
)
@click.option(
    "--points",
    type=click.Choice(["map", "scans"]),
    default="map",
    show_default=True,
    help="ply: the run's map, or all returns of the LIDAR in the camera's colours.",
)
@click.option(
    "--every",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="ply of scans: one return of N.",
    metavar="N",
)
@click.option(
    "--images",
    type=click.Choice(["compressed", "raw", "none"]),
    default="compressed",
    show_default=True,
    help="mcap: PNG, or pixels, or no images.",
)
@click.option(
    "--tf",
    type=click.Choice(["all", "odom", "none"]),
    default="all",
    show_default=True,
    help="mcap: moving transforms; odom leaves out map to odom, which SLAM finds itself.",
)
@click.option(
    "--origin",
    type=OriginType(),
    help="mcap: latitude and longitude in degrees and height in metres of the world's origin.",
)
@click.option(
    "--judged", is_flag=True, help="tum, csv: only rows at which the position error is evaluated."
)
@JSON
def export(run: Path, kind: str, out: Path | None, as_json: bool, **choices: Any) -> int:
    """Write RUN, a run directory, in a format of other tools.

    Sensor data (mcap, euroc, kitti, and ply of scans) needs a flight with --log-sensors.

    Example: touchdown export runs/crossroad-livo-0 --format mcap
    """
    from touchdown.experiments.errors import UsageError
    from touchdown.experiments.export.flown_run import ExportOptions
    from touchdown.experiments.export.run import export as export_run

    for name, (kinds, default) in _ONLY.items():
        if kind not in kinds and choices[name] != default:
            raise UsageError(f"--{name} is for --format {' or '.join(kinds)}, not {kind}")
    if kind != "tum" and choices["poses"] == "reference":
        raise UsageError("--poses reference is for --format tum alone")
    if kind == "csv" and choices["poses"] != "estimate":
        raise UsageError("--poses is not for --format csv: it holds all trajectories")
    if kind == "euroc" and choices["poses"] != "estimate":
        raise UsageError("--poses is not for --format euroc: its ground truth is the truth")
    if kind == "ply" and choices["points"] == "map" and choices["poses"] != "estimate":
        raise UsageError("--poses is for --points scans: the map is a file of the run")
    if kind == "ply" and choices["points"] == "map" and choices["every"] != 1:
        raise UsageError("--every is for --points scans")
    done = export_run(run, kind, out, ExportOptions(**choices))
    if as_json:
        figures = {"file": str(done.out), "format": kind, "counts": done.counts}
        click.echo(json.dumps({**figures, **done.facts, "notes": done.notes}, indent=2))
        return EXIT_DONE
    width = max(len(name) for name in done.counts)
    for name, count in done.counts.items():
        say(f"{name:<{width}}  {count:>9}")
    for note in done.notes:
        say(f"note: {note}")
    say(f"written: {done.out} ({done.facts['bytes'] / 1e6:.1f} MB)")
    return EXIT_DONE
