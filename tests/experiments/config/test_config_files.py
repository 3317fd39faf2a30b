"""Configuration files at their limits: one line, at once, whatever they hold."""

import json
import os
import re
from pathlib import Path
from typing import Any

import pytest

import touchdown
from touchdown.experiments.campaign.plan import load_plan
from touchdown.experiments.config.loading import load_config, parse_seeds
from touchdown.experiments.errors import UsageError

from support.command import Says

DIGITS = "9" * 5000
DEEP = 3000

TOML = {
    "integer of 5000 digits": (f"seed = {DIGITS}", "too large: whole numbers go to"),
    "hexadecimal integer of 5000 digits": (f"seed = 0x{'f' * 5000}", "too large"),
    "integer within a list": (f"external.gains = [1, [{2**63}]]", "too large"),
    "3000 tables": (f"[{'.'.join('a' * DEEP)}]\nb = 1", "nested too deeply"),
    "3000 dotted keys": (f"{'.'.join('a' * DEEP)} = 1", "nested too deeply"),
    "3000 lists": (f"a = {'[' * DEEP}{']' * DEEP}", "nested too deeply"),
    "3000 inline tables": (f"a = {'{b=' * DEEP}1{'}' * DEEP}", "nested too deeply"),
    "40 levels": (f"external.a = {'[' * 40}{']' * 40}", "at most 32 levels"),
    "half a character": ('scene = "\\ud800"', "is not valid TOML"),
    "a zero byte": ('scene = "a\\u0000b"', "is no text: 'a\\x00b'"),
    "markup": ('"[/x]" = 1', "unknown key '[/x]'"),
    "control characters": ('"\\u001b[31m\\u202e" = 1', r"unknown key '\x1b[31m\u202e'"),
    "seed": (f"seed = {2**63}", "too large: whole numbers go to 9223372036854775807"),
    "scene_seed": (f"scene_seed = {2**63}", "too large"),
}
JSON = {
    "integer of 5000 digits": (f'{{"seed": {DIGITS}}}', "too large: whole numbers go to"),
    "3000 objects": ('{"a":' * DEEP + "1" + "}" * DEEP, "nested too deeply"),
    "100000 lists": ("[" * 100_000, "nested too deeply"),
    "half a character": ('{"scene": "\\ud800"}', r"is no text: '\ud800' has half a character"),
    "half a character in a number's place": ('{"scene_seed": "\\udcff"}', "is no text"),
    "half a character in a key": ('{"\\udcff": 1}', r"'\udcff' has half a character"),
    "a zero byte": ('{"scene": "a\\u0000b"}', "zero byte"),
    "a list": ("[1]", "must hold one object"),
    "infinity in a list of lists": ('{"external": {"a": [[Infinity]]}}', "external.a"),
}
CASES = [
    *(pytest.param(f"{name}.toml", *case, id=f"TOML {name}") for name, case in TOML.items()),
    *(pytest.param(f"{name}.json", *case, id=f"JSON {name}") for name, case in JSON.items()),
]


@pytest.mark.parametrize(("name", "text", "words"), CASES)
def test_a_file_at_its_limits_is_one_line(
    tmp_path: Path, says: Says, name: str, text: str, words: str
) -> None:
    file = tmp_path / name
    file.write_text(text, encoding="utf-8")
    error = says(2, "fly", "flat", "--config", file, "--out", tmp_path / "out").err
    assert error.count("\n") == 1 and error.strip().isprintable() and len(error) < 1000
    assert words in error and not (tmp_path / "out").exists()


def test_a_byte_order_mark_is_no_mistake(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_bytes(b"\xef\xbb\xbfseed = 7\n")
    (tmp_path / "a.json").write_bytes(b"\xef\xbb\xbf" + json.dumps({"seed": 8}).encode())
    assert load_config(tmp_path / "a.toml").seed == 7
    assert touchdown.load_config(tmp_path / "a.json").seed == 8


def test_a_large_file_is_not_read(tmp_path: Path) -> None:
    with (tmp_path / "a.toml").open("wb") as file:
        file.truncate(1 << 36)
    with pytest.raises(UsageError, match="more than 1 MB, which no configuration needs"):
        load_config(tmp_path / "a.toml")


@pytest.mark.parametrize(
    "key", ["a." * 40 + "b", '"a" .' * 40 + "b", "'.'\t.\t" * 40 + '"b"', "[" + "-._." * 20 + "c]"]
)
def test_a_key_of_many_parts_is_not_parsed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, key: str
) -> None:
    """The time for it grows with the square of its parts."""
    monkeypatch.setattr("tomllib.loads", pytest.fail)
    (tmp_path / "a.toml").write_text(f"seed = 1\n{key} = 1\n")
    with pytest.raises(UsageError, match="nested too deeply"):
        load_config(tmp_path / "a.toml")


def test_what_is_no_file_is_named(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "circle").symlink_to("circle")
    cases = {
        tmp_path: "is a directory", tmp_path / "pipe": "is a named pipe",
        tmp_path / "circle": "cannot be read (Too many levels", Path("/dev/zero"): "is a device",
        Path("/proc/version"): "is a file of the kernel's state",
        Path("/proc/kmsg"): "is a file of the kernel's state",
        Path("/proc/self/mem"): "is a file of the kernel's state",
        tmp_path / "gone": "does not exist",
    }  # fmt: skip
    for path, words in cases.items():
        with pytest.raises(UsageError, match=re.escape(words)):
            load_config(path)


@pytest.mark.parametrize(
    "value", [2**63, 10**5000, "\ud800", [["\udcff"]], {"a": "\0"}], ids=range(5)
)
def test_overrides_of_python(value: Any) -> None:
    with pytest.raises(UsageError, match=r"external\.x in overrides is"):
        touchdown.load_config(estimator="a:b", overrides={"external.x": value})
    with pytest.raises(UsageError, match=f"too large: whole numbers go to {LARGEST}"):
        load_config(None, [f"external.n=[{DIGITS}]"], estimator="a:b")


LARGEST = 2**63 - 1


@pytest.mark.parametrize("arguments", [
    ("fly", "flat", "--seed", str(2**63)), ("land", "flat", "--seed", DIGITS),
    ("fly", "flat", "--set", f"scene_seed={2**63}"),
    ("scenes", "render", "flat", "--seed", str(2**63)),
    ("scenes", "export", "flat", "--seed", str(2**63)), ("calibrate", "--seed", str(2**63)),
    ("dataset", "render", "--seed", str(2**63)), ("train", "data", "--seed", "-1"),
    ("bench", "loop", "--seed", str(2**63)),
], ids=" ".join)  # fmt: skip
def test_a_seed_that_no_table_holds_is_refused_where_it_enters(
    arguments: tuple[str, ...], says: Says, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    error = says(2, *list(arguments)).err
    assert error.count("\n") == 1 and "seed" in error
    assert str(LARGEST) in error or len(arguments[-1]) > 100
    assert not list(tmp_path.iterdir())


def test_lists_of_seeds_and_the_largest_seed(tmp_path: Path) -> None:
    for text in (f"{2**63}", f"0-{2**63}", f"{2**63}-{2**63 + 1}", DIGITS):
        with pytest.raises(UsageError, match=f"holds a seed above {LARGEST}, the largest"):
            parse_seeds(text, "--seeds")
    assert parse_seeds(f"{LARGEST - 1}-{LARGEST}", "--seeds") == [LARGEST - 1, LARGEST]
    assert load_config(seed=LARGEST).seed == LARGEST
    (tmp_path / "c.toml").write_text(f'name = "c"\n[axes]\nscene = ["flat"]\nseeds = "{LARGEST}"\n')
    assert load_plan(tmp_path / "c.toml").runs[0].values["seed"] == LARGEST
