"""The truth of every shipped scene against single rays of MuJoCo.

``pytest tests/scenes/test_truth_rays.py -m slow -s`` prints the figures.
"""

import numpy as np
import pytest

from touchdown.scenes.registry import scene_names
from touchdown.scenes.truth.maps import truth_maps
from touchdown.scenes.truth.static_surface import cast_points

from support.places import cached_scene
from support.truth_rays import SingleRays

BESIDE_M = np.array([1.37e-4, 2.11e-4])
"""Truth rays aim beside the edges of regular grids."""
MOST_EDGES = 0.003
"""share of points; a scene has some hundreds of metres of edges, looked at 4 mm wide"""


@pytest.mark.parametrize("name", ["forest"])
def test_heights_are_those_of_single_rays(name: str) -> None:
    scene = cached_scene(name, 1)
    points = np.random.default_rng(11).uniform(*scene.bounds_xy_m, (1000, 2))
    wrong, edges = SingleRays(scene).disagreements(points + BESIDE_M, cast_points(scene, points)[0])
    assert wrong.size == 0, points[wrong]
    assert edges <= MOST_EDGES * len(points)


@pytest.mark.slow
@pytest.mark.parametrize("name", scene_names())
def test_truth_maps_are_those_of_single_rays(name: str) -> None:
    """10,000 random cells of the map. A cell that holds something narrower than itself has that
    thing's height, not the one at its centre: counted as well."""
    scene = cached_scene(name, 0)
    maps = truth_maps(scene, 0.1)
    rng = np.random.default_rng(12)
    cells = np.stack([rng.integers(0, count, 10_000) for count in maps.height_m.shape[::-1]], 1)
    centres = maps.origin_xy_m + (cells + 0.5) * maps.cell_m
    heights = maps.height_m[cells[:, 1], cells[:, 0]].astype(np.float64)
    sampled = cast_points(scene, centres)[0]
    thin = heights > sampled + 1e-3
    rays = SingleRays(scene)
    wrong, edges = rays.disagreements(centres[~thin] + BESIDE_M, heights[~thin])
    wrong_thin, _ = rays.disagreements(centres[thin] + BESIDE_M, sampled[thin])
    print(f"{name}: {len(cells)} cells, {wrong.size + wrong_thin.size} differ by more than 1 cm, "
          f"{edges} at edges, {thin.sum()} with thin things")  # fmt: skip
    assert wrong.size == 0 and wrong_thin.size == 0
    assert edges <= MOST_EDGES * len(cells) and thin.sum() <= 0.02 * len(cells)
