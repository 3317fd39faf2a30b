"""Turn-on errors of an IMU: scale, alignment of the axes, response of the gyroscope to specific
force, saturation."""

from __future__ import annotations

import math
from zlib import crc32

import numpy as np

from touchdown.sim.api import ImuParams
from touchdown.sim.typing import Array


class ImuErrors:
    """The measurement of true rates and specific forces by one IMU; drawn once, from the seed."""

    def __init__(self, params: ImuParams, seed: int) -> None:
        scale, bend = params.scale_sigma, math.radians(params.misalignment_sigma_deg)
        self.matrix = np.eye(6)
        """(6, 6): measured rate and force from the true ones"""
        # Each error has its own stream, so that one at 0 leaves the draws of the others alone.
        for start in (0, 3):
            name = b"gyro" if start == 0 else b"accel"
            block = self.matrix[start : start + 3, start : start + 3]
            block += np.diag(scale * _normal(seed, name + b" scale", 3))
            across = ~np.eye(3, dtype=bool)
            block[across] += bend * _normal(seed, name + b" misalignment", 6)
        response = _normal(seed, b"gyro g sensitivity", 9).reshape(3, 3)
        self.matrix[:3, 3:] = params.gyro_g_sensitivity * response
        limits = np.repeat([params.gyro_range, params.accel_range], 3)
        self._limits = np.where(limits > 0.0, limits, np.inf)
        self._least = -self._limits
        self.distorts = bool((self.matrix != np.eye(6)).any())
        """False: the matrix is the identity"""
        self.saturates = bool(np.isfinite(self._limits).any())

    def sizes(self) -> dict[str, float]:
        """Root mean squares over the axes of both sensors: relative errors of scale, and
        misalignments in degrees."""
        blocks = np.array([self.matrix[:3, :3], self.matrix[3:, 3:]]) - np.eye(3)
        own = np.eye(3, dtype=bool)
        return {
            "imu_scale": float(np.sqrt((blocks[:, own] ** 2).mean())),
            "imu_misalignment_deg": math.degrees(float(np.sqrt((blocks[:, ~own] ** 2).mean()))),
        }

    def saturated(self, measured: Array) -> Array:
        """(6,) within the ranges."""
        return np.minimum(np.maximum(measured, self._least), self._limits)


def _normal(seed: int, name: bytes, count: int) -> Array:
    return np.random.default_rng([seed, crc32(b"imu " + name)]).standard_normal(count)
