"""Hills with a valley, a track cut into them, and clearings of every slope."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.height_field import HeightField
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.relief import level_takeoff, smoothstep
from touchdown.scenes.places.forest.layout import HALF_M, Clearing, Course, Plan

NODES = 193
TRACK_HALF_M = 1.7
BROOK_DEPTH_M = 0.9
WATER_DEPTH_M = 0.28
BROOK_FALL = 0.012
"""Metres down per metre along."""


def shape_ground(rng: np.random.Generator, plan: Plan) -> HeightField:
    """Returns the forest's ground; the height at the take-off spot is 0."""
    heights = hills(rng)
    plain = HeightField(heights_m=heights, half_m=HALF_M)
    xy = np.stack(plain.node_grid(), axis=-1)
    to_brook, at_brook = plan.brook.nearest(xy)
    bed = brook_profile(plan.brook, plain)
    valley = bed[at_brook] + BROOK_DEPTH_M + 0.05 * to_brook
    heights = valley + (heights - valley) * smoothstep(3.0, 15.0, to_brook)
    rough = hummocks(rng)
    heights = heights + rough * smoothstep(-2.0, 3.0, plan.clearing_distance(xy))
    for clearing in plan.clearings:
        heights = _clear(rng, heights, xy, clearing, rough)
    to_track, at_track = plan.track.nearest(xy)
    course = HeightField(heights_m=heights, half_m=HALF_M).at(plan.track.line_m)
    over, nearest = plan.brook.nearest(plan.track.line_m)
    bridge = bed[nearest] + BROOK_DEPTH_M + 0.2
    even = gaussian_filter1d(course, 7.0, mode="nearest")
    even = np.where(over < 6.0, np.maximum(even, bridge), even)
    level = gaussian_filter1d(even, 2.0, mode="nearest")[at_track]
    heights = level + (heights - level) * smoothstep(TRACK_HALF_M, TRACK_HALF_M + 4.5, to_track)
    heights = _lowered_to(heights, bed[at_brook], to_brook)
    return level_takeoff(heights, HALF_M, plan.frame.takeoff_xy_m)


def hills(rng: np.random.Generator) -> Array:
    """(NODES, NODES) metres: hills about 90 m apart with shoulders and gullies."""
    cell = 2.0 * HALF_M / (NODES - 1)
    shape = (NODES, NODES)
    large = rng.uniform(1.9, 2.5) * fractal_noise(rng, shape, 34.0 / cell, 1)
    small = rng.uniform(0.50, 0.70) * fractal_noise(rng, shape, 12.0 / cell, 2, 0.4)
    return np.asarray(large + small, np.float64)


def hummocks(rng: np.random.Generator) -> Array:
    """(NODES, NODES) metres: roots, hollows and tussocks of the forest floor."""
    cell = 2.0 * HALF_M / (NODES - 1)
    noise = fractal_noise(rng, (NODES, NODES), 2.6 / cell, 2, 0.6)
    return np.asarray(rng.uniform(0.09, 0.13) * noise, np.float64)


def brook_profile(brook: Course, terrain: HeightField) -> Array:
    """(N,) height of the bed along the brook: it always falls, and lies below the ground. Of the
    two ways to run it takes the one that cuts less."""
    inside = (np.abs(brook.line_m) < HALF_M).all(axis=1)
    ground = gaussian_filter1d(terrain.at(brook.line_m), 5.0, mode="nearest") - 1.2
    ground[~inside] = np.inf
    fall = BROOK_FALL * np.arange(len(ground))
    ahead = np.minimum.accumulate(ground + fall) - fall
    back = (np.minimum.accumulate(ground[::-1] + fall) - fall)[::-1]
    bed = ahead if ahead[inside].mean() > back[inside].mean() else back
    index = np.arange(len(bed))
    # Beyond the scene the bed goes on level, so that smoothing does not bend its ends.
    whole = np.interp(index, index[inside], bed[inside])
    return np.asarray(gaussian_filter1d(whole, 3.0, mode="nearest"))


def _lowered_to(heights: Array, bed: Array, to_brook: Array) -> Array:
    """The brook's channel: a bed 1.2 m wide between steep banks."""
    channel = bed + BROOK_DEPTH_M * smoothstep(0.6, 2.3, to_brook)
    return np.where(to_brook < 2.3, np.minimum(heights, channel), heights)


def _clear(
    rng: np.random.Generator, heights: Array, xy: Array, clearing: Clearing, rough: Array
) -> Array:
    """Evens the ground of a clearing: a plane of its kind's slope, with its kind's roughness."""
    slopes_deg = {"start": (0.0, 0.5), "meadow": (0.5, 2.4), "plot": (0.3, 1.8),
                  "slope": (11.0, 15.0), "stumps": (1.0, 3.5), "boulders": (1.0, 4.0)}  # fmt: skip
    roughness = {"start": 0.05, "meadow": 0.07, "plot": 0.06, "slope": 0.3, "stumps": 0.25,
                 "boulders": 0.55}  # fmt: skip
    distance = clearing.distance(xy)
    rel = xy - clearing.centre_xy_m
    inside = distance < 0.0
    # Downhill stays downhill: the plane turns with the ground that it replaces.
    gradient = np.linalg.lstsq(
        np.column_stack([rel[inside], np.ones(inside.sum())]), heights[inside], rcond=None
    )[0][:2]
    unit = gradient / max(float(np.hypot(*gradient)), 1e-6)
    slope = np.tan(np.deg2rad(rng.uniform(*slopes_deg[clearing.kind])))
    plane = float(heights[inside].mean()) + slope * (rel @ unit)
    plane = plane + roughness[clearing.kind] * rough
    blended: Array = plane + (heights - plane) * smoothstep(-0.3, 6.5, distance)
    return blended
