"""`flat`: fills flat.xml with a patchwork of lawns and fields drawn from a seed.

The ground is level to the bit and nothing stands on it, so that range alone says nothing about
motion along it; its picture says all.
"""

from __future__ import annotations

from pathlib import Path
from zlib import crc32

import mujoco
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Surface
from touchdown.scenes.authoring.builder import Builder
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.ground import Canvas
from touchdown.scenes.authoring.light import draw_sun, finish_picture
from touchdown.scenes.authoring.terrain import Terrain, write_hfield
from touchdown.scenes.places.flat.parcels import (
    HALF_M,
    MARGIN_M,
    draw_rows,
    paint_parcels,
    paint_pitch,
)

Array = NDArray[np.float64]

XML = Path(__file__).with_name("flat.xml")
NODES = 9


def generate(seed: int) -> SceneDraft:
    """The place of ``seed``, without the vehicle. Same seed, same bytes."""
    rng = np.random.default_rng([seed, crc32(b"scenes.flat")])
    spec = mujoco.MjSpec.from_file(str(XML))
    # The ground goes on beyond the bounds, so that it is safe up to the very edge.
    terrain = Terrain(heights_m=np.zeros((NODES, NODES)), half_m=HALF_M + MARGIN_M)
    write_hfield(spec, "terrain", "terrain", terrain, base_m=1.0)
    sun = draw_sun(rng, spec)
    builder = Builder(spec=spec, rng=rng, terrain=terrain)
    canvas = Canvas(half_m=terrain.half_m)
    takeoff = np.array([-25.0, -20.0]) + rng.uniform(-2.5, 2.5, 2)
    angle = float(rng.uniform(0.0, np.pi))
    paint_parcels(rng, canvas, angle)
    paint_pitch(rng, canvas, takeoff + rng.uniform([18.0, 12.0], [30.0, 26.0]))
    finish_picture(builder, canvas, sun, draw_rows(rng, angle))
    builder.surfaces["terrain"] = Surface(land_class="lawn", reflectivity=0.45)
    return SceneDraft(
        spec=spec,
        takeoff_xy_m=takeoff,
        takeoff_yaw=float(rng.uniform(-0.10, 0.10)),
        bounds_xy_m=np.array([[-HALF_M, -HALF_M], [HALF_M, HALF_M]]),
        surfaces=builder.surfaces,
        ground=canvas.raster("terrain"),
    )
