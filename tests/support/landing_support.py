"""A rig, analytic scans and hand-made maps for the tests of mapping and landing."""

from typing import Any

import numpy as np

from touchdown.estimator.api import HEIGHT_BIN_M, HEIGHT_BINS, Estimate, GridMap, MapView
from touchdown.estimator.mapping.kernels import Grid, Pulses, accumulate_heights
from touchdown.landing.api import LandingParams, Selection, SelectorInput, SelectorRig
from touchdown.landing.selection.ground.elevation_raster import ElevationRaster, observed_raster
from touchdown.landing.selection.selector import select_sites
from touchdown.sim.api import (
    CameraIntrinsics,
    ImuSample,
    ImuSheet,
    LidarScan,
    LidarSheet,
    Observation,
    SensorRig,
    VehicleModel,
)
from touchdown.sim.frames import BODY_FROM_DOWNWARD_OPTICAL, Pose
from touchdown.sim.typing import Array

from support.messages import make_scan

LEG_HEIGHT = 0.3
DOWNWARD = Pose(BODY_FROM_DOWNWARD_OPTICAL, np.zeros(3))


def make_rig(start: tuple[float, float, float] = (0.0, 0.0, LEG_HEIGHT)) -> SensorRig:
    vehicle = VehicleModel(
        mass_kg=4.0, inertia_kgm2=np.array([0.05, 0.05, 0.09]),
        rotor_xy_m=0.25 * np.array([[1.0, -1], [1, 1], [-1, 1], [-1, -1]]),
        rotor_spin=np.array([1.0, -1, 1, -1]), thrust_coefficient=4e-5, torque_coefficient=6e-7,
        rotor_speed_min=80.0, rotor_speed_max=800.0, motor_time_constant_s=0.04, linear_drag=0.3,
        leg_height_m=LEG_HEIGHT, footprint_radius_m=0.5,
    )  # fmt: skip
    camera = CameraIntrinsics(width=848, height=480, fx=617.0, fy=617.0, cx=423.5, cy=239.5)
    return SensorRig(
        tick_hz=600, body_from_imu=Pose.identity(), body_from_lidar=DOWNWARD,
        body_from_camera=DOWNWARD, body_from_camera_right=DOWNWARD, camera=camera,
        lidar=LidarSheet(), imu=ImuSheet(), imu_ticks=3, camera_ticks=20, lidar_scan_ticks=60,
        compute_latency_ticks=36, world_from_body_start=Pose(np.eye(3), np.array(start)),
        vehicle=vehicle,
    )  # fmt: skip


def make_obs(tick: int, **changes: Any) -> Observation:
    values: dict[str, Any] = {
        "tick": tick, "time_s": tick / 600.0, "rotor_speed_radps": np.zeros(4),
        "battery_fraction": 1.0,
    }  # fmt: skip
    return Observation(**(values | changes))


def make_estimate(tick: int, pose: Pose, velocity: Any = (0.0, 0.0, 0.0)) -> Estimate:
    return Estimate(
        tick=tick, time_s=tick / 600.0, odom_from_body=pose, world_from_odom=Pose.identity(),
        velocity_odom=np.asarray(velocity, dtype=float), angular_velocity_body=np.zeros(3),
        acceleration_odom=np.zeros(3), position_covariance=np.eye(3) * 1e-6,
        rotation_covariance=np.eye(3) * 1e-8,
    )  # fmt: skip


ABOVE = make_estimate(0, Pose(np.eye(3), np.array([8.0, 8.0, 30.0])))
"""30 m above the middle of 16 x 16 m"""


def make_imu(tick: int, up_mps2: float) -> ImuSample:
    return ImuSample(
        tick=tick, time_s=tick / 600.0, angular_velocity=np.zeros(3),
        specific_force=np.array([0.0, 0.0, up_mps2]),
    )  # fmt: skip


def cast_scan(
    start_tick: int, directions: Array, poses: list[Pose], box: tuple[Array, Array] | None = None,
    hole: tuple[Array, Array] | None = None,
) -> LidarScan:  # fmt: skip
    """Ranges of pulses fired over 60 ticks, pulse i from ``poses[i]`` (world_from_body), against
    the plane z = 0 and an axis-aligned box; those into ``hole`` (xy corners) have no return."""
    n = directions.shape[0]
    ranges = np.zeros(n)
    for i, pose in enumerate(poses):
        beam = pose.rotation @ BODY_FROM_DOWNWARD_OPTICAL @ directions[i]
        origin = pose.translation
        distance = -origin[2] / beam[2]
        if box is not None:
            with np.errstate(divide="ignore"):
                near, far = np.sort(np.stack([(box[0] - origin) / beam, (box[1] - origin) / beam]),
                                    axis=0)  # fmt: skip
            if near.max() <= far.min() and near.max() > 0.0:
                distance = min(distance, near.max())
        end = origin[:2] + distance * beam[:2]
        lost = hole is not None and (end >= hole[0]).all() and (end <= hole[1]).all()
        ranges[i] = 0.0 if lost else distance
    return make_scan(start_tick + 60, directions, ranges, np.linspace(0.1 / n, 0.1, n))


def beam_fan(n: int, half_x: float, half_y: float, seed: int) -> Array:
    """(n, 3) unit directions spread evenly over a field of view, LIDAR frame."""
    rng = np.random.default_rng(seed)
    d = np.column_stack([rng.uniform(-half_x, half_x, n), rng.uniform(-half_y, half_y, n),
                         np.ones(n)])  # fmt: skip
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def rising(slope_deg: float = 0.0, side: int = 80, cell_m: float = 0.2) -> Array:
    """Heights of a square, 16 x 16 m, that rises to the east."""
    _, x = np.mgrid[0:side, 0:side] * cell_m
    return np.tan(np.deg2rad(slope_deg)) * x


def make_grid(
    height: Array, cell_m: float = 0.2, *, origin: tuple[float, float] = (0.0, 0.0),
    returns: int = 40, sigma: float = 0.02, seed: int = 0,
) -> GridMap:  # fmt: skip
    """Map of a height raster (NaN: unseen) from ``returns`` noisy returns per cell."""
    rng = np.random.default_rng(seed)
    samples = height[None] + sigma * rng.standard_normal((returns, *height.shape))
    return grid_of_returns(samples, cell_m, origin=origin)


def grid_of_returns(
    samples: Array, cell_m: float = 0.2, *, origin: tuple[float, float] = (0.0, 0.0)
) -> GridMap:
    """Map of the heights of returns (returns, rows, cols), those of an unseen cell all NaN."""
    known = np.isfinite(samples[0])
    shape = known.shape
    histogram = np.zeros((*shape, HEIGHT_BINS), np.uint8)
    base = np.full(shape, np.nan, np.float32)
    rows, cols = np.nonzero(known)
    x, y = origin[0] + (cols + 0.5) * cell_m, origin[1] + (rows + 0.5) * cell_m
    for heights in samples:
        points = np.stack([x, y, heights[known]], axis=-1).astype(np.float32)
        accumulate_heights(
            Pulses(points, np.zeros_like(points), np.ones(len(points), np.float32)),
            Grid(*origin, cell_m), HEIGHT_BIN_M, histogram, base,
        )  # fmt: skip
    return GridMap(
        origin_xy_m=np.array(origin), cell_m=cell_m,
        count=np.where(known, len(samples), 0).astype(np.float32),
        height_m=samples.mean(axis=0).astype(np.float32),
        height_std_m=samples.std(axis=0).astype(np.float32),
        min_height_m=samples.min(axis=0).astype(np.float32),
        max_height_m=samples.max(axis=0).astype(np.float32),
        rgb=np.where(known[..., None], 120.0, np.nan).astype(np.float32).repeat(3, axis=2),
        intensity=np.full(shape, 40.0, np.float32), missing=np.zeros(shape, np.float32),
        last_seen_s=np.zeros(shape, np.float32), histogram=histogram, histogram_base_m=base,
    )  # fmt: skip


def raster_of(grid: GridMap) -> ElevationRaster:
    raster = observed_raster(grid)
    assert raster is not None
    return raster


def view_of(coarse: GridMap, fine: GridMap | None = None) -> MapView:
    return MapView(version=1, coarse=coarse, fine=fine)


def select(view: MapView, estimate: Estimate, params: LandingParams, **seen: Any) -> Selection:
    """What the shipped selector chooses, with more of its input as keywords."""
    rig = SelectorRig(vehicle=make_rig().vehicle, landing=params)
    return select_sites(SelectorInput(map_view=view, estimate=estimate, **seen), rig)
