"""`flat`: fills flat.xml with a patchwork of lawns and fields drawn from a seed.

The ground is exactly level and without objects, so that ranges hold no information about motion
along it; only the texture does.
"""

from __future__ import annotations

from zlib import crc32

import numpy as np

from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import Takeoff, finish, paint_terrain, start_scene
from touchdown.scenes.authoring.ground import Canvas
from touchdown.scenes.authoring.height_field import HeightField
from touchdown.scenes.places.flat.parcels import (
    HALF_M,
    MARGIN_M,
    draw_rows,
    paint_parcels,
    paint_pitch,
)

NODES = 9


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = np.random.default_rng([seed, crc32(b"scenes.flat")])
    # The ground goes on beyond the bounds, so that it is safe up to the very edge.
    terrain = HeightField(heights_m=np.zeros((NODES, NODES)), half_m=HALF_M + MARGIN_M)
    builder = start_scene("flat", rng, terrain, base_m=1.0)
    canvas = Canvas(half_m=terrain.half_m)
    takeoff = np.array([-25.0, -20.0]) + rng.uniform(-2.5, 2.5, 2)
    angle = float(rng.uniform(0.0, np.pi))
    paint_parcels(rng, canvas, angle)
    paint_pitch(rng, canvas, takeoff + rng.uniform([18.0, 12.0], [30.0, 26.0]))
    ground = paint_terrain(builder, canvas, draw_rows(rng, angle))
    plan = Takeoff(takeoff_xy_m=takeoff, takeoff_yaw=float(rng.uniform(-0.10, 0.10)))
    return finish(plan, builder, ground, half_m=HALF_M)
