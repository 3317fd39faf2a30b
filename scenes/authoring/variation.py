"""Other materials and other water than scenes are planned with, in a context."""

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar
from typing import NamedTuple

from touchdown.scenes.api import Bytes


class Variation(NamedTuple):
    """Other materials and other water than a scene is planned with."""

    materials: Bytes
    """(len(`scenes.authoring.ground.Ground`),) the material in place of each"""
    body: tuple[float, float, float]
    """as `scenes.authoring.water.WaterLook`, like the following"""
    clarity_m: tuple[float, float, float]
    ripple: float


_variation: ContextVar[Variation | None] = ContextVar("variation", default=None)


def present_variation() -> Variation | None:
    """That of the context; None where scenes are made as planned."""
    return _variation.get()


@contextlib.contextmanager
def varied(variation: Variation) -> Iterator[None]:
    """Makes ``variation`` the present one inside the context."""
    token = _variation.set(variation)
    try:
        yield
    finally:
        _variation.reset(token)
