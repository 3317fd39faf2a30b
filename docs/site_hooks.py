"""What makes a site of pages that are written for GitHub. MkDocs calls these functions by name.

The pages in the root (README and others) become pages of the site; no text is kept twice.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent

ROOT_PAGES = {
    "README.md": "index.md",
    "ARCHITECTURE.md": "architecture.md",
    "CONVENTIONS.md": "conventions.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
"""File in the root: page of the site."""
COMMANDS_PAGE = "commands.md"
"""Page with the help of every command."""
CONFIGURATION_PAGE = "configuration.md"
"""Page with every configuration key."""
WIDTH = 96
"""Columns of the help."""

_LINK = re.compile(r"(?<=\]\()([^)\s#:]+)(?=[)#])")
_EXAMPLE = re.compile(r"^\[.*\]\(\.\./(examples/\w+\.py)\)$", re.MULTILINE)
"""A link to an example, on a line of its own."""


def anchor(heading: str, separator: str = "-") -> str:
    """The anchor that GitHub gives to a heading, so that links hold in both places."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", separator)


def links_of_the_site(text: str, source: str) -> str:
    """Markdown whose relative links hold in the site.

    source: path of the page in the repository. Links to files that are no part of the site stay
    as they are; the build refuses them.
    """
    page = ROOT_PAGES.get(source) or source.removeprefix("docs/")

    def moved(match: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), match[1]))
        if target in ROOT_PAGES:
            target = f"docs/{ROOT_PAGES[target]}"
        if not target.startswith("docs/"):
            return match[1]
        return posixpath.relpath(target.removeprefix("docs/"), posixpath.dirname(page) or ".")

    return _LINK.sub(moved, text)


def with_examples(text: str) -> str:
    """Markdown with the code of each example in place of the link to it."""

    def printed(match: re.Match[str]) -> str:
        return f"```python\n{(ROOT / match[1]).read_text(encoding='utf-8')}```"

    return _EXAMPLE.sub(printed, text)


def help_of_commands() -> str:
    """Markdown with what ``--help`` of every command prints."""
    import click

    from touchdown.experiments.cli.main import cli

    def sections(command: click.Command, name: str, parent: click.Context | None) -> Iterator[str]:
        context = click.Context(
            command, parent, name, terminal_width=WIDTH, max_content_width=WIDTH
        )
        text = command.get_help(context)
        if "COMMAND [ARGS]" not in text:  # some groups do something by themselves
            yield f"## {context.command_path}\n\n```text\n{text}\n```\n"
        if isinstance(command, click.Group):
            for inner in command.list_commands(context):
                found = command.get_command(context, inner)
                assert found is not None
                yield from sections(found, inner, context)

    return "# Command line\n\n" + "\n".join(sections(cli, "touchdown", None))


def on_config(config: Any) -> Any:
    config.mdx_configs["toc"]["slugify"] = anchor
    config.watch.extend(str(ROOT / name) for name in ROOT_PAGES)
    return config


def on_files(files: Any, config: Any) -> Any:
    from mkdocs.structure.files import File

    from touchdown.experiments.config.reference import reference_page

    for source, page in ROOT_PAGES.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=links_of_the_site(text, source)))
    files.append(File.generated(config, COMMANDS_PAGE, content=help_of_commands()))
    files.append(File.generated(config, CONFIGURATION_PAGE, content=reference_page()))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    if page.file.src_uri in ROOT_PAGES.values():
        return markdown
    return links_of_the_site(with_examples(markdown), f"docs/{page.file.src_uri}")
