"""Plan of a campaign: the runs of its file, and errors in the file."""

from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.campaign import plan as plans
from touchdown.experiments.campaign.plan import in_shard, load_plan
from touchdown.experiments.errors import UsageError

from support.campaign_flights import axes, make_plan
from support.command import Says


def test_plan_is_the_product_of_the_axes_seed_by_seed(tmp_path: Path) -> None:
    text = axes(scene=["flat", "lake"], estimator=["livo", "oracle"], seeds="3, 7-8")
    text += "wind_kmh = [0, 20.5]\n[axes.survey]\nlegs = [1]\n"
    plan = make_plan(tmp_path, text)
    names = [run.run_id for run in plan.runs]
    assert len(set(names)) == 2 * 2 * 3 * 2
    assert names[:3] == ["flat-livo-s3-w0", "flat-livo-s3-w20.5", "flat-oracle-s3-w0"]
    assert names[-1] == "lake-oracle-s8-w20.5"
    assert plan.runs[1].values == {
        "sim.threads": 1, "profile": "field", "scene": "flat", "estimator": "livo", "seed": 3,
        "wind.mean_kmh": 20.5, "survey.legs": 1, "record": False, "landing.survey_only": True,
    }  # fmt: skip
    assert len({run.config_sha for run in plan.runs}) == len(names)


def test_overrides_apply_where_their_axes_match(tmp_path: Path) -> None:
    text = axes(scene=["flat", "lake"], estimator=["livo", "oracle"])
    text += """
[base]
survey.height_m = 25.0
log = { camera_hz = 1.0 }
[[override]]
when = { estimator = ["oracle"], scene = "lake" }
set = { survey.height_m = 12.0, "log.scan_hz" = 1.0 }
"""
    by_name = {run.run_id: run.values for run in make_plan(tmp_path, text).runs}
    assert by_name["lake-oracle-s0"]["survey.height_m"] == 12.0
    assert by_name["lake-oracle-s0"]["log.scan_hz"] == 1.0
    plan = load_plan(tmp_path / "campaign.toml", overrides=["survey.height_m=9"])
    heights = {run.run_id: run.values["survey.height_m"] for run in plan.runs}
    assert heights["flat-livo-s0"] == 9 and heights["lake-oracle-s0"] == 12.0
    with pytest.raises(UsageError, match="'seed' in --set is an axis"):
        load_plan(tmp_path / "campaign.toml", overrides=["seed=1"])
    for other in ("lake-livo-s0", "flat-oracle-s0"):
        assert by_name[other]["survey.height_m"] == 25.0 and "log.scan_hz" not in by_name[other]
        assert by_name[other]["log.camera_hz"] == 1.0


@pytest.mark.parametrize(
    ("text", "fragments"),
    [
        ("axes = 3\n", ["lacks 'name'"]),
        ('name = "x"\n', ["lacks 'axes'"]),
        (axes(estimator=["livo"]), ["lacks scene"]),
        (axes(scene=["crossrod"]), ["unknown scene 'crossrod'", "did you mean 'crossroad'"]),
        (axes(scene=["no/such.xml"]), ["no/such.xml", "does not exist"]),
        (axes(scene=["flat"], estimator=["lvio"]), ["lvio", "did you mean 'livo'"]),
        (axes(scene=["flat"], estimater=["livo"]), ["estimater", "did you mean 'estimator'"]),
        (axes(scene="flat"), ["'scene'", "list"]),
        (axes(scene=[]), ["'scene'", "list"]),
        (axes(scene=["flat", "flat"]), ["flat twice"]),
        (axes(scene=["flat"]) + "bias.xy_m = [[0.0, 1.0], [0.0, 1.0]]\n", ["[0.0, 1.0] twice"]),
        # Counted before anything is compared with everything else.
        (axes(scene=["flat"], wind_kmh=[1] * 10_000, seeds="0-99999"), ["span 1000000000 runs"]),
        (axes(scene=["flat"], seed=[-1]), ["seed -1", "from 0 up"]),
        (axes(scene=["flat"], seeds="9-0"), ["counts down"]),
        (axes(scene=["flat"], seeds="a"), ["'0-9'"]),
        (axes(scene=["flat"], seeds="1", seed=[1]), ["both seed and seeds"]),
        (axes(scene=["flat"], wind_kmh=["strong"]), ["wind.mean_kmh", "number"]),
        (axes(scene=["flat"], wind_kmh=[-3]), ["wind.mean_kmh = -3", "within 0 to 450"]),
        (axes(scene=["flat"]) + "[base]\nwind.mean_kph = 3\n", ["did you mean 'wind.mean_kmh'"]),
        (axes(scene=["flat"]) + "[base]\nseed = 3\n", ["'seed'", "[axes] seeds"]),
        (axes(scene=["flat"]) + "[base]\nrecord = true\n", ["'record'", "whole campaign"]),
        (axes(scene=["flat"], wind_kmh=[3]) + "[base]\nwind.mean_kmh = 3\n", ["axis already"]),
        (axes(scene=["flat"]) + "[limits]\nmemory_gib = 3\n", ["did you mean 'memory_gb'"]),
        (axes(scene=["flat"]) + "[limits]\nretries = -1\n", ["limits.retries"]),
        ("recrod = 'all'\n" + axes(scene=["flat"]), ["did you mean 'record'"]),
        ("record = 'some'\n" + axes(scene=["flat"]), ["record", "'failures'"]),
        (
            axes(scene=["flat"]) + "[[override]]\nwhen = {scene = 'flat'}\nset = {a = 1}\nif = 1\n",
            ["unknown key 'override.0.if'", "known: when, set"],
        ),
        (
            axes(scene=["flat"]) + "[[override]]\nwhen = {scenes = 'flat'}\nset = {}\n",
            ["did you mean 'scene'"],
        ),
        (axes(scene=["flat"]) + "[axes", ["not valid TOML", "line"]),
    ],
)
def test_usage_errors_are_one_line_and_write_nothing(
    text: str, fragments: list[str], tmp_path: Path, says: Says
) -> None:
    file = tmp_path / "bad.toml"
    file.write_text(text, encoding="utf-8")
    captured = says(2, "campaign", file, "--out", tmp_path / "out")
    assert captured.out == "" and captured.err.count("\n") == 1
    for fragment in fragments:
        assert fragment in captured.err
    assert not (tmp_path / "out").exists()


def test_a_scene_file_that_is_none_is_refused_before_the_first_flight(
    tmp_path: Path, says: Says
) -> None:
    (tmp_path / "place.xml").write_text("<mujoco><wrong/></mujoco>")
    file = tmp_path / "c.toml"
    file.write_text(axes(scene=[str(tmp_path / "place.xml")]))
    error = says(2, "campaign", file, "--out", tmp_path / "out").err
    assert error.count("\n") == 1 and "'wrong'" in error and "place.xml" in error
    assert not (tmp_path / "out").exists()


def test_shards_share_the_runs_among_them() -> None:
    names = [f"lake-livo-s{seed}" for seed in range(200)]
    parts = [{name for name in names if in_shard(name, (part, 3))} for part in (1, 2, 3)]
    assert set.union(*parts) == set(names) and sum(map(len, parts)) == len(names)
    assert min(map(len, parts)) > 40


@pytest.mark.parametrize("more", [{"seeds": "0-10"}, {"seeds": "0-3", "wind_kmh": [0, 1, 2]}])
def test_axes_that_span_too_many_runs_are_not_multiplied(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, more: dict[str, Any]
) -> None:
    monkeypatch.setattr(plans, "MAX_RUNS", 10)
    with pytest.raises(UsageError, match=r"more than 10; (give fewer|split the campaign)"):
        make_plan(tmp_path, axes(scene=["flat"], **more))


def test_an_impossible_survey_is_refused_before_the_first_flight(tmp_path: Path) -> None:
    text = axes(scene=["flat"], estimator=["gps"]) + "[axes.survey]\nduration_s = [36.0, 3.0]\n"
    with pytest.raises(UsageError, match=r"a survey of 3 legs of 50 m does not fit into 3 s"):
        make_plan(tmp_path, text)
