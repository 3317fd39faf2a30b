"""Ablation: errors on equal logs, with one part left out."""

from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.benchmarks import ablation
from touchdown.experiments.errors import UsageError
from touchdown.experiments.flight.replay import open_run

from support.command import Says
from support.replay_support import LIFT_OFF_S, make_run, shifted


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("runs") / "flown", estimate=shifted([0.03, 0.0, 0.04]))


def test_an_estimator_is_measured_from_lift_off_to_the_end(run: Path) -> None:
    logged = open_run(run)
    whole = ablation.replayed(logged, "livo: tight, all on")
    assert whole["error_m"] < 0.03 and whole["lost_s"] is None and whole["cpu_ms"] > 0.0
    early = ablation.replayed(logged, "livo: tight, all on", LIFT_OFF_S + 0.05)
    assert early["error_m"] != whole["error_m"]


def test_ablation_replays_every_variant(
    run: Path, monkeypatch: pytest.MonkeyPatch, says: Says
) -> None:
    variants = {"livo: all on": ("livo", {}), "livo: LIDAR only": ("livo", {"use_vision": False})}
    monkeypatch.setattr(ablation, "VARIANTS", variants)
    rows = ablation.ablate([run], seconds=0.4)[run.name]
    assert 0.0 < rows["livo: all on"]["error_m"] < 0.03
    assert rows["livo: LIDAR only"]["error_m"] != rows["livo: all on"]["error_m"]
    lost = {"error_m": 3.0, "lost_s": 12.4, "cpu_ms": 1.0}
    table = ablation.ablation_table({"here": rows, "there": {**rows, "livo: all on": lost}})
    lines = table.splitlines()
    assert lines[0] == "| variant | here | there |"
    assert lines[2].startswith("| livo: all on | 0.0") and lines[2].endswith("| lost at 12 s |")
    assert lines[3].startswith("| livo: LIDAR only | 0.")
    printed = says(0, "bench", "ablate", run, "--seconds", "0.4", "--method", "livo").out
    assert printed.splitlines()[0] == f"| variant | {run.name} |" and printed.count("livo: ") == 2


def test_ablation_tells_by_how_much_each_part_lowers_the_error() -> None:
    def rows(whole: float, without: float) -> dict[str, Any]:
        figures = {"lost_s": None, "cpu_ms": 1.0}
        return {
            "zou2024: all on": {"error_m": whole, **figures},
            "zou2024: no f_c": {"error_m": without, **figures},
        }

    found = {"a 1": rows(0.1, 0.12), "a 2": rows(0.2, 0.22), "b 1": rows(0.1, 0.12)}
    lines = ablation.ablation_table(found).splitlines()
    assert lines[0] == "| variant | a 1 | a 2 | b 1 | more error, 95 % |"
    assert lines[2].endswith("| – |") and lines[3].endswith("| +0.020 [+0.020, +0.020] |")
    found["b 1"]["zou2024: no f_c"]["lost_s"] = 3.0
    assert ablation.ablation_table(found).endswith("| lost at 3 s | – |")
    assert ablation.variants(["zou2024: no f_c"]) == ["zou2024: all on", "zou2024: no f_c"]
    assert {v.split(":")[0] for v in ablation.variants(["livo"])} == {"livo"}
    with pytest.raises(UsageError, match="--method: no 'flow'; name one of: livo, zou2024, "):
        ablation.variants(["flow"])
