"""`touchdown bench all` and `bench compare` on stand-ins of checkouts that print known figures."""

import json
from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.benchmarks import all_measures
from touchdown.experiments.benchmarks.all_measures import COMMANDS, MEASURES

from support.command import Says

TITLES = [measure.title for measure in MEASURES]
STAGES = {
    "picture: draw": (20, 4.0), "film": (20, 3.0), "camera": (20, 1.0), "lidar: aim": (10, 2.0),
    "lidar": (10, 1.0), "scene": (1, 6.0), "set-up": (1, 8.0),
}  # fmt: skip
PRINTED: dict[str, Any] = {
    "core_s_per_sim_s": 0.5,
    "stages": {name: {"calls": n, "ms": ms} for name, (n, ms) in STAGES.items()}
    | {"estimator": {"ms_per_scan": 12.0}},
    "real_time_factor": 2.0, "ratio": {"embree": 0.7, "mujoco_lidar": 8.0},
    "stage_ms": {"sum": 20.0}, "classifier_ms": {"ten_patches": 13.0},
}  # fmt: skip
EXPECTED = [0.5, 8.0, 3.0, 12.0, 14.0, 2.0, 0.7, 8.0, 20.0, 13.0]


def checkout(folder: Path, log: Path) -> Path:
    """Prints, whatever it is asked, all figures."""
    package = folder / "src" / "touchdown"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "__main__.py").write_text(
        f"open({str(log)!r}, 'a').write({folder.name!r} + '\\n')\nprint('progress')\n"
        f"print({json.dumps(PRINTED)!r})\n"
    )
    return folder


def test_two_checkouts_take_turns(tmp_path: Path, says: Says) -> None:
    log = tmp_path / "log"
    trees = [checkout(tmp_path / "a", log), checkout(tmp_path / "b", log)]
    second = trees[1] / "src" / "touchdown" / "__main__.py"
    second.write_text(second.read_text().replace('sim_s": 0.5', 'sim_s": 0.25'))
    printed = says(0, "bench", "compare", *trees, "--rounds", "2", "--json").out
    assert log.read_text().split() == ["a", "b"] * 2 * len(COMMANDS)
    found = json.loads(printed)
    assert list(found) == TITLES and found.pop("memory of a landing")["values"][0] > 5.0
    assert [one["values"][0] for one in found.values()] == pytest.approx(EXPECTED)
    assert found["landing"]["values"] == [0.5, 0.25] and found["landing"]["ratio"] == 0.5
    words = says(0, "bench", "compare", *trees).out.splitlines()[0].split()
    assert " ".join(words) == "landing 0.5 0.25 core-s per s x 0.50"


def test_what_a_checkout_does_not_print_is_left_out(tmp_path: Path) -> None:
    tree = checkout(tmp_path / "a", tmp_path / "log")
    main = tree / "src" / "touchdown" / "__main__.py"
    main.write_text(main.read_text().replace('"embree"', '"other"'))
    found = [one for _, figures in all_measures.measure_all([tree]) for one in figures]
    missing = [one.measure.title for one in found if one.values == (None,)]
    assert missing == ["LIDAR over bare Embree"] and len(found) == len(MEASURES)


def test_a_checkout_that_does_not_run_is_one_line(tmp_path: Path, says: Says) -> None:
    tree = checkout(tmp_path / "a", tmp_path / "log")
    main = tree / "src" / "touchdown" / "__main__.py"
    main.write_text("import sys\nprint('no camera', file=sys.stderr)\nsys.exit(2)")
    for message in ("no camera", "is no checkout of touchdown"):
        lines = says(2, "bench", "compare", tree, tree).err.strip().splitlines()
        assert len(lines) == 1 and message in lines[0]
        (main.parent / "__init__.py").unlink(missing_ok=True)
