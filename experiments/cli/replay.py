"""The command ``touchdown replay``."""

from importlib.resources import files
from pathlib import Path
from typing import Any

import click

from touchdown.experiments.cli.common import (
    JSON,
    OVERRIDES,
    PATH,
    QUIET,
    Number,
    answer,
    completed,
)
from touchdown.experiments.cli.fly import ESTIMATORS, print_run
from touchdown.experiments.terminal import make_progress, say


@click.command()
@click.argument("data", type=PATH)
@click.option(
    "--rig",
    type=PATH,
    metavar="FILE",
    help="Kalibr's camchain-imucam.yaml, or a TOML file: what DATA does not say.",
)
@click.option(
    "--estimator",
    metavar="NAME",
    shell_complete=completed(lambda: ESTIMATORS),
    help=f"{', '.join(ESTIMATORS[:-1])}, or MODULE:FUNCTION.  [livo]",
)
@click.option(
    "--truth",
    type=PATH,
    metavar="FILE.tum|registration",
    help="True poses of the body, on the clock of DATA; or by registration of its scans.",
)
@click.option(
    "--align",
    type=click.Choice(["origin", "se3", "none"]),
    default="origin",
    show_default=True,
    help="How the truth is moved to the estimate, as evo does it.",
)
@click.option("--moving", is_flag=True, help="DATA begins in motion.")
@click.option(
    "--from",
    "from_s",
    type=Number(min=0.0),
    default=0.0,
    metavar="S",
    help="Begin so many seconds after the first frame.  [0]",
)
@click.option(
    "--until", "until_s", type=Number(min=0.0), default=1e5, metavar="S", help="End there."
)
@OVERRIDES
@click.option(
    "--log-sensors",
    is_flag=True,
    help="Write sensors.mcap, as a flight does, for export and for fly --replay.",
)
@click.option("--out", type=PATH, help="Run directory.  [runs/DATA-ESTIMATOR-0-replay]")
@JSON
@QUIET
def replay(
    data: Path, out: Path | None, as_json: bool, quiet: bool, **options: Any
) -> int:  # fmt: skip
    """Replay a recording of a real flight through an estimator.

    DATA is a bag of ROS 1 or ROS 2, a folder of EuRoC (mav0/), a sequence of KITTI odometry or a
    log of PX4 (.ulg).

    Example: touchdown replay V1_01_easy --estimator stereo
    """
    from touchdown.experiments.external.processes import none_left
    from touchdown.experiments.io.run_directory import default_out_dir
    from touchdown.experiments.recordings.run import ReplayOptions, replay_recording

    asked = ReplayOptions(**options)
    name = data.resolve().name
    out = out or default_out_dir(name, asked.estimator or ESTIMATORS[0], 0, "-replay")
    with none_left():
        result = replay_recording(data, out, asked, make_progress(quiet))
    code = print_run(result, out, as_json=as_json, quiet=quiet)
    for event in () if as_json else result.events:
        if event.time_s == 0.0:
            say(event.text)
    return code


@click.command()
@click.argument("name", required=False)
@JSON
def datasets(name: str | None, as_json: bool) -> int:
    """List recordings of others that `touchdown replay` reads: what, how large, whose, where.

    NAME shows one with its layout and its command.

    Example: touchdown datasets mars-lvig
    """
    import tomllib

    from touchdown.experiments.errors import UsageError, nearest

    text = (files("touchdown.experiments.recordings") / "datasets.toml").read_text("utf-8")
    known = tomllib.loads(text)
    if name is not None and name not in known:
        told = nearest(name, known)
        raise UsageError(f"unknown data set '{name}'{told}; known: {', '.join(known)}")

    def show(_figures: Any) -> None:
        if name is None:
            for one, row in known.items():
                say(f"{one}: {row['what']}; {row['size']}; {row['licence']}")
            return
        for key, value in known[name].items():
            say(f"{key}: {value}")

    return answer(known if name is None else known[name], as_json, show)
