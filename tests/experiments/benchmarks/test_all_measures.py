"""`touchdown bench all` and `bench compare` on stand-ins of checkouts that print known figures."""

import json
from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.benchmarks import all_measures
from touchdown.experiments.benchmarks.all_measures import COMMANDS, MEASURES
from touchdown.experiments.benchmarks.flights_probe import Clock
from touchdown.experiments.cli import main as cli

from support.command import Says

TITLES = [measure.title for measure in MEASURES]


def checkout(folder: Path, factor: float, log: Path) -> Path:
    """Prints, whatever it is asked, each figure: its place in `MEASURES` times ``factor``."""
    package = folder / "src" / "touchdown"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    printed: dict[str, Any] = {}
    for place, measure in enumerate(MEASURES, 1):
        inner = printed
        for key in measure.path[:-1]:
            inner = inner.setdefault(key, {})
        inner[measure.path[-1]] = factor * place
    (package / "__main__.py").write_text(
        f"open({str(log)!r}, 'a').write({folder.name!r} + '\\n')\nprint('progress')\n"
        f"print({json.dumps(printed)!r})\n"
    )
    return folder


@pytest.fixture
def _as_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    commands = dict.fromkeys(COMMANDS, ("-m", "touchdown"))
    monkeypatch.setattr(all_measures, "COMMANDS", commands)


@pytest.mark.usefixtures("_as_modules")
def test_two_checkouts_take_turns(
    tmp_path: Path, says: Says, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "log"
    trees = [checkout(tmp_path / "a", 1.0, log), checkout(tmp_path / "b", 0.5, log)]
    assert cli.main(["bench", "compare", *map(str, trees), "--rounds", "2", "--json"]) == 0
    assert log.read_text().split() == ["a", "b"] * 2 * len(COMMANDS)
    found = json.loads(capsys.readouterr().out)
    assert list(found) == TITLES
    for place, title in enumerate(TITLES, 1):
        assert found[title]["values"] == [place, 0.5 * place] and found[title]["ratio"] == 0.5
    words = says(0, "bench", "compare", *map(str, trees)).out.splitlines()[0].split()
    assert " ".join(words) == "landing in a worker 1 0.5 core-s per s x 0.50"


@pytest.mark.usefixtures("_as_modules")
def test_what_a_checkout_does_not_print_is_left_out(tmp_path: Path) -> None:
    tree = checkout(tmp_path / "a", 1.0, tmp_path / "log")
    main = tree / "src" / "touchdown" / "__main__.py"
    main.write_text(main.read_text().replace('"embree"', '"other"'))
    found = [one for _, figures in all_measures.measure_all([tree]) for one in figures]
    missing = [one.measure.title for one in found if one.values == (None,)]
    assert missing == ["LIDAR over bare Embree"] and len(found) == len(MEASURES)


@pytest.mark.usefixtures("_as_modules")
def test_a_checkout_that_does_not_run_is_one_line(tmp_path: Path, says: Says) -> None:
    tree = checkout(tmp_path / "a", 1.0, tmp_path / "log")
    main = tree / "src" / "touchdown" / "__main__.py"
    main.write_text("import sys\nprint('no camera', file=sys.stderr)\nsys.exit(2)")
    for message in ("no camera", "is no checkout of touchdown"):
        lines = says(2, "bench", "compare", tree, tree).err.strip().splitlines()
        assert len(lines) == 1 and message in lines[0]
        (main.parent / "__init__.py").unlink(missing_ok=True)


def test_the_clock_counts_calls_and_their_processor_time() -> None:
    class Sensor:
        def work(self, much: int) -> int:
            return sum(range(much))

    clock, sensor = Clock(Sensor, "work"), Sensor()
    assert clock.ms() == 0.0 and sensor.work(10) == 45 and sensor.work(much=4) == 6
    assert clock.calls == 2 and clock.ms() == 500.0 * clock.seconds > 0.0
