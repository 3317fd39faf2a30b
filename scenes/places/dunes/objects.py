"""Objects among the dunes: scrub, tufts of grass, outcrops, marker posts."""

from __future__ import annotations

import numpy as np

from touchdown.scenes.api import Surface
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.height_field import HeightField
from touchdown.scenes.places.dunes.layout import HALF_M, Plan, Relief
from touchdown.scenes.props.arid import add_scrub, add_slab, add_tuft, grow_scrub
from touchdown.scenes.props.wires import add_post

SAND = Surface(land_class="field", reflectivity=0.44)


def place_objects(builder: SceneBuilder, plan: Plan, relief: Relief) -> None:
    """Adds everything that stands in the sand: scrub and grass on the flats, in clumps."""
    rng = builder.rng
    land = grow_scrub(builder)
    dune = HeightField(heights_m=relief.dune, half_m=HALF_M)
    builder.claim(plan.takeoff_xy_m, 6.0)
    for centre, radius in plan.outcrops:
        if float(dune.at(centre)) > 0.4:
            continue
        for _ in range(int(rng.integers(4, 8))):
            spot = centre + rng.normal(0.0, 0.45 * radius, 2)
            add_slab(builder, land, spot, float(rng.uniform(0.5, 1.3)))
    for _ in range(70):
        middle = plan.middle.points(rng.uniform([-56.0, -52.0], [56.0, 52.0]))
        for _ in range(int(rng.integers(2, 8))):
            spot = middle + rng.normal(0.0, 2.6, 2)
            outside = np.abs(spot).max() > HALF_M - 2.0
            if outside or float(dune.at(spot)) > 0.5 or not builder.is_free(spot, 0.5):
                continue
            (add_tuft if rng.random() < 0.62 else add_scrub)(builder, land, spot)
    for side in (-1.0, 1.0):
        spot = plan.middle.points(np.array([side * rng.uniform(14.0, 28.0), rng.uniform(-16, 16)]))
        if builder.is_free(spot, 1.0):
            add_post(builder, spot, 1.5, 0.05, [0.45, 0.37, 0.28, 1.0])
