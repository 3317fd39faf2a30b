"""Parts of all three kinds of turf: lines, edge planting, a footpath."""

from itertools import pairwise
from typing import Protocol

import numpy as np

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.ground import Canvas
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plane import pick, unit
from touchdown.scenes.authoring.plots import Plot
from touchdown.scenes.authoring.relief import HALF_M, NODES
from touchdown.scenes.props.street import add_bench, add_bin, add_lamp
from touchdown.scenes.props.woods import TRUNKS_M, Wood, add_broadleaf, add_conifer, add_shrub

LINE_M = 0.12


class Turf(Protocol):
    """One kind of turf: its relief first, then its texture, then its objects."""

    plot: Plot

    def shape(self, heights: Array, xy: Array) -> Array: ...

    def pools(self, xy: Array) -> Array: ...

    def paint(self, canvas: Canvas, rng: np.random.Generator) -> None: ...

    def build(self, builder: SceneBuilder, wood: Wood) -> None: ...

    def free(self, xy_m: Array) -> Array: ...


def undulation(rng: np.random.Generator, height_m: float) -> Array:
    """(NODES, NODES) metres: long swells, and the unevenness that mowing leaves."""
    cell = 2.0 * HALF_M / (NODES - 1)
    shape = (NODES, NODES)
    swell = height_m * fractal_noise(rng, shape, 34.0 / cell, 2, 0.30)
    return np.asarray(swell + 0.008 * fractal_noise(rng, shape, 3.0 / cell, 2), np.float64)


def stroke(canvas: Canvas, line_m: Array, width_m: float = LINE_M, cover: int = 235) -> None:
    """White paint along a polyline, (N, 2) world."""
    for first, second in pairwise(np.asarray(line_m)):
        along = (second - first) / max(float(np.hypot(*(second - first))), 1e-9)
        left = 0.5 * width_m * np.array([-along[1], along[0]])
        reach = 0.5 * width_m * along
        canvas.mark(np.array([first - reach - left, second + reach - left,
                              second + reach + left, first - reach + left]), cover)  # fmt: skip


def arc(plot: Plot, u: float, v: float, radius: float, span: tuple[float, float]) -> Array:
    """(N, 2) world points of a circle's arc between two angles (radians in the plot)."""
    turn = np.linspace(*span, max(6, int(abs(span[1] - span[0]) * radius / 0.4)))
    return plot.points(np.array([u, v]) + radius * unit(turn))


def plant_edge(builder: SceneBuilder, wood: Wood, turf: Turf, count: int) -> None:
    """Adds trees in loose groups along the edge of the scene, bushes among them."""
    rng = builder.rng
    groups = rng.uniform(-HALF_M + 4.0, HALF_M - 4.0, (400, 2))
    outside = np.abs(groups).max(axis=1) > HALF_M - 17.0
    groups = groups[outside & (turf.free(groups) > 5.0)][: count // 3]
    planted = 0
    for group in groups:
        conifers = rng.random() < 0.3
        for spot in group + rng.normal(0.0, 4.0, (9, 2)):
            inside = (np.abs(spot) < HALF_M - 2.0).all()
            if planted >= count or not inside or float(turf.free(spot)) < 3.0:
                continue
            if not builder.is_free(spot, 2.4):
                continue
            plant_one(builder, wood, spot, conifers)
            planted += 1
        shrub = group + rng.normal(0.0, 3.5, 2)
        inside = bool((np.abs(shrub) < HALF_M - 2.0).all())
        if inside and float(turf.free(shrub)) > 2.0 and builder.is_free(shrub, 1.0):
            add_shrub(builder, wood, shrub)


def plant_one(builder: SceneBuilder, wood: Wood, xy_m: Array, conifer: bool) -> None:
    """Adds a single tree."""
    rng = builder.rng
    if conifer:
        crown = pick(rng, wood.conifers)
        add_conifer(builder, wood, xy_m, crown, pick(rng, wood.needles))
    else:
        crown = pick(rng, wood.crowns)
        leaf = pick(rng, wood.leaves)
        trunk = TRUNKS_M[int(rng.integers(2))]
        add_broadleaf(builder, wood, xy_m, crown, leaf, trunk)
    builder.claim(xy_m, 2.0)


def furnish_path(builder: SceneBuilder, path_m: Array, way_in: float, lamps: bool) -> None:
    """Adds benches, a bin and light poles along a footpath; ``way_in``: heading of the turf from
    it."""
    aside = unit(way_in)
    inside = np.flatnonzero((np.abs(path_m) < HALF_M - 3.0).all(axis=1))
    for index in inside[6::16]:
        spot = path_m[index] + 1.8 * aside
        if builder.is_free(spot, 0.8):
            add_bench(builder, spot, way_in)
    for index in inside[14::32]:
        add_bin(builder, path_m[index] + 1.6 * aside, [0.16, 0.30, 0.20, 1])
    for index in inside[10::22] if lamps else []:
        spot = path_m[index] - 1.5 * aside
        if builder.is_free(spot, 0.5):
            add_lamp(builder, spot, way_in, 4.6)
