"""Cases over configurations, campaign files and command lines."""

import json
import os
from functools import cache
from pathlib import Path
from typing import Any

import click
import numpy as np

from touchdown.experiments.cli import main as cli
from touchdown.experiments.config.keys import flatten
from touchdown.experiments.config.loading import dump_config, known_keys
from touchdown.experiments.config.schema import Config

from fuzz.cases import Case
from fuzz.mutations import (
    MARKED,
    NUMBERS,
    TEXTS,
    Rng,
    chance,
    json_text,
    misspelt,
    mutate_tree,
    neighbour,
    pick,
    put,
    toml_oddity,
    toml_text,
    toml_value,
    value,
)

_SANE_SCENES = ("flat", "crossroad", "lake")

FLOOR = """<mujoco><worldbody><geom name="lawn" type="plane" size="40 40 1"/>
<geom name="building" type="box" size="1 1 1" pos="9 0 1"/></worldbody></mujoco>"""


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
    if key in ("scene", "estimator") and chance(rng, 0.5):
        changed = pick(rng, (*_SANE_SCENES, "livo", "gps", "stereo"))
    return key, changed


def set_text(rng: Rng, key: str, item: Any) -> str:
    """``KEY=VALUE``"""
    raw = toml_value(item) if chance(rng, 0.8) else str(item)
    text = f"{key}={raw}"
    return misspelt(rng, text) if chance(rng, 0.08) else text


def toml_case(rng: Rng, folder: Path, _shared: Path) -> Case:
    """``--config FILE.toml`` and ``--set KEY=VALUE``."""
    tree = dict(setting(rng) for _ in range(int(rng.integers(0, 6))))
    text = toml_text(tree)
    if chance(rng, 0.15):
        text = toml_oddity(rng, text)
    name = pick(rng, ("a.toml", "a.toml", "größe und form.toml", "noext", "[x].toml"))
    target = str(put(rng, folder / name, text, 0.2).relative_to(folder))
    if chance(rng, 0.03):
        target = pick(rng, (".", "gone.toml", "a\nb", "", "/dev/null", "/dev/zero"))
    count = int(pick(rng, (0, 0, 0, 1, 2, 4)))
    given = [set_text(rng, *setting(rng)) for _ in range(count)]
    options = [part for text in given for part in ("--set", text)]
    return Case(arguments=(_flight(rng), "flat", "--config", target, *options, "--quiet"))


def _flight(rng: Rng) -> str:
    """Mostly without the network, which takes half a second to load."""
    return str(pick(rng, ("fly", "fly", "fly", "fly", "land")))


def config_document(rng: Rng) -> dict[str, Any]:
    """A ``config.json``, with up to three changes."""
    document: dict[str, Any] = json.loads(dump_config(Config(scene="flat", estimator="gps")))
    for _ in range(int(rng.integers(0, 4))):
        group = pick(rng, document)
        inner = document[group]
        if isinstance(inner, dict) and inner and chance(rng, 0.8):
            key = pick(rng, inner)
            inner[misspelt(rng, key) if chance(rng, 0.2) else key] = neighbour(rng, inner[key])
        else:
            document[group] = value(rng)
    return document


def config_json_case(rng: Rng, folder: Path, _shared: Path) -> Case:
    """``--config config.json`` of an earlier run."""
    put(rng, folder / "config.json", json_text(rng, config_document(rng)), 0.2)
    return Case(arguments=(_flight(rng), "flat", "--config", "config.json", "--quiet"))


def _campaign(rng: Rng) -> dict[str, Any]:
    tree: dict[str, Any] = {
        "name": pick(rng, ("fuzz", "fuzz", "fuzz", *MARKED)), "mode": pick(rng, ("fly", "land")),
        "record": pick(rng, ("none", "all", "failures")),
        "axes": {
            "scene": [pick(rng, _SANE_SCENES)],
            "estimator": [pick(rng, ("gps", "livo", "oracle"))],
            "seeds": pick(rng, ("0-3", "1,4-5", "7")),
        },
        "base": {}, "limits": {"run_timeout_s": 100.0},
    }  # fmt: skip
    for _ in range(int(pick(rng, (0, 0, 1)))):
        key, item = setting(rng)
        tree["base"][key] = item
    for _ in range(int(pick(rng, (0, 0, 1)))):
        key, item = setting(rng)
        tree["axes"][key] = [item, neighbour(rng, item)] if chance(rng, 0.7) else item
    if chance(rng, 0.4):
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


def campaign_case(rng: Rng, folder: Path, _shared: Path) -> Case:
    """``campaign FILE.toml``."""
    tree = _campaign(rng)
    for _ in range(int(pick(rng, (0, 0, 0, 1, 1, 2)))):
        mutate_tree(rng, tree)
    text = toml_text(tree)
    if chance(rng, 0.08):
        text = toml_oddity(rng, text)
    name = pick(rng, ("c.toml", "c.toml", "c.json", "ü ü.toml"))
    file = put(rng, folder / name, text, 0.15)
    out = folder / pick(rng, ("out", "out", "tief/er/out", "c.toml"))
    if chance(rng, 0.15):
        if not (out.is_file() or out.is_symlink()):
            out.mkdir(parents=True, exist_ok=True)
        if out.is_dir():
            inner = pick(rng, ("campaign.json", "thesis.tex", ".lock", "campaign.toml"))
            put(rng, out / inner, "{}", 0.5)
    extra = pick(rng, ((), (), ("--shard", pick(rng, ("1/2", "0/2", "3/2", "1/1", "x")))))
    extra = (*extra, *pick(rng, ((), (), ("--json",), ("--jobs", str(pick(rng, NUMBERS))))))
    target = str(out.relative_to(folder))
    arguments = ("campaign", file.name, "--out", target, "--quiet", *extra)
    return Case(arguments=arguments, writes=(target,))


def leaves(
    group: Any = cli.cli, path: tuple[str, ...] = ()
) -> list[tuple[tuple[str, ...], click.Command]]:
    """Every command that does something, and its path."""
    if not isinstance(group, click.Group):
        return [(path, group)]
    found = []
    context = click.Context(group)
    for name in group.list_commands(context):
        found += leaves(group.get_command(context, name), (*path, name))
    return found


_FLYING = ("land", "fly", "campaign", "export", "view", "report", "regress", "scenes")
_LEARNING = ("train", "evaluate", "classify", "quantize")
"""commands that need torch or a network's file"""

_VALUES: dict[str, tuple[str, ...]] = {
    "scene": (*_SANE_SCENES, "crossrod", "floor.xml", "gone.xml"),
    "estimator": ("livo", "gps", "oracle", "lvio", "os:getcwd", "os.path:sep"),
    "seeds": ("0-3", "5", "3-1", "1,2", "0-99999999999", "-", "0--1", "²"),
    "site": ("1,2", "1e400,0", "1;2", "1,2,3", " 1 , 2 "),
    "shard": ("1/2", "2/1", "0/0", "1/0", "x/y"),
    "sql": ("select 1", "selec", "", "select * from runs", "select [1, {'a': 2}]"),
}
_FILES = (
    "floor.xml", "empty.toml", "empty.json", "a folder", "gone", "new/er", "new.png", "new.jpg",
    "noise.bin", "a folder/inner", "fifo", "circle", "zero",
)  # fmt: skip


def _argument(rng: Rng, parameter: click.Parameter) -> str:
    """Returns a value for a parameter, mostly a nearly valid one."""
    if chance(rng, 0.25):
        return str(pick(rng, TEXTS)).replace("\0", "")
    kind = parameter.type
    if isinstance(kind, click.Choice):
        word = str(pick(rng, kind.choices))
        return misspelt(rng, word) if chance(rng, 0.2) else word
    if isinstance(kind, click.types.IntParamType | click.types.FloatParamType):
        return str(pick(rng, (*NUMBERS, "1,5", "1e3", "3", "2", "1", "0.5")))
    name = str(parameter.name)
    if name == "overrides":
        return set_text(rng, *setting(rng))
    if name == "fault":
        fault = pick(rng, ("lidar_dropout", "camera_blackout", "gps_jump", "x"))
        return f"{fault}@{pick(rng, NUMBERS)}+{pick(rng, NUMBERS)}"
    same = {"scenes": "scene", "names": "scene", "name": "estimator"}
    return str(pick(rng, _VALUES.get(same.get(name, name), _FILES)))


def argv_case(rng: Rng, folder: Path, _shared: Path) -> Case:
    """A command line of any command, for the most part well formed."""
    (folder / "floor.xml").write_text(FLOOR)
    (folder / "empty.toml").touch()
    (folder / "empty.json").write_text("{}")
    (folder / "noise.bin").write_bytes(bytes(rng.integers(0, 256, 400, dtype=np.uint8)))
    (folder / "a folder").mkdir()
    _put_specials(folder)
    path, command = pick(rng, [leaf for leaf in leaves() if leaf[0][0] not in _LEARNING])
    if path[0] == "bench" and chance(rng, 0.8):  # half of all commands, and they measure for long
        path, command = pick(rng, [leaf for leaf in leaves() if leaf[0][0] in _FLYING])
    arguments = list(path)
    for parameter in command.params:
        if isinstance(parameter, click.Argument):
            if chance(rng, 0.92):
                arguments += [
                    _argument(rng, parameter) for _ in range(1 if parameter.nargs == 1 else 2)
                ]
        elif isinstance(parameter, click.Option) and (parameter.required or chance(rng, 0.25)):
            arguments.append(pick(rng, (*parameter.opts, *parameter.secondary_opts)))
            if not parameter.is_flag:
                arguments += [_argument(rng, parameter) for _ in range(parameter.nargs)]
    if chance(rng, 0.2) and arguments:
        at = int(rng.integers(len(arguments)))
        arguments[at : at + 1] = pick(
            rng, ([], [arguments[at]] * 2, [misspelt(rng, arguments[at])], [pick(rng, TEXTS)])
        )
    arguments = [_as_given(one) for one in arguments if one != "/proc/self/mem"]
    can_be_quiet = any(option.name == "quiet" for option in command.params)
    if chance(rng, 0.5) and can_be_quiet:
        arguments.append("--quiet")
    # It says how far it is, and cannot be quiet.
    noisy = path == ("scenes", "check") or (can_be_quiet and "--quiet" not in arguments)
    return Case(arguments=tuple(arguments), writes=("*",), noisy=noisy)


def _as_given(word: str) -> str:
    """What a system can hand to a program: bytes without zeros."""
    word = word.replace("\0", "")
    try:
        os.fsencode(word)
    except UnicodeEncodeError:
        return word.encode("utf-8", "replace").decode("utf-8")
    return word


def _put_specials(folder: Path) -> None:
    os.mkfifo(folder / "fifo")
    (folder / "circle").symlink_to("circle")
    (folder / "zero").symlink_to("/dev/zero")
