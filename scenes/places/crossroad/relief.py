"""The rugged ground around the roads."""

from __future__ import annotations

import numpy as np

from touchdown.scenes.authoring.height_field import HeightField
from touchdown.scenes.authoring.relief import (
    NODES,
    Ditch,
    Pad,
    dig_ditches,
    level_pads,
    level_takeoff,
    natural_ground,
    smoothstep,
)
from touchdown.scenes.places.crossroad.layout import GUTTER_M, HALF_M, ROAD_DEPTH_M, Plan


def shape_ground(
    rng: np.random.Generator, plan: Plan, pads: list[Pad], ditches: list[Ditch]
) -> HeightField:
    """Returns natural ground with the roads, pads, ditches and the take-off spot cut in. The height
    at the take-off spot is 0."""
    terrain = HeightField(heights_m=natural_ground(rng, NODES, HALF_M), half_m=HALF_M)
    xy = np.stack(terrain.node_grid(), axis=-1)
    heights = terrain.heights_m + (0.35 - terrain.heights_m.mean())
    heights = level_pads(dig_ditches(heights, xy, ditches), xy, pads)
    kerb = plan.kerb_distance(xy)
    # Beyond the pavement the ground may rise or fall over a few metres; it never dips below it
    # near the edge, as a gardener would have it.
    blend = smoothstep(plan.corridor_m, plan.corridor_m + 5.0, kerb)
    heights = blend * heights
    roadway = smoothstep(0.0, GUTTER_M, -kerb)
    heights = heights - ROAD_DEPTH_M * roadway
    return level_takeoff(heights, HALF_M, plan.takeoff_xy_m)
