"""Parts that somebody brings for each slot: named, examined, watched in flight, told apart."""

import dataclasses
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from touchdown.experiments.campaign.directory import check_external_code, parts_named
from touchdown.experiments.campaign.plan import load_plan
from touchdown.experiments.config.loading import dump_config, load_config
from touchdown.experiments.config.slots import SLOTS, other_parts, params_of
from touchdown.experiments.errors import ExternalPartError, UsageError
from touchdown.experiments.external.examination import RULES
from touchdown.experiments.external.examine import examine, setpoint_at, textures, true_estimate
from touchdown.experiments.external.loading import external_builder
from touchdown.experiments.external.synthetic_descent import Box, Descent
from touchdown.experiments.external.synthetic_stream import SyntheticStream, synthetic_rig
from touchdown.experiments.external.synthetic_world import (
    FollowedSetpoints,
    hovering,
    synthetic_map,
)
from touchdown.experiments.external.wrapper import (
    LONGEST_CALL_S,
    ExternalClassifier,
    ExternalController,
    ExternalLander,
    ExternalMapper,
    ExternalSelector,
    ExternalWatch,
)
from touchdown.experiments.flight.replay import replay_config
from touchdown.experiments.flight.slots import RIGS
from touchdown.experiments.reporting.regression.baseline import cells_of
from touchdown.experiments.reporting.report import part_words
from touchdown.landing.api import SelectorInput, SelectorParams
from touchdown.sim.api import SensorNeeds

from support.command import Says

ROOT = Path(__file__).parents[3]
OTHERS = [kind for kind in SLOTS if kind != "estimator"]
LAWN = """<mujoco><worldbody>
<light pos="0 0 50" dir="0 0 -1"/>
<geom name="lawn" type="plane" size="60 60 1"/>
</worldbody></mujoco>"""
EXAMPLES = {
    "selector": "flat_disc", "lander": "straight_in", "controller": "lqr", "mapper": "plain_map",
    "classifier": "colours", "watch": "bare_ground",
}  # fmt: skip
"""Modules of `examples/` by kind."""
LOW = (
    "preset=short", "survey.height_m=5", "survey.min_height_m=5", "survey.leg_length_m=4",
    "survey.duration_s=3",
)  # fmt: skip


@pytest.fixture
def brought(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., str]]:
    """Writes the example of a kind, changed, as a module of the current directory; returns
    MODULE:FUNCTION."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    names = []

    def write(kind: str, old: str = "", new: str = "") -> str:
        text = (ROOT / "examples" / f"{EXAMPLES[kind]}.py").read_text(encoding="utf-8")
        assert text.count(old) or not old
        names.append(f"mine_{len(names)}_{tmp_path.name}")
        (tmp_path / f"{names[-1]}.py").write_text(text.replace(old, new, 1), encoding="utf-8")
        return f"{names[-1]}:build"

    yield write
    for name in names:
        sys.modules.pop(name, None)


def examined(kind: str, name: str, *overrides: str) -> Any:
    config = load_config(None, [*LOW, *overrides], **{kind: name})
    rig = RIGS[kind](config, synthetic_rig())
    return examine(kind, external_builder(name, kind), rig, params_of(config, kind))


@pytest.mark.parametrize("kind", OTHERS)
def test_a_name_that_leads_nowhere_is_one_line_before_any_flight(
    kind: str, says: Says, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    plan = f'name = "test"\nmode = "land"\n[axes]\nscene = ["flat"]\n{kind} = ["no_lab.x:build"]\n'
    Path("plan.toml").write_text(plan)
    for command in (
        ["land", "flat", f"--{kind}", "no_lab.x:build"],
        ["campaign", "plan.toml", "--out", "o"],
        ["check-plugin", kind, "no_lab.x:build"],
    ):
        output = says(2, *command).err
        assert output.count("\n") == 1 and f"{kind} 'no_lab.x:build': there is no module" in output
    assert not Path("o").exists() and not Path("runs").exists()
    slot = SLOTS[kind]
    if not slot.takes_file:
        with pytest.raises(UsageError, match=f"did you mean '{slot.shipped[0]}'"):
            load_config(None, [f"{slot.key}={slot.shipped[0]}x"])


@pytest.mark.parametrize("kind", OTHERS)
def test_results_bring_no_code_and_a_replay_needs_none(kind: str, tmp_path: Path) -> None:
    key = SLOTS[kind].key
    config = load_config(None, [f"{key}=theirs:build", f"external.{kind}.gain=2"])
    (tmp_path / "config.json").write_text(dump_config(config))
    words = f"came with results and names code, {kind} 'theirs:build'.* name the {kind} with --"
    with pytest.raises(UsageError, match=words):
        load_config(tmp_path / "config.json")
    assert load_config(tmp_path / "config.json", allow_code=True) == config
    again = load_config(tmp_path / "config.json", **{kind: "mine:build"})
    assert params_of(again, kind) == {"gain": 2}
    assert replay_config(tmp_path).external == {}
    (tmp_path / "campaign.json").write_text("{}")
    for place in (f'{kind} = ["theirs:build"]', f'[base]\n{key} = "theirs:build"'):
        plan = tmp_path / "campaign.toml"
        plan.write_text(f'name = "t"\n[axes]\nscene = ["flat"]\n{place}\n')
        with pytest.raises(UsageError, match="names code"):
            load_plan(plan)
        assert parts_named(load_plan(plan, allow_code=True)) == [(kind, "theirs:build")]


def test_parameters_of_each_part_are_its_own() -> None:
    both = ["estimator=a:b", "landing.selector=c:d"]
    config = load_config(None, [*both, "external.x=1", "external.estimator.y=2",
                                "external.selector.z.w=3"])  # fmt: skip
    assert params_of(config, "estimator") == {"x": 1, "y": 2}
    assert params_of(config, "selector") == {"z": {"w": 3}}
    for overrides, words in (
        (["external.selector.z=1"], "an external selector, MODULE:FUNCTION, which 'risk' is not"),
        (["landing.selector=c:d", "external.z=1"], "that of the selector is external.selector.z"),
        ([*both, "external.selector=1"], "is the table of the selector; set its keys"),
    ):
        with pytest.raises(UsageError, match=re.escape(words)):
            load_config(None, overrides)
    assert load_config(None, both).landing.chosen_selector == SelectorParams()


def test_finished_runs_of_other_code_stop_a_campaign(
    brought: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = brought("selector")
    file = tmp_path / "plan.toml"
    file.write_text(f'name = "t"\n[axes]\nscene = ["flat"]\nselector = ["risk", "{name}"]\n')
    plan = load_plan(file)
    assert [run.run_id for run in plan.runs][1].endswith(f"-s0-{name.replace(':', '.')}")
    row = {"run_id": "r", "estimator": "livo", "parts.selector": name, "parts_sha.selector": "0"}
    monkeypatch.setattr("touchdown.experiments.campaign.directory.refresh", lambda _: [row])
    (tmp_path / "campaign.json").write_text("{}")
    with pytest.raises(UsageError, match=f"the code of {name} has changed"):
        check_external_code(plan, tmp_path)


@pytest.mark.parametrize("kind", EXAMPLES)
def test_the_example_conforms_and_the_command_says_so(
    kind: str, brought: Callable[..., str], says: Says
) -> None:
    name = brought(kind)
    lines = says(0, "check-plugin", kind, name).out.splitlines()
    assert lines[-1] == f"{kind} {name}: conforms"
    assert any(line.startswith("latency: ") and " ms a call" in line for line in lines)


ASK = "def update(self, estimate: Estimate, setpoint: Setpoint) -> Command:\n        "
SPEEDS = "return Command(rotor_speed_radps=speeds)"
BROKEN: list[tuple[str, str, str, str, str]] = [
    ("selector", "def select", "def choose", "builds", "has no method select"),
    ("selector", "return api.RankedSites(sites=tuple(sites), layers=layers)", "return sites",
     "answers", "list, not RankedSites"),
    ("selector", "value=v", 'value=float("nan")', "finite", "term 'disc' is not finite"),
    ("selector", "position_odom=place,", "position_odom=place[:1],", "shapes", "shape (1,)"),
    ("selector", "known = grid", "grid.rgb[:] = 0.0\n        known = grid", "inputs", "modified"),
    ("selector", "name=n, value=v", "name=n + str(v), value=v", "terms", "unlike"),
    ("selector", "place = np.array([x[col], y[row, 0]])",
     "place = np.array([x[col], y[row, 0]]) + np.random.rand() * 1e-9", "deterministic", "differ"),
    ("selector", "place = np.array([x[col], y[row, 0]])", "place = np.zeros(2)", "ground",
     "stays where it is"),
    ("selector", "np.argmax(score)", "np.argmax(-abs(score))", "order", "above"),
    ("selector", "return api.RankedSites(sites=())",
     "return api.RankedSites(sites=(api.Site(position_odom=np.zeros(2),"
     "terms=(api.ScoreTerm(name='disc', value=0.0),)),))", "missing data", "nothing is mapped"),
    ("controller", SPEEDS, "return speeds", "answers", "ndarray, not Command"),
    ("controller", SPEEDS, "return Command(rotor_speed_radps=speeds[:3])", "shapes", "shape (3,)"),
    ("controller", SPEEDS, "return Command(rotor_speed_radps=speeds * np.nan)", "finite", "not f"),
    ("controller", SPEEDS, "return Command(rotor_speed_radps=speeds - 900)", "finite", "negative"),
    ("controller", SPEEDS, SPEEDS + "[0]", "answers", "raised TypeError"),
    ("controller", "wrench = -self.gain", "wrench = self.gain", "steers", "m from the setpoint"),
    ("controller", "limit = setpoint.thrust_limit", "limit = None", "limit", "of the weight"),
    ("controller", "if not setpoint.motors_on", "if False", "stop", "left rotors turning"),
    ("lander", "def view", "def state", "builds", "has no method view"),
    ("lander", "needs = SensorNeeds(lidar=True)", "needs = None", "builds", "no SensorNeeds"),
    ("lander", "return next(self.steps)", "return self.reference", "answers", "not Setpoint"),
    ("lander", "return LanderView(", "return dict(", "answers", "dict, not LanderView"),
    ("lander", "yaw_odom=self.heading", "yaw_odom=np.nan", "finite", "yaw_odom is not finite"),
    ("lander", "np.zeros(3) if velocity", "np.zeros(2) if velocity", "shapes", "shape (2,)"),
    ("lander", "self.reference = start + way", "self.reference = start + way + [1, 0, 0]",
     "continuity", "jumped by 1.00 m"),
    ("lander", "low + 1.0], sinking)", "low - 0.5], 9.0)", "touchdown", "is touched with"),
    ("lander", "self.phase, self.note = Phase.SURVEY", "_ = Phase.SURVEY", "mission", "surveyed"),
    ("lander", "yaw_odom=self.heading", "yaw_odom=1e-9 * np.random.rand()",
     "deterministic", "two runs differ"),
    ("mapper", "SensorNeeds(lidar=True)", "SensorNeeds(camera_hz=12)", "builds", "camera_hz is 12"),
    ("mapper", "return self.shown", "return self.coarse", "answers", "Grid, not MapView"),
    ("mapper", 'layer.astype(np.float32)', "layer.astype(float)", "shapes", "no float32 array"),
    ("mapper", "origin_xy_m=self.origin,", "origin_xy_m=np.full(2, np.nan),", "finite", "origin"),
    ("mapper", "back = scan.ranges > 0.0", "back = scan.ranges > 0.0\n        scan.ranges[0] = 1",
     "inputs", "modified"),
    ("mapper", "points = self.sensors.body_from_lidar.apply(", "points = (", "heights", "m off"),
    ("mapper", "version = self.shown.version + 1", "version = 0", "version", "after 3 s of scans"),
    ("mapper", "self.poses.append", "1 / len(obs.scans)\n        self.poses.append",
     "missing data", "ZeroDivisionError"),
    ("mapper", "points = np.einsum", "points += np.random.rand()\n        points = np.einsum",
     "deterministic", "two runs differ"),
    ("classifier", "image_size = 32", "image_size = 0", "builds", "image_size is 0"),
    ("classifier", "min_probability = 0.6", "min_probability = 60", "builds", "min_probability is"),
    ("classifier", "return GroundPrediction(", "return dict(", "answers", "dict, not Ground"),
    ("classifier", "likelihood / likelihood.sum(axis=1, keepdims=True)", "likelihood[:, :3]",
     "shapes", "not (5, 7)"),
    ("classifier", "likelihood = np.exp(", "likelihood = np.nan * (", "finite", "not finite"),
    ("classifier", "likelihood / likelihood.sum(axis=1, keepdims=True)", "likelihood + 1.0",
     "probabilities", "do not add up to 1"),
    ("classifier", "offsets = self", "means -= means.mean(axis=0)\n        offsets = self",
     "batch", "alone has probabilities"),
    ("classifier", "offsets = self.features(means)", "offsets = self.features(0 * means)",
     "images", "the same probabilities"),
    ("classifier", "means = images", "assert images.max()\n        means = images",
     "missing data", "AssertionError"),
    ("watch", "def look", "def see", "builds", "has no method look"),
    ("watch", "needs = SensorNeeds(lidar=True)", "needs = None", "builds", "no SensorNeeds"),
    ("watch", "return self.report", "return self.report.verdict", "answers", "not WatchReport"),
    ("watch", 'reason=f"{tall} returns above the ground"', 'reason=""', "answers", "no reason"),
    ("watch", "if tall <= self.returns:", "if True:", "warns", "is not noticed"),
    ("watch", "if tall <= self.returns:", "if False:", "calm", "with nothing on it"),
    ("watch", "near = points[", "1 / len(points)\n        near = points[",
     "missing data", "ZeroDiv"),
    ("controller", ASK, ASK + "1 / float(estimate.healthy)\n        ", "missing data", "ZeroDivi"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "old", "new", "rule", "words"), BROKEN, ids=[f"{row[0]}-{row[3]}" for row in BROKEN]
)
def test_each_bad_habit_is_reported_with_its_reason(
    brought: Callable[..., str], kind: str, old: str, new: str, rule: str, words: str
) -> None:
    found = {v.rule: v.reason for v in examined(kind, brought(kind, old, new)).violations}
    assert words in found[rule] and found.keys() <= RULES[kind]


@pytest.mark.parametrize("kind", EXAMPLES)
def test_a_slow_part_is_told_in_flight_and_does_not_conform(
    kind: str, brought: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(cast(dict[str, float], LONGEST_CALL_S), kind, 1e-9)
    name = brought(kind)
    (found,) = examined(kind, name).violations
    assert found.rule == "latency" and "above 1e-06 ms" in found.reason


def asked(kind: str, name: str) -> Any:
    """The answer of an external part in a flight, to the input of its examination."""
    config = load_config(None, [], **{kind: name})
    rig, params = RIGS[kind](config, synthetic_rig()), params_of(config, kind)
    if kind == "controller":
        return ExternalController(name, params, rig).update(hovering(), setpoint_at(1.0))
    if kind == "classifier":
        classifier = ExternalClassifier(name, params, rig)
        return classifier.classify(textures(classifier.image_size))
    if kind == "lander":
        lander = ExternalLander(name, params, rig)
        return lander.update(*FollowedSetpoints(rig.sensors).seen()), lander.view()
    if kind == "watch":
        box = Box(middle=(0.0, 0.0), from_s=1.0)
        watch, descent = ExternalWatch(name, params, rig), Descent(boxes=(box,))
        return [watch.look(seen) for seen in descent.seen(rig.sensors)][-1]
    if kind == "mapper":
        mapper, stream = ExternalMapper(name, params, rig), SyntheticStream(
            rig.sensors, SensorNeeds(lidar=True), 0.4)  # fmt: skip
        return [mapper.update(obs, true_estimate(stream, obs, 600)) for obs in stream][-1]
    seen = SelectorInput(map_view=synthetic_map(), estimate=hovering())
    return ExternalSelector(name, params, rig).select(seen)


@pytest.mark.parametrize(
    ("kind", "old", "new", "rule", "words"),
    [row for row in BROKEN if row[3] in ("answers", "inputs")],
)
def test_a_wrong_part_is_one_line_that_names_it_and_the_rule(
    brought: Callable[..., str], kind: str, old: str, new: str, rule: str, words: str
) -> None:
    name = brought(kind, old, new)
    with pytest.raises(ExternalPartError) as failure:
        asked(kind, name)
    text = str(failure.value)
    assert text.startswith(f"{kind} '{name}': ") and f"(rule '{rule}')" in text and words in text
    assert "\n" not in text and text.endswith(f"`touchdown check-plugin {kind} {name}` says more")


def test_a_selectors_terms_are_its_candidates_and_its_costmap(brought: Callable[..., str]) -> None:
    name = brought("selector")
    selection = asked("selector", name)
    first, costmap = selection.candidates[0], selection.costmap
    assert [term.name for term in first.terms] == ["disc", "distance"] and first.accepted
    assert first.value == sum(term.value for term in first.terms)
    assert np.hypot(*(first.position_odom[:2] - [12.0, -9.0])) < 2.0  # 3 m of a disc of 5 m
    col, row = ((first.position_odom[:2] - costmap.origin_xy_m) / costmap.cell_m).astype(int)
    assert costmap.value[row, col] == pytest.approx(first.value, abs=1e-5)
    assert [layer.name for layer in costmap.terms] == ["disc", "distance"]
    config = load_config(selector=name)
    rig = RIGS["selector"](config, synthetic_rig())
    seen = SelectorInput(map_view=synthetic_map(), estimate=hovering(), reach_m=1.0,
                         avoid_odom=first.position_odom[None])  # fmt: skip
    selector = ExternalSelector(name, {}, rig)
    rules = {site.rule for site in selector.select(seen).candidates}
    assert rules == {"near_refused_site", "out_of_reach"}
    near = dataclasses.replace(seen, reach_m=99.0, emergency=True)
    assert selector.select(near).candidates[0].accepted
    assert selector.part.slowness() == ""
    selector.part.seconds = 2.5 * selector.part.calls
    rows, cols = seen.map_view.coarse.height_m.shape
    assert selector.part.slowness().startswith(
        f"selector '{name}' took 2.5e+03 ms of processor time a call on a map of {rows} x {cols} "
        "cells, above 1000 ms"
    )


def test_the_time_of_a_part_is_that_of_the_processor(brought: Callable[..., str]) -> None:
    """A part that waits is not slow: so does one on a loaded machine."""
    name = brought("controller", ASK, f"{ASK}import time\n        time.sleep(0.3)\n        ")
    asked_of = ExternalController(name, {}, RIGS["controller"](load_config(None), synthetic_rig()))
    asked_of.update(hovering(), setpoint_at(1.0))
    assert 0.0 < asked_of.part.seconds < 0.2 and asked_of.part.map_text == ""


def test_a_flight_that_a_part_ends_leaves_nothing(brought: Callable[..., str], says: Says) -> None:
    name = brought("controller", ASK, ASK + "1 / (estimate.time_s < 0.05)\n        ")
    Path("lawn.xml").write_text(LAWN)
    short = ["--profile", "ideal", "--no-record", "--quiet", "--out", "flown/one", "--as-is"]
    output = says(2, "land", "lawn.xml", "--estimator", "oracle", "--controller", name, *short).err
    assert output.count("\n") == 1 and f"controller '{name}': at 0.050 s update raised" in output
    assert "(rule 'answers')" in output and list(Path("flown").iterdir()) == []


def test_results_and_reports_name_the_parts_that_flew() -> None:
    config = load_config(selector="zou2024", controller="a.b:c")
    assert other_parts(config) == {"selector": "zou2024", "controller": "a.b:c"}
    survey = load_config(selector="zou2024", mapper="a.b:c", survey_only=True)
    assert other_parts(survey) == {"mapper": "a.b:c"} and other_parts(load_config()) == {}
    rows: list[dict[str, Any]] = [{"parts.mapper": "a.b:c"}, {"parts.selector": "zou2024"}]
    assert part_words([*rows, {**rows[0], **rows[1]}]) == [
        "Selector: `zou2024`, and that by default. Mapper: `a.b:c`, and that by default."
    ]
    same = {"scene": "flat", "estimator": "livo", "seed": 0, "mode": "land", "outcome": "LANDED"}
    cells = cells_of([{**same, **row, "run_id": f"flat-livo-0-{n}"} for n, row in enumerate(rows)])
    assert [variant for _, _, variant in cells] == ["land a.b:c", "land zou2024"]
    assert part_words([rows[0]]) == ["Mapper: `a.b:c`."] and part_words([{}]) == []
