"""The camera: distortion of its lens, and its rolling shutter.

The rows of an image are exposed one after the other. Within a readout of 15 ms a quadrotor's rates
change little, so that the pose at a row is that at one instant moved on at a constant twist
(Hedborg, Forssen, Felsberg and Ringaby, "Rolling shutter bundle adjustment", CVPR 2012,
interpolate poses likewise). The pixels found are moved to that instant, and whatever uses them
afterwards needs no model of the shutter. The instant also takes up the part of an IMU step between
the filter's state and the image. Landmarks of `livo` keep the instants of their rows instead
(``Shutter``, ``rows_of_keyframe``).
"""

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.filtering.error_state import POSITION, ROTATION
from touchdown.estimator.filtering.imu_propagation import exp_so3_each
from touchdown.estimator.filtering.keyframes import bearing_rays
from touchdown.sim.api import CameraImage, CameraIntrinsics, SensorRig
from touchdown.sim.frames import Pose, cross
from touchdown.sim.geometry.lens import bearing
from touchdown.sim.typing import Array, Bytes


class Undistorter:
    """Resamples images to a pinhole camera of the same size: with the same matrix, or of a fisheye
    with one that shows as much of its image as has no black edge. A pinhole without distortion
    leaves images as they are.

    ``rig``: the given one with that pinhole as its camera."""

    def __init__(self, rig: SensorRig) -> None:
        camera = rig.camera
        self.rig = rig
        self._maps: tuple[NDArray[np.int16], NDArray[np.uint16]] | None = None
        size, matrix = (camera.width, camera.height), camera.matrix()
        if camera.lens == "fisheye":
            pinhole = _inside_fisheye(camera)
            self.rig = dataclasses.replace(rig, camera=pinhole)
            maps = cv2.fisheye.initUndistortRectifyMap(
                matrix, camera.distortion[:4], np.eye(3), pinhole.matrix(), size, cv2.CV_16SC2
            )
        elif np.any(camera.distortion):
            maps = cv2.initUndistortRectifyMap(
                matrix, camera.distortion, None, matrix, size, cv2.CV_16SC2
            )
        else:
            return
        self._maps = np.asarray(maps[0], np.int16), np.asarray(maps[1], np.uint16)

    def __call__(self, image: Bytes) -> Bytes:
        """Returns the undistorted image (H, W) or (H, W, 3)."""
        if self._maps is None:
            return image
        return np.asarray(cv2.remap(image, *self._maps, cv2.INTER_LINEAR), dtype=np.uint8)

    def grey(self, rgb: Bytes) -> Bytes:
        """Returns the undistorted grey image (H, W)."""
        return self(np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8))


def _inside_fisheye(camera: CameraIntrinsics) -> CameraIntrinsics:
    """The widest pinhole with square pixels that shows nothing beyond the middles of the edges of
    a fisheye's image, or beyond 60 degrees from the axis."""
    middles = np.diag([0.5 * camera.width - 1.0, 0.5 * camera.height - 1.0])
    angles = np.arctan(
        np.linalg.norm(bearing(camera, middles + [camera.cx, camera.cy])[:, :2], axis=1)
    )
    reach = np.tan(np.minimum(angles, _FISHEYE_EDGE))
    focal = float(np.max(0.5 * np.array([camera.width, camera.height]) / reach))
    return CameraIntrinsics(
        width=camera.width, height=camera.height, fx=focal, fy=focal,
        cx=0.5 * (camera.width - 1), cy=0.5 * (camera.height - 1),
    )  # fmt: skip


_FISHEYE_EDGE = np.radians(60.0)
_NEAREST_M = 0.05
_FARTHEST_HEIGHTS = 5.0
"""multiple of the camera's height: a ray that meets level ground farther off, or not at all, counts
so"""


def at_middle_row(image: CameraImage, rig: SensorRig) -> CameraImage:
    """The image stamped with the exposure of its middle row, not of its last."""
    early_s = 0.5 * rig.camera_readout_s
    if early_s == 0.0:
        return image
    time_s = max(image.time_s - early_s, 0.0)
    return dataclasses.replace(image, tick=round(time_s * rig.tick_hz), time_s=time_s)


def ground_depths(pixels: Array, camera: CameraIntrinsics, pose: Pose, ground_m: float) -> Array:
    """Depths (N,) along the optical axis of level ground of height ``ground_m`` at ``pixels``
    (N, 2). ``pose``: of the camera, z up."""
    height = max(float(pose.translation[2]) - ground_m, _NEAREST_M)
    down = -bearing_rays(pixels, camera) @ pose.rotation[2]
    return height / np.maximum(down, 1.0 / _FARTHEST_HEIGHTS)


@dataclasses.dataclass(frozen=True, slots=True)
class CameraTwist:
    """Twist of a camera in its own frame at the instant that pixels are moved to, and the delay of
    an image's middle row after that instant."""

    rate: Array
    """(3,) rad/s"""
    velocity: Array
    """(3,) m/s"""
    late_s: float

    @staticmethod
    def of_imu(rate: Array, velocity: Array, imu_from_camera: Pose, late_s: float) -> "CameraTwist":
        """The twist of a camera from angular rate and velocity (3,) of the IMU, in its frame."""
        rotation = imu_from_camera.rotation.T
        lever = imu_from_camera.translation
        return CameraTwist(rotation @ rate, rotation @ (velocity + cross(rate, lever)), late_s)


STATIONARY = CameraTwist(np.zeros(3), np.zeros(3), 0.0)


class ShutterModel:
    """Moves the pixels of a rolling shutter to one instant."""

    def __init__(self, rig: SensorRig) -> None:
        self._camera = rig.camera
        self._readout_s = rig.camera_readout_s

    def idle(self, twist: CameraTwist) -> bool:
        """True if no pixel moves: all rows are exposed at the instant itself."""
        return self._readout_s == 0.0 and twist.late_s == 0.0

    def row_delays(self, pixels: Array, late_s: float) -> Array:
        """Delays (N,) s of the rows of ``pixels`` (N, 2) after the instant."""
        fraction = pixels[:, 1] / max(self._camera.height - 1, 1) - 0.5
        return late_s + self._readout_s * np.clip(fraction, -0.5, 0.5)

    def to_instant(self, pixels: Array, depths: Array, twist: CameraTwist) -> Array:
        """Pixels (N, 2) at the instant, of ``pixels`` (N, 2) found in the image. ``depths`` (N,)
        along the optical axis, which matter to the translation alone."""
        if self.idle(twist) or len(pixels) == 0:
            return pixels
        delays = self.row_delays(pixels, twist.late_s)
        camera = self._camera
        focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
        rotations = exp_so3_each(delays[:, None] * twist.rate)
        points = np.einsum("nij,nj->ni", rotations, bearing_rays(pixels, camera)) * depths[:, None]
        points += delays[:, None] * twist.velocity
        front = points[:, 2] > _NEAREST_M
        scale = np.where(front, points[:, 2], 1.0)
        moved = points[:, :2] / scale[:, None] * focal + centre
        return np.where(front[:, None], moved, pixels)

    def at_instant(self, pixels: Array, pose: Pose, ground_m: float, twist: CameraTwist) -> Array:
        """As ``to_instant``, of points on level ground of height ``ground_m``; ``pose``: of the
        camera."""
        if self.idle(twist):
            return pixels
        return self.to_instant(pixels, ground_depths(pixels, self._camera, pose, ground_m), twist)

    def to_rows(self, pixels: Array, depths: Array, twist: CameraTwist) -> Array:
        """The inverse of ``to_instant``: where points expected at ``pixels`` (N, 2) at the instant
        appear in the image."""
        if self.idle(twist) or len(pixels) == 0:
            return pixels
        found = pixels
        for _ in range(2):
            found = found + pixels - self.to_instant(found, depths, twist)
        return found


@dataclasses.dataclass(frozen=True, slots=True)
class Shutter:
    """Readout of an image whose last row is exposed at its stamp."""

    readout_s: float = 0.0
    """time from the first row to the last; 0: all rows at once"""

    @property
    def middle_s(self) -> float:
        """Instant of the middle row less the stamp."""
        return -0.5 * self.readout_s

    def row_times(self, rows: Array, height: int) -> Array:
        """Instants (N,) of ``rows`` (N,), in pixels from the top, less the stamp."""
        return self.readout_s * (rows / max(height - 1, 1) - 1.0)


def rows_of_keyframe(
    rays: Array, twist: Array, imu_from_camera: Pose, row_times: Array
) -> tuple[Array, Array]:
    """Returns rays (N, 3) and their starts (N, 3), each from the pose at its row's instant, in the
    camera frame at the stamp.

    ``rays`` (N, 3) in the camera frame of their own instants; ``twist`` (6,): angular rate and
    velocity of the IMU in its own frame.
    """
    if not row_times.any():
        return rays, np.zeros_like(rays)
    to_camera, lever = imu_from_camera.rotation.T, imu_from_camera.translation
    rate = to_camera @ twist[ROTATION]
    velocity = to_camera @ (twist[POSITION] + np.cross(twist[ROTATION], lever))
    rotations = exp_so3_each(row_times[:, None] * rate)
    return np.einsum("nij,nj->ni", rotations, rays), row_times[:, None] * velocity
