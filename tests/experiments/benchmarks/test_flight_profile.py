"""``touchdown bench profile``: own time of stages, places of functions, flame graph."""

import json
import sys
import threading
from pathlib import Path

import numba
import pytest

from touchdown.experiments.benchmarks import flight_profile
from touchdown.experiments.benchmarks.flight_profile import STAGES, StageProfile, found
from touchdown.experiments.benchmarks.loop import compiled_before

from support.command import Says


def test_a_stage_has_its_time_without_that_of_the_stages_within(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = [0.0]
    monkeypatch.setattr(flight_profile.time, "thread_time", lambda: now[0])

    def spend(seconds: float) -> None:
        now[0] += seconds

    profile = StageProfile()
    inner = profile.clocked("inner", spend)

    def whole() -> None:
        spend(1.0)
        inner(2.0)
        inner(3.0)

    profile.clocked("outer", whole)()
    inner(4.0)
    assert profile.seconds == {"inner": 9.0, "outer": 1.0}
    assert profile.calls == {"inner": 3, "outer": 1}


def test_every_stage_is_a_function_and_is_put_back() -> None:
    before = [vars(owner)[name] for owner, name in map(found, STAGES.values())]
    with StageProfile().watching(STAGES):
        within = [vars(owner)[name] for owner, name in map(found, STAGES.values())]
    assert all(old is not new for old, new in zip(before, within, strict=True))
    assert [vars(owner)[name] for owner, name in map(found, STAGES.values())] == before


def test_the_flame_graph_is_of_the_same_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, says: Says
) -> None:
    """A py-spy that writes its command in place of a flame graph, and prints stages."""
    spy = tmp_path / "py-spy"
    figures = {"core_s_per_sim_s": 0.5, "stages": {"film": {"calls": 2, "ms": 3.0}}}
    spy.write_text(
        f"#!{sys.executable}\nimport sys\n"
        "open(sys.argv[sys.argv.index('--output') + 1], 'w').write(' '.join(sys.argv))\n"
        f"print('''py-spy> Sampling {{}}\n{json.dumps(figures, indent=1)}\npy-spy> Wrote {{}}''')\n"
    )
    spy.chmod(0o755)
    monkeypatch.setattr("shutil.which", lambda *_name, **_path: str(spy))
    out = tmp_path / "out"
    says(0, "bench", "profile", "lake", "--seed", "7", "--full", "--out", out)
    assert json.loads((out / "stages.json").read_text()) == figures
    command = (out / "flame.svg").read_text()
    assert (
        "touchdown bench profile lake --estimator livo --profile field --seed 7 --full" in command
    )


def test_the_table_adds_up() -> None:
    profile = StageProfile()
    profile.seconds = {"scene": 5.0, "film": 1.0, "rest": 3.0}
    profile.calls = {"scene": 1, "film": 20, "rest": 1}
    rows = flight_profile._rows(profile, sim_s=2.0)
    assert rows["film"] == {"calls": 20, "ms": 50.0, "ms_per_scan": 50.0, "fraction": 0.25}
    assert "fraction" not in rows["scene"]
    text = flight_profile.table({"stages": rows, "core_s_per_sim_s": 2.0})
    assert "25.0%" in text and text.endswith("2.000 core-seconds per simulated second")


def test_a_measurement_during_compilation_is_repeated() -> None:
    @numba.njit
    def kernel(x: float) -> float:
        return 2.0 * x

    calls: list[float] = []

    def measure() -> int:
        worker = threading.Thread(target=lambda: calls.append(kernel(1.0)))
        worker.start()
        worker.join()
        return len(calls)

    assert compiled_before(measure) == 2
    assert compiled_before(measure) == 3  # all compiled
