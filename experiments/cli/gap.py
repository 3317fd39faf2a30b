"""`touchdown gap`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from touchdown.experiments.cli.common import PATH, QUIET, answered
from touchdown.experiments.terminal import say


def _print(found: Mapping[str, Any]) -> None:
    say(found["text"])


@click.command()
@click.option("--data", type=PATH, required=True, metavar="DIR",
              help="Recordings: flight/, caliterra/, dem/, EuRoC's mav0/ ...")  # fmt: skip
@click.option("--out", type=PATH, default=Path("gap"), show_default=True, metavar="DIR")
@QUIET
@answered(_print)
def gap(data: Path, out: Path, quiet: bool) -> dict[str, Any]:
    """Compare the simulated world with recordings of the real one.

    Writes gap.md and gap.png. Which recordings are read from where: docs/results/gap.md.

    Example: touchdown gap --data recordings
    """
    from touchdown.experiments.gap.page import write_card

    return write_card(data, out, lambda row: None if quiet else say(f"{row} ...", err=True))
