"""People in images: where they stand, who is the same, and who is remembered."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from touchdown.landing.watch.people import Person, overlap, peaks
from touchdown.landing.watch.sightings import Sightings
from touchdown.sim.api import CameraImage, CameraIntrinsics
from touchdown.sim.frames import Pose

LENS = CameraIntrinsics(width=848, height=480, fx=617.0, fy=625.0, cx=423.5, cy=239.5)
DOWN = Pose(np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), np.zeros(3))
RIG: Any = SimpleNamespace(camera=LENS, body_from_camera=DOWN)


class Seen:
    """Finds people at places (x, y, z), world frame, from a pose, as boxes that the image cuts."""

    def __init__(self) -> None:
        self.people: list[tuple[float, float, float]] = []
        self.score, self.half_px = 0.45, 10.0
        self.pose = Pose(np.eye(3), np.zeros(3))

    def find(self, _image: Any, metres_per_pixel: float) -> tuple[Person, ...]:
        self.metres_per_pixel = metres_per_pixel
        found = []
        for place in self.people:
            x, y, z = (self.pose @ DOWN).inverse().apply(np.array(place))
            u, v = LENS.fx * x / z + LENS.cx, LENS.fy * y / z + LENS.cy
            if 0 <= u < LENS.width and 0 <= v < LENS.height:
                box = np.array([u, v, u, v]) + self.half_px * np.array([-1.0, -1.0, 1.0, 1.0])
                found.append(Person(*np.clip(box, 0.0, [847.0, 479.0] * 2), self.score))
        return tuple(found)


class Watched:
    """Sightings from images every 0.2 s."""

    def __init__(self) -> None:
        self.seen, self.time_s = Seen(), 0.0
        self.sightings = Sightings(RIG, self.seen)  # type: ignore[arg-type]

    def image(self, height: float, *people: tuple[float, float], away: float = 0.0) -> Any:
        self.seen.people = [(x, y, 0.8 - 3.0) for x, y in people]
        self.seen.pose = Pose(np.eye(3), np.array([away, 0.0, height - 3.0]))
        self.time_s += 0.2
        tick = round(600 * self.time_s)
        picture = CameraImage(tick=tick, time_s=self.time_s, rgb=np.zeros((2, 2, 3), np.uint8))
        self.sightings.add(picture, self.seen.pose, -3.0)
        return [tuple(np.round(one.xy_odom, 6)) for one in self.sightings.present()]


def test_somebody_is_where_he_stands_once_two_images_have_him() -> None:
    watched = Watched()
    assert watched.image(9.0, (1.0, -2.0)) == []
    assert watched.image(9.0, (1.0, -2.0)) == [(1.0, -2.0)]
    assert watched.image(8.0, (1.0, -2.0), away=0.5) == [(1.0, -2.0)]  # ego-motion is no motion
    assert watched.seen.metres_per_pixel == pytest.approx(8.0 / 617.0)


def test_who_walks_is_followed_and_two_are_two() -> None:
    watched = Watched()
    for step in range(4):
        present = watched.image(10.0, (0.6 * step - 2.0, 1.0), (2.0, -2.0))
        speeds = {round(float(one.velocity_odom[0]), 6) for one in watched.sightings.present()}
        assert speeds == (set(), {0.0}, {3.0, 0.0}, {3.0, 0.0})[step]
    assert sorted(present) == [(-0.2, 1.0), (2.0, -2.0)]


def test_slow_and_old_motion_is_none() -> None:
    watched = Watched()
    for step in range(12):
        watched.image(10.0, (min(0.4 * step, 2.0), 1.0), (-2.0, 0.1 * step - 1.0))
    assert all((one.velocity_odom == 0.0).all() for one in watched.sightings.present())


def test_who_is_found_surely_is_there_at_once() -> None:
    watched = Watched()
    watched.seen.score = 0.95
    assert watched.image(9.0, (1.0, -2.0)) == [(1.0, -2.0)]
    watched.seen.score = 0.4
    assert watched.image(9.0, (1.0, -2.0), (-2.0, 0.0)) == [(1.0, -2.0)]


def test_who_has_gone_is_forgotten_and_who_left_the_image_is_not() -> None:
    watched = Watched()
    for _ in range(2):
        watched.image(9.0, (0.0, 2.5))
    for _ in range(5):  # too low to see him
        assert watched.image(4.0) == [(0.0, 2.5)]
    for _ in range(3):
        watched.image(9.0)
    assert watched.image(9.0) == []  # he would be in the image
    for _ in range(2):
        watched.image(9.0, (0.0, 2.5))
    for _ in range(52):
        left = watched.image(4.0)
    assert left == []


@pytest.mark.parametrize("at", [(0.0, 5.0), (0.0, -5.0), (2.2, 0.0), (-2.2, 0.0)])
def test_whom_the_border_of_an_image_cuts_has_not_moved(at: tuple[float, float]) -> None:
    watched = Watched()
    watched.seen.half_px = 80.0
    assert [watched.image(height, at) for height in (9.97, 8.99, 8.21)] == [[], [at], [at]]
    assert not watched.sightings.present()[0].velocity_odom.any()


def test_what_is_level_with_the_camera_has_no_place() -> None:
    watched = Watched()
    assert watched.image(1.0, (0.2, 0.0)) == watched.image(1.0, (0.2, 0.0)) == []


def test_peaks_are_the_highest_of_their_boxes() -> None:
    heat = np.zeros((10, 12), np.float32)
    heat[4, 5], heat[4, 6], heat[8, 1] = 0.9, 0.8, 0.4
    sizes = np.full((2, 10, 12), 16.0, np.float32)
    found = peaks(heat, sizes, 0.35)
    assert found[0] == (14.0, 10.0, 30.0, 26.0, pytest.approx(0.9))
    assert len(found) == 2 and found[1][4] == pytest.approx(0.4)
    assert len(peaks(heat, sizes, 0.5)) == 1
    heat[4, 7] = 0.85  # no neighbour of the highest, and yet the same person
    assert len(peaks(heat, sizes, 0.5)) == 1
    assert overlap((0, 0, 2, 2), (1, 0, 3, 2)) == pytest.approx(1 / 3)
    assert overlap((0, 0, 1, 1), (2, 0, 3, 1)) == 0.0
