"""The cost equations against values worked out by hand."""

import numpy as np
import pytest

from touchdown.landing.api import LandingParams
from touchdown.landing.selection.clustering import _search_offsets, kernel_density, quick_shift
from touchdown.landing.selection.costmap import (
    c_sum,
    colour_edges,
    distance,
    flatness,
    flatness_kernel,
    smoothness,
)
from touchdown.landing.selection.ground.elevation_raster import disc_maximum, fit_planes, pooled

from support.landing_support import make_grid, raster_of

PARAMS = LandingParams()


def test_planes_recover_slope_and_level_and_skip_unknown_windows() -> None:
    y, x = np.mgrid[0:40, 0:60] * 0.2
    height = (0.1 * x - 0.05 * y + 300.0).astype(np.float32)
    height[:, 30:] = np.nan
    planes = fit_planes(height, 0.2, 0.5)
    angle = np.arctan(np.hypot(0.1, 0.05))
    assert planes.angle_rad[5:35, 5:28] == pytest.approx(angle, abs=1e-3)
    assert planes.level[5:35, 5:28] == pytest.approx(height[5:35, 5:28], abs=1e-3)
    assert np.isnan(planes.level[:, 33:]).all()


def test_eq16_corrected_prefers_level_and_literal_prefers_the_average() -> None:
    angles = np.deg2rad(np.array([[0.0, 5.0, 10.0, 25.0]], np.float32))
    corrected = flatness_kernel(angles, form="corrected", sigma_rad=np.deg2rad(5.0))
    assert corrected[0] == pytest.approx([1.0, np.exp(-0.5), np.exp(-2.0), np.exp(-12.5)], rel=1e-4)
    literal = flatness_kernel(angles, form="literal", sigma_rad=1.0)
    # mean 10 deg, population standard deviation sqrt(87.5) deg
    assert literal[0] == pytest.approx(
        np.exp(-np.array([100.0, 25.0, 0.0, 225.0]) / 175.0), rel=1e-4
    )
    with pytest.raises(ValueError, match="flatness_form"):
        flatness_kernel(angles, form="letter", sigma_rad=1.0)


def test_eq17_mean_over_the_disc_and_unknown_never_flat() -> None:
    kernel = np.ones((15, 15), np.float32)
    kernel[7, 7] = np.nan
    count = np.full((15, 15), 10.0, np.float32)
    cost = flatness(kernel, count, form="corrected", radius_m=0.2, cell_m=0.2)
    # A disc of one cell radius has five cells.
    assert cost[3, 3] == pytest.approx(1.0)
    assert cost[7, 6] == pytest.approx(4.0 / 5.0)
    assert cost[0, 0] == pytest.approx(3.0 / 5.0)
    assert np.isnan(cost[7, 7])
    count[3, 3] = 60.0
    literal = flatness(kernel, count, form="literal", radius_m=0.2, cell_m=0.2)
    assert literal[3, 3] == pytest.approx(1.0)
    assert literal[11, 11] == pytest.approx(50.0 / 100.0)


def test_eq14_distance_to_the_only_edge() -> None:
    rgb = np.full((60, 60, 3), 60.0, np.float32)
    rgb[:, 30:] = 200.0
    edges, coloured = colour_edges(rgb, blur_cells=1.0, low=40.0, high=100.0, hole_cells=4)
    assert coloured.all()
    columns = np.flatnonzero(edges.any(axis=0))
    assert columns.size == 1
    assert columns[0] in (29, 30)
    assert edges[:, columns[0]].all()
    smooth = smoothness(edges, coloured, 0.2, full_m=4.0)
    assert smooth[10, columns[0] + 5] == pytest.approx(5 * 0.2 / 4.0)
    assert smooth[10, 0] == pytest.approx(1.0)
    rgb[5:9, 50:54] = np.nan  # a hole too large to be chance
    edges, coloured = colour_edges(rgb, blur_cells=1.0, low=40.0, high=100.0, hole_cells=4)
    smooth = smoothness(edges, coloured, 0.2, full_m=4.0)
    assert np.isnan(smooth[6, 51])
    assert smooth[6, 56] == pytest.approx(3 * 0.2 / 4.0)
    corner = (np.indices((9, 9)).sum(axis=0) == 0).astype(np.uint8)
    smooth = smoothness(corner, np.ones((9, 9), np.bool_), 0.2, full_m=4.0)
    assert smooth[3, 4] == pytest.approx(5 * 0.2 / 4.0)


def test_eq18_distance_and_its_energy_threshold() -> None:
    raster = raster_of(make_grid(np.zeros((3, 50)), sigma=0.0))
    cost = distance(raster, np.array([0.1, 0.3, 0.0]), reach_m=6.05)
    assert cost[1, 0] == pytest.approx(1.0)
    assert cost[1, 15] == pytest.approx(0.5, abs=0.01)
    assert cost[1, 30] == pytest.approx(0.0, abs=0.01)
    assert np.isnan(cost[1, 31:]).all()


def test_eq13_weights_and_unknown() -> None:
    one, half = np.ones((1, 2), np.float32), np.full((1, 2), 0.5, np.float32)
    near = np.array([[0.25, np.nan]], np.float32)
    total = c_sum(half, one, near, PARAMS)
    assert total[0, 0] == pytest.approx(0.3 * 0.5 + 0.5 * 1.0 + 0.2 * 0.25)
    assert np.isnan(total[0, 1])


def test_disc_maximum_reaches_exactly_its_radius() -> None:
    layer = np.full((21, 21), np.nan, np.float32)
    layer[10, 10] = 2.0
    reached = np.isfinite(disc_maximum(layer, 4.0))
    r, c = np.indices(layer.shape)
    assert (reached == ((r - 10) ** 2 + (c - 10) ** 2 <= 16)).all()


def test_pooling_keeps_mean_spread_and_top() -> None:
    raster = raster_of(make_grid(np.array([[0.0, 0.2], [0.2, np.nan]]), sigma=0.0))
    merged = pooled(raster, 2)
    assert merged.shape == (1, 1)
    assert merged.cell_m == pytest.approx(0.4)
    assert merged.count[0, 0] == 120.0
    assert merged.height[0, 0] == pytest.approx(0.4 / 3.0)
    assert merged.std[0, 0] == pytest.approx(np.std([0.0, 0.2, 0.2]))
    assert merged.high[0, 0] == pytest.approx(0.2)


def brute_force_parent(density: np.ndarray, radius: float) -> np.ndarray:
    """Nearest cell of higher density, by looking at all pairs."""
    _rows, cols = density.shape
    flat = density.ravel()
    index = np.arange(flat.size)
    r, c = index // cols, index % cols
    parent = np.full(flat.size, -1)
    for i in index[np.isfinite(flat)]:
        squared = (r - r[i]) ** 2 + (c - c[i]) ** 2
        with np.errstate(invalid="ignore"):
            higher = (flat > flat[i]) | ((flat == flat[i]) & (index < i))
        ok = higher & (squared <= radius**2) & (squared > 0)
        parent[i] = i if not ok.any() else index[ok][np.lexsort((index[ok], squared[ok]))[0]]
    return parent


def test_eq19_quick_shift_equals_brute_force() -> None:
    rng = np.random.default_rng(7)
    values = np.round(rng.uniform(0.0, 1.0, (23, 31)), 1).astype(np.float32)  # with ties
    values[4:8, 10:20] = np.nan
    clusters = quick_shift(values, bandwidth_cells=1.0, radius_cells=4.0)
    parent = brute_force_parent(clusters.density, 4.0)
    root = parent.copy()
    for _ in range(root.size):
        root = np.where(root >= 0, parent[root], -1)
    modes = np.unique(root[root >= 0])
    np.testing.assert_array_equal(clusters.modes, np.column_stack([modes // 31, modes % 31]))
    label = clusters.label.ravel()
    assert (label[root < 0] == -1).all()
    assert (modes[label[root >= 0]] == root[root >= 0]).all()
    assert 1 < modes.size < 60


def test_quick_shift_finds_two_hills_and_one_mode_on_a_plateau() -> None:
    r, c = np.mgrid[0:40, 0:60]
    hills = np.exp(-((r - 20) ** 2 + (c - 15) ** 2) / 60.0)
    hills += np.exp(-((r - 20) ** 2 + (c - 45) ** 2) / 60.0)
    clusters = quick_shift(hills.astype(np.float32), bandwidth_cells=1.5, radius_cells=12.0)
    assert clusters.modes.tolist() == [[20, 15], [20, 45]]
    flat = quick_shift(np.ones((10, 10), np.float32), bandwidth_cells=1.0, radius_cells=20.0)
    assert flat.modes.shape == (1, 2)


def test_density_is_an_average_that_ignores_unknown_cells() -> None:
    values = np.full((20, 20), 0.7, np.float32)
    values[5:9, 5:9] = np.nan
    density = kernel_density(values, 2.0)
    assert np.isnan(density[6, 6])
    assert density[np.isfinite(density)] == pytest.approx(0.7, abs=1e-5)
    assert _search_offsets(1.5).shape == (8, 2)
