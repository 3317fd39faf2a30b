"""``touchdown calibrate``: camera and LIDAR from chessboard poses."""

from __future__ import annotations

from pathlib import Path

import click

from touchdown.experiments.cli.common import PATH, QUIET, SEED, answer
from touchdown.experiments.cli.console import print_calibration
from touchdown.experiments.errors import usage_errors
from touchdown.experiments.terminal import make_notes


@click.command()
@click.option("--poses", type=click.IntRange(min=3), default=12, show_default=True)
@click.option("--seed", type=SEED, help="Varies the poses, the room and all noise.  [0]")
@click.option(
    "--out",
    type=PATH,
    default=Path("calibration.json"),
    show_default=True,
    help="The file that flights load with --calibration.",
)
@click.option("--pictures", type=PATH, help="Folder for figures.")
@click.option("--config", "config_file", type=PATH, help="A TOML file.")
@click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="KEY=VALUE",
    help="Such as camera.distortion=[-0.05,0.02,0.0,0.0,0.0]. May be repeated.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the report as one JSON object.")
@QUIET
def calibrate(
    poses: int,
    seed: int | None,
    out: Path,
    pictures: Path | None,
    config_file: Path | None,
    overrides: tuple[str, ...],
    as_json: bool,
    quiet: bool,
) -> int:
    """Calibrate camera and LIDAR from a chessboard held in front of them in several poses.

    Renders and scans the board with all noise on, estimates the camera matrix, the distortion and
    the pose of the LIDAR, and reports the errors beside the stated covariance.

    Example: touchdown calibrate --poses 12 --out calibration.json --pictures pictures
    """
    from touchdown.experiments.calibration.evaluate import run_calibration
    from touchdown.experiments.config.loading import load_config

    # No estimator is built. Calibration is done in a workshop, on a rig at rest in even light.
    config = load_config(
        config_file, overrides, allow_code=True, profile_default="ideal", seed=seed
    )
    report = usage_errors(lambda: run_calibration(config, poses, out, pictures, make_notes(quiet)))
    return answer(report, as_json, print_calibration)
