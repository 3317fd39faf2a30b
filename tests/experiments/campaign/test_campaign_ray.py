"""Campaigns on Ray, whose nodes do not see the campaign's folder: runs come back whole, once."""

import io
import json
import sys
import tarfile
from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.campaign.plan import Plan
from touchdown.experiments.campaign.results_table import RUNS, finished_ids
from touchdown.experiments.campaign.session import Watcher, fly_campaign, make_engine
from touchdown.experiments.errors import UsageError

from support.campaign_flights import MANY, RUNNER, axes, figures, fly, make_plan
from support.ray_fake import FakeRay


def flown(monkeypatch: pytest.MonkeyPatch, plan: Plan, out: Path, ray: FakeRay) -> dict[str, Any]:
    monkeypatch.setitem(sys.modules, "ray", ray)
    return fly_campaign(plan, out, make_engine("ray", None), runner=RUNNER)


def test_missing_ray_is_reported_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UsageError, match=r"constraints.txt -e '\.\[ray\]'"):
        make_engine("ray", None)
    with pytest.raises(UsageError, match="--engine ray"):
        make_engine("local", None, "auto")


def test_runs_come_back_from_nodes_with_other_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second and the third task are lost with their node, when they are flown."""
    plan, out = make_plan(tmp_path, MANY), tmp_path / "out"
    ray = FakeRay(out, lost=(1, 2))
    totals = flown(monkeypatch, plan, out, ray)
    assert (totals["finished"], totals["crashed"], totals["missing"]) == (8, 0, [])
    assert ray.asked == 8 + 2 + 4, "runs, those that were lost, recordings"
    fly(plan, tmp_path / "here", jobs=2)
    assert figures(out) == figures(tmp_path / "here")
    assert {str(path.relative_to(out)) for path in out.glob("runs/*/*")} == {
        str(path.relative_to(tmp_path / "here")) for path in (tmp_path / "here").glob("runs/*/*")
    }


def test_a_run_is_given_up_when_its_nodes_are_lost_again_and_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = make_plan(tmp_path, axes(scene=["flat"], estimator=["fake:good"], seeds="0-1"))
    ray = FakeRay(tmp_path / "out", lost=(0, 2, 3, 4, 5, 6))
    totals = flown(monkeypatch, plan, tmp_path / "out", ray)
    assert (totals["finished"], totals["crashed"]) == (1, 1)
    assert list(totals["errors"].values()) == ["the Ray worker was lost"]


def test_failures_on_a_node_are_recorded_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = make_plan(tmp_path, axes(scene=["flat"], estimator=["fake:raises", "fake:good"]))
    ray = FakeRay(tmp_path / "out")
    assert flown(monkeypatch, plan, tmp_path / "out", ray)["crashed"] == 1
    record = json.loads((tmp_path / "out" / "failed" / "flat-fake.raises-s0.json").read_text())
    assert record["attempts"] == 2 and "in fly" in record["traceback"]
    full = make_plan(tmp_path, axes(scene=["flat"], estimator=["fake:fills_the_disk"]))
    with pytest.raises(UsageError, match="No space left"):
        flown(monkeypatch, full, tmp_path / "full", FakeRay(tmp_path / "full"))


def _changed_result(packed: bytes) -> bytes:
    """The tar file with another outcome in its result."""
    made = io.BytesIO()
    with (
        tarfile.open(fileobj=io.BytesIO(packed)) as old,
        tarfile.open(fileobj=made, mode="w") as new,
    ):
        for member in old:
            file = old.extractfile(member)
            data = b"" if file is None else file.read()
            if member.name.endswith("result.json"):
                data = json.dumps(json.loads(data) | {"outcome": "DIVERGED"}).encode()
                member.size = len(data)
            new.addfile(member, io.BytesIO(data))
    return made.getvalue()


@pytest.mark.parametrize(("row", "packed", "reason"), [
    ({"config_sha": "0" * 12}, lambda data: data, "another version of the program"),
    ({"run_id": "../../x"}, lambda data: data, "is of the run '../../x'"),
    ({}, _changed_result, "are of two flights"), ({}, lambda data: b"", "No such file"),
])  # fmt: skip
def test_a_run_that_is_not_the_planned_one_does_not_count(
    row: dict[str, Any], packed: Any, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def changed(answer: tuple[list[dict[str, Any]], bytes]) -> Any:
        events, data = answer
        events[-1]["row"] |= row
        return events, packed(data)

    plan, out = make_plan(tmp_path, axes(scene=["flat"], estimator=["fake:good"])), tmp_path / "out"
    totals = flown(monkeypatch, plan, out, FakeRay(out, on_the_way=changed))
    assert totals["crashed"] == 1 and reason in totals["errors"]["flat-fake.good-s0"]
    assert not (out / RUNS).exists()
    assert fly(plan, out)["finished"] == 1, "the next start flies it"


@pytest.mark.slow
def test_a_real_cluster_loses_a_node(tmp_path: Path) -> None:
    """Two nodes of one machine: what a worker makes lies in a folder of its own on each."""
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    plan, out = make_plan(tmp_path, MANY), tmp_path / "out"
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1}, connect=True)
    far, finished = cluster.add_node(num_cpus=1), list[str]()
    cluster.wait_for_nodes()

    class Axe(Watcher):
        def see(self, event: dict[str, Any]) -> None:
            finished.extend([event["run_id"]] if event["event"] == "finished" else [])
            if len(finished) == 2 and len(cluster.list_all_nodes()) == 2:
                cluster.remove_node(far, allow_graceful=False)

    try:
        engine = make_engine("ray", None)
        totals = fly_campaign(plan, out, engine, runner=RUNNER, watcher=Axe())
    finally:
        ray.shutdown()
        cluster.shutdown()
    assert (totals["finished"], totals["crashed"], totals["missing"]) == (8, 0, [])
    assert sorted(finished) == sorted(run.run_id for run in plan.runs)
    assert sorted(finished_ids(out)) == sorted(finished)
