"""Mutations of values, trees, texts and bytes, and files that are none."""

import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

Rng = np.random.Generator

NUMBERS: tuple[Any, ...] = (
    0, -1, 1, 2, 3, 7, 100, -0.0, 0.5, 1e-300, 1e300, 1e308, 2**31, 2**53 + 1, 2**63, 2**64,
    10**30, -(2**63), 1e9, 10**9, 1e-9, -1e-9, 0.1, 3.5, 1e5, 10**5, 5e5, float("nan"),
    float("inf"), float("-inf"),
)  # fmt: skip
MARKED = (
    "[/x]", "[bold red]x[/bold red]", "<script>alert(1)</script>", "|a|b|", "`x`", "\x1b[31mred",
    "\x9b2J", "../../x", "../x", "a\ud800b", "\u202egpj", "{{ x }}", "%s%n", "](x)", "*x*", "\0",
)  # fmt: skip
"""Names that a terminal, a page, a table or a path would take for something else."""
TEXTS = (
    "", " ", "nan", "inf", "-1", "0", "1e999", "ü", "💥", "../..", "/dev/null", "/proc/self/mem",
    "a" * 5000, "'", '"', "]", "{", "null", "true", "[]", "$(x)", "1,5", "١٢", "0x10", "1_000",
    "--help", "-", "--", "crossroad", "flat", "livo", "no.xml", "a/b.xml", "os:system",
    "os.path:join", ":", "x:", ":x", "a b", "\t", "line\nline", "line\rline", "\u2028", "C:\\x",
    "~", ".", "..", "/", "//", "\udcff", "*", "?", "[a", "0-9", "9-0", "1/4", "12.5,-3", "nan,1",
    "lidar_dropout@20+1", *(text for text in MARKED if text != "\0"),
)  # fmt: skip


def pick(rng: Rng, items: Iterable[Any]) -> Any:
    """Returns one of ``items``."""
    items = list(items)
    return items[int(rng.integers(len(items)))]


def chance(rng: Rng, fraction: float) -> bool:
    """True with the given probability."""
    return bool(rng.random() < fraction)


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
    if chance(rng, 0.2):
        return value(rng)
    if isinstance(old, bool):
        return not old
    if isinstance(old, int | float):
        if chance(rng, 0.3):
            return pick(rng, NUMBERS)
        scaled = old * float(pick(rng, (-1, 0, 0.001, 0.1, 0.5, 1, 1.5, 2, 3, 10, 1000)))
        whole = isinstance(old, int) and np.isfinite(scaled) and chance(rng, 0.9)
        return round(scaled) if whole else scaled
    if isinstance(old, list):
        changed = [neighbour(rng, item) if chance(rng, 0.5) else item for item in old]
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
            word[:at] + word[at + 1 :], word[:at] + letter + word[at:],
            word[:at] + letter + word[at + 1 :], word.upper(), word + "." + word, word,
        ),
    )  # fmt: skip


def mutate_tree(rng: Rng, tree: Any) -> None:
    """Changes, renames, removes, adds, doubles or nests one thing somewhere in a dictionary."""
    key, inner = _somewhere(rng, tree)
    while True:
        if isinstance(inner, list) and inner and chance(rng, 0.6):
            at = int(rng.integers(len(inner)))
            if isinstance(inner[at], dict) and chance(rng, 0.7):
                tree = inner[at]
                key, inner = _somewhere(rng, tree)
                continue
            _mutate_list(rng, inner, at)
            return
        if not (isinstance(inner, dict) and inner and chance(rng, 0.7)):
            break
        tree = inner
        key, inner = _somewhere(rng, tree)
    kind = int(rng.integers(6))
    if kind == 0 and key in tree:
        del tree[key]
    elif kind == 1 and key in tree:
        tree[misspelt(rng, key)] = tree.pop(key)
    elif kind in (2, 3):
        tree[key] = neighbour(rng, inner)
    elif kind == 4:
        tree[key] = pick(rng, ([inner], {key: inner}, [inner, inner], None, str(inner)))
    else:
        tree[pick(rng, ("seeds", "seed", "extra", "name", "wind_kmh", *TEXTS[:6]))] = value(rng)


def _somewhere(rng: Rng, tree: dict[str, Any]) -> tuple[str, Any]:
    key = pick(rng, tree) if tree else "x"
    return key, tree.get(key)


def _mutate_list(rng: Rng, items: list[Any], at: int) -> None:
    new = pick(rng, ([], [items[at]] * 2, *[[neighbour(rng, items[at])]] * 2))
    items[at : at + 1] = new


def mutate_rows(rng: Rng, rows: list[list[str]], odd: Iterable[Any]) -> None:
    """Changes a word of a table, or cuts, doubles, moves or removes one of its rows."""
    if not rows:
        return
    row = pick(rng, rows)
    at = int(rng.integers(max(len(row), 1)))
    kind = int(rng.integers(9))
    if kind < 3 and row:
        row[at] = str(pick(rng, odd))
    elif kind == 3:
        del row[at:]
    elif kind == 4:
        row.insert(at, str(pick(rng, odd)))
    elif kind == 5:
        rows.insert(int(rng.integers(len(rows))), list(row))
    elif kind == 6:
        rows.remove(row)
    elif kind == 7:
        del rows[int(rng.integers(3)) :]
    else:
        rows[:] = rows[len(rows) // 2 :] + rows[: len(rows) // 2]


def toml_text(tree: Mapping[str, Any]) -> str:
    """TOML with dotted keys; values that TOML cannot hold are left out."""
    lines = [
        f"{toml_key(key)} = {toml_value(item)}" for key, item in tree.items() if item is not None
    ]
    return "\n".join(lines) + "\n"


def toml_key(key: str) -> str:
    """A dotted key, its parts quoted where they have to be."""
    return ".".join(
        part if part.isidentifier() and part.isascii() else json.dumps(part)
        for part in key.split(".")
    )


def toml_value(item: Any) -> str:
    """A value of TOML."""
    if isinstance(item, bool):
        return "true" if item else "false"
    if isinstance(item, list | tuple):
        return "[" + ", ".join(toml_value(part) for part in item if part is not None) + "]"
    if isinstance(item, dict):
        return "{" + ", ".join(f"{json.dumps(k)} = {toml_value(v)}" for k, v in item.items()) + "}"
    if isinstance(item, str):
        return json.dumps(item, ensure_ascii=False)
    return repr(item)


def json_text(rng: Rng, tree: Any) -> str:
    """JSON, now and then with what Python's own reader takes and others do not, nested too deeply
    or with too many digits."""
    text = json.dumps(tree, ensure_ascii=chance(rng, 0.7))
    if not chance(rng, 0.12):
        return text
    return pick(rng, (
        "[" * 100_000 + "]" * 100_000, '{"a":' * 20_000 + "1" + "}" * 20_000, f"[{text}]",
        text + text, text.replace("1", "9" * 6000, 1), text.replace(":", ': NaN, "x":', 1),
        text[:-1] + ', "big": 1e999}',
    ))  # fmt: skip


def toml_oddity(rng: Rng, text: str) -> str:
    """``text`` with something that a reader of TOML may stumble over."""
    return pick(rng, (
        *(text + line for line in (
            f"a = {'1' * 5000}\n", "a = " + "[" * 3000 + "]" * 3000 + "\n", "[a]\n[a]\n",
            "a." * 3000 + "a = 1\n", "when = 2020-01-01T00:00:00Z\n", "a = 07:32:00\n",
            f"seed = {'9' * 400}\n", "seed = 0x7fffffffffffffffffff\n", "\0", text,
        )),
        "\ufeff" + text, text.replace("\n", "\r"), "[[sim]]\n" + text, "sim = 3\n" + text,
    ))  # fmt: skip


def damaged(rng: Rng, data: bytes) -> bytes:
    """``data`` as a bad disk, a wrong editor or a lost connection would leave it."""
    at, end = sorted(int(x) for x in rng.integers(0, len(data) + 1, 2))
    noise = bytes(rng.integers(0, 256, int(rng.integers(1, 300)), dtype=np.uint8))
    lines = data.split(b"\n")
    rng.shuffle(lines)  # type: ignore[arg-type]
    return pick(rng, (
        data[:at], data[:at] + data[end:], data[:at] + noise[:8] + data[at + 8 :], b"", noise,
        data[:at] + data[at:end][:200] * 2 + data[end:], b"\xef\xbb\xbf" + data,
        data.replace(b"\n", b"\r\n"), data.decode("utf-8", "replace").encode("utf-16"),
        data[:at] + "größe".encode("latin-1") + data[at:], data[:at] + b"\0" + data[at:],
        b"\n".join(lines), *[flipped(rng, data)] * 2,
    ))  # fmt: skip


def flipped(rng: Rng, data: bytes) -> bytes:
    """``data`` with one to ten other bytes."""
    changed = bytearray(data)
    for at in rng.integers(0, max(len(data), 1), int(rng.integers(1, 11))):
        if data:
            changed[int(at)] = int(rng.integers(256))
    return bytes(changed)


def encoded(text: str) -> bytes:
    """UTF-8; lone surrogates stay what they are."""
    return text.encode("utf-8", "surrogatepass")


def put(rng: Rng, path: Path, data: str | bytes, fraction: float = 0.25) -> Path:
    """Writes ``data``, damaged with the given probability, seldom as a file that is none."""
    data = encoded(data) if isinstance(data, str) else data
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir() and not path.is_symlink():
        path.rmdir()
    path.unlink(missing_ok=True)  # it may be a pipe, or a link to elsewhere
    if not chance(rng, fraction):
        path.write_bytes(data)
    elif chance(rng, 0.2):
        put_special(rng, path)
    else:
        path.write_bytes(damaged(rng, data))
    return path


def put_special(rng: Rng, path: Path) -> None:
    """Puts something at ``path`` that is no ordinary file."""
    targets = (path.name, "/dev/zero", "gone", "/dev/null")  # the first is a circle
    links = [lambda target=target: path.symlink_to(target) for target in targets]
    pick(rng, (lambda: os.mkfifo(path), path.mkdir, path.touch, *links))()
