"""An estimator: RKO-LIO 0.4 (Malladi et al. 2025), a LIDAR-inertial odometry.

touchdown fly crossroad --estimator examples.rko_lio_odometry:build
"""

import numpy as np
from rko_lio.config import LIOConfig
from rko_lio.lio import LIO
from rko_lio.rko_lio_pybind import InputError, RegistrationError

from examples.scan_odometry import Sample, ScanOdometry, Seen
from touchdown.sim.api import LidarScan, SensorRig
from touchdown.sim.frames import Pose

NS = 1e9


class RkoLio(ScanOdometry):
    """Its other parameters are those of `LIOConfig`."""

    def begin(self, level_from_imu: Pose, level_from_lidar: Pose) -> None:
        sheet = self.rig.lidar
        config = LIOConfig(
            max_num_threads=1, min_range=sheet.min_range_m, max_range=sheet.max_range_m,
            **self.settings,
        )  # fmt: skip
        self.odometry, self.alone = LIO(config), True
        self.mounts = level_from_imu.matrix(), level_from_lidar.matrix()

    def register(self, scan: LidarScan, samples: list[Sample]) -> Seen | None:
        for time_s, rates, force in samples:
            self.odometry.add_imu_measurement(force, rates, round(time_s * NS), self.mounts[0])
        back = scan.ranges > 0.0
        times = scan.start_time_s + scan.time_offsets[back].astype(np.float64)
        span = round(scan.start_time_s * NS), round(scan.end_time_s * NS)
        try:
            self.odometry.register_scan(
                scan.points[back], np.round(times * NS), self.mounts[1], *span
            )
        except (InputError, RegistrationError):
            if self.world_from_odometry is None:
                self.begun = False  # the map of one scan: from the next one anew
            return None
        first, self.alone = self.alone, False
        pose = self.odometry.pose()
        return None if first else Seen(scan.end_time_s, Pose(pose[:3, :3], pose[:3, 3]))


def build(params: dict, rig: SensorRig) -> RkoLio:
    return RkoLio(params, rig)
