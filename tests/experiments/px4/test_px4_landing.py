"""A landing with a scripted PX4, and with a real one where ``TOUCHDOWN_PX4`` names a build."""

import os
from pathlib import Path

import pytest

from touchdown.experiments.config.schema import Config
from touchdown.experiments.flight.run import fly
from touchdown.experiments.io.results import RunResult
from touchdown.experiments.px4.autopilot import Px4Autopilot
from touchdown.experiments.px4.process import VARIABLE

from support.px4_peer import SILENT_STEPS, make_build
from support.worlds import load_ideal_config

pytest.importorskip("pymavlink")
LOW = (
    "preset=short", "survey.height_m=4.0", "survey.leg_length_m=2.0", "survey.duration_s=2.0",
    "landing.site_xy_m=[-20.0,-18.0]", "landing.check_site=false", "landing.site_recheck=false",
    "landing.touchdown_speed_mps=0.2", "landing.sweep_m=0",
)  # fmt: skip
"""A hop of four metres to a site nearby."""


def config_of(build: Path, *overrides: str) -> Config:
    return load_ideal_config(
        None, [*LOW, *overrides], scene="flat", estimator="oracle", seed=0, controller="px4",
        px4=str(build), record=False,
    )  # fmt: skip


def check(result: RunResult) -> None:
    assert result.outcome == "LANDED", result.reason
    assert result.parts is not None and result.parts.controller == "px4"
    assert result.landing is not None and result.landing.safe
    assert result.landing.target_offset_m is not None and result.landing.target_offset_m < 0.1
    assert 0.0 < (result.landing.vertical_speed_mps or 0.0) < 0.3
    texts = [event.text for event in result.events if event.text.startswith("PX4: ")]
    for text in ("PX4: mode OFFBOARD", "PX4: armed", "PX4: disarmed"):
        assert text in texts


def test_a_landing_in_lockstep_is_repeated_to_the_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts: list[tuple[int, int]] = []
    close = Px4Autopilot.close

    def counted(self: Px4Autopilot) -> None:
        counts.append(self.lockstep)
        close(self)

    monkeypatch.setattr(Px4Autopilot, "close", counted)
    build = make_build(tmp_path / "build")
    result = fly(config_of(build), tmp_path / "run")
    check(result)
    steps, answers = counts[0]
    before = round(200.0 * result.timing.sim_s) - steps
    assert steps == answers and SILENT_STEPS <= before < 200, "one answer a step, none missing"
    fly(config_of(build, "referee.timeout_s=6.0"), tmp_path / "again")
    begun = (tmp_path / "again/truth.tum").read_bytes()
    assert begun.count(b"\n") > 250
    assert (tmp_path / "run/truth.tum").read_bytes().startswith(begun)
    assert not (tmp_path / "run/px4").exists() and (tmp_path / "run/px4.log").exists()


@pytest.mark.slow
@pytest.mark.skipif(VARIABLE not in os.environ, reason="no PX4 is named")
def test_px4_itself_lands(tmp_path: Path) -> None:
    config = config_of(Path(os.environ[VARIABLE]), "px4.ulog=true")
    check(fly(config, tmp_path / "run"))
    assert (tmp_path / "run/px4.ulg").stat().st_size > 10_000
