"""Places of mutations in the source: found by syntax tree, replaced as text.

An entry names a file below ``src/touchdown``, a function, method or class in it (or nothing: the
module) and a statement. Formatting, comments and line numbers do not matter. A statement may be
several that follow one another, or the header of a compound statement (``if``, ``for``, ``while``,
``with``, ``def``) with its colon, which leaves the body as it is.
"""

import ast
import functools
import io
import tokenize
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

SOURCES = Path("src/touchdown")
Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
BODIES = ("body", "orelse", "finalbody")


@dataclass(frozen=True)
class Mutation:
    """One change of the source and the tests that should fail with it. ``survives`` is the reason
    why none does: the change has no effect, or seeing it costs too much."""

    name: str
    function: str
    statement: str
    becomes: str
    tests: tuple[str, ...]
    survives: str = ""

    @property
    def path(self) -> Path:
        """Of the mutated file, from the root of the project."""
        return SOURCES / self.function.partition("::")[0]

    @property
    def qualified(self) -> str:
        """Name of the function, method or class; empty for the module."""
        return self.function.partition("::")[2]

    @property
    def area(self) -> str:
        return self.name.partition(":")[0]


class PlaceError(Exception):
    """A mutation that has no place, or more than one."""


def load(folder: Path) -> list[Mutation]:
    """Mutations of the TOML files of a folder, in order of file and line."""
    tables = [
        table
        for path in sorted(folder.glob("*.toml"))
        for table in tomllib.loads(path.read_text(encoding="utf-8"))["mutation"]
    ]
    return [Mutation(**{**table, "tests": tuple(table["tests"])}) for table in tables]


def mutated(text: str, mutation: Mutation) -> str:
    """``text`` of the file with the one statement replaced. Raises ``PlaceError``."""
    scope: ast.AST = _tree(text)
    for name in filter(None, mutation.qualified.split(".")):
        inner = [node for node in _definitions(scope) if node.name == name]
        if len(inner) != 1:
            raise PlaceError(f"{mutation.function}: {name} is defined {len(inner)} times")
        scope = inner[0]
    wanted, is_header = _parsed(mutation.statement)
    meant = meaning(mutation.statement)
    found = [
        (block[i], block[i + len(wanted) - 1])
        for block in _blocks(scope)
        for i in range(len(block) - len(wanted) + 1)
        if [_dump(node, is_header) for node in block[i : i + len(wanted)]] == meant
    ]
    if len(found) != 1:
        raise PlaceError(f"{mutation.function}: {len(found)} times `{mutation.statement.strip()}`")
    return _replaced(text, *found[0], mutation.becomes, is_header)


def meaning(statement: str) -> list[str]:
    """The syntax trees of a ``Mutation.statement``, as text."""
    nodes, is_header = _parsed(statement)
    return [_dump(node, is_header) for node in nodes]


_tree = functools.lru_cache(maxsize=1)(ast.parse)  # mutations of one file follow one another


def _definitions(scope: ast.AST) -> Iterator[Definition]:
    """Functions and classes that are defined in a scope itself."""
    for block in _blocks(scope):
        yield from (node for node in block if isinstance(node, Definition))


def _blocks(node: ast.AST) -> Iterator[list[ast.stmt]]:
    """Lists of statements of a scope, nested ones too, those of inner scopes not."""
    for field in BODIES:
        block = getattr(node, field, None)
        if isinstance(block, list):
            yield block
            for inner in block:
                if not isinstance(inner, Definition):
                    yield from _blocks(inner)
    for part in (*getattr(node, "handlers", ()), *getattr(node, "cases", ())):
        yield from _blocks(part)


def _parsed(statement: str) -> tuple[list[ast.stmt], bool]:
    """(statements, whether it is a header)."""
    text = statement.strip()
    try:
        return ast.parse(text).body, False
    except SyntaxError:
        return ast.parse(text.removeprefix("el") + "\n    pass").body, True


def _dump(node: ast.stmt, is_header: bool) -> str:
    """The tree of a statement, of a header without the body and what follows it."""
    if not is_header:
        return ast.dump(node)
    kept = {
        name: value
        for name, value in ast.iter_fields(node)
        if name not in (*BODIES, "handlers", "decorator_list")
    }
    return f"{type(node).__name__} " + ast.dump(type(node)(**kept))


def _replaced(text: str, first: ast.stmt, last: ast.stmt, becomes: str, is_header: bool) -> str:
    """``text`` with the characters of statements ``first`` to ``last`` replaced."""
    lines = text.splitlines(keepends=True)
    start = _offset(lines, first.lineno, first.col_offset)
    assert last.end_lineno is not None and last.end_col_offset is not None
    end = _offset(lines, last.end_lineno, last.end_col_offset)
    if is_header:
        end = start + _header_length(text[start:end])
    new = becomes.strip()
    if text.startswith("elif", start) and new.startswith("if"):
        new = f"el{new}"
    line = lines[first.lineno - 1]
    indent = line[: len(line) - len(line.lstrip())]
    return text[:start] + new.replace("\n", f"\n{indent}") + text[end:]


def _offset(lines: list[str], line: int, column: int) -> int:
    """In characters, of a position that counts bytes within its line."""
    before = lines[line - 1].encode()[:column].decode()
    return sum(map(len, lines[: line - 1])) + len(before)


def _header_length(text: str) -> int:
    """Characters up to and with the colon that ends the header of a compound statement."""
    depth = 0
    lines = text.splitlines(keepends=True)
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.OP:
            depth += (token.string in "([{") - (token.string in ")]}")
            if token.string == ":" and depth == 0:
                row, column = token.end
                return sum(map(len, lines[: row - 1])) + column
    raise PlaceError(f"no header in {lines[0]}")
