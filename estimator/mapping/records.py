"""What the kernels of the mapper take."""

from __future__ import annotations

from typing import NamedTuple

from touchdown.estimator.typing import Float32


class Pulses(NamedTuple):
    """N pulses in the odom frame."""

    origins: Float32  # (N, 3) m
    beams: Float32  # (N, 3) unit
    ranges: Float32  # (N,) m; 0: no return


class Grid(NamedTuple):
    """Where the cells of a grid lie."""

    x: float  # m, of the corner
    y: float
    cell: float  # m


class Lens(NamedTuple):
    """A lens as OpenCV describes it."""

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float
    p1: float
    p2: float
    k3: float


class Layers(NamedTuple):
    """Layers of a ``GridMap`` that returns are added to, (rows, cols) float32, ``rgb`` (rows, cols,
    3), and the number of coloured returns."""

    counts: Float32
    height_m: Float32
    height_std_m: Float32
    min_height_m: Float32
    max_height_m: Float32
    rgb: Float32
    rgb_count: Float32
    intensity: Float32
    missing: Float32
    last_seen_s: Float32
