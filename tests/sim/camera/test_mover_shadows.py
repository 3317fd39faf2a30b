"""Shadows of walkers: where they fall, how far, and under which light."""

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from touchdown.scenes.api import MovingBody, Scene, TrafficParams
from touchdown.scenes.compose import load_scene
from touchdown.sim.api import CameraParams
from touchdown.sim.camera.mover_shadows import LEFT, MoverShadows
from touchdown.sim.camera.sensor import CameraSensor
from touchdown.sim.moving import MovingBodies

PLACE = """<mujoco><worldbody>
  <light directional="true" dir="0 1 -1" diffuse="0.6 0.6 0.6"/>
  <geom name="path" type="plane" size="20 20 1" rgba="0.7 0.7 0.7 1"/>
  <site name="takeoff" pos="0 -15 0"/>
  <camera name="above" pos="0 0 10" xyaxes="1 0 0 0 1 0"/>
</worldbody></mujoco>"""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A person stands at (0, 0); the sun is in the south, 45 degrees high."""
    folder = tmp_path_factory.mktemp("place")
    (folder / "place.xml").write_text(PLACE)
    (folder / "paths.csv").write_text("name,t,x,y\nperson,0,0,-0.01\nperson,1,0,0\n")
    traffic = TrafficParams(paths=str(folder / "paths.csv"))
    return load_scene(str(folder / "place.xml"), 0, traffic=traffic)


def pictures(scene: Scene) -> tuple[np.ndarray, float]:
    """The brightness beside that without shadows, and pixels a metre on the ground."""
    params = CameraParams(width=320, height=240, fov_x_deg=60.0, fov_y_deg=46.8, noise_sigma=0.0)
    data, found = mujoco.MjData(scene.model), []
    MovingBodies(scene).write(data, 5.0)
    mujoco.mj_forward(scene.model, data)
    for light in ("day", "overcast"):
        camera = CameraSensor(replace(scene, light=light), params, 0, "above")
        found.append(camera.render(camera.snapshot(data), 0).astype(float).mean(axis=2))
        scale = camera.intrinsics().fx / 10.0
        camera.close()
    return found[0] / found[1], scale


def test_a_shadow_lies_behind_who_throws_it_as_long_as_he_is_tall(scene: Scene) -> None:
    ratio, per_m = pictures(scene)
    tall = max(float(scene.model.geom(g).pos[2]) for g in range(scene.model.ngeom)
               if "person" in scene.model.geom(g).name)  # fmt: skip
    dark = ratio < 0.75
    rows, cols = np.nonzero(dark)
    north = (119.5 - rows) / per_m
    assert north.max() == pytest.approx(tall, abs=0.25)
    assert north.min() > -0.35 and np.abs((cols - 159.5) / per_m).max() < 0.5
    on_ground = dark & (np.arange(240)[:, None] < 119.5 - 0.5 * per_m)
    assert np.median(ratio[on_ground]) == pytest.approx(LEFT, abs=0.04)
    assert np.median(ratio[118:122, 157:163]) > 0.9  # his head is in the sun
    assert np.median(ratio[~dark]) == pytest.approx(1.0, abs=0.01)


def test_cars_of_the_scene_and_other_lights_throw_none(scene: Scene) -> None:
    pinhole = CameraSensor(scene, CameraParams(), 0, "above").intrinsics()
    assert MoverShadows.of(scene, pinhole) is not None
    assert MoverShadows.of(replace(scene, light="overcast"), pinhole) is None
    car = MovingBody(body_name=scene.moving[0].body_name, path_world=np.zeros((1, 3)))
    assert MoverShadows.of(replace(scene, moving=(car,)), pinhole) is None


def test_out_of_view_nothing_is_computed(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    pinhole = CameraSensor(scene, CameraParams(), 0, "above").intrinsics()
    shadows = MoverShadows.of(scene, pinhole)
    assert shadows is not None
    data = mujoco.MjData(scene.model)
    mujoco.mj_forward(scene.model, data)
    camera = CameraSensor(scene, CameraParams(), 0, "above")
    far = camera.snapshot(data)
    far.cam_xpos[:, 0] += 40.0
    monkeypatch.setattr("touchdown.sim.camera.mover_shadows._shade", None)
    drawn = np.full((4, 4, 3), 9, np.uint8)
    shadows.darken(drawn, None, far, scene.model.camera("above").id, 4)
    assert (drawn == 9).all() and math.isfinite(far.cam_xpos.sum())
