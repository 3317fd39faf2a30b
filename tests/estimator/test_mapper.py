"""The mapper on scenes whose geometry is known in closed form."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from touchdown.estimator.api import MapperParams, MapView, PoseTrack
from touchdown.estimator.filtering.deskew import Track, deskew
from touchdown.estimator.filtering.error_state import Frame
from touchdown.estimator.mapping import kernels
from touchdown.estimator.mapping.kernels import Grid, Lens, Pulses
from touchdown.estimator.mapping.mapper import GridMapper
from touchdown.sim.api import CameraImage, LidarScan
from touchdown.sim.frames import Pose, quat_wxyz_from_matrix, so3_exp
from touchdown.sim.typing import Array

from support.landing_support import beam_fan, cast_scan, make_estimate, make_obs, make_rig

BOX = (np.array([1.0, -1.0, 0.0]), np.array([3.0, 1.0, 0.5]))
PARAMS = MapperParams(extent_m=60.0)


def motion(time_s: float) -> Pose:
    """Forward flight at 4 m/s with a roll of 0.5 rad/s, 12 m up."""
    rotation = so3_exp(np.array([0.5 * (time_s - 0.05), 0.1, 0.0]))
    return Pose(rotation, np.array([4.0 * time_s, 0.3, 12.0]))


def moving_scan(n: int, seed: int = 0, **scene: object) -> LidarScan:
    directions = beam_fan(n, 0.86, 0.22, seed)
    times = np.linspace(0.1 / n, 0.1, n)
    return cast_scan(60, directions, [motion(0.1 + t) for t in times], **scene)


def at_height(metres: float) -> Pose:
    return Pose(np.eye(3), np.array([0.0, 0.0, metres]))


def fly(
    mapper: GridMapper, body: Pose | Callable[[float], Pose], scan: LidarScan, start: int = 0,
    images: tuple[CameraImage, ...] = (),
) -> MapView:  # fmt: skip
    """Feeds causal poses at 200 Hz from tick ``start`` on, and the scan of 60 ticks after it
    and the images, 36 ticks late."""
    for tick in range(start, start + 157, 3):
        late = {"scans": (scan,), "images": images} if tick == start + 156 else {}
        pose = body if isinstance(body, Pose) else body(tick / 600.0)
        view = mapper.update(make_obs(tick, **late), make_estimate(tick, pose))
    return view


def test_moving_scan_maps_plane_and_box_to_their_heights() -> None:
    view = fly(GridMapper(make_rig(), PARAMS), motion, moving_scan(20000, box=BOX))
    seen = view.coarse.count > 0
    heights = view.coarse.height_m[seen]
    col, row = np.meshgrid(np.arange(300), np.arange(300))
    x, y = (view.coarse.origin_xy_m[:, None, None] + (np.stack([col, row]) + 0.5) * 0.2)[:, seen]
    far_out = (x < 0.8) | (x > 3.2) | (np.abs(y) > 1.2)
    inside = (x > 1.2) & (x < 2.8) & (np.abs(y) < 0.8)
    assert inside.sum() > 30
    assert np.abs(heights[far_out]).max() < 2e-3  # lerp between 200 Hz poses of a turning body
    assert np.abs(heights[inside] - 0.5).max() < 2e-3
    assert np.nanmax(view.coarse.height_std_m[seen][far_out]) < 2e-3


@pytest.mark.parametrize("count", [1, 63, 64, 65, 129, 2400])
def test_every_pulse_is_placed_by_the_pose_at_its_time(count: int) -> None:
    """5 rad/s and 8 m/s, compared with the exact pose of each pulse."""
    rng = np.random.default_rng(count)
    axis = np.array([0.6, 0.0, 0.8])
    mount = Pose(so3_exp(np.array([0.2, -0.3, 0.1])), np.array([0.1, -0.2, -0.3]))

    def body(time_s: float) -> Pose:
        return Pose(so3_exp(5.0 * time_s * axis), np.array([8.0, 1.0, -2.0]) * time_s)

    times = np.arange(0.0, 0.1101, 0.001)
    offsets = (np.arange(1, count + 1) / 24000.0).astype(np.float32)
    directions = rng.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    quats = np.array([quat_wxyz_from_matrix(body(t).rotation) for t in times])
    quats[1::3] *= -1.0  # the same rotations
    origins, beams = deskew(
        directions.astype(np.float32), offsets, 0.0,
        Track(times, np.array([body(t).translation for t in times]), quats), Frame.of(mount),
    )  # fmt: skip
    poses = [body(float(t)) @ mount for t in offsets]
    # A tenth of the Horizon's rate puts knots 2.7 ms apart: the chord of 13 mrad is 2e-5 short.
    np.testing.assert_allclose(origins, [p.translation for p in poses], atol=2e-5)
    exact = [pose.rotation @ way for pose, way in zip(poses, directions, strict=True)]
    np.testing.assert_allclose(beams, exact, atol=3e-5)


def test_the_estimators_own_track_is_preferred() -> None:
    track = raised_track(0.09, 0.21)
    mapper = GridMapper(make_rig(), PARAMS)
    scan = moving_scan(4000)
    mapper.update(make_obs(0), make_estimate(0, motion(0.0)))
    estimate = dataclasses.replace(make_estimate(156, motion(0.26)), scan_track=track)
    view = mapper.update(make_obs(156, scans=(scan,)), estimate)
    assert np.nanmin(view.coarse.height_m) == pytest.approx(1.0, abs=2e-3)
    assert np.nanmax(view.coarse.height_m) == pytest.approx(1.0, abs=2e-3)


def test_pulses_without_return_are_missing_where_they_should_have_hit() -> None:
    hole = (np.array([-1.0, -4.0]), np.array([2.0, -1.0]))
    view = fly(GridMapper(make_rig(), PARAMS), motion, moving_scan(20000, hole=hole))
    grid = view.coarse
    rows, cols = np.nonzero(grid.missing > 0)
    centres = grid.origin_xy_m + (np.column_stack([cols, rows]) + 0.5) * grid.cell_m
    assert rows.size > 50 and (centres > hole[0] - 0.2).all()
    assert (centres < hole[1] + 0.2).all()
    deep = (centres > hole[0] + 0.2).all(axis=1) & (centres < hole[1] - 0.2).all(axis=1)
    assert (grid.count[rows[deep], cols[deep]] == 0).all()


def painted(tick: int, left: int, right: int) -> CameraImage:
    """Red of these levels in the left and the right half, half of it in green, and blue of 7."""
    rgb = np.zeros((480, 848, 3), np.uint8)
    rgb[:, :424, 0], rgb[:, 424:, 0] = left, right
    rgb[..., 1], rgb[..., 2] = rgb[..., 0] // 2, 7
    return CameraImage(tick=tick, time_s=tick / 600.0, rgb=rgb)


def red_by_place(view: MapView) -> tuple[Array, Array]:
    """y and red of the coloured cells."""
    grid = view.coarse
    rows, cols = np.nonzero(np.isfinite(grid.rgb[..., 0]))
    red, green, blue = grid.rgb[rows, cols].T
    np.testing.assert_allclose([2.0 * green, blue], [red, np.full_like(blue, 7.0)], rtol=1e-5)
    return grid.origin_xy_m[1] + (rows + 0.5) * grid.cell_m, red


def test_an_image_is_placed_where_it_was_taken_not_where_it_arrived() -> None:
    """20 m/s to the left: 1.2 m between exposure at y = 4 m and delivery."""

    def body(time_s: float) -> Pose:
        return Pose(np.eye(3), np.array([0.0, 20.0 * time_s, 12.0]))

    times = 0.1 + np.linspace(0.1 / 6000, 0.1, 6000)
    scan = cast_scan(60, beam_fan(6000, 0.86, 0.22, 1), [body(t) for t in times])
    images = (painted(120, 200, 100),)
    y, red = red_by_place(fly(GridMapper(make_rig(), PARAMS), body, scan, images=images))
    assert (red[(y > 4.3) & (y < 9.0)] == 200.0).all() and (red[y < 3.7] == 100.0).all()
    assert 8.0 < np.abs(y - 4.0).max() < 8.6  # half of the view; returns come from further aside


def test_a_return_has_the_colour_of_the_image_nearest_in_time() -> None:
    """The scan sweeps from left to right between a dark image and a bright one."""
    directions = beam_fan(6000, 0.5, 0.22, 1)
    directions = directions[np.argsort(directions[:, 0])]
    scan = cast_scan(60, directions, [at_height(12.0)] * 6000)
    images = painted(60, 50, 60), painted(120, 240, 250)
    mapper = GridMapper(make_rig(), PARAMS)
    y, red = red_by_place(fly(mapper, at_height(12.0), scan, images=images))
    early, late_ones = red[y > 0.5], red[y < -0.5]
    assert len(early) > 100 and len(late_ones) > 100
    assert (early <= 60.0).all() and (late_ones >= 240.0).all()


def test_the_colour_of_a_cell_is_the_mean_of_its_returns() -> None:
    """A dark scan of 30 returns, then a bright one of 90."""
    mapper = GridMapper(make_rig(), PARAMS)
    for start, count, level in ((0, 30, 40), (600, 90, 200)):
        down = np.tile([[0.004, 0.004, 1.0]], (count, 1))
        scan = cast_scan(start + 60, down, [at_height(12.0)] * count)
        images = (painted(start + 120, level + 10, level),)
        view = fly(mapper, at_height(12.0), scan, start, images)
    (red,) = red_by_place(view)[1]
    assert red == pytest.approx(160.0, rel=1e-5)


def test_colours_are_taken_through_the_lens() -> None:
    """Tangent 0.5 to the right, k1 = -0.2: 0.5 (1 - 0.05) times the focal length of 100."""
    image = np.repeat(np.arange(200, dtype=np.uint8)[None, :, None], 3, axis=2).repeat(100, axis=0)
    colours = np.full((1, 3), np.nan, np.float32)
    ahead = np.array([[0.5, 0.0, 1.0]], np.float32)
    kernels.sample_colours(
        Pulses(np.zeros((1, 3), np.float32), ahead, np.full(1, 7.0, np.float32)),
        (0, 1), (0, 0), image, Frame.of(Pose.identity()),
        Lens(100.0, 100.0, 99.2, 50.0, -0.2, 0.0, 0.0, 0.0, 0.0, False), colours,
    )  # fmt: skip
    assert colours[0].tolist() == [round(99.2 + 47.5)] * 3


def test_spread_is_exact_and_extremes_fade() -> None:
    """Heights of 0.1 and -0.1 m in turn, then a minute later only the mean."""
    mapper = GridMapper(make_rig(), dataclasses.replace(PARAMS, extreme_memory_s=60.0))
    down = np.tile([[0.004, 0.004, 1.0]], (100, 1))
    for start, swing in ((0, 0.1), (36_000, 0.0)):
        scan = cast_scan(start + 60, down, [at_height(12.0)] * 100)
        ranges = scan.ranges + np.float32(swing) * (-1.0) ** np.arange(100)
        levels = np.tile([20, 60], 50).astype(np.uint8)
        scan = dataclasses.replace(scan, ranges=ranges.astype(np.float32), intensity=levels)
        view = fly(mapper, at_height(12.0), scan, start)
        if swing:
            assert np.nanmax(view.coarse.height_std_m) == pytest.approx(0.1, rel=1e-3)
            assert np.nanmax(view.coarse.intensity) == pytest.approx(40.0, rel=1e-3)
    kept = 0.1 * np.exp(-1.0)
    assert np.nanmax(view.coarse.max_height_m) == pytest.approx(kept, rel=0.01)
    assert np.nanmin(view.coarse.min_height_m) == pytest.approx(-kept, rel=0.01)
    assert np.nanmax(view.coarse.height_std_m) == pytest.approx(0.1 / np.sqrt(2.0), rel=1e-3)


def test_a_pulse_without_return_says_nothing_beyond_the_reach() -> None:
    hole = (np.array([-1.0, -4.0]), np.array([2.0, -1.0]))
    for reach_m, shown in ((60.0, True), (11.0, False)):
        params = dataclasses.replace(PARAMS, missing_max_reach_m=reach_m)
        view = fly(GridMapper(make_rig(), params), motion, moving_scan(4000, hole=hole))
        assert (view.coarse.missing > 0).any() == shown


def test_many_pulses_without_return_outweigh_returns() -> None:
    """Of four kept in mind, each further one takes a quarter of the returns' count."""
    count, missing = np.full((1, 2), 10.0, np.float32), np.zeros((1, 2), np.float32)
    spots = np.full((6, 2), 0.1, np.float32)
    kernels.accumulate_missing(spots, Grid(0.0, 0.0, 0.2), 4.0, count, missing)
    np.testing.assert_allclose(missing, [[4.0, 0.0]])
    np.testing.assert_allclose(count, [[10.0 * 0.75**2, 10.0]])


def test_recent_returns_outweigh_old_ones() -> None:
    """After the cap a raised floor is learnt at the rate of the cap, not of all history."""
    mapper = GridMapper(make_rig(), dataclasses.replace(PARAMS, count_cap=50.0))
    straight_down = np.tile([[0.004, 0.004, 1.0]], (1000, 1))
    for floor, tick in ((12.0, 0), (11.0, 300)):
        scan = cast_scan(tick + 60, straight_down, [at_height(floor)] * 1000)
        view = fly(mapper, at_height(12.0), scan, tick)
    cells = view.coarse.count > 0
    assert view.coarse.count[cells].max() == 50.0
    assert view.coarse.height_m[cells].max() == pytest.approx(1.0, abs=1e-4)
    assert view.coarse.max_height_m[cells].max() == pytest.approx(1.0, abs=1e-4)


def test_fine_grid_opens_low_follows_and_keeps_the_overlap() -> None:
    mapper = GridMapper(make_rig(), PARAMS)
    directions = beam_fan(4000, 0.86, 0.22, 2)

    def hover(x: float, z: float, tick: int) -> MapView:
        still = Pose(np.eye(3), np.array([x, 0.0, z]))
        return fly(mapper, still, cast_scan(tick + 60, directions, [still] * 4000), tick)

    assert hover(0.0, 20.0, 0).fine is None
    low = hover(0.0, 10.0, 600)
    assert low.fine is not None and low.fine.cell_m == 0.05
    before, old_count = low.fine.origin_xy_m, low.fine.count.copy()
    moved = hover(7.0, 10.01, 1200)  # the very same ranges again would be a frozen sensor
    assert moved.fine is not None
    assert moved.fine.origin_xy_m == pytest.approx(before + np.array([7.0, 0.0]))
    shift = round(7.0 / 0.05)
    common = moved.fine.count[:, : 480 - shift]
    assert (common >= old_count[:, shift:]).all() and old_count[:, shift:].sum() > 0
    with pytest.raises(ValueError, match="read-only"):
        moved.fine.count[0, 0] = 1.0


def test_the_fine_grid_opens_by_the_height_above_the_ground_below() -> None:
    """20 m above the take-off, 9 m above a hill that the first scan shows."""
    mapper = GridMapper(make_rig(), PARAMS)
    views = []
    for start in (0, 120):
        scan = cast_scan(start + 60, beam_fan(4000, 0.86, 0.22, start), [at_height(9.0)] * 4000)
        views.append(fly(mapper, at_height(20.0), scan, start))
    assert views[0].fine is None and views[1].fine is not None


def test_not_a_number_in_pose_or_range_leaves_the_map_clean() -> None:
    mapper = GridMapper(make_rig(), PARAMS)
    scan = moving_scan(2000)
    ranges = scan.ranges.copy()
    ranges[::7] = np.nan
    fly(mapper, motion, dataclasses.replace(scan, ranges=ranges))
    broken = Pose(np.full((3, 3), np.nan), np.full(3, np.nan))
    view = mapper.update(make_obs(159, scans=(scan,)), make_estimate(159, broken))
    seen = view.coarse.count > 0
    assert seen.any() and np.isfinite(view.coarse.height_m[seen]).all()


def raised_track(start_s: float, end_s: float, by_m: float = 1.0) -> PoseTrack:
    """The true motion, ``by_m`` too high: what it places differs from the causal poses."""
    times = np.arange(round(start_s * 200), round(end_s * 200) + 1) / 200.0
    poses = [motion(t) for t in times]
    return PoseTrack(
        times_s=times,
        positions_odom=np.array([p.translation for p in poses]) + np.array([0.0, 0.0, by_m]),
        quats_wxyz=np.array([quat_wxyz_from_matrix(p.rotation) for p in poses]),
    )


def fly_with_tracks(
    scans: dict[int, LidarScan], tracks: dict[int, PoseTrack], ticks: int
) -> list[MapView]:
    """The map after every update; scans and tracks by the tick of their arrival."""
    mapper = GridMapper(make_rig(), PARAMS)
    views = []
    for tick in range(0, ticks, 3):
        estimate = make_estimate(tick, motion(tick / 600.0))
        estimate = dataclasses.replace(estimate, scan_track=tracks.get(tick))
        scan = scans.get(tick)
        views.append(mapper.update(make_obs(tick, scans=(scan,) if scan else ()), estimate))
    return views


def mean_height(view: MapView) -> float:
    return float(np.nanmean(view.coarse.height_m))


def test_a_scan_waits_for_a_track_that_comes_later() -> None:
    """Held back by the estimator for 60 ms, the scan is placed by its track, not by the causal
    poses."""
    tracks = {30: raised_track(0.0, 0.05), 192: raised_track(0.1, 0.2)}
    views = fly_with_tracks({156: moving_scan(4000)}, tracks, 210)
    assert [view.version for view in views[:64]] == [0] * 64 and views[64].version == 1
    assert mean_height(views[-1]) == pytest.approx(1.0, abs=2e-3)


def test_a_scan_without_a_track_is_placed_by_the_causal_poses_in_the_end() -> None:
    """0.3 s after its end; an estimator that never gives tracks makes no scan wait."""
    views = fly_with_tracks({156: moving_scan(4000)}, {30: raised_track(0.0, 0.05)}, 330)
    first = next(n for n, view in enumerate(views) if view.version == 1)
    assert 3 * first == 120 + 180 and mean_height(views[-1]) == pytest.approx(0.0, abs=2e-3)
    assert fly_with_tracks({156: moving_scan(4000)}, {}, 160)[156 // 3].version == 1


def test_a_scan_older_than_one_with_a_track_waits_no_longer() -> None:
    """The order of the scans is kept: the estimator has refused the older one."""
    later = dataclasses.replace(
        moving_scan(4000, seed=1), start_tick=120, end_tick=180, start_time_s=0.2, end_time_s=0.3
    )
    tracks = {30: raised_track(0.0, 0.05), 216: raised_track(0.2, 0.3)}
    views = fly_with_tracks({156: moving_scan(4000), 216: later}, tracks, 220)
    assert views[213 // 3].version == 0 and views[216 // 3].version == 2


def test_histograms_hold_every_return_of_the_coarse_and_the_fine_map() -> None:
    scan = cast_scan(60, beam_fan(5000, 0.5, 0.3, 2), [at_height(8.0)] * 5000)
    view = fly(GridMapper(make_rig(), PARAMS), at_height(8.0), scan)
    assert view.fine is not None
    for grid in (view.coarse, view.fine):
        assert grid.histogram is not None and grid.histogram_base_m is not None
        np.testing.assert_array_equal(grid.histogram.sum(axis=2, dtype=np.float32), grid.count)
        seen = grid.count > 0
        assert seen.any() and (grid.histogram_base_m < grid.min_height_m)[seen].all()
        with pytest.raises(ValueError, match="read-only"):
            grid.histogram[0, 0, 0] = 1
        assert np.abs(grid.ground().height_m[seen]).max() < 0.02
