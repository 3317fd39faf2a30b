"""Command ``touchdown doctor``."""

from typing import Any

import click

from touchdown.experiments.cli.common import JSON, QUIET, answer
from touchdown.experiments.errors import visible
from touchdown.experiments.terminal import end_progress, make_progress, say


@click.command()
@JSON
@QUIET
def doctor(as_json: bool, quiet: bool) -> int:
    """Say what this machine has and lacks, and fly ten seconds.

    The renderer, versions, cores and memory; what is missing and the command that gets it; the
    real-time factor of a flight with LIDAR and camera. Exit code 1 means that it did not fly.

    Example: touchdown doctor
    """
    from touchdown.experiments.benchmarks.doctor import examine
    from touchdown.experiments.flight.run import fly_with_usage_errors

    progress = make_progress(quiet)
    found = examine(lambda config, out: fly_with_usage_errors(config, out, progress))
    end_progress(quiet)
    return answer(found, as_json, _print, good=found["ready"])


def _print(found: dict[str, Any]) -> None:
    machine, renderer, flight = found["machine"], found["renderer"], found["flight"]
    cost = ", in software: no GPU is needed" if renderer["in_software"] else ""
    _line("system", machine["system"])
    _line("cores", machine["cores"])
    free, total = machine["available_gb"], machine["memory_gb"]
    _line("memory", f"{free:.1f} of {total:.1f} GB available; a worker takes 0.6 GB")
    _line("renderer", f"{renderer['name']} by {renderer['backend']}{cost}")
    _line("versions", ", ".join(f"{name} {value}" for name, value in found["versions"].items()))
    _line("revision", found["git_revision"])
    for lack in found["missing"]:
        _line("missing", f"{lack['what']}, for {lack['for']}: {lack['command']}")
    if "error" in flight:
        _line("no flight", flight["error"])
        return
    _line(
        "flown",
        f"{flight['sim_s']:.1f} simulated seconds in {flight['wall_s']:.1f} s: real-time factor "
        f"{flight['real_time_factor']:.2f}, {flight['outcome']}",
    )


def _line(name: str, value: object) -> None:
    say(f"{name:10}{visible(value)}")
