"""Who has been seen lately in images, and where he stands."""

from dataclasses import dataclass

import numpy as np

from touchdown.landing.watch.people import SURE, PeopleDetector, Person
from touchdown.sim.api import CameraImage, SensorRig
from touchdown.sim.frames import Pose
from touchdown.sim.geometry.lens import bearing, project
from touchdown.sim.typing import Array

_MIDDLE_M = 0.8
"""height above the ground at which the middle of a box is taken to be"""
_SAME_M = 1.2
"""distance between two images up to which somebody is the same: a runner's way in 0.3 s"""
_TWICE = 2
"""images in which somebody has to be found who is not found surely"""
_LATELY_S, _MOVES_AFTER, _MOVES_MPS = 0.9, 3, 0.7
"""time over which a velocity is measured, images that it needs, and speed below which one stands"""
_BORDER_PX = 4.0
"""distance to the border of an image within which a box may be of a part of somebody"""
_LOST_S = 0.7
"""time after which somebody is gone who should be in the image and is not found"""
_REMEMBERED_S = 10.0
"""time for which somebody counts who has left the image"""


@dataclass(slots=True)
class Sighting:
    """Somebody in images: times, and places (2,) in the odom frame, of the last second; the highest
    score; in how many images."""

    times_s: list[float]
    places_odom: list[Array]
    score: float
    count: int = 1

    @property
    def xy_odom(self) -> Array:
        """(2,) where he was seen last."""
        return self.places_odom[-1]

    @property
    def last_s(self) -> float:
        """When he was seen last, by time of the image."""
        return self.times_s[-1]

    @property
    def velocity_odom(self) -> Array:
        """(2,) m/s; 0 where he stands or it is not known yet."""
        times = np.array(self.times_s) - np.mean(self.times_s)
        if len(times) < _MOVES_AFTER:
            return np.zeros(2)
        velocity: Array = times @ np.array(self.places_odom) / (times @ times)
        return velocity if np.linalg.norm(velocity) > _MOVES_MPS else np.zeros(2)

    def add(self, time_s: float, xy_odom: Array, score: float) -> None:
        """Takes another image of him."""
        self.times_s.append(time_s)
        self.places_odom.append(xy_odom)
        while self.times_s[0] < time_s - _LATELY_S:
            del self.times_s[0], self.places_odom[0]
        self.score, self.count = max(self.score, score), self.count + 1


class Sightings:
    """Follows who is found in images. Positions are relative to the vehicle over seconds, as all of
    the watch's."""

    def __init__(self, rig: SensorRig, detector: PeopleDetector) -> None:
        self._rig, self._detector = rig, detector
        self._known: list[Sighting] = []

    def clear(self) -> None:
        """Forgets all."""
        self._known.clear()

    def add(self, image: CameraImage, odom_from_body: Pose, ground_z: float) -> None:
        """Takes an image, from the pose of the body when it was exposed; ``ground_z``: height of
        the ground below, odom frame."""
        camera = odom_from_body @ self._rig.body_from_camera
        per_pixel = max(float(camera.translation[2]) - ground_z, 0.0) / self._rig.camera.fx
        for box in self._detector.find(image.rgb, per_pixel):
            xy = self._place(box.x0 + box.x1, box.y0 + box.y1, camera, ground_z)
            if xy is None:
                continue
            near = [one for one in self._known if np.linalg.norm(one.xy_odom - xy) < _SAME_M]
            same = min(near, key=lambda one: float(np.linalg.norm(one.xy_odom - xy)), default=None)
            if same is None:
                self._known.append(Sighting([image.time_s], [xy], box.score))
            elif same.last_s < image.time_s:
                same.add(image.time_s, xy if self._is_whole(box) else same.xy_odom, box.score)
        self._known = [
            one for one in self._known if self._counts(one, image.time_s, camera, ground_z)
        ]

    def present(self) -> list[Sighting]:
        """Those found surely, or in two images or more."""
        return [one for one in self._known if one.count >= _TWICE or one.score >= SURE]

    def _counts(self, one: Sighting, now_s: float, camera: Pose, ground_z: float) -> bool:
        ago = now_s - one.last_s
        if ago <= _LOST_S:
            return True
        return ago <= _REMEMBERED_S and not self._in_image(one.xy_odom, camera, ground_z)

    def _is_whole(self, box: Person) -> bool:
        """Whether a box is well inside of the image: the middle of a part of somebody wanders."""
        beyond = max(box.x1 - self._rig.camera.width, box.y1 - self._rig.camera.height)
        return min(box.x0, box.y0, -beyond) > _BORDER_PX

    def _place(self, two_x: float, two_y: float, camera: Pose, ground_z: float) -> Array | None:
        """(2,) where the ray through the middle of a box meets the height of a person's middle."""
        k = self._rig.camera
        ray = camera.rotation @ bearing(k, np.array([0.5 * two_x, 0.5 * two_y]))
        drop = ground_z + _MIDDLE_M - camera.translation[2]
        if ray[2] >= -0.1 or drop >= -0.3:
            return None
        return (camera.translation + drop / ray[2] * ray)[:2]

    def _in_image(self, xy: Array, camera: Pose, ground_z: float) -> bool:
        """Whether the middle of somebody at ``xy`` (2,) is well inside of the image."""
        k = self._rig.camera
        point = camera.inverse().apply(np.array([*xy, ground_z + _MIDDLE_M]))
        if point[2] < 0.2:
            return False
        x, y = project(k, point)[0]
        return bool(0.05 * k.width < x < 0.95 * k.width and 0.05 * k.height < y < 0.95 * k.height)
