"""Seeded generators of command lines and configurations: valid ones, mutated."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import click
import numpy as np

from touchdown.experiments.cli import main as cli
from touchdown.experiments.config.keys import flatten
from touchdown.experiments.config.loading import dump_config, known_keys
from touchdown.experiments.config.schema import Config

from fuzz.fuzzing import Case

Rng = np.random.Generator
ROOT = Path(__file__).parents[2]

NUMBERS: tuple[Any, ...] = (
    0, -1, 1, 2, 3, 7, 100, -0.0, 0.5, 1e-300, 1e300, 1e308, 2**31, 2**53 + 1, 2**63, 2**64,
    10**30, -(2**63), 1e9, 10**9, 1e-9, -1e-9, 0.1, 3.5, 1e5, 10**5, float("nan"), float("inf"),
    float("-inf"),
)  # fmt: skip
TEXTS = (
    "", " ", "nan", "inf", "-1", "0", "1e999", "ü", "💥", "../..", "/dev/null", "/proc/self/mem",
    "a" * 5000, "\x1b[31mred", "'", '"', "]", "{", "null", "true", "[]", "%s%n", "$(x)",
    "\u202egpj", "1,5", "١٢", "0x10", "1_000", "--help", "-", "--", "crossroad", "flat", "livo",
    "no.xml", "a/b.xml", "os:system", "os.path:join", ":", "x:", ":x", "a b", "\t", "line\nline",
    "line\rline", "\u2028", "C:\\x", "~", ".", "..", "/", "//", "\udcff", "*", "?", "[a", "0-9",
    "9-0", "1/4", "12.5,-3", "nan,1", "lidar_dropout@20+1",
)  # fmt: skip
_SANE_SCENES = ("flat", "crossroad", "lake")


def pick(rng: Rng, items: Any) -> Any:
    items = list(items)
    return items[int(rng.integers(len(items)))]


def value(rng: Rng, depth: int = 0) -> Any:
    """Returns any value of TOML or JSON."""
    kind = int(rng.integers(8 if depth < 3 else 5))
    if kind < 3:
        return pick(rng, NUMBERS)
    if kind == 3:
        return pick(rng, TEXTS)
    if kind == 4:
        return bool(rng.integers(2))
    if kind < 7:
        return [value(rng, depth + 1) for _ in range(int(rng.integers(0, 5)))]
    return {pick(rng, ("a", "b c", "", "when", "ü")): value(rng, depth + 1)}


def neighbour(rng: Rng, old: Any) -> Any:
    """Returns mostly a value of the type of ``old`` with another size, sign or length."""
    if rng.random() < 0.2:
        return value(rng)
    if isinstance(old, bool):
        return not old
    if isinstance(old, int | float):
        if rng.random() < 0.3:
            return pick(rng, NUMBERS)
        scaled = old * float(pick(rng, (-1, 0, 0.001, 0.1, 0.5, 1, 1.5, 2, 3, 10, 1000)))
        return round(scaled) if isinstance(old, int) and rng.random() < 0.9 else scaled
    if isinstance(old, list):
        changed = [neighbour(rng, item) if rng.random() < 0.5 else item for item in old]
        return pick(rng, (changed, changed[:-1], [*changed, 0.0], changed[::-1]))
    if isinstance(old, str):
        return pick(rng, (*TEXTS, old, old + "x", old[:-1], old.upper()))
    return pick(rng, (None, 0.0, 1.5, -3.0, [1.0, 2.0], "x", False))


def misspelt(rng: Rng, word: str) -> str:
    """``word`` with a letter less, more, or other."""
    at = int(rng.integers(max(len(word), 1)))
    letter = pick(rng, "aeiou_.-= \n\tÄ0")
    return pick(
        rng,
        (
            word[:at] + word[at + 1 :],
            word[:at] + letter + word[at:],
            word[:at] + letter + word[at + 1 :],
            word.upper(),
            word + "." + word,
            word,
        ),
    )


# -------------------------------------------------------------------------------------- text, files


def toml_text(tree: Mapping[str, Any]) -> str:
    """TOML with dotted keys; values that TOML cannot hold are left out."""
    lines = [
        f"{_toml_key(key)} = {_toml_value(item)}" for key, item in tree.items() if item is not None
    ]
    return "\n".join(lines) + "\n"


def _toml_key(key: str) -> str:
    return ".".join(
        part if part.isidentifier() and part.isascii() else json.dumps(part)
        for part in key.split(".")
    )


def _toml_value(item: Any) -> str:
    if isinstance(item, bool):
        return "true" if item else "false"
    if isinstance(item, list | tuple):
        return "[" + ", ".join(_toml_value(part) for part in item if part is not None) + "]"
    if isinstance(item, dict):
        return "{" + ", ".join(f"{json.dumps(k)} = {_toml_value(v)}" for k, v in item.items()) + "}"
    if isinstance(item, str):
        return json.dumps(item, ensure_ascii=False)
    return repr(item)


def damaged(rng: Rng, data: bytes) -> bytes:
    """``data`` as a bad disk, a wrong editor or a lost connection would leave it."""
    at, end = sorted(int(x) for x in rng.integers(0, len(data) + 1, 2))
    kind = int(rng.integers(12))
    if kind == 0:
        return data[:at]
    if kind == 1:
        return data[:at] + data[min(end, at + 40) :]
    if kind == 2:
        return data[:at] + bytes(rng.integers(0, 256, 8, dtype=np.uint8)) + data[at + 8 :]
    if kind == 3:
        return data[:at] + data[at:end][:200] * 2 + data[end:]
    if kind == 4:
        return b""
    if kind == 5:
        return b"\xef\xbb\xbf" + data
    if kind == 6:
        return data.replace(b"\n", b"\r\n")
    if kind == 7:
        return data.decode("utf-8", "replace").encode("utf-16")
    if kind == 8:
        return data[:at] + "größe".encode("latin-1") + data[at:]
    if kind == 9:
        return data[:at] + b"\0" + data[at:]
    if kind == 10:
        lines = data.split(b"\n")
        rng.shuffle(lines)  # type: ignore[arg-type]
        return b"\n".join(lines)
    return bytes(rng.integers(0, 256, int(rng.integers(1, 300)), dtype=np.uint8))


def put(rng: Rng, path: Path, text: str, share: float = 0.25) -> Path:
    """Writes ``text``, damaged with the given probability."""
    data = text.encode("utf-8", "surrogatepass")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(damaged(rng, data) if rng.random() < share else data)
    return path


# ----------------------------------------------------------------------------------------- configs


@cache
def defaults() -> dict[str, Any]:
    """Every dotted key with its default."""
    return dict(flatten(json.loads(Config().model_dump_json())))


def setting(rng: Rng) -> tuple[str, Any]:
    """Returns a key, mostly an existing one, and a value, mostly a nearly valid one."""
    key = pick(rng, known_keys())
    changed = neighbour(rng, defaults()[key])
    kind = rng.random()
    if kind < 0.12:
        key = misspelt(rng, key)
    elif kind < 0.16:
        key = pick(rng, TEXTS)
    elif kind < 0.2:
        key = key.split(".")[0]
    if key in ("scene", "estimator") and rng.random() < 0.5:
        changed = pick(rng, (*_SANE_SCENES, "livo", "gps", "stereo"))
    return key, changed


def _set_text(rng: Rng, key: str, item: Any) -> str:
    raw = _toml_value(item) if rng.random() < 0.8 else str(item)
    text = f"{key}={raw}"
    return misspelt(rng, text) if rng.random() < 0.08 else text


def set_case(rng: Rng, folder: Path) -> Case:
    """``--set KEY=VALUE``, one or several."""
    count = int(pick(rng, (1, 1, 1, 2, 4)))
    command = pick(rng, ("land", "fly", "land"))
    given = [_set_text(rng, *setting(rng)) for _ in range(count)]
    options = [part for text in given for part in ("--set", text)]
    return Case(kind="set", arguments=(command, "flat", *options, "--quiet"), folder=folder)


def config_case(rng: Rng, folder: Path) -> Case:
    """``--config FILE``: TOML, or the config.json of a run."""
    if rng.random() < 0.5:
        tree = dict(setting(rng) for _ in range(int(rng.integers(0, 6))))
        name = pick(rng, ("a.toml", "a.toml", "größe und form.toml", "noext"))
        file = put(rng, folder / name, toml_text(tree))
    else:
        document = json.loads(dump_config(Config()))
        for _ in range(int(rng.integers(0, 4))):
            group = pick(rng, document)
            inner = document[group]
            if isinstance(inner, dict) and inner and rng.random() < 0.8:
                key = pick(rng, inner)
                inner[misspelt(rng, key) if rng.random() < 0.2 else key] = neighbour(
                    rng, inner[key]
                )
            else:
                document[group] = value(rng)
        file = put(rng, folder / "config.json", json.dumps(document))
    target = str(file) if rng.random() < 0.95 else pick(rng, (str(folder), "gone.toml", "a\nb", ""))
    command = pick(rng, ("land", "fly"))
    return Case(
        kind="config", arguments=(command, "flat", "--config", target, "--quiet"), folder=folder
    )


# --------------------------------------------------------------------------------------- campaigns


def _campaign(rng: Rng) -> dict[str, Any]:
    tree: dict[str, Any] = {
        "name": "fuzz",
        "mode": pick(rng, ("fly", "land")),
        "record": pick(rng, ("none", "all", "failures")),
        "axes": {
            "scene": [pick(rng, _SANE_SCENES)],
            "estimator": [pick(rng, ("gps", "livo", "oracle"))],
            "seeds": pick(rng, ("0-3", "1,4-5", "7")),
        },
        "base": {},
        "limits": {"run_timeout_s": 100.0},
    }
    for _ in range(int(pick(rng, (0, 0, 1)))):
        key, item = setting(rng)
        tree["base"][key] = item
    for _ in range(int(pick(rng, (0, 0, 1)))):
        key, item = setting(rng)
        tree["axes"][key] = [item, neighbour(rng, item)] if rng.random() < 0.7 else item
    if rng.random() < 0.4:
        key, item = setting(rng)
        when = {
            pick(rng, ("scene", "seed", "estimator", "wind_kmh", key)): pick(
                rng, ("flat", 0, ["gps"], item)
            )
        }
        tree["override"] = pick(
            rng, ([{"when": when, "set": {key: item}}], [{"when": when}], {"set": {}}, [])
        )
    return tree


def mutate_tree(rng: Rng, tree: Any) -> None:
    """Changes, renames, removes or adds one thing somewhere."""
    while True:
        key = pick(rng, tree) if tree else "x"
        inner = tree.get(key) if tree else None
        if not (isinstance(inner, dict) and inner and rng.random() < 0.7):
            break
        tree = inner
    kind = int(rng.integers(4))
    if kind == 0 and key in tree:
        del tree[key]
    elif kind == 1 and key in tree:
        tree[misspelt(rng, key)] = tree.pop(key)
    elif kind == 2:
        tree[key] = neighbour(rng, inner)
    else:
        tree[pick(rng, ("seeds", "seed", "extra", "name", "wind_kmh", *TEXTS[:6]))] = value(rng)


def campaign_case(rng: Rng, folder: Path) -> Case:
    """``campaign FILE.toml``."""
    tree = _campaign(rng)
    for _ in range(int(pick(rng, (0, 0, 0, 1, 1, 2)))):
        mutate_tree(rng, tree)
    file = put(
        rng, folder / pick(rng, ("c.toml", "c.toml", "c.json", "ü ü.toml")), toml_text(tree), 0.15
    )
    out = folder / pick(rng, ("out", "out", "tief/er/out", "c.toml"))
    if rng.random() < 0.15:
        if not out.is_file():
            out.mkdir(parents=True, exist_ok=True)
        if out.is_dir():
            put(
                rng,
                out / pick(rng, ("campaign.json", "thesis.tex", ".lock", "campaign.toml")),
                "{}",
                0.5,
            )
    extra = pick(rng, ((), (), ("--shard", pick(rng, ("1/2", "0/2", "3/2", "1/1", "x")))))
    extra = (*extra, *pick(rng, ((), (), ("--json",), ("--jobs", str(pick(rng, NUMBERS))))))
    arguments = ("campaign", str(file), "--out", str(out), "--quiet", *extra)
    return Case(kind="campaign", arguments=arguments, folder=folder)


# ------------------------------------------------------------------------------------ command lines

FLOOR = """<mujoco><worldbody><geom name="lawn" type="plane" size="40 40 1"/>
<geom name="building" type="box" size="1 1 1" pos="9 0 1"/></worldbody></mujoco>"""


def leaves(
    group: Any = cli.cli, path: tuple[str, ...] = ()
) -> list[tuple[tuple[str, ...], click.Command]]:
    """Every command that does something, and its path."""
    if not isinstance(group, click.Group):
        return [(path, group)]
    found = []
    for name, command in group.commands.items():
        found += leaves(command, (*path, name))
    return found


LEARNING = ("train", "evaluate", "classify")
"""commands that need torch or a network's file"""


def _argument(rng: Rng, parameter: click.Parameter) -> str:
    """Returns a value for a parameter, mostly a nearly valid one."""
    if rng.random() < 0.25:
        return str(pick(rng, TEXTS)).replace("\0", "")
    kind = parameter.type
    if isinstance(kind, click.Choice):
        word = str(pick(rng, kind.choices))
        return misspelt(rng, word) if rng.random() < 0.2 else word
    if isinstance(kind, click.types.IntParamType | click.types.FloatParamType):
        return str(pick(rng, (*NUMBERS, "1,5", "1e3", "3", "2", "1", "0.5")))
    name = str(parameter.name)
    if name in ("overrides",):
        return _set_text(rng, *setting(rng))
    if name in ("scene", "scenes", "names"):
        return str(pick(rng, (*_SANE_SCENES, "crossrod", "floor.xml", "gone.xml")))
    if name == "estimator" or name == "name":
        return str(pick(rng, ("livo", "gps", "oracle", "lvio", "os:getcwd", "os.path:sep")))
    if name == "seeds":
        return str(pick(rng, ("0-3", "5", "3-1", "1,2", "0-99999999999", "-", "0--1", "²")))
    if name == "site":
        return str(pick(rng, ("1,2", "1e400,0", "1;2", "1,2,3", " 1 , 2 ")))
    if name == "shard":
        return str(pick(rng, ("1/2", "2/1", "0/0", "1/0", "x/y")))
    if name == "fault":
        kind = pick(rng, ("lidar_dropout", "camera_blackout", "gps_jump", "x"))
        return f"{kind}@{pick(rng, NUMBERS)}+{pick(rng, NUMBERS)}"
    if name == "sql":
        return str(
            pick(
                rng,
                (
                    "select 1",
                    "selec",
                    "",
                    "select * from runs",
                    "drop table runs",
                    "select 1;select 2",
                    "copy runs to 'x.csv'",
                    "select [1, {'a': 2}]",
                    "pragma version",
                ),
            )
        )
    return str(
        pick(
            rng,
            (
                "floor.xml",
                "empty.toml",
                "empty.json",
                "a folder",
                "gone",
                "new/er",
                "new.png",
                "new.jpg",
                "noise.bin",
                "a folder/inner",
            ),
        )
    )


def argv_case(rng: Rng, folder: Path) -> Case:
    """A command line of any command, for the most part well formed."""
    (folder / "floor.xml").write_text(FLOOR)
    (folder / "empty.toml").touch()
    (folder / "empty.json").write_text("{}")
    (folder / "noise.bin").write_bytes(bytes(rng.integers(0, 256, 400, dtype=np.uint8)))
    (folder / "a folder").mkdir()
    path, command = pick(rng, [leaf for leaf in leaves() if leaf[0][0] not in LEARNING])
    arguments = list(path)
    for parameter in command.params:
        if isinstance(parameter, click.Argument):
            if rng.random() < 0.92:
                arguments += [
                    _argument(rng, parameter) for _ in range(1 if parameter.nargs == 1 else 2)
                ]
        elif isinstance(parameter, click.Option) and (parameter.required or rng.random() < 0.25):
            arguments.append(pick(rng, (*parameter.opts, *parameter.secondary_opts)))
            if not parameter.is_flag:
                arguments += [_argument(rng, parameter) for _ in range(parameter.nargs)]
    if rng.random() < 0.2 and arguments:
        at = int(rng.integers(len(arguments)))
        arguments[at : at + 1] = pick(
            rng, ([], [arguments[at]] * 2, [misspelt(rng, arguments[at])], [pick(rng, TEXTS)])
        )
    arguments = [one for one in arguments if one not in ("/proc/self/mem",)]
    return Case(kind="argv", arguments=tuple(arguments), folder=folder)
