"""Messages of sensors by hand, on a clock of 600 Hz."""

from typing import Any

import numpy as np

from touchdown.sim.api import LidarScan

HZ, SCAN_TICKS = 600, 60


def make_scan(
    end: int, directions: Any, ranges: Any, offsets: Any = 0.0, level: Any = 40
) -> LidarScan:
    """A scan of a tenth of a second that ends at tick ``end``."""
    start, count = end - SCAN_TICKS, len(ranges)
    return LidarScan(
        start_tick=start, end_tick=end, start_time_s=start / HZ, end_time_s=end / HZ,
        directions=np.asarray(directions, np.float32), ranges=np.asarray(ranges, np.float32),
        time_offsets=np.broadcast_to(offsets, count).astype(np.float32),
        intensity=np.broadcast_to(level, count).astype(np.uint8),
    )  # fmt: skip
