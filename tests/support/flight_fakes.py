"""Synthetic truths, estimates and views."""

from typing import Any

import numpy as np

from touchdown.estimator.api import Estimate
from touchdown.landing.api import LanderView, Phase
from touchdown.sim.api import Contact, Truth
from touchdown.sim.frames import Pose, rotation_from_yaw


def make_truth(time_s: float, position: Any, **changes: Any) -> Truth:
    values: dict[str, Any] = {
        "tick": round(time_s * 600), "time_s": time_s,
        "world_from_body": Pose(np.eye(3), np.asarray(position, dtype=float)),
        "velocity_world": np.zeros(3), "acceleration_world": np.zeros(3),
        "angular_velocity_body": np.zeros(3), "wind_world": np.zeros(3),
        "rotor_speed_radps": np.zeros(4), "contacts": (), "peak_contact_accel": 0.0,
        "energy_used_j": 0.0,
    }  # fmt: skip
    return Truth(**(values | changes))


def make_estimate(time_s: float, place: Any, yaw: float = 0.0) -> Estimate:
    """``place``: a position, or a pose."""
    if not isinstance(place, Pose):
        place = Pose(rotation_from_yaw(yaw), np.asarray(place, dtype=float))
    return Estimate(
        tick=round(time_s * 600), time_s=time_s, odom_from_body=place,
        world_from_odom=Pose.identity(), velocity_odom=np.zeros(3),
        angular_velocity_body=np.zeros(3), acceleration_odom=np.zeros(3),
        position_covariance=np.eye(3), rotation_covariance=np.eye(3),
    )  # fmt: skip


def make_view(phase: Phase, **changes: Any) -> LanderView:
    values: dict[str, Any] = {
        "phase": phase, "note": "", "candidates": (), "costmap": None, "site_world": None,
        "committed_site_world": None, "reference_world": np.zeros(3), "no_site": False,
        "aborted": False,
    }  # fmt: skip
    return LanderView(**(values | changes))


LEG_ON_LAWN = (Contact(part="leg", other="terrain", normal_force_n=10.0),)
