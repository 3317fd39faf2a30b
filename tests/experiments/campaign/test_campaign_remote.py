"""Campaigns at an address: nothing is flown twice, on this machine or another, nothing lost."""

import shutil
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from touchdown.experiments.campaign import remote
from touchdown.experiments.campaign.executor import LocalEngine
from touchdown.experiments.campaign.plan import in_shard
from touchdown.experiments.campaign.results_table import load_rows
from touchdown.experiments.campaign.session import Watcher
from touchdown.experiments.errors import UsageError

from support.campaign_flights import RUNNER, attempts, axes, make_plan

THREE, SIX = (axes(scene=["flat"], estimator=["fake:good"], seeds=s) for s in ("0-2", "0-5"))


@pytest.fixture(autouse=True)
def caches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def fly_to(tmp_path: Path, text: str = THREE, shard: tuple[int, int] | None = None) -> int:
    plan = make_plan(tmp_path, text)
    figures = remote.fly_to_address(
        plan, f"file://{tmp_path}/there", LocalEngine(1), runner=RUNNER, shard=shard
    )
    return int(figures["finished"])


def test_another_machine_goes_on_where_one_stopped(tmp_path: Path) -> None:
    """A run that was cut off while it was sent has no row there: it is flown again."""
    assert fly_to(tmp_path, axes(scene=["flat"], estimator=["fake:good"], seeds="0-1")) == 2
    there = tmp_path / "there"
    (there / "runs" / "flat-fake.good-s1" / "row.parquet").unlink()
    (there / "runs" / "flat-fake.good-s0" / "stranger.txt").write_text("mine")
    shutil.rmtree(tmp_path / "cache")
    assert fly_to(tmp_path) == 3
    copy = remote.Remote(f"file://{there}").directory
    assert attempts(copy) == {"flat-fake.good-s1": 1, "flat-fake.good-s2": 1}
    assert [row["seed"] for row in load_rows(there)] == [0, 1, 2]
    assert not [*copy.rglob("stranger.txt")]


def test_what_was_not_sent_is_sent_at_the_next_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as killed:
        killed.setattr(remote.Remote, "send_file", lambda *_: None)
        assert fly_to(tmp_path) == 3
    assert not (tmp_path / "there").exists() and fly_to(tmp_path) == 3
    assert len(load_rows(tmp_path / "there")) == 3
    assert set(attempts(remote.Remote(f"file://{tmp_path}/there").directory).values()) == {1}


def test_a_recording_of_a_second_flight_is_sent(tmp_path: Path) -> None:
    assert fly_to(tmp_path, axes(scene=["flat"], estimator=["fake:is_lost"], seeds="0")) == 1
    assert [path.parent.name for path in (tmp_path / "there").rglob("flight.rrd")] == [
        "flat-fake.is_lost-s0"
    ]


def test_the_last_machine_to_end_writes_the_table_of_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second machine begins and ends while the first one flies."""

    assert len({in_shard(run.run_id, (1, 2)) for run in make_plan(tmp_path, SIX).runs}) == 2

    class Meanwhile(Watcher):
        def end(self) -> None:
            with monkeypatch.context() as machine:
                machine.setenv("XDG_CACHE_HOME", str(tmp_path / "other"))
                fly_to(tmp_path, SIX, shard=(2, 2))

    plan = make_plan(tmp_path, SIX)
    figures = remote.fly_to_address(
        plan, f"file://{tmp_path}/there", LocalEngine(1), runner=RUNNER, shard=(1, 2),
        watcher=Meanwhile(),
    )  # fmt: skip
    table = pq.read_table(tmp_path / "there" / "results.parquet")
    assert sorted(table["seed"].to_pylist()) == [*range(6)] and figures["finished"] == 6


def test_a_run_that_is_flown_after_a_crash_is_no_crash_there(tmp_path: Path) -> None:
    text = axes(scene=["flat"], estimator=["fake:raises"], seeds="0") + "[limits]\nretries = 0\n"
    assert fly_to(tmp_path, text) == 0
    record = tmp_path / "there" / "failed" / "flat-fake.raises-s0.json"
    assert record.is_file()
    copy = remote.Remote(f"file://{tmp_path}/there")
    copy.fetch()
    (copy.directory / "runs" / record.stem).mkdir(parents=True)
    for _ in range(2):
        copy.send_run(record.stem)
    assert not record.exists()


def test_an_address_that_cannot_be_used_is_one_line() -> None:
    with pytest.raises(UsageError, match=r"--out nowhere://a: Protocol not known: nowhere"):
        remote.Remote("nowhere://a")
