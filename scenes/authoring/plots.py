"""Plots of ground with coordinates of their own; position and heading of the survey."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.plane import unit_circle
from touchdown.scenes.authoring.relief import Pad

SURVEY_MIDDLE_M = np.array([25.0, 20.0])
"""Middle of the survey's 50 x 40 m: ahead of the take-off spot, to the left of it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Plot:
    """A plot: ``u`` metres along ``angle`` and ``v`` metres to its left from ``origin_xy_m``;
    mirrored plots have ``v`` to the right."""

    origin_xy_m: Array
    angle: float
    mirrored: bool = False

    @property
    def axes(self) -> Array:
        """(2, 2): unit vectors of u and v as rows."""
        c, s = np.cos(self.angle), np.sin(self.angle)
        sign = -1.0 if self.mirrored else 1.0
        return np.array([[c, s], [-sign * s, sign * c]])

    def points(self, uv_m: Array) -> Array:
        """(..., 2) plot coordinates -> (..., 2) world."""
        return self.origin_xy_m + np.asarray(uv_m, np.float64) @ self.axes

    def at(self, u: float, v: float) -> Array:
        """(2,) world point."""
        return self.points(np.array([u, v]))

    def coordinates(self, xy_m: Array) -> Array:
        """(..., 2) world -> (..., 2) plot coordinates."""
        return (np.asarray(xy_m, np.float64) - self.origin_xy_m) @ self.axes.T

    def rectangle(self, u: tuple[float, float], v: tuple[float, float]) -> Array:
        """(4, 2) world corners."""
        return self.points(np.array([[u[0], v[0]], [u[1], v[0]], [u[1], v[1]], [u[0], v[1]]]))

    def ring(self, u: float, v: float, radius: float, steps: int = 32) -> Array:
        """(steps, 2) world points of a circle."""
        return self.points(np.array([u, v]) + radius * unit_circle(steps))

    def pad(self, u: float, v: float, half: tuple[float, float], blend_m: float = 3.0) -> Pad:
        """A level rectangle about (u, v)."""
        return Pad(
            centre_xy_m=self.at(u, v), half_size_m=np.array(half), angle=self.angle, blend_m=blend_m
        )

    @property
    def away(self) -> float:
        """Heading (radians) of v."""
        return self.angle + (-0.5 if self.mirrored else 0.5) * np.pi


class Area(Protocol):
    """Ground with coordinates of its own."""

    def at(self, u: float, v: float) -> Array:
        """(2,) world point."""


def scatter(
    builder: SceneBuilder,
    area: Area,
    count: int,
    u: tuple[float, float],
    v: tuple[float, float],
    gap_m: float,
) -> list[Array]:
    """Returns up to ``count`` free spots in a rectangle, at least ``gap_m`` clear, claimed."""
    rng = builder.rng
    spots = (area.at(rng.uniform(*u), rng.uniform(*v)) for _ in range(12 * count))
    return claim_free(builder, spots, count, gap_m)


def claim_free(
    builder: SceneBuilder,
    spots: Iterable[Array],
    count: int,
    gap_m: float,
    claim_m: float | None = None,
) -> list[Array]:
    """Returns the first ``count`` of ``spots`` that are ``gap_m`` clear, each claimed, by default
    with that radius."""
    found: list[Array] = []
    for spot in spots:
        if len(found) < count and builder.is_free(spot, gap_m):
            builder.claim(spot, gap_m if claim_m is None else claim_m)
            found.append(spot)
    return found


def free_spots(
    builder: SceneBuilder,
    count: int,
    tries: int,
    half_m: float,
    gap_m: float,
    fits: Callable[[Array], bool],
) -> Iterator[Array]:
    """Yields up to ``count`` of ``tries`` random spots of a square that fit and are ``gap_m``
    clear: what is placed on one keeps the next ones away."""
    found = 0
    for _ in range(tries):
        spot = builder.rng.uniform(-half_m, half_m, 2)
        if found < count and builder.is_free(spot, gap_m) and fits(spot):
            found += 1
            yield spot


def claim_area(
    builder: SceneBuilder, plot: Plot, u: tuple[float, float], v: tuple[float, float]
) -> None:
    """Reserves a rectangle of the plot against later random placements."""
    for along in np.linspace(*u, int((u[1] - u[0]) / 3.0) + 2):
        for across in np.linspace(*v, int((v[1] - v[0]) / 3.0) + 2):
            builder.claim(plot.at(float(along), float(across)), 2.2)


@dataclass(frozen=True, kw_only=True, slots=True)
class SurveyFrame:
    """Coordinates of the survey: u along the take-off heading, v to its left."""

    takeoff_xy_m: Array
    takeoff_yaw: float

    @property
    def from_takeoff(self) -> Plot:
        """Coordinates from the take-off spot."""
        return Plot(origin_xy_m=self.takeoff_xy_m, angle=self.takeoff_yaw)

    @property
    def from_middle(self) -> Plot:
        """Coordinates from the survey's middle."""
        return Plot(origin_xy_m=self.from_takeoff.points(SURVEY_MIDDLE_M), angle=self.takeoff_yaw)


def draw_frame(rng: np.random.Generator) -> SurveyFrame:
    """A frame whose survey's middle is within 2 m of the scene's along each axis: the survey
    lies in a square of 128 m for every heading."""
    yaw = float(rng.uniform(-np.pi, np.pi))
    middle = Plot(origin_xy_m=rng.uniform(-2.0, 2.0, 2), angle=yaw)
    return SurveyFrame(takeoff_xy_m=middle.points(-SURVEY_MIDDLE_M), takeoff_yaw=yaw)
