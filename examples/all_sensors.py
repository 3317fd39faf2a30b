"""An estimator: `livo` as shipped, in a flight that measures with every sensor, so that its log
serves every estimator in a replay.

touchdown fly crossroad --estimator examples.all_sensors:build --log-sensors
"""

from dataclasses import dataclass, replace

from touchdown.estimator.api import Estimate, ImageThinning
from touchdown.estimator.livo.estimator import Livo
from touchdown.experiments.config.loading import load_config
from touchdown.sim.api import Observation, SensorNeeds, SensorRig


@dataclass
class AllSensors:
    livo: Livo
    thinning: ImageThinning
    needs: SensorNeeds

    def update(self, obs: Observation) -> Estimate:
        images = tuple(image for image in obs.images if self.thinning.keeps(image))
        return self.livo.update(replace(obs, images=images))


def build(params: dict, rig: SensorRig) -> AllSensors:
    profile = params.get("profile", "field")
    livo = Livo(rig, load_config(overrides=(f"profile={profile}",)).livo)
    clock_hz = rig.tick_hz // rig.camera_ticks  # the rate of any estimator divides it
    needs = SensorNeeds(
        camera_hz=clock_hz, stereo=True, lidar=True, gps=True, barometer=True, magnetometer=True,
        rangefinder=True,
    )  # fmt: skip
    return AllSensors(livo, ImageThinning(rig, clock_hz // livo.needs.camera_hz), needs)
