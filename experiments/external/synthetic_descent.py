"""Descents of a synthetic vehicle to level ground with boxes on it, as a watch is given them, by
numpy alone."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from touchdown.experiments.external.synthetic_world import estimate_at, flat_map
from touchdown.landing.api import WatchInput
from touchdown.sim.api import LidarScan, Observation, SensorRig
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array

_STEP_TICKS = 12
_PULSES, _MORE, _PARTS = 8000, 5, 10
"""pulses of a scan, factor for one that looks around, and instants at which it is cast"""
_HALF_VIEW = (0.86, 0.22)
"""tangents of half the field of view, along and across its long axis"""
_NOISE_M = 0.02


@dataclass(frozen=True, kw_only=True)
class Box:
    """Something with upright sides, there from ``from_s`` on."""

    middle: tuple[float, float]
    """m, at the time 0"""
    size: tuple[float, float, float] = (0.5, 0.5, 0.5)
    velocity: tuple[float, float] = (0.0, 0.0)
    """m/s"""
    from_s: float = -np.inf


@dataclass(frozen=True, kw_only=True)
class Descent:
    """What happens: world frame, the ground at z = 0 at the site (0, 0)."""

    pose_at: Callable[[float], Pose] = lambda _: Pose(np.eye(3), np.array([0.0, 0.0, 6.0]))
    """of the body, by time"""
    boxes: Sequence[Box] = ()
    seconds: float = 3.0
    slope: float = 0.0
    """rise of the ground along x"""
    plants_m: float = 0.0
    """height up to which pulses return from plants on the ground"""
    drift_mps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """of the estimate"""
    returned: float = 1.0
    """fraction of the pulses"""
    around: bool = False
    """whether the LIDAR sees all that is below the horizon"""
    touchdown_s: float = 8.0
    known: bool = True
    """whether there is a map from before"""
    seed: int = 0

    def scan(self, rig: SensorRig, start_tick: int) -> LidarScan:
        """The scan that begins at a tick."""
        rng = np.random.default_rng([self.seed, start_tick])
        half, pulses = np.array(_HALF_VIEW), _PULSES
        if self.around:
            pulses *= _MORE
            beams = rng.standard_normal((pulses, 3))
            beams[:, 2] = np.abs(beams[:, 2]) + 1e-3
        else:
            beams = np.column_stack([rng.uniform(-half, half, (pulses, 2)), np.ones(pulses)])
        beams /= np.linalg.norm(beams, axis=1, keepdims=True)
        ticks, hz = rig.lidar_scan_ticks, rig.tick_hz
        offsets = np.linspace(0.0, ticks / hz, pulses)
        times = [start_tick / hz + float(part.mean()) for part in np.split(offsets, _PARTS)]
        lifts = rng.uniform(0.0, self.plants_m, pulses) if self.plants_m else np.zeros(pulses)
        parts = zip(times, np.split(beams, _PARTS), np.split(lifts, _PARTS), strict=True)
        ranges = np.concatenate([self._ranges(rig, *part) for part in parts])
        ranges += rng.normal(0.0, _NOISE_M, pulses)
        ranges[rng.random(pulses) >= self.returned] = 0.0
        return LidarScan(
            start_tick=start_tick, end_tick=start_tick + ticks, start_time_s=start_tick / hz,
            end_time_s=(start_tick + ticks) / hz, directions=beams.astype(np.float32),
            ranges=ranges.astype(np.float32), time_offsets=offsets.astype(np.float32),
            intensity=np.full(pulses, 40, np.uint8),
        )  # fmt: skip

    def _ranges(self, rig: SensorRig, time_s: float, beams: Array, lifts: Array) -> Array:
        pose = self.pose_at(time_s) @ rig.body_from_lidar
        origin, along = pose.translation, beams @ pose.rotation.T
        above = origin[2] - self.slope * origin[0] - lifts
        hit = -above / (along[:, 2] - self.slope * along[:, 0])
        for box in self.boxes:
            if time_s < box.from_s:
                continue
            middle = np.array(box.middle) + time_s * np.array(box.velocity)
            half = 0.5 * np.array(box.size[:2])
            foot = self.slope * middle[0]
            low = np.array([*(middle - half), foot - 1.0])
            high = np.array([*(middle + half), foot + box.size[2]])
            ends = np.sort(np.stack([(low - origin) / along, (high - origin) / along]), axis=0)
            near, far = ends[0].max(axis=1), ends[1].min(axis=1)
            hit = np.where((near <= far) & (near > 0.0), np.minimum(hit, near), hit)
        return hit

    def seen(self, rig: SensorRig) -> Iterator[WatchInput]:
        """What a watch is given, fifty times a second: scans when they have arrived."""
        grid = flat_map(np.zeros(2))
        waiting: list[LidarScan] = []
        for tick in range(0, round(self.seconds * rig.tick_hz), _STEP_TICKS):
            time_s = tick / rig.tick_hz
            if tick % rig.lidar_scan_ticks == 0 and tick:
                waiting.append(self.scan(rig, tick - rig.lidar_scan_ticks))
            late = tick - rig.compute_latency_ticks
            arrived = tuple(scan for scan in waiting if scan.end_tick <= late)
            waiting = waiting[len(arrived) :]
            before, pose = self.pose_at(time_s - 0.01), self.pose_at(time_s)
            drift = np.array(self.drift_mps)
            velocity = (pose.translation - before.translation) / 0.01 + drift
            moved = Pose(pose.rotation, pose.translation + time_s * drift)
            yield WatchInput(
                obs=Observation(
                    tick=tick, time_s=time_s, scans=arrived, rotor_speed_radps=np.zeros(4),
                    battery_fraction=0.8,
                ),
                estimate=estimate_at({"tick": tick, "time_s": time_s}, moved, velocity),
                map_view=grid,
                site_odom=time_s * drift,
                touchdown_s=self.touchdown_s,
                known=grid.coarse if self.known else None,
            )  # fmt: skip
