"""The LIDAR's ray caster against MuJoCo's own, geom type by geom type and on whole scenes."""

import subprocess
import sys

import mujoco
import numpy as np
import pytest

from touchdown.scenes.api import Scene
from touchdown.scenes.registry import scene_names
from touchdown.sim.geometry.ray_target import Hits
from touchdown.sim.geometry.tessellation import FIRST_HIDDEN_GROUP
from touchdown.sim.lidar.raycast_scene import LidarScene
from touchdown.sim.typing import Array, Float32

from support.places import cached_scene

GEOMS = {
    "sphere": 'type="sphere" size="1"', "pebble": 'type="sphere" size="0.05"',
    "ellipsoid": 'type="ellipsoid" size="1 0.3 1.4"', "capsule": 'type="capsule" size="0.4 1"',
    "wire": 'type="capsule" size="0.02 1.2"', "cylinder": 'type="cylinder" size="0.7 1"',
    "disc": 'type="cylinder" size="1.2 0.02"', "box": 'type="box" size="1 0.5 0.8"',
    "mesh": 'type="mesh" mesh="tetrahedron"', "hfield": 'type="hfield" hfield="field"',
    "plane": 'type="plane" size="4 3 1"',
}  # fmt: skip
ASSETS = (
    '<mesh name="tetrahedron" vertex="0 0 0 2 0 0 0 2 0 0 0 2"/>'
    '<hfield name="field" nrow="33" ncol="41" size="3 2 1 0.5"/>'
)
VISIBLE = (np.arange(mujoco.mjNGROUP) < FIRST_HIDDEN_GROUP).astype(np.uint8)


def scene_of(world: str) -> Scene:
    xml = f"<mujoco><asset>{ASSETS}</asset><worldbody>{world}</worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(xml)
    model.hfield_data[:] = np.random.default_rng(7).uniform(size=model.nhfielddata)
    return Scene(
        name="test", seed=0, model=model, takeoff_xy_m=np.zeros(2), takeoff_yaw=0.0,
        bounds_xy_m=np.array([[-60.0, -60.0], [60.0, 60.0]]), surfaces={}, ground=None, moving=(),
    )  # fmt: skip


def mujoco_distances(scene: Scene, rays: Float32) -> Array:
    """``mj_ray`` one by one over the static scene; inf for a miss."""
    data = mujoco.MjData(scene.model)
    for moving in scene.moving:
        data.mocap_pos[scene.model.body(moving.body_name).mocapid[0]] = [0.0, 0.0, -1e5]
    mujoco.mj_kinematics(scene.model, data)
    geom = np.zeros(1, dtype=np.int32)
    out = np.empty(len(rays))
    for i, ray in enumerate(rays.astype(np.float64)):
        out[i] = mujoco.mj_ray(scene.model, data, ray[:3], ray[3:], VISIBLE, 1, -1, geom)
    return np.where(out < 0.0, np.inf, out)


def fraction_within_1_mm(scene: Scene, rays: Float32) -> float:
    target = LidarScene(scene).static
    ours, theirs = target.cast(rays).distance.astype(np.float64), mujoco_distances(scene, rays)
    missed = np.isinf(ours) & np.isinf(theirs)
    return float(np.mean(missed | (np.abs(np.where(missed, 0.0, ours) - theirs) < 1e-3)))


def rays_at(center: Array, reach: float, count: int, seed: int) -> Float32:
    """Unit directions of all kinds, aimed at a box around ``center`` from 15 m off."""
    rng = np.random.default_rng(seed)
    directions = rng.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    targets = center + rng.uniform(-reach, reach, (count, 3))
    return np.column_stack([targets - 15.0 * directions, directions]).astype(np.float32)


@pytest.mark.parametrize("kind", GEOMS)
def test_every_geom_type_as_in_mujoco(kind: str) -> None:
    scene = scene_of(f'<geom name="g" {GEOMS[kind]} pos="1 2 3" euler="20 30 40"/>')
    rays = rays_at(np.array([1.0, 2.0, 3.0]), 1.1, 20_000, seed=7)
    if kind == "plane":  # MuJoCo's planes have a front only
        data = mujoco.MjData(scene.model)
        mujoco.mj_kinematics(scene.model, data)
        rays[:, 3:] *= -np.sign(rays[:, 3:] @ data.geom_xmat[0].reshape(3, 3)[:, 2:])
        rays[:, :3] = np.array([1.0, 2.0, 3.0]) - 15.0 * rays[:, 3:]
    hits = np.isfinite(mujoco_distances(scene, rays)).mean()
    assert hits > 0.0005
    assert fraction_within_1_mm(scene, rays) > 0.9999


def test_grazing_rays_and_touching_shapes() -> None:
    """Silhouettes, and shapes that intersect within the margins of their bounding volumes."""
    world = (
        '<geom type="sphere" size="1"/><geom type="sphere" size="1.0005" pos="0.001 0 0"/>'
        '<geom type="cylinder" size="0.3 2"/><geom type="ellipsoid" size="2 0.5 0.5"/>'
        '<geom type="box" size="3 3 0.05" pos="0 0 -0.98"/>'
    )
    rng = np.random.default_rng(3)
    rays = rays_at(np.zeros(3), 0.2, 20_000, seed=3).astype(np.float64)
    sideways = np.cross(rays[:, 3:], rng.standard_normal((20_000, 3)))
    sideways /= np.linalg.norm(sideways, axis=1, keepdims=True)
    rays[:, :3] += sideways * rng.uniform(0.9, 1.02, (20_000, 1))
    assert fraction_within_1_mm(scene_of(world), rays.astype(np.float32)) > 0.999


def test_rays_from_inside_leave_where_mujoco_lets_them() -> None:
    for kind in ("sphere", "ellipsoid", "capsule", "cylinder"):
        scene = scene_of(f"<geom {GEOMS[kind]}/>")
        rays = rays_at(np.zeros(3), 0.1, 3000, seed=5)
        rays[:, :3] += 15.0 * rays[:, 3:]
        assert fraction_within_1_mm(scene, rays) == 1.0


def scene_rays(scene: Scene, count: int) -> Float32:
    """From up to 40 m above the scene's middle, half of them steep, half anywhere down."""
    rng = np.random.default_rng(11)
    low, high = scene.bounds_xy_m
    spot = rng.uniform(0.9 * low + 0.1 * high, 0.1 * low + 0.9 * high, (count, 2))
    directions = rng.standard_normal((count, 3))
    directions[::2, :2] *= 0.3
    directions[:, 2] = -np.abs(directions[:, 2])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.column_stack([spot, rng.uniform(12.0, 40.0, count), directions]).astype(np.float32)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name == "crossroad" else pytest.mark.slow)
        for name in scene_names()
    ],
)
def test_scenes_as_in_mujoco(name: str) -> None:
    scene = cached_scene(name)
    assert fraction_within_1_mm(scene, scene_rays(scene, 50_000)) > 0.999


def test_open_ground_is_a_shortcut_and_nothing_else() -> None:
    """Landing rays by the horizon map gives what the general caster gives."""
    scene = cached_scene("crossroad")
    rays = scene_rays(scene, 50_000)
    target = LidarScene(scene).static
    general, quick = target.cast_all(rays), Hits.of(len(rays))
    others = target.cast_apart(rays, quick)
    assert 0.05 < len(others) / len(rays) < 0.8
    np.testing.assert_array_equal(quick.geom, general.geom)
    hit = quick.geom >= 0
    np.testing.assert_allclose(quick.distance[hit], general.distance[hit], atol=1e-4)
    np.testing.assert_allclose(quick.cosine[hit], general.cosine[hit], atol=1e-4)


_PROGRAM = """
import sys
from touchdown.sim.geometry.ray_target import load_open3d
open3d = load_open3d()
assert open3d.t.geometry.RaycastingScene(nthreads=1) is not None
assert not {"dash", "IPython", "plotly"} & set(sys.modules), "a viewer"
assert callable(open3d.visualization.draw_geometries) and "plotly" in sys.modules
assert not hasattr(open3d, "no_such_name")
assert load_open3d() is open3d
"""


def test_viewers_are_imported_when_somebody_asks_for_one() -> None:
    done = subprocess.run([sys.executable, "-c", _PROGRAM], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
