"""Who has been seen lately in images, and where he stands."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from touchdown.landing.watch.people import PeopleDetector
from touchdown.sim.api import CameraImage, SensorRig
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array

_MIDDLE_M = 0.8
"""height above the ground at which the middle of a box is taken to be"""
_SAME_M = 1.2
"""distance between two images up to which somebody is the same: a runner's way in 0.3 s"""
_TWICE = 2
"""images in which somebody has to be found"""
_LOST_S = 0.7
"""time after which somebody is gone who should be in the image and is not found"""
_REMEMBERED_S = 10.0
"""time for which somebody counts who has left the image"""


@dataclass(slots=True)
class Sighting:
    """Somebody: (2,) where, odom frame; when last, by time of the image; in how many images."""

    xy_odom: Array
    last_s: float
    count: int = 1


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
        found = [self._place(box.x0 + box.x1, box.y0 + box.y1, camera, ground_z)
                 for box in self._detector.find(image.rgb, per_pixel)]  # fmt: skip
        for xy in found:
            if xy is None:
                continue
            near = [one for one in self._known if np.linalg.norm(one.xy_odom - xy) < _SAME_M]
            same = min(near, key=lambda one: float(np.linalg.norm(one.xy_odom - xy)), default=None)
            if same is None:
                self._known.append(Sighting(xy, image.time_s))
            elif same.last_s < image.time_s:
                same.xy_odom, same.last_s, same.count = xy, image.time_s, same.count + 1
        self._known = [
            one for one in self._known if self._counts(one, image.time_s, camera, ground_z)
        ]

    def present(self) -> list[Sighting]:
        """Those found in two images or more."""
        return [one for one in self._known if one.count >= _TWICE]

    def _counts(self, one: Sighting, now_s: float, camera: Pose, ground_z: float) -> bool:
        ago = now_s - one.last_s
        if ago <= _LOST_S:
            return True
        return ago <= _REMEMBERED_S and not self._in_image(one.xy_odom, camera, ground_z)

    def _place(self, two_x: float, two_y: float, camera: Pose, ground_z: float) -> Array | None:
        """(2,) where the ray through the middle of a box meets the height of a person's middle."""
        k = self._rig.camera
        pixel = np.array([[[0.5 * two_x, 0.5 * two_y]]])
        x, y = cv2.undistortPoints(pixel, k.matrix(), k.distortion).ravel()
        ray = camera.rotation @ np.array([x, y, 1.0])
        drop = ground_z + _MIDDLE_M - camera.translation[2]
        if ray[2] >= -0.1 or drop >= -0.3:
            return None
        place: Array = (camera.translation + drop / ray[2] * ray)[:2]
        return place

    def _in_image(self, xy: Array, camera: Pose, ground_z: float) -> bool:
        """Whether the middle of somebody at ``xy`` (2,) is well inside of the image."""
        k = self._rig.camera
        point = camera.inverse().apply(np.array([*xy, ground_z + _MIDDLE_M]))
        if point[2] < 0.2:
            return False
        x, y = k.fx * point[0] / point[2] + k.cx, k.fy * point[1] / point[2] + k.cy
        return bool(0.05 * k.width < x < 0.95 * k.width and 0.05 * k.height < y < 0.95 * k.height)
