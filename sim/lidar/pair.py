"""Two LIDARs whose scans are merged into one, as drivers do."""

from zlib import crc32

import numpy as np

from touchdown.sim.api import LidarParams, LidarScan
from touchdown.sim.frames import Pose, so3_exp
from touchdown.sim.typing import Array


def known_pair(first_from_second: Pose, params: LidarParams, seed: int) -> Pose:
    """What the driver knows of ``first_from_second``: the truth with the error that ``params``
    names, drawn from ``seed``."""
    draws = np.random.default_rng([seed, crc32(b"lidar pair")]).standard_normal(6)
    turn = so3_exp(np.deg2rad(params.pair_rotation_sigma_deg) * draws[:3])
    shift = params.pair_translation_sigma_m * draws[3:]
    return Pose(turn @ first_from_second.rotation, first_from_second.translation + shift)


def merged(first: LidarScan, second: LidarScan, first_from_second: Pose) -> LidarScan:
    """Both scans, of the same time, in the frame of the first: pulses in the order of their times.
    Directions and ranges of returns count from the first's origin; pulses without return keep their
    direction."""
    returned = second.ranges > 0.0
    directions = second.directions @ first_from_second.rotation.T.astype(np.float32)
    points = first_from_second.apply(second.points[returned].astype(np.float64))
    reach: Array = np.linalg.norm(points, axis=1)
    ranges = second.ranges.copy()
    ranges[returned], directions[returned] = reach, points / reach[:, None]
    times = np.concatenate([first.time_offsets, second.time_offsets])
    order = np.argsort(times, kind="stable")
    return LidarScan(
        start_tick=first.start_tick,
        end_tick=first.end_tick,
        start_time_s=first.start_time_s,
        end_time_s=first.end_time_s,
        directions=np.concatenate([first.directions, directions])[order],
        ranges=np.concatenate([first.ranges, ranges])[order],
        time_offsets=times[order],
        intensity=np.concatenate([first.intensity, second.intensity])[order],
    )
