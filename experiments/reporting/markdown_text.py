"""Text of a report as Markdown. Names of scenes, methods and files come from outside: nothing of
them but `code` becomes markup, as in the HTML."""

from __future__ import annotations

import re

from touchdown.experiments.errors import visible

_MARKUP = re.compile(
    r"[\\*~$]"  # escapes, emphasis, strike-through, formulas
    r"|<(?=[A-Za-z/!?])"  # tags, comments, addresses
    r"|&(?=#?\w+;)"  # entities
    r"|\](?=[(\[:])"  # links, images, definitions
    r"|(?<![^\W_])_|_(?![^\W_])"  # emphasis, but within words
)


def markdown_text(text: str) -> str:
    """One line of text whose `code` stays code; all other markup in it is escaped."""
    line = visible(text)
    parts = line.split("`")
    if len(parts) % 2 == 0 or "" in parts[1::2]:  # stray backticks are no code
        return _begun(_plain(line).replace("`", "\\`"))
    shown = [part if n % 2 else _plain(part) for n, part in enumerate(parts)]
    return _begun("`".join(shown))


def markdown_cell(text: str) -> str:
    """`markdown_text` in the cell of a table."""
    return markdown_text(text).replace("|", "\\|")


def fenced(text: str) -> list[str]:
    """Lines of a block of code, in a fence that the text cannot close."""
    longest = max((len(run) for run in re.findall(r"`+", text)), default=0)
    fence = "`" * max(3, longest + 1)
    return [fence, visible(text.strip(), keep="\n\t"), fence]


def _plain(text: str) -> str:
    return _MARKUP.sub(lambda found: f"\\{found[0]}", text)


def _begun(line: str) -> str:
    """A line that begins no list, heading, quotation or table."""
    number = re.match(r"(\s*\d+)([.)])(?=\s|$)", line)
    if number:
        return f"{number[1]}\\{line[len(number[1]) :]}"
    return re.sub(r"^(\s*)(?=[-+=#>])", r"\1\\", line)
