"""A mapper: means, spreads and extremes of the returns in square cells, by NumPy alone.

touchdown land flat --mapper examples.plain_map:build
"""

from collections import deque

import numpy as np

from touchdown.estimator.api import Estimate, GridMap, MapperRig, MapView
from touchdown.sim.api import LidarScan, Observation, SensorNeeds


class Grid:
    """Returns so far in square cells about ``centre`` (2,)."""

    def __init__(self, centre: np.ndarray, cell_m: float, extent_m: float) -> None:
        self.side, self.cell_m = round(extent_m / cell_m), cell_m
        self.origin = np.floor((centre - 0.5 * extent_m) / cell_m) * cell_m
        layers = {"count": 0, "sum": 0, "squares": 0, "light": 0, "low": np.inf, "high": -np.inf}
        shape = (self.side, self.side)
        self.layers = {name: np.full(shape, start, float) for name, start in layers.items()}
        self.seen_s = np.full(shape, -np.inf, np.float32)

    def add(self, points: np.ndarray, light: np.ndarray, time_s: float) -> None:
        """Adds returns (N, 3), odom frame, with their intensities (N,)."""
        col, row = np.floor((points[:, :2] - self.origin) / self.cell_m).astype(int).T
        inside = (col >= 0) & (col < self.side) & (row >= 0) & (row < self.side)
        order = np.argsort((row * self.side + col)[inside], kind="stable")
        if not order.size:
            return
        index, height = (row * self.side + col)[inside][order], points[inside, 2][order]
        cells, first = np.unique(index, return_index=True)
        values = {"count": np.ones_like(height), "sum": height, "squares": height**2,
                  "light": light[inside][order].astype(float)}  # fmt: skip
        for name, value in values.items():
            self.layers[name].flat[cells] += np.add.reduceat(value, first)
        for name, reduce in (("low", np.minimum), ("high", np.maximum)):
            flat = self.layers[name].reshape(-1)
            flat[cells] = reduce(flat[cells], reduce.reduceat(height, first))
        self.seen_s.flat[cells] = time_s

    def view(self) -> GridMap:
        """The map of the cells. It finds no water: pulses without return are left out."""
        count, known = self.layers["count"], self.layers["count"] > 0
        fraction = np.where(known, 1.0 / np.maximum(count, 1.0), np.nan)
        mean, light = self.layers["sum"] * fraction, self.layers["light"] * fraction
        spread = np.sqrt(np.maximum(self.layers["squares"] * fraction - mean**2, 0.0))
        low, high = (np.where(known, self.layers[name], np.nan) for name in ("low", "high"))
        layers = {"count": count, "height_m": mean, "height_std_m": spread, "min_height_m": low,
                  "max_height_m": high, "rgb": np.stack([light] * 3, axis=-1), "intensity": light,
                  "missing": np.zeros_like(count), "last_seen_s": self.seen_s}  # fmt: skip
        single = {name: layer.astype(np.float32) for name, layer in layers.items()}
        return GridMap(origin_xy_m=self.origin, cell_m=self.cell_m, **single)


class PlainMap:
    """A coarse grid about the take-off spot, and a fine one under the vehicle when it is low."""

    needs = SensorNeeds(lidar=True)

    def __init__(self, params: dict, rig: MapperRig) -> None:
        self.sensors, self.params = rig.sensors, rig.mapper
        start = rig.sensors.world_from_body_start.translation
        self.ground_z = start[2] - rig.sensors.vehicle.leg_height_m
        self.coarse = Grid(start[:2], self.params.cell_m, self.params.extent_m)
        self.fine: Grid | None = None
        self.poses: deque = deque(maxlen=200)  # a second of them
        self.shown = MapView(version=0, coarse=self.coarse.view(), fine=None)

    def update(self, obs: Observation, estimate: Estimate) -> MapView:
        self.poses.append((estimate.time_s, estimate.odom_from_body))
        for scan in obs.scans:
            self._add(scan, estimate.odom_from_body.translation)
        return self.shown

    def _add(self, scan: LidarScan, here: np.ndarray) -> None:
        back = scan.ranges > 0.0
        times = np.array([time_s for time_s, _ in self.poses])
        at = np.searchsorted(times, scan.start_time_s + scan.time_offsets[back])
        at = np.minimum(at, len(times) - 1)  # the pose of the step that each pulse was fired in
        turns = np.stack([pose.rotation for _, pose in self.poses])
        places = np.stack([pose.translation for _, pose in self.poses])
        points = self.sensors.body_from_lidar.apply(scan.points[back].astype(float))
        points = np.einsum("nij,nj->ni", turns[at], points) + places[at]
        low = here[2] - self.ground_z < self.params.fine_below_m
        if low and (self.fine is None or self._away(self.fine, here) > self.params.fine_recentre_m):
            self.fine = Grid(here[:2], self.params.fine_cell_m, self.params.fine_extent_m)
        for grid in (self.coarse, *((self.fine,) if low else ())):
            grid.add(points, scan.intensity[back], scan.end_time_s)
        fine = self.fine.view() if low else None
        version = self.shown.version + 1
        # A view of the whole map costs as much as ten scans: two a second are enough.
        coarse = self.coarse.view() if version % 5 == 0 else self.shown.coarse
        self.shown = MapView(version=version, coarse=coarse, fine=fine)

    def _away(self, grid: Grid, here: np.ndarray) -> float:
        return float(abs(here[:2] - grid.origin - 0.5 * self.params.fine_extent_m).max())


def build(params: dict, rig: MapperRig) -> PlainMap:
    return PlainMap(params, rig)
