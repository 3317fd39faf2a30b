"""The geometric check on synthetic ground, and touchdown detection."""

import numpy as np
import pytest
from numpy.typing import NDArray

from touchdown.estimator.api import GridMap
from touchdown.landing.api import LandingParams
from touchdown.landing.mission.site_recheck import ground_under
from touchdown.landing.mission.touchdown import TouchdownDetector
from touchdown.landing.selection.ground.elevation_raster import ElevationRaster, observed_raster
from touchdown.landing.selection.ground.landable import (
    Defect,
    LandableMap,
    assess,
    explain,
    fit_footprint,
    ground_planes,
)
from touchdown.landing.selection.ground.traffic import traffic_zone
from touchdown.sim.frames import Pose

from support.landing_support import (
    make_estimate,
    make_grid,
    make_imu,
    make_obs,
    make_rig,
    select,
    view_of,
)

Array = NDArray[np.float64]

PARAMS = LandingParams()
ABOVE = make_estimate(0, Pose(np.eye(3), np.array([8.0, 8.0, 30.0])))
MIDDLE = (40, 40)


def ground(slope_deg: float = 0.0) -> Array:
    """16 x 16 m."""
    _, x = np.mgrid[0:80, 0:80] * 0.2
    return np.tan(np.deg2rad(slope_deg)) * x


def judged(grid: GridMap) -> tuple[ElevationRaster, LandableMap]:
    raster = observed_raster(grid)
    assert raster is not None
    return raster, assess(
        raster, ground_planes(raster, PARAMS), PARAMS, margin_m=PARAMS.map_margin_m,
        min_returns=PARAMS.min_returns,
    )  # fmt: skip


def landable(grid: GridMap) -> bool:
    return bool(judged(grid)[1].mask[MIDDLE])


def test_noise_of_2_cm_leaves_flat_ground_landable() -> None:
    for seed in range(3):
        _, result = judged(make_grid(ground(), seed=seed))
        assert result.mask[10:70, 10:70].all()


def test_thin_post_is_seen_by_its_few_returns() -> None:
    """Two of forty returns from a post 1 m away: the mean hardly moves."""
    grid = make_grid(ground())
    assert landable(grid)
    grid.max_height_m[40, 45] = 0.6
    grid.height_m[40, 45] += 0.03
    grid.height_std_m[40, 45] = 0.13
    assert not landable(grid)


def test_something_tall_beyond_the_footprint_keeps_1_5_m_away() -> None:
    grid = make_grid(ground())
    grid.max_height_m[:, 48] = 1.0  # a wire fence 1.6 m from the middle cell's centre
    raster, result = judged(grid)
    assert not result.mask[MIDDLE]
    assert result.mask[40, 38]
    assert (
        "m high within 1.9 m (limit 0.25 m)" in explain(raster, result, *MIDDLE, PARAMS, 0.35).text
    )


def test_traffic_is_detected_by_changing_heights() -> None:
    """A lane 2 m wide on which cars passed, against a static edge one cell wide."""
    lane = make_grid(ground())
    lane.height_std_m[30:50, 58:68] = 0.5
    lane.height_m[30:50, 58:68] = 0.2
    lane.max_height_m[30:50, 58:68] = 1.5
    _, result = judged(lane)
    assert result.defect[40, 45] == Defect.MOVING  # 2.6 m from the lane
    edge = make_grid(ground())
    edge.height_std_m[:, 62] = 0.5
    edge.max_height_m[:, 62] = 1.5
    _, result = judged(edge)
    assert result.defect[40, 58] == Defect.NONE
    crown = make_grid(ground())
    crown.height_std_m[36:46, 60:70] = 1.5
    crown.height_m[36:46, 60:70] = 4.0
    crown.max_height_m[36:46, 60:70] = 6.0
    _, result = judged(crown)
    assert result.defect[40, 50] == Defect.NONE


def test_footprint_plane_of_a_known_slope() -> None:
    raster, _ = judged(make_grid(ground(4.0), sigma=0.0))
    plane = fit_footprint(raster, np.array([8.0, 8.0]), 1.0)
    assert plane.slope_deg == pytest.approx(4.0, abs=1e-3)
    assert plane.roughness_m == pytest.approx(0.0, abs=1e-5)
    assert plane.position[2] == pytest.approx(np.tan(np.deg2rad(4.0)) * 7.9, abs=1e-4)
    angle = np.deg2rad(4.0)
    assert plane.normal == pytest.approx([-np.sin(angle), 0.0, np.cos(angle)], abs=1e-4)


def test_whole_surface_with_traffic_is_avoided() -> None:
    """Level ground of low intensity west of x = 8, high east of it, with motion at x = 1."""
    grid = make_grid(ground())
    grid.intensity[:, :40] = 14.0
    grid.intensity[:, 40:] = 46.0
    raster, result = judged(grid)
    # nothing moved: nothing known
    assert not traffic_zone(raster, result, PARAMS).any()
    grid.height_std_m[30:50, 2:10] = 0.5
    grid.max_height_m[30:50, 2:10] = 1.5
    raster, result = judged(grid)
    zone = traffic_zone(raster, result, PARAMS)
    assert zone[70, 30] and not zone[70, 60]  # the same surface, far from where it moved
    sites = select(view_of(grid), ABOVE, PARAMS).candidates
    assert sites[0].accepted
    assert sites[0].position_odom[0] > 9.5  # 2 m less half the averaging window


def test_empty_map_gives_no_candidate() -> None:
    empty = make_grid(np.full((20, 20), np.nan))
    nothing = select(view_of(empty), ABOVE, PARAMS)
    assert nothing.candidates == ()
    assert nothing.costmap is None


def fine(height: Array, corner: tuple[float, float] = (4.0, 4.0)) -> GridMap:
    return make_grid(height, 0.05, origin=corner, returns=10)


def test_ground_height_prefers_the_fine_map() -> None:
    coarse, close = make_grid(ground()), fine(np.full((160, 160), 0.25))
    assert ground_under(view_of(coarse, close), np.array([8.0, 8.0])) == pytest.approx(
        0.25, abs=0.01
    )
    assert ground_under(view_of(coarse), np.array([8.0, 8.0])) == pytest.approx(0.0, abs=0.01)
    slope = make_grid(ground(5.0), sigma=0.0)
    expected = np.tan(np.deg2rad(5.0)) * (8.03 - 0.1)
    assert ground_under(view_of(slope), np.array([8.03, 8.0])) == pytest.approx(expected, abs=1e-4)
    assert np.isnan(ground_under(view_of(coarse), np.array([99.0, 8.0])))


def test_touchdown_is_detected_by_weight_on_the_legs_not_by_gusts_or_a_bump() -> None:
    detector = TouchdownDetector(make_rig())
    weight = 4.0 * 9.81

    def step(tick: int, force_mps2: float, thrust_fraction: float, sink: float) -> bool:
        speed = np.full(4, np.sqrt(thrust_fraction * weight / 4.0 / 4e-5))
        obs = make_obs(tick, imu=(make_imu(tick, force_mps2),), rotor_speed_radps=speed)
        estimate = make_estimate(tick, Pose.identity(), (0.0, 0.0, -sink))
        return detector.update(obs, estimate)

    rng = np.random.default_rng(1)
    tick = 0
    for _ in range(400):  # sinking at 0.12 m/s with ground effect of 12 % and gusts
        fraction = 0.9 + 0.05 * rng.standard_normal()
        assert not step(
            tick, 9.81 * (fraction + 0.12) + 0.3 * rng.standard_normal(), fraction, 0.12
        )
        tick += 3
    assert not step(tick, 40.0, 0.9, 0.02)  # one hard bump, then airborne again
    for _ in range(100):
        tick += 3
        assert not step(tick, 9.81, 0.98, 0.02)
    felt_after = 0
    while not step(tick, 9.81, 0.6, 0.01):  # 40 % of the weight on the legs
        tick += 3
        felt_after += 1
        assert felt_after < 100
    assert 0.1 < felt_after * 0.005 < 0.3
