"""Expected results in a campaign's file, and their evaluation."""

import json
from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.campaign import expectations
from touchdown.experiments.campaign.campaign_file import Expect
from touchdown.experiments.campaign.session import summary
from touchdown.experiments.errors import UsageError

from support.campaign_flights import fly, make_plan
from support.command import Says

FILE = """
name = "test"
[axes]
scene = ["flat", "lake"]
estimator = ["support.campaign_fakes:good", "support.campaign_fakes:is_lost"]
seeds = "0-1"
[axes.faults]
events = [[], ["fog@0"]]
[[skip]]
when = { estimator = ["support.campaign_fakes:is_lost"], faults.events = [["fog@0"]] }
[[expect]]
when = { estimator = ["support.campaign_fakes:good"], faults.events = [["fog@0"]] }
outcome = ["COMPLETED"]
position_error_m_max = %s
[[expect]]
name = "lost ones"
when = { estimator = ["support.campaign_fakes:is_lost"] }
outcome = ["DIVERGED"]
"""


def landed(outcome: str = "LANDED", safe: bool | None = True, error: float = 0.1) -> dict[str, Any]:
    return {
        "run_id": "a", "outcome": outcome, "reason": "why", "landing.touchdown_xy_m": [1.0, 2.0],
        "landing.safe_geometry": safe, "landing.safe": safe, "landing.judged_on": "geometry",
        "position_error_m.max": error,
    }  # fmt: skip


DARK = [{"name": "camera_black@20", "happened": True, "text": "771 of 771 images"}]
ONE_IMAGE = [
    {"name": "camera_black@20", "happened": False, "text": "1 of 771 images"},
    {"name": "night", "happened": True, "text": "night"},
]


def test_idle_conditions() -> None:
    rows = [landed() | {"conditions": found, "run_id": run} for run, found in
            (("a", DARK), ("b", ONE_IMAGE), ("c", json.dumps(ONE_IMAGE)), ("d", None))]  # fmt: skip
    assert expectations.idle_conditions(rows) == [
        "condition 'camera_black@20' did not happen in 2 of 3 runs, such as b, 1 of 771 images"
    ]


@pytest.mark.parametrize(("row", "given", "fragment"), [
    (landed(), {}, ""),
    (landed(), {"outcome": ["ABORTED", "LANDED"], "position_error_m_max": 0.1}, ""),
    (landed(), {"outcome": ["ABORTED"]}, "LANDED (why)"),
    (landed(error=0.2), {"position_error_m_max": 0.1}, "0.20 m, at most 0.1 m expected"),
    (landed() | {"position_error_m.max": None}, {"position_error_m_max": 0.1}, "unknown"),
    (landed(safe=False), {}, "unsafe touchdown"), (landed(safe=None), {}, "unsafe touchdown"),
    (landed("ABORTED", safe=False), {}, "unsafe touchdown"),
    (landed("TIPPED"), {}, "unsafe touchdown"),
    (landed("COLLIDED") | {"landing.touchdown_xy_m": None}, {}, "unsafe touchdown"),
    (landed("DIVERGED") | {"landing.touchdown_xy_m": None}, {}, ""),
    (landed("TIPPED", safe=False), {"unsafe": True}, ""),
    (landed(), {"at_most": {"position_error_m.max": 0.1}}, ""),
    (landed(), {"at_most": {"position_error_m.max": 0.09}}, "max 0.1, at most 0.09 expected"),
    (landed(), {"at_most": {"slowed_s": 1.0}}, "slowed_s unknown"),
    (landed("CRASHED"), {"unsafe": True}, "crashed: why"),
    (landed() | {"conditions": DARK}, {"happened": True}, ""),
    (landed() | {"conditions": json.dumps(DARK)}, {"happened": True}, ""),  # of a table
    (landed() | {"conditions": ONE_IMAGE}, {"happened": False}, ""),
    (landed() | {"conditions": ONE_IMAGE}, {"happened": True}, "(1 of 771 images)"),
    (landed() | {"conditions": ONE_IMAGE}, {"happened": ["camera_black@20"]}, "not happen"),
    (landed() | {"conditions": ONE_IMAGE}, {"happened": ["night"]}, ""),
    (landed() | {"conditions": []}, {"happened": True}, ""),
    (landed(), {"happened": True}, "no record of what happened"),
])  # fmt: skip
def test_expectations_of_one_row(row: dict[str, Any], given: dict[str, Any], fragment: str) -> None:
    found = expectations.unexpected(Expect(**given), row)
    assert fragment in found if fragment else found == ""


def test_runs_are_found_by_their_values_and_counted() -> None:
    runs = [
        {"run_id": "a", "values": {"faults.events": ["fog@0"], "seed": 0}},
        {"run_id": "b", "values": {"faults.events": ["fog@0"], "seed": 1}},
        {"run_id": "c", "values": {"faults.events": [], "seed": 0}},
    ]
    fog = Expect(when={"faults.events": [["fog@0"]]}, outcome=["LANDED"])
    verdict = expectations.judge(fog, runs, {"a": landed(error=0.3)})
    assert (verdict.runs, verdict.finished, verdict.word) == (2, 1, "1 to go")
    assert verdict.name == "fog@0" and verdict.largest_error_m == 0.3
    verdict = expectations.judge(
        fog, runs, {"a": landed(), "b": landed("NO_SITE"), "c": landed("TIPPED")}
    )
    assert verdict.failures == {"b": "NO_SITE (why)"} and verdict.word == "1 not as expected"
    assert verdict.outcomes == {"LANDED": 1, "NO_SITE": 1}
    assert expectations.judge(fog, runs, {"a": landed(), "b": landed()}).word == "as expected"


def test_means_are_judged_by_scene_once_all_runs_are_there() -> None:
    runs = [{"run_id": name, "values": {}} for name in "abcd"]
    rows = {
        name: landed(outcome, error=error)
        | {"scene": scene, "estimator": "livo", "success": outcome == "LANDED"}
        for name, scene, error, outcome in (
            ("a", "lake", 0.1, "LANDED"), ("b", "lake", 0.3, "LANDED"),
            ("c", "forest", 0.1, "LANDED"), ("d", "forest", 0.2, "NO_SITE"),
        )
    }  # fmt: skip
    bound = {"position_error_m.max": 0.18}
    at_most, at_least = Expect(mean_at_most=bound), Expect(mean_at_least=bound)
    assert expectations.judge(at_most, runs, {k: rows[k] for k in "abc"}).failures == {}
    assert expectations.judge(at_most, runs, rows).failures == {
        "lake, livo": "mean of position_error_m.max 0.2, at most 0.18 expected"
    }
    assert list(expectations.judge(at_least, runs, rows).failures) == ["forest, livo"]
    unmeasured = expectations.judge(Expect(mean_at_most={"slowed_s": 1.0}), runs, rows)
    assert set(unmeasured.failures) == {"lake, livo", "forest, livo"}
    assert not expectations.judge(Expect(success_at_least=0.75), runs, rows).failures
    kinds = [run | {"values": {"variant": name}} for run, name in zip(runs, "xyxx", strict=True)]
    assert expectations.judge(Expect(mean_at_most=bound), kinds, rows).failures == {
        "lake, livo, y": "mean of position_error_m.max 0.3, at most 0.18 expected"
    }
    few = expectations.judge(Expect(success_at_least=0.76), runs, rows)
    assert few.failures == {"all": "3 of 4 successful, at least 76% expected"}


def test_a_campaign_is_judged_row_by_row(tmp_path: Path, says: Says) -> None:
    out = tmp_path / "out"
    plan = make_plan(tmp_path, FILE % "2.0")
    assert len(plan.runs) == 2 * 2 * (2 + 1)  # scenes, seeds, faults of each method
    figures = fly(plan, out)
    assert figures["as_expected"] and [v["finished"] for v in figures["expectations"]] == [4, 4]
    assert "lost ones" in says(0, "campaign", "status", out).out
    # the same runs, other expectations: error 2 * (0.1 + 0.01 seed + 0.012 + 0.4) is 1.02 and 1.04
    fly(make_plan(tmp_path, FILE % "1.03"), out)
    verdicts = expectations.judge_campaign(out)
    assert [len(v.failures) for v in verdicts] == [2, 0]
    assert all("-s1" in run_id for run_id in verdicts[0].failures)
    assert json.loads(says(1, "campaign", "status", out, "--json").out)["as_expected"] is False
    assert "2 not as expected" in says(1, "report", out).out
    report = (out / "report" / "report.md").read_text()
    assert "Expectations and outcomes" in report and "at most 1.03 m expected" in report
    assert not expectations.lines([]) and summary(out)["as_expected"] is False


@pytest.mark.parametrize(("old", "new", "fragment"), [
    ("outcome = [", 'outcome = ["LANDET", ', "unknown outcome 'LANDET'.*did you mean 'LANDED'"),
    ('name = "lost ones"', "limit = 3", "unknown key 'expect.1.limit'"),
    ("position_error_m_max = 2.0", "position_error_m_max = -1.0", "position_error_m_max"),
    ("when = { estimator", "when = { estimater", "did you mean 'estimator'"),
    ('name = "lost', 'at_most = { slowed = 1 }\nname = "lost', "column 'slowed' in at_most"),
    ('name = "lost', 'at_most = { slowed_s = "a" }\nname = "lost', "slowed_s.* a valid number"),
    ('name = "lost', 'success_at_least = 2\nname = "lost', "success_at_least"),
    ('[["fog@0"]] }\noutcome', '[["fog@1"]] }\noutcome', "no value of the axis"),
])  # fmt: skip
def test_invalid_expectations_are_one_line(
    tmp_path: Path, old: str, new: str, fragment: str
) -> None:
    with pytest.raises(UsageError, match=fragment) as caught:
        make_plan(tmp_path, (FILE % "2.0").replace(old, new))
    assert "\n" not in str(caught.value)
