"""The pytest plugin, run in a pytest of its own; and the page that explains it."""

import os
from pathlib import Path

import pytest

from touchdown.experiments.errors import UsageError
from touchdown.experiments.pytest_plugin import assert_position_error, fly_all

from support.command import lines_of
from support.docs_support import blocks_of

pytest_plugins = ["pytester"]

ROOT = Path(__file__).parents[3]


def row(**changes: object) -> dict[str, object]:
    good = {
        "scene": "lake", "estimator": "mine", "seed": 4, "outcome": "COMPLETED",
        "position_error_m.mean": 0.05,
    }  # fmt: skip
    return good | changes


def test_bound_names_every_flight_that_breaks_it() -> None:
    assert_position_error([row()], below=0.1)
    bad = [
        row(),
        row(seed=5, **{"position_error_m.mean": 0.25}),
        row(seed=6, outcome="DIVERGED", reason="the estimate is 20.1 m off"),
        row(seed=7, **{"position_error_m.mean": None}),
    ]
    with pytest.raises(AssertionError) as failure:
        assert_position_error(bad, below=0.1)
    assert str(failure.value).splitlines() == [
        "3 of 4 flights are not below 0.1:",
        "  lake, mine, seed 5: position_error_m.mean = 0.25",
        "  lake, mine, seed 6: DIVERGED (the estimate is 20.1 m off)",
        "  lake, mine, seed 7: position_error_m.mean = None",
    ]
    with pytest.raises(ValueError, match="no flight"):
        assert_position_error([], below=0.1)
    with pytest.raises(AssertionError, match=r"= 0\.1$"):
        assert_position_error([row(**{"position_error_m.mean": 0.1})], below=0.1)


@pytest.mark.parametrize(("arguments", "message"), [
    ({"mode": "hover"}, "mode = 'hover'"), ({"jobs": 0}, "touchdown-jobs 0"),
    ({"overrides": ["survey.hight_m=3"]}, "unknown key 'survey.hight_m'"),
    ({"scenes": ["atlantis"]}, "atlantis"),
])  # fmt: skip
def test_mistakes_are_reported_before_a_flight(
    tmp_path: Path, arguments: dict[str, object], message: str
) -> None:
    given = {"scenes": ["flat"], "seeds": [0], "out": tmp_path} | arguments
    with pytest.raises(UsageError, match=message):
        fly_all("oracle", **given)
    assert list(tmp_path.iterdir()) == []


def test_an_estimator_that_raises_is_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "broken_vio.py").write_text(
        "from touchdown.sim.api import SensorNeeds\n"
        "def build(params, rig):\n"
        "    return Broken()\n"
        "class Broken:\n"
        "    needs = SensorNeeds()\n"
        "    def update(self, obs):\n"
        "        raise ArithmeticError('lost my way')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    rows = fly_all("broken_vio:build", scenes=["flat"], seeds=[0], out=tmp_path / "runs")
    assert rows[0]["outcome"] == "CRASHED"
    with pytest.raises(AssertionError, match="ArithmeticError: lost my way"):
        assert_position_error(rows, below=1.0)


def test_the_plugin_needs_nothing_but_pytest() -> None:
    script = (
        "import sys, touchdown.experiments.pytest_plugin; "
        "print([m for m in ('numpy', 'mujoco', 'scipy', 'cv2') if m in sys.modules])"
    )
    assert lines_of(script, env={**os.environ, "PYTHONPATH": str(ROOT)}) == ["[]"]


def test_the_example_of_the_page_passes_as_it_is_printed(pytester: pytest.Pytester) -> None:
    """But for the second seed, which is left out, and the height and length."""
    block = blocks_of(ROOT / "docs" / "ci-regression.md", "python")[0]
    block = block.replace("seeds=range(2)", "seeds=range(1)")
    low = '"survey.height_m=5", "survey.min_height_m=5", "survey.leg_length_m=4", "preset=short"'
    block = block.replace('"survey.legs=1"', f'"survey.legs=1", {low}, "survey.duration_s=3"')
    pytester.makepyfile(test_positioning=block)
    pytester.runpytest_subprocess("-q", "--touchdown-out=kept").assert_outcomes(passed=2)
    assert (pytester.path / "kept" / "flat-oracle-s0" / "result.json").is_file()
