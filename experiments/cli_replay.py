"""``touchdown fly --replay`` and ``touchdown check-estimator``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from experiments.cli_base import EXIT_DONE, EXIT_FAILED, is_good

_FLOWN = {
    "seed": "--seed",
    "wind_kmh": "--wind-kmh",
    "calibration": "--calibration",
    "config_file": "--config",
    "record": "--record",
    "fault": "--fault",
    "log_sensors": "--log-sensors",
}
"""Options that decide a flight and mean nothing once it is over."""


def run_replay(run: Path, options: dict[str, Any]) -> int:
    """Logged sensors of ``run`` through an estimator; ``options`` are those of ``fly``."""
    from experiments.config import UsageError
    from experiments.console import end_progress, make_progress, print_result
    from experiments.replay import replay, replay_config

    for name, option in _FLOWN.items():
        if options.get(name) not in (None, (), False):
            raise UsageError(f"{option} does not go with --replay: the flight is over")
    config = replay_config(run, options["estimator"], options["overrides"])
    scene, quiet = options["scene"], options["quiet"]
    if scene is not None and scene != config.scene:
        raise UsageError(f"'{run}' was flown over {config.scene}, not {scene}")
    out = options["out"]
    if out is None:
        stem = Path(config.scene).stem
        name = config.estimator.replace(":", ".")
        out = Path("runs") / f"{stem}-{name}-{config.seed}-replay"
    result = replay(run, config, out, make_progress(quiet))
    end_progress(quiet)
    good = is_good(result)
    if options["as_json"]:
        click.echo(json.dumps({**result, "run_dir": str(out)}, indent=2))
    else:
        print_result(result, out, good)
        click.echo(f"replayed open loop, judged {result['judged_hz']:g} times a second")
    return EXIT_DONE if good else EXIT_FAILED
