"""The inputs of one control step, as the rules of the mission see them."""

import math
from dataclasses import dataclass

import numpy as np

from touchdown.estimator.api import Estimate, MapView
from touchdown.landing.api import LandingParams, WatchReport
from touchdown.sim.api import Observation
from touchdown.sim.typing import Array

_FACTOR, _GROWTH_M = 3.0, 0.1
"""growth of the standard deviation from which on nothing measures"""
_RATE_PER_S = 0.1
"""relative growth of the standard deviation of dead reckoning by what measures the velocity; with
the inertial sensors alone it is 0.2 and more for twenty seconds"""
_SURE_M = 0.05
"""standard deviation below which one counts as this: at take-off the position is given"""
_LOWERS = 0.9
"""fraction to which a measurement lowers a standard deviation that has grown; turns of the vehicle
lower it by less"""


@dataclass(frozen=True, kw_only=True, slots=True)
class MissionView:
    """Messages, wind and clock of a control step, with what is fixed before the flight."""

    params: LandingParams
    start_world: Array
    """(3,) body origin before the take-off, world frame"""
    leg_height_m: float
    obs: Observation
    estimate: Estimate
    map_view: MapView
    now_s: float
    """time of the mission: that of ``obs`` without the control steps that were held"""
    time_left_s: float
    """remaining flight time of the battery at its mean rate since take-off; inf at first"""
    unhealthy_s: float
    """time for which the estimate has been unhealthy in the air; -1 where it is healthy"""
    blind_s: float
    """time for which nothing has measured the horizontal position; 0 where something does"""
    wind_mps: float
    """mean wind speed"""
    felt_wind_odom: Array
    """(3,) wind of the last second, m/s"""
    load_aloft: float
    """thrust and tilt that a hover at survey height would need over what is allowed; 0 where it is
    unknown or the climb has ended"""
    load_lowest: float = 0.0
    """the same at the lowest height of a survey"""
    behind_m: float = 0.0
    """distance of the vehicle, as estimated, from the last reference"""
    watch: WatchReport | None = None
    """what the watch says; None where it does not look"""

    @property
    def ground_world(self) -> float:
        """Height of the ground at the take-off spot, world frame."""
        return float(self.start_world[2]) - self.leg_height_m

    @property
    def position_odom(self) -> Array:
        """(3,) estimated position of the vehicle, odom frame."""
        return self.estimate.odom_from_body.translation

    def odom(self, world: Array) -> Array:
        """Returns a world position in the odom frame by the current estimate."""
        return self.estimate.world_from_odom.inverse().apply(world)

    def world(self, odom: Array) -> Array:
        """Returns an odom position in the world frame by the current estimate."""
        return self.estimate.world_from_odom.apply(odom)

    @property
    def ground_odom(self) -> float:
        """Height of the ground at the take-off spot, odom frame."""
        return float(self.odom(self.start_world)[2]) - self.leg_height_m

    @property
    def commanded_odom(self) -> Array | None:
        """(2,) the commanded site in the odom frame by the current estimate; None without one."""
        if self.params.site_xy_m is None:
            return None
        return self.odom(np.array([*self.params.site_xy_m, self.ground_world]))[:2]

    @property
    def away_m(self) -> float:
        """Horizontal distance to the take-off spot."""
        return float(np.linalg.norm((self.position_odom - self.odom(self.start_world))[:2]))

    @property
    def felt_wind_mps(self) -> float:
        """Speed of the felt wind."""
        return float(np.hypot(self.felt_wind_odom[0], self.felt_wind_odom[1]))

    @property
    def in_emergency(self) -> bool:
        """True where the least bad site is accepted: by the parameters, or since the remaining
        battery time is below ``emergency_s``."""
        return self.params.emergency == "battery" or self.time_left_s < self.params.emergency_s

    @property
    def takes_risky(self) -> bool:
        """True where roads and roofs are accepted."""
        return self.params.allow_risky or self.in_emergency


class Sight:
    """Follows the larger horizontal standard deviation of the position. A measurement lowers it;
    without any it rises, with the inertial sensors ever faster."""

    def __init__(self) -> None:
        self._peak = self._least = self._time_s = 0.0
        self._since_s: float | None = None

    def lost_s(self, time_s: float, covariance: Array) -> float:
        """Time since the last measurement, s, where ``covariance`` (3, 3) has grown since then as
        nothing that measures lets it grow, else 0; called once a control step."""
        sigma = float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[1]))
        self._least *= math.exp(_RATE_PER_S * (time_s - self._time_s))
        if self._since_s is None or sigma < max(_LOWERS * self._peak, self._least):
            self._least, self._peak, self._since_s = max(sigma, _SURE_M), sigma, time_s
        self._peak, self._time_s = max(sigma, self._peak), time_s
        grown = sigma > _FACTOR * self._least and sigma > self._least + _GROWTH_M
        return time_s - self._since_s if grown else 0.0
