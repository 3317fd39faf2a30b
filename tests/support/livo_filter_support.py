"""States and IMU buffers for tests of the filter."""

from typing import Any

import numpy as np

from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.imu_propagation import ImuBuffer, NavState
from touchdown.estimator.livo.visual import VisualFrontEnd
from touchdown.sim.api import GRAVITY_MPS2, ImuParams
from touchdown.sim.frames import so3_exp

STEP_S = 0.005


def random_state(rng: np.random.Generator) -> NavState:
    return NavState(
        0, so3_exp(rng.normal(0.0, 0.5, 3)), rng.normal(0.0, 10.0, 3), rng.normal(0.0, 3.0, 3),
        rng.normal(0.0, 1e-3, 3), rng.normal(0.0, 1e-2, 3),
    )  # fmt: skip


def filled_buffer(rng: np.random.Generator, count: int) -> ImuBuffer:
    buffer = ImuBuffer(ImuParams(), STEP_S)
    for i in range(count):
        force = np.array([0.0, 0.0, GRAVITY_MPS2]) + rng.normal(0.0, 1.0, 3)
        buffer.push(3 * (i + 1), rng.normal(0.0, 0.5, 3), force, False)
    return buffer


def add_keyframe(vision: VisualFrontEnd, eskf: Eskf, *view: Any, **more: Any) -> bool:
    """Makes an image a keyframe, as `livo` does; True if it can be one."""
    keyframe = vision.new_keyframe(eskf, *view, **more)
    if keyframe is not None:
        vision.append(eskf, keyframe, vision.surplus(eskf))
    return keyframe is not None
