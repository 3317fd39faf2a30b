"""The oracle: an estimator that returns the true state, as the upper bound of every comparison."""

from collections.abc import Callable

import numpy as np

from touchdown.estimator.api import Estimate
from touchdown.sim.api import Observation, SensorNeeds, Truth
from touchdown.sim.frames import Pose

_POSITION_VARIANCE_M2 = 1e-8
_ROTATION_VARIANCE_RAD2 = 1e-10


class Oracle:
    """Returns the true state as its estimate; the only estimator that may look at the truth.

    ``truth`` is called once per update and must give the state at the observation's tick.
    """

    needs = SensorNeeds()

    def __init__(self, truth: Callable[[], Truth]) -> None:
        self._truth = truth

    def update(self, obs: Observation) -> Estimate:
        """Returns the true state. Raises ValueError if it belongs to another tick."""
        truth = self._truth()
        if truth.tick != obs.tick:
            raise ValueError(
                f"oracle: the truth is of tick {truth.tick} but the observation of tick {obs.tick};"
                " call update before the world steps on"
            )
        return Estimate(
            tick=obs.tick,
            time_s=obs.time_s,
            odom_from_body=truth.world_from_body,
            world_from_odom=Pose.identity(),
            velocity_odom=truth.velocity_world,
            angular_velocity_body=truth.angular_velocity_body,
            acceleration_odom=truth.acceleration_world,
            position_covariance=_POSITION_VARIANCE_M2 * np.eye(3),
            rotation_covariance=_ROTATION_VARIANCE_RAD2 * np.eye(3),
        )
