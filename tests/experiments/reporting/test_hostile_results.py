"""Results of outside with text and numbers that no table holds: one line, whatever reads them."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.cli import main as cli
from touchdown.experiments.errors import broken_text

from support.command import Says
from support.report_support import write_run

COMMANDS = (
    ("report", "{runs}"),
    ("report", "{runs}", "--out", "{out}"),
    ("query", "{runs}", "select * from runs"),
    ("regress", "{runs}", "--baseline", "{out}", "--update"),
)


def _changed(**changes: Any) -> Callable[[Path], None]:
    def change(run: Path) -> None:
        file = run / "result.json"
        file.write_text(json.dumps(json.loads(file.read_text()) | changes))

    return change


def _renamed(run: Path) -> None:
    os.rename(os.fsencode(run), os.fsencode(run.parent) + b"/a\xff")


def _digits(run: Path) -> None:
    file = run / "result.json"
    file.write_text(file.read_text().replace('"seed": 0', f'"seed": {"9" * 5000}'))


def _deep(run: Path) -> None:
    (run / "result.json").write_text('{"a":' * 3000 + "1" + "}" * 3000)


REFUSED = {
    "half a character in an extra key": (_changed(extra="\ud800"), r"'\ud800' has half a char"),
    "half a character in a name": (_changed(scene="\ud800"), r"'\ud800' has half a character"),
    "half a character deep down": (_changed(versions={"x": ["\udcff"]}), r"'\udcff' has half"),
    "half a character in a key": (_changed(**{"\udcff": 1}), r"'\udcff' has half a character"),
    "a zero byte": (_changed(reason="a\0b"), r"'a\x00b' has half a character or a zero byte"),
    "an integer of 5000 digits": (_digits, "a number of thousands of digits"),
    "3000 levels": (_deep, "nested too deeply"),
}


@pytest.mark.parametrize("command", COMMANDS, ids=lambda c: f"{c[0]}{len(c)}")
@pytest.mark.parametrize(("change", "words"), REFUSED.values(), ids=REFUSED)
def test_refused_in_one_line(
    command: tuple[str, ...], change: Callable[[Path], None], words: str, tmp_path: Path, says: Says
) -> None:
    change(write_run(tmp_path / "runs", "flat", "m", 0))
    given = [part.format(runs=tmp_path / "runs", out=tmp_path / "out") for part in command]
    error = says(2, *given).err
    assert error.count("\n") == 1 and words in error and "sys." not in error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", COMMANDS[1:], ids=lambda c: c[0])
def test_a_directory_whose_name_is_no_text(
    command: tuple[str, ...], tmp_path: Path, says: Says
) -> None:
    _renamed(write_run(tmp_path / "runs", "flat", "m", 0))
    given = [part.format(runs=tmp_path / "runs", out=tmp_path / "out") for part in command]
    line = f"the name of '{tmp_path}/runs/a\\udcff' is no UTF-8 text; rename that directory"
    assert says(2, *given).err == f"touchdown: error: {line}\n"


@pytest.mark.parametrize("command", COMMANDS, ids=lambda c: f"{c[0]}{len(c)}")
@pytest.mark.parametrize("extra", [10**400, [1, 10**400], [[10**400]]], ids=range(3))
def test_numbers_beyond_floats_are_no_obstacle(
    command: tuple[str, ...], extra: Any, tmp_path: Path
) -> None:
    _changed(extra=extra)(write_run(tmp_path / "runs", "flat", "m", 0))
    given = [part.format(runs=tmp_path / "runs", out=tmp_path / "out") for part in command]
    assert cli.main(given) == 0


def test_broken_text() -> None:
    assert broken_text({"a": ["ü", {"💥": 1.0}], "b": None}) is None
    assert broken_text({"a": [{"\ud83d": 1}]}) == r"'\ud83d'"
    assert broken_text(["x" * 1000 + "\0"]) == "'" + "x" * 59
