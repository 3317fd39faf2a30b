"""Rolling shutter: the instants of an image's rows, and rays from where the camera was at each.

The pose at a row is that at the image's stamp, moved on by the row's offset in time at constant
angular rate and velocity. Within a readout of 15 ms a quadrotor's rates change little (Hedborg,
Forssen, Felsberg and Ringaby, "Rolling shutter bundle adjustment", CVPR 2012, interpolate poses
likewise).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from touchdown.estimator.filtering.error_state import POSITION, ROTATION
from touchdown.estimator.filtering.imu_propagation import exp_so3_each
from touchdown.estimator.typing import Array
from touchdown.sim.frames import Pose


@dataclass(frozen=True, slots=True)
class Shutter:
    """Readout of an image whose last row is exposed at its stamp."""

    readout_s: float = 0.0
    """from the first row to the last; 0: all rows at once"""

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
