"""Estimators that somebody brings: found, built, watched in flight, known by their code."""

import dataclasses
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.estimator.api import Estimate
from touchdown.experiments.cli import main as cli
from touchdown.experiments.config.loading import dump_config
from touchdown.experiments.errors import ExternalPartError, UsageError
from touchdown.experiments.external.conformance import TURN_RAD, Step, check_estimator, twist
from touchdown.experiments.external.loading import code_now, external_builder, flown_code
from touchdown.experiments.external.synthetic_stream import SyntheticStream, synthetic_rig
from touchdown.experiments.external.wrapper import ExternalEstimator
from touchdown.experiments.flight.replay import replay_config
from touchdown.experiments.flight.wiring import ESTIMATORS, build_estimator
from touchdown.sim.api import Observation, SensorNeeds, SensorRig
from touchdown.sim.frames import Pose

from support.campaign_fakes import started
from support.campaign_flights import axes, is_alive
from support.command import Says
from support.flight_fakes import make_estimate
from support.worlds import load_ideal_config as load_config

STILL = """
import dataclasses
import numpy as np
from support.flight_fakes import make_estimate
from touchdown.sim.api import SensorNeeds
from touchdown.sim.frames import Pose

class Still:
    def __init__(self, params, rig):
        self.needs, self.rig, self.params = SensorNeeds(), rig, params

    def update(self, obs):
        return self.spoil(obs, make_estimate(obs.time_s, self.rig.world_from_body_start))

    def spoil(self, obs, estimate):
        return estimate

def build(params, rig):
    return Still(params, rig)
"""
OBSERVATION = Observation(tick=600, time_s=1.0, rotor_speed_radps=np.zeros(4), battery_fraction=1.0)


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., str]]:
    """Writes a module into a package of the current directory, which is nowhere else to be found;
    returns its dotted name."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    package = f"lab_{tmp_path.name.replace('-', '_')}"
    (tmp_path / package).mkdir()

    def write(text: str, name: str = "vio") -> str:
        (tmp_path / package / f"{name}.py").write_text(text, encoding="utf-8")
        return f"{package}.{name}"

    yield write
    for module in [name for name in sys.modules if name.partition(".")[0] == package]:
        del sys.modules[module]


def _spoilt(body: str) -> str:
    return (
        STILL
        + f"\nclass Spoilt(Still):\n    def spoil(self, obs, estimate):\n        {body}\n"
        + ("\ndef build(params, rig):\n    return Spoilt(params, rig)\n")
    )


def test_a_module_of_the_current_directory_is_found_and_hides_nothing(
    lab: Callable[..., str], tmp_path: Path
) -> None:
    module = lab(STILL)
    (tmp_path / "json.py").write_text("raise RuntimeError\n")
    assert external_builder(f"{module}:build").__module__ == module
    assert sys.path[-1] == str(tmp_path)


@pytest.mark.parametrize(("name", "text", "words"), [
    ("no_lab.vio:build", "", ["no module 'no_lab'", "folder that holds it", "pip install -e"]),
    ("{package}.vioo:build", STILL, ["no module '{package}.vioo'", "(did you mean 'vio'?)"]),
    ("{package}.vio:bild", STILL, ["no function 'bild' (did you mean 'build'?)"]),
    ("{package}.vio:build", "import torchh\n", ["needs the module 'torchh', which"]),
    ("{package}.vio:build", "x = 1\ndef build(:\n", ["syntax error in", "vio.py:2"]),
    (
        "{package}.vio:build",
        "from touchdown.sim.api import SensorNeeds\n"
        "class A:\n    needs = SensorNeeds(gpss=True)\n",
        ["raised TypeError", "'gpss'", "vio.py:3)"],
    ),
    ("{package}.vio:build", "build = 3\n", ["build is no function"]),
    ("{package}.vio:build", "def build(rig): ...\n", ["build(rig) must take (params, rig)"]),
    ("{package}/vio.py:build", STILL, ["MODULE:FUNCTION, such as my_lab.vio:build"]),
])  # fmt: skip
def test_a_name_that_leads_nowhere_is_one_line_before_any_flight(
    lab: Callable[..., str], says: Says, name: str, text: str, words: list[str]
) -> None:
    package = lab(text).partition(".")[0]
    name = name.format(package=package)
    Path("plan.toml").write_text(axes(scene=["flat"], estimator=["gps", name], seeds="0-1"))
    for command in (["fly", "flat", "--estimator", name], ["campaign", "plan.toml", "--out", "o"]):
        output = says(2, *command).err
        assert output.count("\n") == 1 and all(
            word.format(package=package) in output for word in words
        ), output
    assert not Path("o").exists() and not Path("runs").exists()


@pytest.mark.parametrize(("text", "words"), [
    ("def build(params, rig):\n    return 1 / 0\n", "build raised ZeroDivisionError"),
    ("def build(params, rig):\n    return None\n", "has no method update"),
    (STILL.replace("SensorNeeds()", "SensorNeeds(camera_hz=12)"), "camera_hz is 12, but"),
    (STILL.replace("def update", "def updat"), "no method update (did you mean 'updat'?)"),
])  # fmt: skip
def test_what_cannot_be_built_is_reported_and_the_contract_says_the_same(
    lab: Callable[..., str], text: str, words: str
) -> None:
    name = f"{lab(text)}:build"
    with pytest.raises(ExternalPartError) as failure:
        ExternalEstimator(name, {}, synthetic_rig())
    assert str(failure.value).startswith(f"estimator '{name}': ") and words in str(failure.value)
    broken = check_estimator(external_builder(name))
    assert [found.rule for found in broken] == ["builds"] and words in broken[0].reason


@pytest.mark.parametrize(("body", "words"), [
    ("return obs.nothing", "at 1.000 s update raised AttributeError"),
    (
        "return dataclasses.replace(estimate, velocity_odom=[0, 0, 0])",
        "velocity_odom is a list, no NumPy array of numbers",
    ),
    ("return dataclasses.replace(estimate, events=None)", "events is NoneType"),
    ("return dataclasses.replace(estimate, diagnostics={'a': 'b'})", "is no number"),
    ("return dataclasses.replace(estimate, scan_track=3)", "scan_track is no PoseTrack"),
])  # fmt: skip
def test_a_wrong_update_is_one_line(lab: Callable[..., str], body: str, words: str) -> None:
    name = f"{lab(_spoilt(body))}:build"
    estimator = ExternalEstimator(name, {}, synthetic_rig())
    with pytest.raises(ExternalPartError) as failure:
        estimator.update(OBSERVATION)
    output = str(failure.value)
    assert words in output and output.endswith(
        f"`touchdown check-plugin estimator {name}` says more"
    )
    assert ("vio.py:" in output) == ("raised" in output)


@pytest.mark.parametrize("ending", ["", "    raise RuntimeError('lost')\n", "    sys.exit(3)\n"])
def test_a_command_ends_the_processes_that_it_starts(
    lab: Callable[..., str], tmp_path: Path, ending: str
) -> None:
    text = (
        "import sys, pathlib\nfrom support.campaign_fakes import start_three\n"
        f"def build(params, rig):\n    start_three(pathlib.Path({str(tmp_path)!r}))\n"
    )
    module = lab(STILL + text + ending + "    return Still(params, rig)\n")
    cli.main(["check-estimator", f"{module}:build", "--seconds", "0.1"])
    assert len(started(tmp_path)) >= 3 and not any(map(is_alive, started(tmp_path)))


def test_external_keys_reach_the_builder_and_come_back(
    lab: Callable[..., str], tmp_path: Path
) -> None:
    name = f"{lab(STILL)}:build"
    file = tmp_path / "mine.toml"
    file.write_text(
        f'estimator = "{name}"\n[external]\ngain = 0.3\n[external.filter]\nsigma = -1\n'
    )
    config = load_config(file, ["external.names=['a', 'b']", "external.gain=0.5"])
    assert config.external == {"gain": 0.5, "filter": {"sigma": -1}, "names": ["a", "b"]}
    built = build_estimator(config, synthetic_rig())
    assert built.part.inner.params == config.external  # type: ignore[attr-defined]
    (tmp_path / "config.json").write_text(dump_config(config))
    assert load_config(tmp_path / "config.json", allow_code=True) == config
    assert replay_config(tmp_path, allow_code=True).external == config.external
    assert replay_config(tmp_path, "livo").external == {}


@pytest.mark.parametrize(("overrides", "words"), [
    (["external.gain=1"], "is for an external estimator, MODULE:FUNCTION"),
    (["estimator=a:b", "external=1"], "'external' in --set external=1 is a group"),
    (["estimator=a:b", "external.x={y=1}"], "set its keys one by one, such as external.x.gain"),
    (["estimator=a:b", "external.x=1", "external.x.y=2"], "beside a value of external.x"),
    (["estimator=a:b", "external.x=2024-01-01"], "is a date; text, numbers"),
    (["estimator=a:b", "external.x=[[nan]]"], "finite"),
    (["estimator=a:b", f"external.{'a.' * 20}b=1"], "nested too deeply"),
    (["estimator=a:b", "externl.gain=1"], "did you mean 'external.gain'"),
])  # fmt: skip
def test_external_keys_that_cannot_be_are_refused(overrides: list[str], words: str) -> None:
    with pytest.raises(UsageError) as failure:
        load_config(None, overrides)
    assert words in str(failure.value)


def test_code_is_known_by_all_files_of_its_package(lab: Callable[..., str]) -> None:
    name = f"{lab(STILL)}:build"
    external_builder(name)
    first = code_now(name)
    assert flown_code(name) == {"estimator_sha": first} and flown_code("livo") == {}
    lab("GAIN = 0.3\n", "gains")
    second = code_now(name)
    lab("GAIN = 0.4\n", "gains")
    assert len({first, second, code_now(name)}) == 3
    assert flown_code(name) == {"estimator_sha": first}, "as it was imported"


class TruePath:
    """Knows the made-up path; ``spoil`` changes what it says."""

    needs = SensorNeeds()

    def __init__(self, rig: SensorRig, spoil: Callable[[Estimate], Estimate]) -> None:
        self._path = SyntheticStream(rig, self.needs, 3.0, turn_rad=TURN_RAD)
        self._spoil = spoil
        self._last: Pose | None = None

    def update(self, obs: Observation) -> Estimate:
        pose = self._path.true_pose(obs.tick)
        rates = obs.imu[-1].angular_velocity if obs.imu else np.zeros(3)
        before = self._path.true_pose(max(0, obs.tick - 3)).translation
        twisted = {
            "velocity_odom": (pose.translation - before) * 200.0, "angular_velocity_body": rates,
        }  # fmt: skip
        return self._spoil(dataclasses.replace(make_estimate(obs.time_s, pose), **twisted))


def _rates(change: Callable[[Any], Any]) -> Callable[[Estimate], Estimate]:
    return lambda e: dataclasses.replace(e, angular_velocity_body=change(e.angular_velocity_body))


def _velocity(change: Callable[[Any], Any]) -> Callable[[Estimate], Estimate]:
    return lambda e: dataclasses.replace(e, velocity_odom=change(e.velocity_odom))


@pytest.mark.parametrize(("spoil", "words"), [
    (_rates(np.rad2deg), "angular_velocity_body adds up to"),
    (_rates(np.negative), "it is in rad/s, in the body frame"),
    (_rates(np.zeros_like), "adds up to (0.00, 0.00, 0.00) degrees"),
    (_velocity(lambda v: 3.6 * v), "velocity_odom adds up to"),
    (_velocity(np.zeros_like), "it is in m/s, in the odom frame"),
    (_velocity(lambda v: v * [1.0, 1.0, -1.0]), "velocity_odom adds up to"),
])  # fmt: skip
def test_velocities_of_another_unit_sign_or_frame_are_reported(
    spoil: Callable[[Estimate], Estimate], words: str
) -> None:
    broken = check_estimator(lambda _params, rig: TruePath(rig, spoil))
    assert [found.rule for found in broken] == ["twist"] and words in broken[0].reason


def test_true_velocities_and_a_correction_are_no_violation() -> None:
    def corrected(estimate: Estimate) -> Estimate:
        pose = estimate.odom_from_body
        drawn = 0.3 * min(1.0, max(0.0, estimate.time_s - 1.5) / 0.1)
        return dataclasses.replace(
            estimate, odom_from_body=Pose(pose.rotation, pose.translation + [drawn, drawn, 0.0])
        )

    assert check_estimator(lambda _params, rig: TruePath(rig, lambda estimate: estimate)) == []
    assert check_estimator(lambda _params, rig: TruePath(rig, corrected)) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in ESTIMATORS if name != "oracle"])
def test_velocities_of_every_built_in_estimator_are_those_of_its_poses(name: str) -> None:
    rig = synthetic_rig()
    estimator = build_estimator(load_config(estimator=name), rig)
    stream = SyntheticStream(rig, estimator.needs, 2.6, turn_rad=TURN_RAD)
    steps = [Step(obs, estimator.update(obs), None) for obs in stream]
    assert twist(steps) == ""
