"""Exit codes, options and the command group that all commands share."""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import click

from touchdown.experiments.config.files import LARGEST

EXIT_DONE, EXIT_FAILED, EXIT_USAGE, EXIT_INTERRUPTED, EXIT_TERMINATED = 0, 1, 2, 130, 143


class TerminatedError(KeyboardInterrupt):
    """The process got SIGTERM."""


def interrupt_code(error: BaseException | None) -> int:
    """The exit code after Ctrl-C or SIGTERM: 128 and the number of the signal."""
    return EXIT_TERMINATED if isinstance(error, TerminatedError) else EXIT_INTERRUPTED


class Number(click.FloatRange):
    """A finite number in a range."""

    name = "NUMBER"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"'{value}' is no finite number", param, ctx)
        return number


class SeedType(click.ParamType):
    """A whole number that tables of results have room for."""

    name = "INTEGER"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        try:
            seed = int(value)
        except ValueError:
            self.fail(f"'{value}' is no whole number", param, ctx)
        if not 0 <= seed <= LARGEST:
            self.fail(f"{value} is no seed: seeds go from 0 to {LARGEST}", param, ctx)
        return seed


SEED = SeedType()
PATH = click.Path(path_type=Path)
JSON = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
QUIET = click.option("--quiet", is_flag=True, help="No progress on stderr.")
OVERRIDES = click.option(
    "--set", "overrides", multiple=True, metavar="KEY=VALUE", help="May be repeated."
)


def answer(figures: Any, as_json: bool, show: Callable[[Any], object]) -> int:
    """Prints ``figures`` as one JSON object, or calls ``show`` with them. Returns EXIT_DONE."""
    if as_json:
        click.echo(json.dumps(figures, indent=2))
    else:
        show(figures)
    return EXIT_DONE


class CommandGroup(click.Group):
    """Command group whose error for an unknown command names the nearest one, and which imports
    the command that is run and no other. ``modules`` gives names of commands their module in
    `experiments.cli` and its attribute, as MODULE:ATTRIBUTE."""

    def __init__(self, *args: Any, modules: Mapping[str, str] | None = None, **options: Any):
        super().__init__(*args, **options)
        self._modules = modules or {}

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted({*super().list_commands(ctx), *self._modules})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name in self._modules and cmd_name not in self.commands:
            module, _, attribute = self._modules[cmd_name].partition(":")
            found = importlib.import_module(f"touchdown.experiments.cli.{module}")
            self.add_command(getattr(found, attribute), cmd_name)
        return super().get_command(ctx, cmd_name)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args and self.get_command(ctx, args[0]) is None and not args[0].startswith("-"):
            from touchdown.experiments.errors import nearest

            known = self.list_commands(ctx)
            raise click.UsageError(
                f"unknown command '{args[0]}'{nearest(args[0], known)}; known: {', '.join(known)}"
            )
        return super().resolve_command(ctx, args)
