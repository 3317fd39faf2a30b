"""An estimator: DLIO (Chen et al. 2023), a LIDAR-inertial odometry, as evalio 0.6.1 packs it.

touchdown fly crossroad --estimator examples.evalio_odometry:build

`external.pipeline` names another pipeline of evalio; all other keys are parameters of it.
"""

import numpy as np
from evalio import types
from evalio._cpp import helpers, pipelines

from examples.scan_odometry import Sample, ScanOdometry, Seen
from touchdown.sim.api import GRAVITY_MPS2, LidarScan, SensorRig
from touchdown.sim.frames import Pose

CALIBRATED = {"gravity": GRAVITY_MPS2, "imu_calibrate": False, "wait_until_move": False}
"""for DLIO, whose own calibration takes the IMU's first seconds for rest"""
EPOCH_NS = 1_000_000_000_000
"""added to all times: time 0 counts as unset"""
POINT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("t", "<u4")]
)  # fmt: skip
FIELDS = [
    helpers.Field(
        name=name,
        datatype=helpers.DataType.UINT32 if name == "t" else helpers.DataType.FLOAT32,
        offset=offset,
    )
    for name, (_, offset) in POINT.fields.items()
]


def stamp(time_s: float) -> types.Stamp:
    return types.Stamp.from_nsec(EPOCH_NS + round(1e9 * time_s))


class Evalio(ScanOdometry):
    """Poses are those of the IMU at the middle of a scan."""

    def begin(self, level_from_imu: Pose, level_from_lidar: Pose) -> None:
        own = dict(self.settings)
        name = own.pop("pipeline", "DLIO")
        self.odometry = getattr(pipelines, name)()
        given = self.odometry.default_params() | (CALIBRATED if name == "DLIO" else {}) | own
        if unknown := self.odometry.set_params(given):
            raise ValueError(f"{name} has no parameter {', '.join(unknown)}")
        imu, lidar = self.rig.imu, self.rig.lidar
        self.scan_s = self.rig.lidar_scan_ticks / self.rig.tick_hz
        self.odometry.set_imu_params(
            types.ImuParams(
                gyro=imu.gyro_density, accel=imu.accel_density, gyro_bias=imu.gyro_bias_walk,
                accel_bias=imu.accel_bias_walk, gravity=np.array([0.0, 0.0, -GRAVITY_MPS2]),
                rate=1.0 / self.step_s,
            )
        )  # fmt: skip
        self.odometry.set_lidar_params(
            types.LidarParams(
                num_rows=1, num_columns=24000, min_range=lidar.min_range_m,
                max_range=lidar.max_range_m, rate=1.0 / self.scan_s,
            )
        )  # fmt: skip
        self.imu_from_level = level_from_imu.inverse()
        imu_from_lidar = self.imu_from_level @ level_from_lidar
        self.odometry.set_imu_T_lidar(types.SE3.from_mat(imu_from_lidar.matrix()))
        self.odometry.initialize()

    def register(self, scan: LidarScan, samples: list[Sample]) -> Seen | None:
        for time_s, rates, force in samples:
            self.odometry.add_imu(types.ImuMeasurement(stamp(time_s), rates, force))
        back = scan.ranges > 0.0
        cloud = np.zeros(int(back.sum()), POINT)
        for axis, name in enumerate("xyz"):
            cloud[name] = scan.points[back, axis]
        cloud["intensity"] = scan.intensity[back]
        cloud["t"] = np.round(1e9 * scan.time_offsets[back])
        facts = helpers.PointCloudMetadata(
            stamp=stamp(scan.start_time_s),
            width=len(cloud),
            height=1,
            point_step=POINT.itemsize,
            row_step=cloud.nbytes,
            is_bigendian=0,
            is_dense=1,
        )
        self.odometry.add_lidar(helpers.pc2_to_evalio(facts, FIELDS, cloud.tobytes()))
        found = self.odometry.saved_estimates()
        if not found:
            return None
        at, pose = found[-1]
        middle_s = at.to_sec() - 1e-9 * EPOCH_NS + 0.5 * self.scan_s
        matrix = pose.to_mat()
        return Seen(middle_s, Pose(matrix[:3, :3], matrix[:3, 3]) @ self.imu_from_level)


def build(params: dict, rig: SensorRig) -> Evalio:
    return Evalio(params, rig)
