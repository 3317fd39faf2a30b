"""Scenes: rendering, collision geometry and truth maps agree."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from touchdown.scenes.api import LAND_CLASSES, OTHER_CLASS_ID, VEHICLE_BODY, Scene
from touchdown.scenes.authoring import ground
from touchdown.scenes.authoring.relief import HeightField
from touchdown.scenes.compose import START_GAP_M, load_scene, spec_of_scene
from touchdown.scenes.export import export_spec
from touchdown.scenes.truth.maps import judge_touchdown, truth_maps
from touchdown.scenes.truth.static_surface import cast_down

from support.places import cached_scene, load_quietly

FLAT_WITH_BOX = """
<mujoco>
  <worldbody>
    <geom name="lawn" type="plane" size="20 20 1"/>
    <geom name="low" type="box" pos="6 0 0" size="0.2 0.2 0.06"/>
    <geom name="high" type="box" pos="-6 0 0.1" size="0.2 0.2 0.2"/>
    <geom name="water_pool" type="box" pos="0 8 0" size="1 1 0.001"/>
    <geom name="path_wire" type="cylinder" pos="0 -8 0.5" size="0.02 0.5"/>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def crossroad() -> Scene:
    return cached_scene("crossroad")


def load_text(tmp_path: Path, text: str) -> Scene:
    path = tmp_path / "model.xml"
    path.write_text(text)
    return load_quietly(path)


def ramp(tmp_path: Path, slope_deg: float, step_m: float = 0.0) -> Scene:
    """A height field that rises along x and has a step at x = 5 m."""
    nodes, half = 401, 10.0
    axis = np.linspace(-half, half, nodes)
    x, _ = np.meshgrid(axis, axis)
    heights = np.tan(np.deg2rad(slope_deg)) * x + step_m * (x > 5.0)
    span = float(np.ptp(heights)) or 1.0
    unit = (heights - heights.min()) / span
    data = np.array([nodes, nodes], "<i4").tobytes() + unit.astype("<f4").tobytes()
    (tmp_path / "ramp.bin").write_bytes(data)
    return load_text(
        tmp_path,
        f"""<mujoco><asset><hfield name="h" file="ramp.bin" size="{half} {half} {span} 1"/></asset>
        <worldbody><geom name="field" type="hfield" hfield="h" pos="0 0 {heights.min()}"/>
        </worldbody></mujoco>""",
    )


def test_vehicle_stands_on_the_takeoff_spot(crossroad: Scene) -> None:
    model = crossroad.model
    assert model.nq == 7
    assert model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    np.testing.assert_allclose(model.qpos0[:2], crossroad.takeoff_xy_m)
    data = mujoco.MjData(model)
    for _ in range(900):
        mujoco.mj_step(model, data)
    assert data.ncon >= 3
    assert abs(data.qpos[2] - model.qpos0[2]) < 2.0 * START_GAP_M
    assert np.linalg.norm(data.qpos[:2] - crossroad.takeoff_xy_m) < 0.01
    assert data.xmat[model.body(VEHICLE_BODY).id][8] > np.cos(np.deg2rad(0.5))


def test_physics_options_and_collision_pairs(crossroad: Scene) -> None:
    model = crossroad.model
    assert model.opt.timestep == 1.0 / 600.0
    assert model.opt.density == 1.225
    assert model.opt.viscosity == 1.8e-5
    root = model.body(VEHICLE_BODY).id
    own = model.body_rootid[model.geom_bodyid] == root
    own_collides = own & (model.geom_conaffinity > 0)
    assert own_collides.any()
    assert not model.geom_contype[own].any()
    assert not model.geom_conaffinity[~own].any()
    assert (model.geom_contype[~own] & 1).all()


def test_terrain_heights_equal_mujoco_s(crossroad: Scene) -> None:
    model = crossroad.model
    size, unit = model.hfield_size[0], model.hfield_data.reshape(model.hfield_nrow[0], -1)
    z = float(model.geom("terrain").pos[2])
    terrain = HeightField(heights_m=unit.astype(float) * size[2] + z, half_m=float(size[0]))
    heights, geoms = cast_down(crossroad, np.array([-40.0, -60.0]), 0.37, (40, 40))
    rows, cols = np.nonzero(geoms == model.geom("terrain").id)
    xy = np.stack([-40.0 + (cols + 0.5) * 0.37, -60.0 + (rows + 0.5) * 0.37], axis=-1)
    np.testing.assert_allclose(heights[rows, cols], terrain.at(xy), atol=2e-3)


def test_texture_agrees_with_the_class_raster(crossroad: Scene) -> None:
    """Seen from above, the raster's lawn is green and its road is grey, cell by cell."""
    model = crossroad.model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = [0.0, 0.0, 0.0]
    camera.distance, camera.elevation, camera.azimuth = 150.0, -90.0, 90.0
    option = mujoco.MjvOption()
    option.geomgroup[4] = 0
    with mujoco.Renderer(model, 800, 800, max_geom=2000) as renderer:
        renderer.update_scene(data, camera, option)
        for index in range(renderer.scene.ngeom):
            if renderer.scene.geoms[index].type != mujoco.mjtGeom.mjGEOM_HFIELD:
                renderer.scene.geoms[index].rgba[3] = 0.0
        image = renderer.render().astype(float)
    focal = 400.0 / np.tan(0.5 * np.deg2rad(model.vis.global_.fovy))
    axis = np.linspace(-50.0, 50.0, 301)
    x, y = np.meshgrid(axis, axis)
    # The ground lies within decimetres of z = 0: less than a pixel at this distance.
    col = np.round(399.5 + focal * x / 150.0).astype(int)
    row = np.round(399.5 - focal * y / 150.0).astype(int)
    red, green, blue = np.moveaxis(image[row, col], -1, 0)
    greenness = green - 0.5 * (red + blue)
    ground = crossroad.ground
    cell = ((np.stack([x, y], -1) - ground.origin_xy_m) / ground.cell_m).astype(int)
    class_id = ground.class_id[cell[..., 1], cell[..., 0]]
    lawn, road = LAND_CLASSES.index("lawn"), LAND_CLASSES.index("road")
    assert (greenness[class_id == lawn] > 6.0).mean() > 0.93
    assert (greenness[class_id == road] < 6.0).mean() > 0.97
    flipped = ground.class_id[::-1][cell[..., 1], cell[..., 0]]
    assert (greenness[flipped == lawn] > 6.0).mean() < 0.85


def test_moving_cars_follow_closed_paths_inside_the_scene(crossroad: Scene) -> None:
    assert 2 <= len(crossroad.moving) <= 3
    for moving in crossroad.moving:
        assert crossroad.model.body(moving.body_name).mocapid[0] >= 0
        assert (np.abs(moving.path_world[:, :2]) <= 64.0).all()
        steps = np.linalg.norm(np.diff(moving.path_world, axis=0), axis=1)
        assert (steps > 0.0).all()
        assert moving.speed_mps > 0.0


def test_ramp_slope_is_exact_and_decides_safety(tmp_path: Path) -> None:
    for slope, safe in ((3.0, True), (4.8, True), (5.2, False), (9.0, False)):
        scene = ramp(tmp_path, slope)
        judgement = judge_touchdown(scene, np.array([1.0, 1.0]))
        assert abs(judgement.slope_deg - slope) < 0.2
        assert judgement.safe_geometry is safe
        maps = truth_maps(scene, 0.1, np.array([[-3.0, -3.0], [3.0, 3.0]]))
        np.testing.assert_allclose(maps.slope_deg, slope, atol=0.2)
        assert maps.safe_geometry.all() == safe
        assert maps.safe_geometry.any() == safe
        assert (maps.class_id == LAND_CLASSES.index("field")).all()


def test_step_is_unsafe_within_one_metre_only(tmp_path: Path) -> None:
    scene = ramp(tmp_path, 0.0, step_m=0.15)
    for x, safe in ((3.3, True), (4.2, False), (4.95, False), (6.6, True)):
        assert judge_touchdown(scene, np.array([x, 0.0])).safe_geometry is safe
    # through the middle of the disc: sqrt(1/4 - 16 / (9 pi^2)) of its height
    rough = max(
        judge_touchdown(scene, np.array([x, 0.0])).roughness_m for x in np.arange(4.5, 6.0, 0.1)
    )
    assert rough == pytest.approx(0.15 * np.sqrt(0.25 - 16.0 / (9.0 * np.pi**2)), rel=0.03)


def test_boxes_water_and_wire_are_judged_by_the_rule(tmp_path: Path) -> None:
    scene = load_text(tmp_path, FLAT_WITH_BOX)
    # A box of 6 cm is no obstacle, one of 30 cm is one up to 1.5 m from its edge.
    cases = {
        (0.0, 0.0): True, (6.0, 0.0): True, (-6.0, 0.0): False, (-4.4, 0.0): False,
        (-4.2, 0.0): True, (0.0, 8.0): False, (0.0, 6.2): False, (0.0, 5.9): True,
        (1.3, -8.0): False, (1.6, -8.0): True,
    }  # fmt: skip
    maps = truth_maps(scene, 0.1, np.array([[-10.0, -10.0], [10.0, 10.0]]))
    for (x, y), safe in cases.items():
        assert judge_touchdown(scene, np.array([x, y])).safe_geometry is safe, (x, y)
        row, col = int((y + 10.0) / 0.1), int((x + 10.0) / 0.1)
        assert bool(maps.safe_geometry[row, col]) is safe, (x, y)
    judgement = judge_touchdown(scene, np.array([-3.2, 0.0]))
    assert abs(judgement.obstacle_distance_m - 2.6) <= 0.051
    assert judge_touchdown(scene, np.array([-6.0, 0.0])).land_class == "other"
    assert maps.class_id[100, 40] == OTHER_CLASS_ID


def test_export_opens_again_and_is_the_same_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ground, "TEXELS", 1024)
    scene = load_scene("flat", 0)
    path = export_spec(spec_of_scene(scene), tmp_path)
    model = mujoco.MjModel.from_xml_path(str(path))
    assert model.ngeom == scene.model.ngeom
    assert model.tex_data.tobytes() == scene.model.tex_data.tobytes()
    assert model.hfield_data.tobytes() == scene.model.hfield_data.tobytes()
    np.testing.assert_allclose(model.qpos0, scene.model.qpos0, atol=1e-3)
    assert str(tmp_path) not in path.read_text()


def test_export_copies_the_files_of_an_imported_scene(tmp_path: Path) -> None:
    scene = ramp(tmp_path, 3.0)
    path = export_spec(spec_of_scene(scene), tmp_path / "out")
    model = mujoco.MjModel.from_xml_path(str(path))
    np.testing.assert_array_equal(model.hfield_data, scene.model.hfield_data)
