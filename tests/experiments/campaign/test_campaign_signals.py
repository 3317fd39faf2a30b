"""A campaign that is killed by a signal, again and again, at random moments after some flights have
finished."""

import random
import signal
import time
from collections import Counter
from pathlib import Path

import pytest

from touchdown.experiments.campaign.results_table import finished_ids, load_rows

from support.campaign_command import start
from support.campaign_flights import attempts, axes, figures, fly, flying, make_plan, wait_for
from support.kills import SIGNALS, marked, new_mark, stamps, strike, unfinished


def kill_again_and_again(folder: Path, number: int, kills: int, seed: int) -> None:
    """Fails where a finished flight is lost or flown twice, or a process or file is left over."""
    runs = 6 * (kills + 1)
    text = axes(scene=["flat", "lake"], estimator=["fake:slow"], seeds=f"0-{runs // 2 - 1}")
    plan, out, draw = make_plan(folder, text), folder / "out", random.Random(seed)
    whole = make_plan(folder / "whole", text)
    done: Counter[str] = Counter()
    kept: dict[Path, tuple[int, bytes]] = {}
    for kill in range(kills):
        mark, before = new_mark(), len(finished_ids(out))
        command = start("campaign", folder / "campaign.toml", "--out", out, "--jobs", "2",
                        "--quiet", **mark)  # fmt: skip
        wait_for(lambda b=before: len(finished_ids(out)) > b and flying(out), "flights")  # type: ignore[misc]
        time.sleep(draw.uniform(0.0, 0.4))
        assert command.poll() is None, f"kill {kill} comes too late"
        strike(command, number, mark)
        now = stamps(out.glob("runs/*/result.json"))
        assert kept.items() <= now.items(), "lost or written anew"
        flown = attempts(out)
        assert all(flown[name] == count for name, count in done.items()), "flown twice"
        kept, done = now, Counter({name: flown[name] for name in finished_ids(out)})
    mark = new_mark()
    command = start("campaign", folder / "campaign.toml", "--out", out, "--jobs", "2", "--quiet",
                    **mark)  # fmt: skip
    _, err = command.communicate(timeout=300.0)
    assert (command.returncode, err) == (0, "")
    assert not marked(mark) and not unfinished(out)
    assert kept.items() <= stamps(out.glob("runs/*/result.json")).items()
    assert all(attempts(out)[name] == count for name, count in done.items()), "flown twice"
    ids = [row["run_id"] for row in load_rows(out)]
    assert sorted(ids) == sorted(run.run_id for run in plan.runs)
    fly(whole, folder / "whole" / "out", jobs=2)
    assert figures(out) == figures(folder / "whole" / "out")


def test_a_signal_costs_no_finished_flight(tmp_path: Path) -> None:
    kill_again_and_again(tmp_path, signal.SIGTERM, kills=1, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("number", SIGNALS)
def test_twenty_signals_cost_no_finished_flight(number: int, tmp_path: Path) -> None:
    kill_again_and_again(tmp_path, number, kills=20, seed=100 + number)
