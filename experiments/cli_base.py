"""What the commands of the command line share."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

EXIT_DONE, EXIT_FAILED, EXIT_USAGE, EXIT_INTERRUPTED = 0, 1, 2, 130


class CommandGroup(click.Group):
    """Names the nearest command for an unknown one."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args and self.get_command(ctx, args[0]) is None and not args[0].startswith("-"):
            from experiments.suggest import nearest

            known = self.list_commands(ctx)
            raise click.UsageError(
                f"unknown command '{args[0]}'{nearest(args[0], known)}; known: {', '.join(known)}"
            )
        return super().resolve_command(ctx, args)


def is_good(result: dict[str, Any]) -> bool:
    """Landed on safe ground; for a survey alone: flown to its end."""
    if result["outcome"] == "COMPLETED":
        return True
    landing = result["landing"] or {}
    return result["outcome"] == "LANDED" and bool(landing.get("safe_geometry"))


def guarded_fly(config: Any, out: Path | None, progress: Callable[..., None]) -> dict[str, Any]:
    """Flies. What goes wrong before the first control step is bad input; after it, our fault."""
    from experiments.config import UsageError
    from experiments.flight import fly as fly_config

    airborne = False

    def watch(time_s: float, phase: str, note: str) -> None:
        nonlocal airborne
        airborne = True
        progress(time_s, phase, note)

    try:
        return fly_config(config, out, watch)
    except (ValueError, OSError) as error:
        if airborne:
            raise
        raise UsageError(str(error)) from error


def rendering_backend() -> str:
    """The first of EGL and OSMesa whose library loads here, else GLFW, which needs a display."""
    for backend, library in (("egl", "libEGL.so.1"), ("osmesa", "libOSMesa.so.8")):
        try:
            ctypes.CDLL(library)
        except OSError:
            continue
        return backend
    return "glfw"


def usage_errors(action: Callable[[], Any]) -> Any:
    """Runs ``action``; what it finds wrong with its input becomes a UsageError."""
    from experiments.config import UsageError

    try:
        return action()
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from error
