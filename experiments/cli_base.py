"""What the commands of the command line share."""

from __future__ import annotations

import ctypes
import errno
import os
from collections.abc import Callable, Mapping
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
    """Landed on safe ground, of a safe class where places were recognised; for a survey alone:
    flown to its end."""
    if result["outcome"] == "COMPLETED":
        return True
    return result["outcome"] == "LANDED" and bool(ground_was_safe(result["landing"] or {}))


def ground_was_safe(landing: Mapping[str, Any]) -> bool | None:
    """By what the flight is judged on; None where the result does not say."""
    by_class = landing.get("judged_on") == "geometry and class"
    found = landing.get("safe" if by_class else "safe_geometry")
    return found if isinstance(found, bool) else None


def guarded_fly(config: Any, out: Path | None, progress: Callable[..., None]) -> dict[str, Any]:
    """Flies. What goes wrong before the first control step is bad input; after it, our fault."""
    from experiments.config import UsageError
    from experiments.flight import fly as fly_config
    from experiments.outside_estimator import OutsideError

    airborne = False

    def watch(time_s: float, phase: str, note: str) -> None:
        nonlocal airborne
        airborne = True
        progress(time_s, phase, note)

    try:
        return fly_config(config, out, watch)
    except (ValueError, OSError) as error:
        if airborne or isinstance(error, OutsideError):
            raise
        raise UsageError(input_message(error)) from error


def has_display() -> bool:
    """Whether the environment names an X11 or Wayland display."""
    names = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
    return any(os.environ.get(name) for name in names)


def rendering_backend() -> str:
    """The first of EGL and OSMesa whose library loads here, else GLFW, which needs a display."""
    for backend, library in (("egl", "libEGL.so.1"), ("osmesa", "libOSMesa.so.8")):
        try:
            ctypes.CDLL(library)
        except OSError:
            continue
        return backend
    return "glfw"


_REMEDIES = {
    errno.ENOSPC: "make room there and give the command again",
    errno.EDQUOT: "make room there and give the command again",
    errno.EROFS: "name a place that can be written to",
    errno.EACCES: "name one that you may use, or change its permissions",
    errno.EPERM: "name one that you may use, or change its permissions",
    errno.ENAMETOOLONG: "give a shorter name",
    errno.ELOOP: "its links lead in a circle; name the place itself",
    errno.ENOTDIR: "a part of that path is a file; name another",
    errno.EISDIR: "that is a directory; name a file",
    errno.EMFILE: "raise the limit on open files (ulimit -n)",
    errno.ENFILE: "raise the limit on open files (ulimit -n)",
    errno.EIO: "the disk may be full or failing",
    errno.EFBIG: "raise the limit on the size of files (ulimit -f)",
}


def system_message(error: OSError) -> str | None:
    """What to tell of an error that the machine has and not the program; None for others."""
    remedy = _REMEDIES.get(error.errno or 0)
    if remedy is None:
        return None
    names = [f"'{name}'" for name in (error.filename2 or error.filename,) if name]
    return f"{': '.join([*names, os.strerror(error.errno or 0)])}; {remedy}"


def input_message(error: ValueError | OSError) -> str:
    """What to tell of an error that bad input or the machine has caused."""
    known = system_message(error) if isinstance(error, OSError) else None
    return known or str(error)


def usage_errors(action: Callable[[], Any]) -> Any:
    """Runs ``action``; what it finds wrong with its input becomes a UsageError."""
    from experiments.config import UsageError

    try:
        return action()
    except (ValueError, OSError) as error:
        raise UsageError(input_message(error)) from error
