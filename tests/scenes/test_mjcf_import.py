"""Import of MJCF files: names, take-off, assets, lights, units and error messages."""

from pathlib import Path

import cv2
import mujoco
import numpy as np
import pytest

from touchdown.scenes.api import VEHICLE_BODY, ImportOptions, Scene
from touchdown.scenes.compose import load_scene

from support.places import height_at, load_quietly

FLOOR = '<geom name="lawn" type="plane" size="40 40 1"/>'
TRIANGLES = "v 0 0 0\nv 4 0 0\nv 0 4 0\nv 0 0 2\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
MACHINE = """<mujoco>
  <option gravity="0 0 -1"><flag contact="disable" gravity="disable"/></option>
  <compiler settotalmass="5" discardvisual="true"/>
  <default><default class="road"><geom material="road_tar"/></default></default>
  <asset><material name="road_tar"/></asset>
  <worldbody>
    <geom name="lawn" type="plane" size="30 30 1"/>
    <geom type="box" class="road" pos="9 0 0" size="1 1 .01"/>
    <body name="arm" pos="5 0 1"><joint name="hinge" type="hinge"/>
      <geom name="building_arm" size=".3" contype="0" conaffinity="0"/><site name="tip"/>
      <body name="hand"><joint name="slide" type="slide"/><geom name="building_hand" size=".2"/>
      </body></body>
    <body name="ball" pos="6 6 3"><freejoint name="free"/>
      <geom name="trees_ball" size=".3"/></body>
  </worldbody>
  <contact><exclude body1="arm" body2="hand"/><pair geom1="lawn" geom2="building_hand"/></contact>
  <tendon><fixed name="rope"><joint joint="hinge" coef="1"/></fixed></tendon>
  <equality><joint joint1="hinge" joint2="slide"/><weld body1="ball" body2="arm"/></equality>
  <actuator><motor name="motor" joint="hinge"/><motor name="winch" tendon="rope"/></actuator>
  <sensor><jointpos joint="hinge"/><gyro site="tip"/></sensor>
  <keyframe><key name="home" qpos="0.1 0.2 6 6 3 1 0 0 0" ctrl="0 0"/></keyframe>
</mujoco>"""


def write(tmp_path: Path, text: str, name: str = "model.xml") -> str:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True, parents=True)
    path.write_text(text)
    return str(path)


def load(tmp_path: Path, body: str, head: str = "") -> Scene:
    text = f"<mujoco>{head}<worldbody>{body}</worldbody></mujoco>"
    return load_quietly(write(tmp_path, text))


def test_joints_are_removed_and_the_vehicle_is_unchanged(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="3 joints") as caught:
        scene = load_scene(write(tmp_path, MACHINE), 0)
    assert len(caught) == 1
    model = scene.model
    plain = load(tmp_path, FLOOR).model
    assert (model.nq, model.nu, model.nkey, model.nsensor - plain.nsensor) == (7, plain.nu, 0, 0)
    assert model.neq == model.ntendon == model.npair == model.nexclude == 0
    assert model.opt.disableflags == 0 and model.opt.gravity[2] == -9.81
    body = model.body(VEHICLE_BODY).id
    assert model.body_subtreemass[body] == pytest.approx(
        plain.body_subtreemass[plain.body(VEHICLE_BODY).id]
    )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(data.body("ball").xpos, [6.0, 6.0, 3.0])
    assert scene.surfaces["building_arm"].land_class == "building"
    assert scene.surfaces["road_tar_1"].land_class == "road"


def test_the_files_own_vehicle_is_not_taken_off_from(tmp_path: Path) -> None:
    drone = """<body pos="0 0 0.2"><freejoint/><geom type="box" size=".3 .3 .2"/></body>
      <body pos="3 0 0.2"><freejoint/><geom type="box" size=".3 .3 .2"/></body>"""
    text = f"<mujoco><worldbody>{FLOOR}{drone}</worldbody></mujoco>"
    with pytest.warns(
        UserWarning, match="moving body 0 moves, and stands at the take-off spot: it is left"
    ):
        scene = load_scene(write(tmp_path, text), 0)
    assert height_at(scene, 0.0, 0.0) == pytest.approx(0.0)
    assert height_at(scene, 3.0, 0.0) == pytest.approx(0.4), (
        "what moves elsewhere stays where it stands"
    )


def test_an_attribute_that_mujoco_does_not_know_may_be_of_a_newer_one(tmp_path: Path) -> None:
    with pytest.raises(
        ValueError, match=rf"'novel'.*; this is MuJoCo {mujoco.__version__}, a newer"
    ):
        load(tmp_path, FLOOR.replace("/>", ' novel="1"/>'))


def test_includes_meshes_and_textures_are_found_beside_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "deep" / "models").mkdir(parents=True)
    (tmp_path / "deep" / "models" / "hut.obj").write_text(TRIANGLES)
    cv2.imwrite(str(tmp_path / "deep" / "models" / "tar.png"), np.zeros((8, 8, 3), np.uint8))
    unit = np.tile(np.linspace(0.0, 1.0, 5, dtype="<f4"), 5)
    header = np.array([5, 5], "<i4").tobytes()
    (tmp_path / "deep" / "models" / "hill.bin").write_bytes(header + unit.tobytes())
    write(
        tmp_path,
        """<mujoco><asset><mesh name="hut" file="hut.obj"/>
        <texture name="tar" type="2d" file="tar.png"/><material name="road" texture="tar"/>
        </asset></mujoco>""",
        "deep/parts.xml",
    )
    path = write(
        tmp_path,
        """<mujoco><compiler meshdir="models" texturedir="models"/><include file="parts.xml"/>
        <asset><hfield name="hill" file="hill.bin" size="30 30 6 1"/></asset>
        <worldbody><geom name="field" type="hfield" hfield="hill" material="road"/>
        <geom name="building" type="mesh" mesh="hut" pos="9 9 6"/></worldbody></mujoco>""",
        "deep/model.xml",
    )
    monkeypatch.chdir(tmp_path)
    scene = load_scene(path, 0)
    # The hill rises from 0 m in the west to 6 m in the east: 3 m in the middle.
    assert height_at(scene, 0.0, 0.0) == pytest.approx(3.0, abs=0.01)
    assert scene.surfaces["field"].land_class == "road"
    assert scene.model.nmesh >= 1


def test_a_sun_is_added_only_to_a_file_without_light(tmp_path: Path) -> None:
    assert load(tmp_path, FLOOR).model.nlight == 1
    lamps = '<light pos="0 0 9"/><light pos="1 0 9"/>'
    assert load(tmp_path, FLOOR + lamps).model.nlight == 2


def test_no_ground_is_one_clear_line(tmp_path: Path) -> None:
    far = '<geom name="lawn" type="box" size="9 9 1" pos="30 0 0"/>'
    with pytest.raises(ValueError, match=r"no ground under the take-off spot \[0.0, 0.0\]"):
        load(tmp_path, far)
    apart = "".join(f'<geom type="box" size="1 1 1" pos="{x} 0 0"/>' for x in (10, 30))
    text = f"<mujoco><worldbody>{apart}</worldbody></mujoco>"
    with pytest.raises(ValueError, match=r"no ground under the take-off spot \[20.0, 0.0\]"):
        load_scene(write(tmp_path, text), 0, options=ImportOptions())
    site = '<site name="takeoff" pos="30 0 0"/>'
    np.testing.assert_allclose(load(tmp_path, far + site).takeoff_xy_m, [30.0, 0.0])


@pytest.mark.parametrize(("asset", "geom", "message", "kind"), [
    ('<mesh name="tree" file="oak.obj"/>', 'mesh="tree" type="mesh"', "mesh 'tree'.*oak.obj",
     FileNotFoundError),
    ('<mesh name="tree" file="oak.dae"/>', 'mesh="tree" type="mesh"', "cannot read 'oak.dae'",
     ValueError),
    ('<texture name="t" type="2d" file="turf.jpg"/><material name="m" texture="t"/>',
     'material="m" size="1"', "cannot read 'turf.jpg' of texture 't'", ValueError),
    ('<hfield name="h" file="dem.tif" size="9 9 1 1"/>', 'hfield="h" type="hfield"',
     "cannot read 'dem.tif' of height field 'h'", ValueError),
    ('<hfield name="h" file="dem.png" size="9 9 1 1"/>', 'hfield="h" type="hfield"',
     "height field 'h' needs the file 'dem.png'", FileNotFoundError),
])  # fmt: skip
def test_invalid_assets_are_named(
    tmp_path: Path, asset: str, geom: str, message: str, kind: type[Exception]
) -> None:
    for name in ("oak.dae", "turf.jpg", "dem.tif"):
        (tmp_path / name).write_text("something else")
    with pytest.raises(kind, match=message) as caught:
        load(tmp_path, f"{FLOOR}<geom {geom}/>", f"<asset>{asset}</asset>")
    assert "\n" not in str(caught.value)


def test_vehicle_of_an_exported_file_is_replaced(tmp_path: Path) -> None:
    body = """<body name="vehicle/quadrotor" pos="3 4 1" euler="0 0 90"><freejoint/>
    <geom name="vehicle/leg_0" size=".1"/><site name="vehicle/imu"/></body>
    <body name="quadrotor" pos="9 9 1"><geom name="path_quad" size=".1"/></body>"""
    scene = load(tmp_path, FLOOR + body)
    assert scene.model.nq == 7
    assert scene.model.body("quadrotor").pos[0] == 9.0
    np.testing.assert_allclose(scene.takeoff_xy_m, [3.0, 4.0])
    assert scene.takeoff_yaw == pytest.approx(0.5 * np.pi)


def test_high_ground_is_moved_to_zero(tmp_path: Path) -> None:
    body = """<frame pos="0 0 1000"><geom name="lawn" type="box" size="40 40 1" pos="0 0 999"/>
    </frame><geom name="path_post" type="capsule" fromto="9 0 2000 9 0 2003" size=".5"/>
    <body name="hut" pos="0 9 2001"><geom name="building" type="box" size="1 1 1"/></body>"""
    scene = load(tmp_path, body)
    assert height_at(scene, 0.0, 0.0) == pytest.approx(0.0, abs=1e-6)
    assert height_at(scene, 9.0, 0.0) == pytest.approx(3.5, abs=2e-3)
    assert height_at(scene, 0.0, 9.0) == pytest.approx(2.0, abs=1e-6)


@pytest.mark.parametrize("size", [0.4, 40_000.0])
def test_unlikely_units_give_a_warning(tmp_path: Path, size: float) -> None:
    text = f"<mujoco><worldbody><geom name='lawn' type='box' size='{size} {size} 1'/></worldbody>"
    with pytest.warns(UserWarning, match="across; are its lengths in metres"):
        load_scene(write(tmp_path, text + "</mujoco>"), 0)
