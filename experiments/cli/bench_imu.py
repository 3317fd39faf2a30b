"""``touchdown bench imu``."""

from __future__ import annotations

import json
from pathlib import Path

import click

from touchdown.experiments.cli.common import EXIT_DONE
from touchdown.experiments.errors import usage_errors


@click.command("imu")
@click.option("--data", type=click.Path(path_type=Path), required=True, metavar="DIR",
              help="Recorded flights of Hurwitz and Klein (2023).")  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path), default=None, metavar="DIR",
              help="Draw imu_spectra.png there.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def bench_imu(data: Path, out: Path | None, as_json: bool) -> int:
    """Compare the vibration of the simulated IMU with that of recorded flights, band by band, and
    fit the levels of its model to them.

    Example: touchdown bench imu --data flights --out figures
    """
    from touchdown.experiments.benchmarks import imu_spectra

    found = usage_errors(lambda: imu_spectra.measure(data, out))
    if as_json:
        click.echo(json.dumps({name: array.tolist() for name, array in found.items()}, indent=2))
    else:
        click.echo("\n".join(imu_spectra.rows(found)))
    return EXIT_DONE
