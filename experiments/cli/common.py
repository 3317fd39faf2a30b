"""Exit codes, options and the command group that all commands share."""

import contextlib
import functools
import json
import math
import pkgutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import click
from click.shell_completion import CompletionItem

from touchdown.experiments.config.files import LARGEST
from touchdown.experiments.errors import nearest, usage_errors

EXIT_DONE, EXIT_FAILED, EXIT_USAGE, EXIT_INTERRUPTED, EXIT_TERMINATED = 0, 1, 2, 130, 143
T = TypeVar("T")


class TerminatedError(KeyboardInterrupt):
    """The process got SIGTERM."""


def interrupt_code(error: BaseException | None) -> int:
    """The exit code after Ctrl-C or SIGTERM: 128 and the number of the signal."""
    return EXIT_TERMINATED if isinstance(error, TerminatedError) else EXIT_INTERRUPTED


@contextlib.contextmanager
def resumable(what: str) -> Iterator[None]:
    """Says at Ctrl-C or SIGTERM that ``what`` is finished is kept."""
    try:
        yield
    except KeyboardInterrupt as error:
        raise click.Abort(f"stopped; finished {what}") from error  # click prints nothing of it


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


class Parsed(click.ParamType):
    """Text of the form ``name``, read by a function that raises ValueError for any other text.
    ``example``: what the error shows."""

    def __init__(self, name: str, example: str, read: Callable[[str], Any]) -> None:
        self.name, self._example, self._read = name, example, read

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if not isinstance(value, str):
            return value
        try:
            return self._read(value)
        except ValueError:
            self.fail(f"'{value}' is not of the form {self.name}, {self._example}", param, ctx)


def finite_numbers(text: str, count: int) -> tuple[float, ...]:
    """``count`` numbers with commas between them. Raises ValueError for other text."""
    numbers = tuple(map(float, text.split(",")))
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ValueError
    return numbers


PATH = click.Path(path_type=Path)
JOB_COUNT = click.IntRange(1, 1024)
PROFILE = click.Choice(["ideal", "field", "harsh"])
LIGHT = click.Choice(["day", "overcast", "dusk", "night"])
"""Names of `scenes.api.Light`, repeated so that help is instant."""
SEEDS = click.IntRange(0, LARGEST)
"""Whole numbers that tables of results have room for."""

JSON = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
QUIET = click.option("--quiet", is_flag=True, help="No progress on stderr.")
OVERRIDES = click.option(
    "--set", "overrides", multiple=True, metavar="KEY=VALUE",
    help="Any key of the configuration, such as survey.height_m=20. May be repeated.",
)  # fmt: skip
CONFIG = click.option("--config", "config_file", type=PATH,
                      help="A TOML file, or the config.json of an earlier run.")  # fmt: skip
SEED = click.option("--seed", type=SEEDS, default=0, show_default=True)
JOBS = click.option("--jobs", type=JOB_COUNT, help="Flights at a time.  [cores]")
ONE_JOB = click.option("--jobs", type=JOB_COUNT, default=1, show_default=True)
PRESET = click.option(
    "--preset", type=click.Choice(["whole", "short", "park"]),
    help="How much is flown: short is one leg of 12 m at 15 m.  [whole]",
)  # fmt: skip


def many(*options: Callable[[T], T]) -> Callable[[T], T]:
    """A decorator that adds several options, the first of them on top."""

    def add(command: T) -> T:
        return functools.reduce(lambda done, option: option(done), reversed(options), command)

    return add


def answer(
    figures: Any, as_json: bool, show: Callable[[Any], object], *, good: object = True
) -> int:
    """Prints ``figures`` as one JSON object, or calls ``show`` with them. Returns the exit code:
    EXIT_FAILED for what is not ``good``."""
    if as_json:
        click.echo(json.dumps(figures, indent=2))
    else:
        show(figures)
    return EXIT_DONE if good else EXIT_FAILED


def answered(show: Callable[[Any], object]) -> Callable[[Callable[..., Any]], Callable[..., int]]:
    """Decorator of a command that returns figures: adds ``--json``, and prints them as `answer`
    does. Its ValueError and OSError are mistakes of the user."""

    def decorate(command: Callable[..., Any]) -> Callable[..., int]:
        @functools.wraps(command)
        def run(as_json: bool, **options: Any) -> int:
            return answer(usage_errors(lambda: command(**options)), as_json, show)

        return JSON(run)

    return decorate


def completed(names: Callable[[], Iterable[str]]) -> Callable[..., list[CompletionItem]]:
    """What a shell completes of an argument: names, and files where none begins so."""

    def complete(
        _context: click.Context, _param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        found = [CompletionItem(name) for name in names() if name.startswith(incomplete)]
        return found or [CompletionItem(incomplete, type="file")]

    return complete


def _scene_names() -> list[str]:
    from touchdown.scenes.registry import scene_names

    return scene_names()


SCENES = completed(_scene_names)
VEHICLE_NAMES = ("quadrotor", "small_quadrotor", "hexarotor", "coaxial_x8")
"""Those of `scenes.api.VEHICLES`, repeated so that help and completion are instant."""
VEHICLE = click.option(
    "--vehicle", metavar="NAME|FILE.xml", shell_complete=completed(lambda: VEHICLE_NAMES),
    help="Of `touchdown vehicles list`, or an MJCF file.  [quadrotor]",
)  # fmt: skip

RIG_NAMES = (
    "all_round", "fisheye", "global_shutter", "mid360_side", "os1_side", "tilted", "two_lidars",
    "xt16_side",
)  # fmt: skip
"""Those of `experiments.config.rigs.RIGS`, likewise."""
RIG = click.option(
    "--rig", metavar="NAME|FILE.toml", shell_complete=completed(lambda: RIG_NAMES),
    help=f"Other cameras and LIDARs: {', '.join(RIG_NAMES)}, or a file of keys.",
)  # fmt: skip


class CommandGroup(click.Group):
    """Command group whose error for an unknown command names the nearest one, and which imports
    the command that is run and no other. ``modules``: names of commands and their MODULE:ATTRIBUTE
    in `experiments.cli`."""

    def __init__(self, *args: Any, modules: Mapping[str, str] | None = None, **options: Any):
        super().__init__(*args, **options)
        self._modules = modules or {}

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted({*super().list_commands(ctx), *self._modules})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name in self._modules and cmd_name not in self.commands:
            place = f"touchdown.experiments.cli.{self._modules[cmd_name]}"
            self.add_command(pkgutil.resolve_name(place), cmd_name)
        return super().get_command(ctx, cmd_name)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args and self.get_command(ctx, args[0]) is None and not args[0].startswith("-"):
            known = self.list_commands(ctx)
            raise click.UsageError(
                f"unknown command '{args[0]}'{nearest(args[0], known)}; known: {', '.join(known)}"
            )
        return super().resolve_command(ctx, args)
