"""Campaigns on Ray: nodes that do not share the directory, rows that do not arrive, and addresses
where no cluster is."""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.campaign import ray_share
from touchdown.experiments.campaign.arrival import why_not_arrived
from touchdown.experiments.campaign.executor_ray import RayEngine
from touchdown.experiments.campaign.plan import Plan
from touchdown.experiments.campaign.results_table import RUNS, load_rows, read_row, write_table
from touchdown.experiments.campaign.session import fly_campaign, make_engine
from touchdown.experiments.errors import UsageError

from support.campaign_flights import RUNNER, axes, fly, make_plan
from support.ray_fake import FakeRay, Node

FOUR = axes(scene=["flat", "lake"], estimator=["fake:good"], seeds="0-1")


@pytest.fixture
def plan(tmp_path: Path) -> Plan:
    return make_plan(tmp_path / "plan", FOUR)


@pytest.fixture(autouse=True)
def no_patience(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_share, "VISIBLE_S", 0.0)
    monkeypatch.setattr(RayEngine, "patience_s", 0.0)


def elsewhere(tmp_path: Path, name: str) -> Node:
    """A node on which every path of the driver is another place of its own."""
    root = tmp_path / f"disk-of-{name}"

    def here(path: str) -> str:
        inner = root / path.lstrip("/")
        inner.parent.mkdir(parents=True, exist_ok=True)
        return str(inner)

    def sees(question: Any) -> Any:
        return dataclasses.replace(question, file=here(question.file))

    def flies(task: Any) -> Any:
        directory = Path(here(task.directory))
        directory.mkdir(exist_ok=True)
        return dataclasses.replace(task, directory=str(directory))

    return Node(name, sees=sees, flies=flies)


def flown(monkeypatch: pytest.MonkeyPatch, plan: Plan, out: Path, ray: FakeRay) -> dict[str, Any]:
    monkeypatch.setitem(sys.modules, "ray", ray)
    return fly_campaign(plan, out, make_engine("ray", None), runner=RUNNER)


def test_a_node_without_the_share_is_refused_before_the_first_flight(
    tmp_path: Path, plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    ray, out = FakeRay(Node("near"), elsewhere(tmp_path, "far")), tmp_path / "out"
    with pytest.raises(UsageError) as caught:
        flown(monkeypatch, plan, out, ray)
    message = str(caught.value)
    assert "the Ray node far (10.0.0.1) does not see" in message and "\n" not in message
    assert "name an --out that all nodes share" in message
    assert not ray.actors and not (out / RUNS).exists() and not (out / "attempts.log").exists()
    assert not list(out.glob(".share*"))


def test_a_node_that_joins_later_is_checked_when_its_actor_starts(
    tmp_path: Path, plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    ray, out = FakeRay(Node("near")), tmp_path / "out"
    ray.joined = [elsewhere(tmp_path, "late")]
    with pytest.raises(UsageError, match=r"the Ray node late .* does not see"):
        flown(monkeypatch, plan, out, ray)
    assert not list(tmp_path.glob("disk-of-late/**/runs"))
    assert len(ray.killed) == 2, "no actor is left"
    ray = FakeRay(Node("near"))
    assert flown(monkeypatch, plan, out, ray)["missing"] == [], "what was flown is kept"


def test_a_node_that_reads_alone_is_refused(
    tmp_path: Path, plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It sees a copy of the directory, in which what it writes stays."""
    node = elsewhere(tmp_path, "copy")

    def sees(question: Any) -> Any:
        assert node.sees is not None
        other = node.sees(question)
        Path(other.file).write_text(question.text)
        return other

    copy = dataclasses.replace(node, sees=sees)
    with pytest.raises(UsageError, match=r"the Ray node copy .* writes into another"):
        flown(monkeypatch, plan, tmp_path / "out", FakeRay(Node("near"), copy))
    assert not (tmp_path / "out" / RUNS).exists()


def test_a_run_whose_row_stays_on_the_node_counts_as_failed(
    tmp_path: Path, plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even where every proof of the share was passed."""
    away = elsewhere(tmp_path, "away")
    away = dataclasses.replace(away, cpus=2.0, sees=lambda question: question)
    totals = flown(monkeypatch, plan, tmp_path / "out", FakeRay(away))
    assert (totals["finished"], totals["crashed"], totals["remaining"]) == (0, 4, 0)
    assert all("its row is not in" in reason for reason in totals["errors"].values())
    assert {row["outcome"] for row in load_rows(tmp_path / "out")} == {"CRASHED"}
    assert fly(plan, tmp_path / "out")["finished"] == 4, "the next start flies them"


def _other_configuration(run: Path, row: dict[str, Any]) -> None:
    write_table([row | {"config_sha": "0" * 12}], run / "row.parquet")


def _other_run(run: Path, row: dict[str, Any]) -> None:
    write_table([row | {"run_id": "../../x"}], run / "row.parquet")


def _two_rows(run: Path, row: dict[str, Any]) -> None:
    write_table([row, row], run / "row.parquet")


def _other_result(run: Path, row: dict[str, Any]) -> None:
    result = json.loads((run / "result.json").read_text()) | {"outcome": "DIVERGED"}
    (run / "result.json").write_text(json.dumps(result))


def _cut_row(run: Path, row: dict[str, Any]) -> None:
    (run / "row.parquet").write_bytes((run / "row.parquet").read_bytes()[:-9])


def _no_result(run: Path, row: dict[str, Any]) -> None:
    (run / "result.json").unlink()


DAMAGES = (
    (_other_configuration, "another version of the program"),
    (_other_run, "it is of the run '../../x'"), (_two_rows, "it has 2 rows"),
    (_other_result, "are of two flights"), (_cut_row, "its row is not in"),
    (_no_result, "its row is not in"),
)  # fmt: skip


def test_a_row_that_is_not_the_planned_one_does_not_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of six runs is damaged on its way here."""
    plan = make_plan(tmp_path, axes(scene=["flat"], estimator=["fake:good"], seeds="0-5"))
    out, names = tmp_path / "out", [run.run_id for run in plan.runs]
    left = dict(zip(names, DAMAGES, strict=True))
    ray = FakeRay(Node("near"))
    get = ray.get

    def get_after_damage(reference: Any) -> Any:
        found = get(reference)
        for name in [name for name in left if (out / RUNS / name).is_dir()]:
            damage, _ = left.pop(name)
            damage(out / RUNS / name, read_row(out / RUNS / name))
        return found

    monkeypatch.setattr(ray, "get", get_after_damage)
    totals = flown(monkeypatch, plan, out, ray)
    assert totals["crashed"] == 6 and not left
    for name, (_, reason) in zip(names, DAMAGES, strict=True):
        assert reason in totals["errors"][name]
    assert fly(plan, out)["finished"] == 6
    assert all(why_not_arrived(out, run.run_id, run.config_sha) == "" for run in plan.runs)
