"""A watch: nothing may rise from the ground near the site.

touchdown land flat --preset short --watch examples.bare_ground:build
"""

import numpy as np

from touchdown.landing.api import Verdict, WatchInput, WatchReport, WatchRig
from touchdown.sim.api import SensorNeeds
from touchdown.sim.frames import PoseHistory


class BareGround:
    """Waits while more than ``returns`` of a scan within ``radius_m`` of the site are ``tall_m``
    above most of the others. It knows neither plants nor what moves."""

    needs = SensorNeeds(lidar=True)

    def __init__(self, params: dict, rig: WatchRig) -> None:
        self.radius_m, self.tall_m = params.get("radius_m", 1.5), params.get("tall_m", 0.3)
        self.returns = params.get("returns", 10)
        self.body_from_lidar = rig.sensors.body_from_lidar
        self.poses = PoseHistory(100)
        self.report = WatchReport()

    def look(self, seen: WatchInput) -> WatchReport:
        self.poses.add(seen.obs.time_s, seen.estimate.odom_from_body)
        for scan in seen.obs.scans:
            pose = self.poses.at(0.5 * (scan.start_time_s + scan.end_time_s))
            if pose is not None:
                points = (pose @ self.body_from_lidar).apply(scan.points[scan.ranges > 0.0])
                self.report = self.judged(points - seen.site_odom)
        return self.report

    def judged(self, points: np.ndarray) -> WatchReport:
        """``points`` (N, 3) from the site, along the axes of odom."""
        near = points[np.hypot(points[:, 0], points[:, 1]) < self.radius_m, 2]
        tall = int((near > np.median(near) + self.tall_m).sum()) if near.size else 0
        if tall <= self.returns:
            return WatchReport()
        return WatchReport(verdict=Verdict.WAIT, reason=f"{tall} returns above the ground")


def build(params: dict, rig: WatchRig) -> BareGround:
    return BareGround(params, rig)
