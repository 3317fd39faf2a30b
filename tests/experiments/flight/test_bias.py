"""The deliberate error ramps in after take-off, and the map moves with it."""

from dataclasses import replace

import numpy as np

from touchdown.estimator.api import Estimate, PoseTrack
from touchdown.experiments.api import BiasParams
from touchdown.experiments.flight.wiring import BiasedEstimator
from touchdown.sim.api import Observation, SensorNeeds

from support.flight_fakes import make_estimate
from support.landing_support import make_obs


class Script:
    needs = SensorNeeds(lidar=True)

    def update(self, obs: Observation) -> Estimate:
        height = 0.3 if obs.time_s < 1.0 else 2.0
        track = PoseTrack(
            times_s=np.array([0.0, 0.1]),
            positions_odom=np.zeros((2, 3)),
            quats_wxyz=np.tile([1.0, 0, 0, 0], (2, 1)),
        )
        return replace(make_estimate(obs.time_s, [0.0, 0.0, height]), scan_track=track)


def test_ramp() -> None:
    biased = BiasedEstimator(Script(), BiasParams(xy_m=(0.5, -1.0)))
    assert biased.needs == SensorNeeds(lidar=True)
    for time_s, fraction in ((0.0, 0.0), (1.0, 0.0), (3.5, 0.5), (6.0, 1.0), (30.0, 1.0)):
        estimate = biased.update(make_obs(round(600 * time_s)))
        expected = fraction * np.array([0.5, -1.0])
        np.testing.assert_allclose(estimate.world_from_body.translation[:2], expected)
        np.testing.assert_allclose(estimate.scan_track.positions_odom[:, :2], [expected] * 2)
