"""Plan and relief of the dunes: crests across the wind with slip faces, and flats between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plots import Plot, draw_frame
from touchdown.scenes.authoring.relief import HeightField, level_takeoff, smoothstep

HALF_M = 64.0
NODES = 321
REPOSE = float(np.tan(np.deg2rad(32.0)))
"""Slope at which dry sand slides."""
_FLAT_SHARE = 0.30
"""of a wave length, the flat before the next dune"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan:
    """Spots in world metres."""

    takeoff_xy_m: Array
    takeoff_yaw: float
    middle: Plot
    """coordinates from the survey's middle, the first along the take-off heading"""
    wind_angle: float
    """radians, the way the wind blows"""
    wave_m: float
    """from dune to dune"""
    height_m: float
    """of the highest crest"""
    outcrops: tuple[tuple[Array, float], ...]
    """middle and radius of bare rock"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Relief:
    """The ground."""

    terrain: HeightField
    dune: Array
    """(N, N) metres of dune over the flat at the nodes"""
    slip: Array
    """(N, N) 0..1: on a slip face"""
    rock: Array
    """(N, N) 0..1: bare rock"""


def draw_plan(rng: np.random.Generator) -> Plan:
    """Returns a plan whose wind blows anywhere, with outcrops on the flats."""
    frame = draw_frame(rng)
    middle = frame.from_middle
    outcrops: list[tuple[Array, float]] = []
    for _ in range(60):
        spot = rng.uniform([-40.0, -36.0], [40.0, 36.0])
        radius = float(rng.uniform(2.2, 4.2))
        world = middle.points(spot)
        clear = np.hypot(*(spot - [-25.0, -20.0])) > 12.0
        apart = all(np.hypot(*(world - other)) > 14.0 for other, _ in outcrops)
        if clear and apart and len(outcrops) < 6:
            outcrops.append((world, radius))
    return Plan(
        takeoff_xy_m=frame.takeoff_xy_m,
        takeoff_yaw=frame.takeoff_yaw,
        middle=middle,
        wind_angle=float(rng.uniform(-np.pi, np.pi)),
        wave_m=float(rng.uniform(27.0, 36.0)),
        height_m=float(rng.uniform(2.3, 3.4)),
        outcrops=tuple(outcrops),
    )


def dune_profile(phase: Array, height_m: Array, wave_m: float) -> tuple[Array, Array]:
    """Heights (...) of dunes at phases 0..1 along the wind, and 1 on slip faces: a flat, a gentle
    rise to the crest, and the fall at the angle of repose. height_m: (...) of the crest there."""
    fall = np.maximum(height_m, 1e-3) / (REPOSE * wave_m)
    crest = 1.0 - fall
    rise = np.clip((phase - _FLAT_SHARE) / np.maximum(crest - _FLAT_SHARE, 0.05), 0.0, 1.0)
    stoss = rise**1.5 * (1.0 - 0.35 * rise) / 0.65
    lee = np.clip((1.0 - phase) / fall, 0.0, 1.0)
    on_lee = phase > crest
    return height_m * np.where(on_lee, lee, stoss), (on_lee & (height_m > 0.25)).astype(np.float64)


def shape_dunes(rng: np.random.Generator, plan: Plan) -> Relief:
    """Returns the ground; the height at the take-off spot is 0."""
    axis = np.linspace(-HALF_M, HALF_M, NODES)
    xy = np.stack(np.meshgrid(axis, axis), axis=-1)
    cell, shape = float(axis[1] - axis[0]), (NODES, NODES)
    east, north = np.cos(plan.wind_angle), np.sin(plan.wind_angle)
    sway = fractal_noise(rng, shape, 34.0 / cell, 2, 0.35).astype(np.float64)
    start = plan.takeoff_xy_m @ np.array([east, north])
    # The take-off lies on a flat, a few metres behind a slip face.
    spot_sway = float(HeightField(heights_m=sway, half_m=HALF_M).at(plan.takeoff_xy_m))
    along = xy @ np.array([east, north]) - start + 6.5 * (sway - spot_sway)
    phase = np.mod(along / plan.wave_m + 0.5 * _FLAT_SHARE, 1.0)
    # Crests break where the sand is scarce.
    scarce = fractal_noise(rng, shape, 30.0 / cell, 2, 0.4).astype(np.float64)
    high = plan.height_m * smoothstep(-1.3, 0.7, scarce)
    dune, slip = dune_profile(phase, high, plan.wave_m)
    ground = 0.35 * fractal_noise(rng, shape, 42.0 / cell, 2, 0.3).astype(np.float64)
    rough = smoothstep(0.5, 1.3, fractal_noise(rng, shape, 15.0 / cell, 2).astype(np.float64))
    rough *= smoothstep(0.6, 0.1, dune)
    mega = 2.0 * np.pi * (along + 0.5 * sway) / rng.uniform(2.0, 2.6)
    ground += 0.028 * rough * np.sin(mega + 0.4 * np.sin(mega))
    ground += 0.012 * fractal_noise(rng, shape, 3.0 / cell, 2)
    rock = np.zeros(shape)
    ragged = 0.8 * fractal_noise(rng, shape, 3.5 / cell, 3, 0.6).astype(np.float64)
    for centre, radius in plan.outcrops:
        off = np.linalg.norm(xy - centre, axis=-1) + ragged
        rock = np.maximum(rock, smoothstep(radius + 0.4, radius - 0.8, off) * (dune < 0.5))
    steps = 0.14 * np.round(2.0 * fractal_noise(rng, shape, 2.2 / cell, 2).astype(np.float64))
    heights = ground + _settled(dune, cell) + rock * (0.25 + 0.5 * steps)
    terrain = level_takeoff(heights, HALF_M, plan.takeoff_xy_m)
    return Relief(terrain=terrain, dune=dune, slip=slip, rock=rock)


def _settled(dune: Array, cell_m: float) -> Array:
    """Sand that lies steeper than its angle of repose, where crests turn, slides: (N, N) heights
    relaxed until no edge between nodes is steeper."""
    heights = dune.copy()
    most = 1.04 * REPOSE * cell_m
    for _ in range(40):
        moved = 0.0
        for axis in (0, 1):
            step = np.diff(heights, axis=axis)
            excess = 0.5 * (step - np.clip(step, -most, most))
            moved = max(moved, float(np.abs(excess).max()))
            pad = [(0, 0), (0, 0)]
            pad[axis] = (0, 1)
            heights += 0.7 * np.pad(excess, pad)
            pad[axis] = (1, 0)
            heights -= 0.7 * np.pad(excess, pad)
        if moved < 1e-3:
            break
    return heights
