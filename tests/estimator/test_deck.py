"""A deck as scans and images show it: surfaces, filter, corners, and what finds and loses it."""

import dataclasses

import cv2
import numpy as np
import pytest
from scipy.linalg import expm

from touchdown.estimator.api import SWAY, Estimate, swayed
from touchdown.estimator.deck.features import DeckFeatures
from touchdown.estimator.deck.filters import DeckFilter
from touchdown.estimator.deck.odometry import DeckOdometry
from touchdown.estimator.deck.surfaces import PlaneFit, fit_plane, surfaces, thinning_part
from touchdown.sim.api import (
    CameraImage,
    CameraIntrinsics,
    LidarScan,
    Observation,
    RangefinderSample,
    SensorNeeds,
    SensorRig,
)
from touchdown.sim.frames import BODY_FROM_DOWNWARD_OPTICAL, Pose
from touchdown.sim.typing import Array

from support.flight_fakes import make_estimate
from support.landing_support import make_obs, make_rig
from support.messages import make_scan

RNG = np.random.default_rng(3)
SPEED = np.array([2.5, -1.0, 0.0])


def plate(size: tuple[float, float], middle: Array, count: int = 6000) -> Array:
    xy = RNG.uniform(-0.5, 0.5, (count, 2)) * size
    return np.column_stack([xy, RNG.normal(0.0, 0.02, count)]) + middle


def test_a_step_parts_surfaces_and_the_edge_of_view_clips_them() -> None:
    deck, house = plate((8.0, 5.0), np.zeros(3)), plate((3.0, 5.0), np.array([5.6, 0.0, 2.0]))
    points = np.concatenate([deck, house])
    first, second = surfaces(points, points[:, 0] > 6.5)
    assert first.area_m2 == pytest.approx(40.0, rel=0.2) and not first.clipped
    assert second.area_m2 == pytest.approx(15.0, rel=0.3) and second.clipped
    np.testing.assert_allclose(first.cells.mean(axis=0), 0.0, atol=0.1)
    assert second.height_m == pytest.approx(2.0, abs=0.02)


def test_a_glint_on_water_thins_out_and_a_deck_ends() -> None:
    below = plate((3.0, 3.0), np.array([6.0, 0.0, -1.2]), 700)
    deck = np.concatenate([plate((8.0, 5.0), np.zeros(3), 3000), below])
    first = surfaces(deck, np.zeros(len(deck), bool))[0]
    assert first.area_m2 == pytest.approx(40.0, rel=0.2)
    assert thinning_part(first, deck) < 0.05
    water = np.random.default_rng(3).uniform(-7.0, 7.0, (4000, 3)) * [1.0, 1.0, 0.005]
    returned = 1.0 / (1.0 + (np.linalg.norm(water[:, :2], axis=1) / 2.0) ** 2)
    glint = water[np.random.default_rng(4).random(4000) < returned]
    found = surfaces(glint, np.zeros(len(glint), bool))[0]
    assert thinning_part(found, glint) > 0.2


def test_a_plane_is_fitted_beside_what_stands_on_it() -> None:
    points = plate((6.0, 4.0), np.array([10.0, 3.0, 0.0]))
    points[:, 2] += 1.0 + points[:, :2] @ [0.1, -0.05]
    points[:400, 2] += 0.4
    plane = fit_plane(points, np.array([10.0, 3.0]))
    assert plane.height == pytest.approx(1.85, abs=0.01)
    np.testing.assert_allclose(plane.slopes, [0.1, -0.05], atol=0.005)
    assert plane.slope_sigma < 0.015


def test_an_oscillation_is_that_of_its_dynamics() -> None:
    for ahead in (0.0, 0.3, 2.0):
        expected = expm(SWAY * ahead) @ [0.4, -0.2]
        np.testing.assert_allclose(swayed(np.array([0.4, -0.2]), ahead), expected, atol=1e-12)


def site_at(time_s: float) -> Array:
    return np.array([5.0, 2.0, 1.0 + 0.3 * np.sin(1.0 * time_s)]) + time_s * SPEED


def test_the_filter_finds_course_heave_and_tilt() -> None:
    rng = np.random.default_rng(3)
    deck = DeckFilter(0.0, site_at(0.0), np.zeros(2))
    for time_s in np.arange(0.1, 20.0, 0.1):
        noisy = site_at(time_s) + rng.normal(0.0, 0.008, 3)
        slopes = np.array([0.05 * np.sin(time_s), 0.0])
        deck.see_plane(time_s, PlaneFit(noisy[2], slopes, 0.01, noisy))
        late = time_s - 0.04
        deck.see_place(late, site_at(late)[:2] + rng.normal(0.0, 0.008, 2), 0.02)
    track = deck.track(time_s + 0.1)
    np.testing.assert_allclose(track.site_odom, site_at(time_s + 0.1), atol=0.06)
    assert np.linalg.norm(track.velocity_odom[:2] - SPEED[:2]) < 0.2
    rate = 0.3 * np.cos(time_s + 0.1)
    assert track.velocity_odom[2] == pytest.approx(rate, abs=0.1)
    assert track.slopes[0, 0] == pytest.approx(0.05 * np.sin(time_s + 0.1), abs=0.01)
    heave, tilt = track.ahead(0.5)
    assert heave == pytest.approx(0.3 * np.cos(time_s + 0.6), abs=0.12) and tilt < 0.08
    assert track.seen_s == pytest.approx(time_s)
    deck.see_height(time_s + 0.2, 9.0)  # that is not the deck
    assert deck.seen_s == pytest.approx(time_s)


def test_a_deck_is_kept_although_a_tilted_odom_frame_accelerates_all() -> None:
    """By a degree and a half: 0.25 m/s^2."""
    rng = np.random.default_rng(3)
    deck, lean = DeckFilter(0.0, np.zeros(3), np.zeros(2), np.array([3.0, 0.0])), 0.25
    for time_s in np.arange(0.1, 30.0, 0.1):
        late = time_s - 0.05
        place = np.array([3.0 * late - 0.5 * lean * late**2, 0.0]) + rng.normal(0.0, 0.02, 2)
        deck.see_plane(time_s, PlaneFit(0.0, np.array([lean / 9.81, 0.0]), 0.01, np.zeros(3)))
        deck.see_place(late, place, 0.03)
    track = deck.track(time_s)
    np.testing.assert_allclose(track.acceleration_odom[:2], [-lean, 0.0], atol=0.06)
    np.testing.assert_allclose(track.velocity_odom[:2], [3.0 - lean * time_s, 0.0], atol=0.15)
    assert track.site_odom[0] == pytest.approx(3.0 * time_s - 0.5 * lean * time_s**2, abs=0.05)
    assert track.ahead(0.0)[1] < 0.006, "level"


def test_a_corner_of_the_deck_tells_the_height_of_its_middle_by_its_tilt() -> None:
    rng = np.random.default_rng(0)
    deck = DeckFilter(0.0, np.zeros(3), np.zeros(2))
    for time_s in np.arange(0.1, 6.0, 0.1):
        middle, size = (np.zeros(3), 5.0) if time_s < 5.0 else (np.array([4.0, 0.0, 0.0]), 0.6)
        points = rng.uniform(-0.5, 0.5, (80, 3)) * [size, size, 0.0] + middle
        points[:, 2] = rng.normal(0.0, 0.03, 80)
        deck.see_plane(time_s, fit_plane(points, np.zeros(2)))
        assert abs(deck.surface(time_s)[0][2]) < 0.06


def test_a_height_is_less_sure_where_a_tilt_that_is_not_known_leads_to_it() -> None:
    deck = DeckFilter(0.0, np.zeros(3), np.zeros(2))
    deck.see_plane(0.1, PlaneFit(0.0, np.zeros(2), 1.0, np.array([4.0, 0.0, 0.4])))
    assert 0.05 < deck.surface(0.1)[0][2] < 0.25


CAMERA = CameraIntrinsics(width=424, height=240, fx=300.0, fy=300.0, cx=211.5, cy=119.5)
PX_PER_M = 40.0
PICTURE = cv2.GaussianBlur(RNG.uniform(0, 255, (480, 640)).astype(np.uint8), (0, 0), 3)
PICTURE = cv2.normalize(PICTURE, None, 0, 255, cv2.NORM_MINMAX)


def drawn(camera: Pose, site: Array) -> Array:
    """The image of a level deck with `PICTURE` on it, its middle at ``site``."""
    k = CAMERA.matrix()
    view = camera.inverse()
    x, y = (view.rotation[:, axis] / PX_PER_M for axis in (0, 1))
    corner = view.apply(site - [0.5 * 640 / PX_PER_M, 0.5 * 480 / PX_PER_M, 0.0])
    return cv2.warpPerspective(PICTURE, k @ np.column_stack([x, y, corner]), (424, 240))


def test_corners_follow_a_deck_that_scans_no_longer_place() -> None:
    cells = np.stack(np.meshgrid(np.arange(-7, 7, 0.4), np.arange(-5, 5, 0.4)), -1).reshape(-1, 2)
    features, height = DeckFeatures(CAMERA, cells), 6.0
    deck = DeckFilter(0.0, site_at(0.0), np.zeros(2))
    for step in range(30):
        time_s = 0.1 * step
        site = site_at(time_s)
        vehicle = np.array([*site[:2], 0.0]) + [0.3 * np.sin(time_s), 0.2, 1.0 + height]
        camera = Pose(BODY_FROM_DOWNWARD_OPTICAL, vehicle)
        deck.see_height(time_s, site[2])
        agreed = features.update(drawn(camera, site), camera, deck, time_s)
    assert agreed > 20
    place, _ = deck.surface(time_s)
    np.testing.assert_allclose(place[:2], site[:2], atol=0.08)
    np.testing.assert_allclose(deck.velocity[:2], SPEED[:2], atol=0.15)


def test_corners_from_far_away_know_a_place_no_better_than_the_attitude_is_known() -> None:
    cells = np.stack(np.meshgrid(np.arange(-7, 7, 0.4), np.arange(-5, 5, 0.4)), -1).reshape(-1, 2)
    features, site = DeckFeatures(CAMERA, cells), np.zeros(3)
    deck = DeckFilter(0.0, site, np.zeros(2))
    camera = Pose(BODY_FROM_DOWNWARD_OPTICAL, np.array([0.0, 0.0, 20.0]))
    for step in range(3):
        agreed = features.update(drawn(camera, site), camera, deck, 0.1 * step)
    assert agreed > 20
    assert 0.1 < deck.track(0.2).sigma_m < 0.2


class Still:
    """An estimator of a vehicle that hovers; keeps what it is told."""

    needs = SensorNeeds()

    def __init__(self) -> None:
        self.told: list[Observation] = []

    def update(self, obs: Observation) -> Estimate:
        self.told.append(obs)
        return make_estimate(obs.time_s, np.array([0.0, 0.0, 25.0]))


def scan_of(tick: int, rig_pose: Pose, decks: list[tuple[Array, tuple[float, float]]]) -> LidarScan:
    """Of a hovering vehicle over nothing but level plates, (middle, size) each, at their places of
    the end of the scan."""
    angles = RNG.uniform(-1.0, 1.0, (12_000, 2)) * [0.7, 0.22]
    directions = np.column_stack([np.tan(angles), np.ones(12_000)])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    beams, ranges = directions @ rig_pose.rotation.T, np.zeros(12_000)
    for middle, size in decks:
        way = (middle[2] - rig_pose.translation[2]) / beams[:, 2]
        met = rig_pose.translation + way[:, None] * beams
        on = (np.abs(met[:, :2] - middle[:2]) < 0.5 * np.array(size)).all(axis=1)
        nearer = on & ((ranges == 0.0) | (way < ranges))
        ranges[nearer] = way[nearer]
    return make_scan(tick, directions, ranges, 0.1, 30)


def test_the_deck_is_the_largest_surface_once_all_of_it_is_in_view() -> None:
    """A bow comes first; the odometry gets no scan from then on until the deck is gone."""
    rig, inner = make_rig((30.0, 30.0, 0.0)), Still()
    odometry = DeckOdometry(inner, rig)
    lidar = Pose(np.eye(3), np.array([0.0, 0.0, 25.0])) @ rig.body_from_lidar
    found_s, seen = None, []
    for tick in range(3, 600 * 14, 3):
        time_s = tick / 600.0
        middle = np.array([0.0, -28.0 + 3.0 * time_s, 1.0])
        bow = middle + [0.0, 7.0, 0.8]
        scans = ()
        if tick % 60 == 0:
            gone = time_s > 10.5
            plates = [] if gone else [(middle, (5.0, 8.0)), (bow, (4.5, 5.0))]
            scans = (scan_of(tick, lidar, plates),)
        estimate = odometry.update(make_obs(tick, scans=scans))
        if estimate.deck is not None and found_s is None:
            found_s = time_s
            assert estimate.deck.site_odom == pytest.approx(middle, abs=0.3)
            assert estimate.deck.velocity_odom == pytest.approx([0.0, 3.0, 0.0], abs=1.0)
        seen.append((time_s, estimate.deck, len(inner.told[-1].scans), middle))
    assert found_s is not None and 3.5 < found_s < 7.0
    at_ten = next(one for one in seen if one[0] >= 10.0)
    assert at_ten[1] is not None
    np.testing.assert_allclose(at_ten[1].site_odom, at_ten[3], atol=0.15)
    np.testing.assert_allclose(at_ten[1].velocity_odom, [0.0, 3.0, 0.0], atol=0.2)
    told = [time_s for time_s, _, scans, _ in seen if scans]
    assert not [time_s for time_s in told if found_s < time_s < 12.0] and told[-1] > 13.0
    assert seen[-1][1] is None


@pytest.mark.parametrize("swapped", [False, True])
def test_a_deck_that_is_led_astray_comes_back_and_water_is_none(swapped: bool) -> None:
    """Without corners, its site is shifted once; or level water is where the deck was."""
    rig, inner = make_rig((30.0, 30.0, 0.0)), Still()
    odometry, found_s = DeckOdometry(inner, rig), None
    lidar = Pose(np.eye(3), np.array([0.0, 0.0, 25.0])) @ rig.body_from_lidar
    for tick in range(60, 600 * 8, 60):
        time_s = tick / 600.0
        middle = np.array([-1.0 + 0.5 * time_s, 0.0, 1.0])
        late = swapped and found_s is not None and time_s > found_s + 1.0
        size = (40.0, 40.0) if late else (5.0, 8.0)
        for earlier in range(tick - 57, tick, 3):
            odometry.update(make_obs(earlier))
        scan = scan_of(tick, lidar, [(middle, size)])
        deck = odometry.update(make_obs(tick, scans=(scan,))).deck
        if deck is not None and found_s is None:
            found_s = time_s
            if not swapped:
                assert odometry._filter is not None
                for axis in odometry._filter._xy:
                    axis.state[0] += 2.0
                    axis.covariance *= 1e-3
    assert found_s is not None and found_s < 2.0
    assert (deck is None) == swapped
    if deck is not None:
        np.testing.assert_allclose(deck.site_odom, middle, atol=0.3)


def test_a_glint_is_not_followed() -> None:
    rig = make_rig((30.0, 30.0, 0.0))
    odometry = DeckOdometry(Still(), rig)
    lidar = Pose(np.eye(3), np.array([0.0, 0.0, 25.0])) @ rig.body_from_lidar
    sheet = scan_of(60, lidar, [(np.zeros(3), (60.0, 60.0))])
    aside = np.linalg.norm(sheet.directions[:, :2], axis=1) * 25.0
    lost = RNG.random(len(aside)) > 1.0 / (1.0 + (aside / 1.5) ** 2)
    ranges = np.where(lost, 0.0, sheet.ranges).astype(np.float32)
    for tick in range(60, 600 * 2, 60):
        for earlier in range(tick - 57, tick, 3):
            odometry.update(make_obs(earlier))
        glint = dataclasses.replace(
            sheet, ranges=ranges, start_tick=tick - 60, end_tick=tick,
            start_time_s=(tick - 60) / 600.0, end_time_s=tick / 600.0,
        )  # fmt: skip
        assert odometry.update(make_obs(tick, scans=(glint,))).deck is None


TAG_M = 1.5


def photographed(rig: SensorRig, body: Pose, middle: Array, side_m: float) -> Array:
    """The image of a level grey deck with a tag of ``side_m`` at ``middle``."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    tag = np.pad(cv2.aruco.generateImageMarker(dictionary, 0, 400), 50, constant_values=255)
    view = (body @ rig.body_from_camera).inverse()
    x, y = view.rotation[:, 0], -view.rotation[:, 1]  # rows go down, y up
    corner = view.apply(middle) - 250 * side_m / 400 * (x + y)
    onto = rig.camera.matrix() @ np.column_stack([x * side_m / 400, y * side_m / 400, corner])
    size = rig.camera.width, rig.camera.height
    seen = cv2.warpPerspective(tag, onto, size, borderValue=90, flags=cv2.INTER_AREA)
    return np.repeat(cv2.GaussianBlur(seen, (0, 0), 0.6)[..., None], 3, axis=2)


def test_a_tag_places_the_site_where_its_deck_is_high() -> None:
    """The tag is aside of the middle, which scans see, and larger than told, so that it seems
    nearer by a metre."""
    rig = make_rig((30.0, 30.0, 0.0))
    body = Pose(np.eye(3), np.array([0.0, 0.0, 25.0]))
    odometry, seen = DeckOdometry(Still(), rig, TAG_M), []
    for tick in range(3, 600 * 6, 3):
        time_s = tick / 600.0
        middle = np.array([0.3, -6.0 + 2.0 * time_s, 1.0])
        tag = middle + [0.3, 0.0, 0.0]
        images, scans = (), ()
        if tick % 60 == 0:
            scans = (scan_of(tick, body @ rig.body_from_lidar, [(middle, (8.0, 5.0))]),)
            images = (
                CameraImage(
                    tick=tick, time_s=time_s, rgb=photographed(rig, body, tag, 1.04 * TAG_M)
                ),
            )
        seen.append((time_s, odometry.update(make_obs(tick, scans=scans, images=images)).deck, tag))
    assert any(deck is not None for time_s, deck, _ in seen if time_s < 1.0)
    for time_s, deck, tag in seen:
        if time_s > 3.0:
            np.testing.assert_allclose(deck.site_odom, tag, atol=0.08)
            np.testing.assert_allclose(deck.velocity_odom, [0.0, 2.0, 0.0], atol=0.15)


def test_the_rangefinder_measures_the_height_below_the_reach_of_scans() -> None:
    rig, inner = make_rig(), Still()
    odometry = DeckOdometry(inner, rig)
    odometry.update(make_obs(3))
    odometry.update(make_obs(6))
    mount = np.array(rig.nav.rangefinder.position_body_m)
    for range_m, taken in ((0.3, True), (5.0, False)):
        deck = DeckFilter(0.0, np.array([0.0, 0.0, 25.0 + mount[2] - range_m]), np.zeros(2))
        odometry._filter = deck
        sample = RangefinderSample(tick=5, time_s=5 / 600.0, range_m=range_m + 0.1)
        before = deck.surface(0.0)[0][2]
        odometry.update(make_obs(9 if taken else 12, rangefinder=(sample,)))
        assert (deck.seen_s > 0.0) == taken
        assert (
            deck.surface(0.0)[0][2] < before - 0.05 if taken else deck.surface(0.0)[0][2] == before
        )
