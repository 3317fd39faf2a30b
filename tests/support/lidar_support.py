"""Small scenes and parameters for tests of the LIDAR."""

from collections.abc import Mapping

import mujoco
import numpy as np

from touchdown.scenes.api import GroundRaster, Scene, Surface
from touchdown.sim.api import LidarParams
from touchdown.sim.frames import BODY_FROM_DOWNWARD_OPTICAL, Pose, quat_wxyz_from_matrix, so3_exp
from touchdown.sim.lidar.patterns import HORIZON
from touchdown.sim.lidar.returns import LinkBudget
from touchdown.sim.moving import BodyTrack
from touchdown.sim.typing import Array

from support.places import bare_scene

TICK_HZ = 600


DOWN = Pose(BODY_FROM_DOWNWARD_OPTICAL, np.zeros(3))


PERFECT = LidarParams(range_sigma_m=0.0, angle_sigma_deg=0.0, divergence=False)


BUDGET = LinkBudget.of(HORIZON.range_limits_m, HORIZON.range_reflectivities, max_m=260.0)


BRIGHT = Surface(land_class="other", reflectivity=0.8)


def make_scene(
    world: str, surfaces: Mapping[str, Surface] | None = None, ground: GroundRaster | None = None,
    assets: str = "",
) -> Scene:  # fmt: skip
    xml = f"<mujoco><asset>{assets}</asset><worldbody>{world}</worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(xml)
    return bare_scene(model, surfaces=surfaces or {}, ground=ground)


def track(ticks: tuple[int, int], height: float, turn_rate: Array | None = None) -> BodyTrack:
    """The body above the origin, level or turning at ``turn_rate`` (3,) rad/s."""
    times = np.arange(ticks[0], ticks[1] + 1) / TICK_HZ
    rate = np.zeros(3) if turn_rate is None else turn_rate
    quats = np.array([quat_wxyz_from_matrix(so3_exp(rate * (t - times[0]))) for t in times])
    positions = np.tile([0.0, 0.0, height], (len(times), 1))
    return BodyTrack(times_s=times, positions=positions, quats_wxyz=quats)


PLANE = '<geom name="plane" type="plane" size="0 0 1"/>'
