"""Builds world and autopilot of an environment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.controller.api import Controller
from touchdown.estimator.api import Estimator
from touchdown.experiments.config.schema import Config
from touchdown.experiments.flight.wiring import make_world
from touchdown.scenes.api import Scene
from touchdown.sim.api import SensorNeeds


@dataclass(slots=True)
class EnvBackend:
    """World, autopilot and viewing camera of one episode. The autopilot hovers the vehicle until
    the policy flies."""

    scene: Scene
    world: Any
    """``sim.world.MujocoWorld``, whose ``start_in_air`` begins an episode"""
    estimator: Estimator
    """the oracle: its estimates are the true state"""
    controller: Controller
    """the cascade controller"""
    step_s: float
    """duration of one control step"""
    render: Callable[[], NDArray[np.uint8]]
    """returns the present view of the vehicle's camera, (H, W, 3)"""
    close: Callable[[], None]


def build_env_backend(
    config: Config,
    scene: Scene,
    needs: SensorNeeds,
    view_pixels: tuple[int, int],
    drawn: bool = False,
) -> EnvBackend:
    """Returns world and autopilot of ``config`` with the sensors of ``needs``. view_pixels: (width,
    height) of rendered views; drawn: the world's own model can be drawn too."""
    from touchdown.controller.cascade import CascadeController
    from touchdown.estimator.oracle import Oracle
    from touchdown.experiments.flight.platform import limit_threads
    from touchdown.sim.api import CameraParams
    from touchdown.sim.camera.sensor import CameraSensor

    limit_threads()
    world = make_world(config, scene, drawn)
    world.require(needs)
    width, height = view_pixels
    lens = CameraParams(noise_sigma=0.0, samples=4, width=width, height=height)
    view = CameraSensor(scene, lens, config.seed)

    def close() -> None:
        view.close()
        world.close()

    return EnvBackend(
        scene=scene,
        world=world,
        estimator=Oracle(world.truth),
        controller=CascadeController(world.rig.vehicle, config.control),
        step_s=config.sim.control_ticks / config.sim.tick_hz,
        render=lambda: view.render(world.snapshot(), 0),
        close=close,
    )
