"""What is left out of a picture does not show in it."""

import os
import sys
import threading
from collections.abc import Iterator

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.camera import ground_picture
from touchdown.sim.camera.gl import Snapshot, Stage
from touchdown.sim.camera.gl_contexts import gl_context, put_back
from touchdown.sim.camera.visible import Terrain
from touchdown.sim.frames import so3_exp

PINHOLE = CameraIntrinsics(width=212, height=120, fx=154.0, fy=156.0, cx=105.5, cy=59.5)
NODES = 65
_NOT_DRAWN = int(mujoco.mjtGeom.mjGEOM_NONE)
POSES = {
    "above the middle": ((3.0, -2.0, 14.0), (0.1, -0.1, 0.4)),
    "low and slanted": ((-8.0, 5.0, 4.0), (0.5, 0.2, 0.0)),
    "at the edge": ((28.0, 20.0, 12.0), (0.0, -0.6, 1.0)),
    "straight down": ((3.0, -2.0, 18.0), (0.0, 0.0, 0.6)),
    "level": ((0.0, 0.0, 6.0), (1.5, 0.0, 0.0)),
}
AFAR = {"from afar": ((3.0, -2.0, 145.0), (0.36, 0.1, 0.6))}


def make_model() -> mujoco.MjModel:
    """A rough terrain of 64 m with 400 posts, under a sky of red."""
    rng = np.random.default_rng(0)
    heights = " ".join(f"{h:.3f}" for h in rng.uniform(0.0, 1.0, NODES**2))
    posts = "".join(
        f'<geom type="cylinder" pos="{x:.2f} {y:.2f} 1.5" size="0.3 1.5" rgba="{r:.2f} .3 .8 1"/>'
        for x, y, r in rng.uniform((-30, -30, 0), (30, 30, 1), (400, 3))
    )
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><asset>
        <texture name="sky" type="skybox" builtin="flat" rgb1="1 0 0" width="8" height="8"/>
        <texture name="dots" type="2d" builtin="flat" rgb1=".4 .6 .3" mark="random"
         markrgb=".8 .3 .6" random="0.05" width="2048" height="2048"/>
        <material name="dots" texture="dots"/>
        <hfield name="ground" nrow="{NODES}" ncol="{NODES}" size="32 32 1.5 1"
         elevation="{heights}"/></asset>
        <worldbody><light pos="0 0 50" dir="0.3 0 -1" directional="true"/>
        <body name="eye" mocap="true"><camera name="eye"/></body>
        <geom type="hfield" hfield="ground" material="dots"/>{posts}</worldbody></mujoco>"""
    )


@pytest.fixture(scope="module")
def stage() -> Iterator[Stage]:
    made = Stage(make_model(), PINHOLE, 0)
    yield made
    made.close()


@pytest.fixture(scope="module")
def plain() -> Iterator[Stage]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ground_picture.GroundPicture, "of", lambda *_: None)
        made = Stage(make_model(), PINHOLE, 0)
    yield made
    made.close()


def snapshot_at(model: mujoco.MjModel, pose: str) -> Snapshot:
    place, turn = (POSES | AFAR)[pose]
    data = mujoco.MjData(model)
    data.mocap_pos[0] = place
    mujoco.mju_mat2Quat(data.mocap_quat[0], so3_exp(np.array(turn)).ravel())
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    return Snapshot.of(data)


def by_mujoco(
    stage: Stage, snapshot: Snapshot, monkeypatch: pytest.MonkeyPatch
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Colours and depths of the whole scene as MuJoCo draws it."""
    with monkeypatch.context() as patch:
        patch.setattr(stage, "_leave_out", lambda *_: None)
        patch.setattr(
            stage, "_lay_ground",
            lambda context, _: mujoco.mjr_uploadHField(stage._model, context, 0),
        )  # fmt: skip
        colours = stage.colour(snapshot, 0, 0, PINHOLE.height).copy()
        return colours, stage.inverse_depth_of_last(PINHOLE.height).metres()


@pytest.mark.parametrize("pose", POSES)
def test_pictures_are_those_of_the_whole_scene(
    stage: Stage, plain: Stage, pose: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    snapshot = snapshot_at(stage._model, pose)
    whole, far = by_mujoco(plain, snapshot, monkeypatch)
    everything = plain._scene.ngeom
    seen = stage.colour(snapshot, 0, 0, PINHOLE.height)
    depth = stage.inverse_depth_of_last(PINHOLE.height).metres()
    np.testing.assert_allclose(depth, far, rtol=1e-5)
    difference = np.abs(seen.astype(int) - whole)

    assert difference.mean() < 1.0  # normals are averaged a little differently
    assert (difference.max(axis=-1) > 25).mean() < 0.01
    drawn = [g for g in stage._scene.geoms[: stage._scene.ngeom] if g.type < _NOT_DRAWN]
    assert len(drawn) < 0.6 * everything and drawn[-1].type == mujoco.mjtGeom.mjGEOM_HFIELD
    sky = bool((whole == [255, 0, 0]).all(axis=-1).any())
    assert sky == (pose in ("at the edge", "level"))
    frustum = stage._frustum(snapshot, 0, 0, PINHOLE.height)
    assert stage._terrains[0].fills(frustum) != sky


def test_ids_are_of_all_that_is_in_view_wherever_was_looked_before(stage: Stage) -> None:
    here, there = (snapshot_at(stage._model, pose) for pose in ("above the middle", "at the edge"))
    stage.colour(there, 0, 0, PINHOLE.height)
    ids = stage.geom_ids(here, 0)
    assert (ids >= 0).all() and (ids > 0).any()
    stage.colour(here, 0, 0, PINHOLE.height)
    np.testing.assert_array_equal(stage.geom_ids(here, 0), ids)


def test_only_tiles_in_view_are_drawn(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[int] = []
    stage.colour(snapshot_at(stage._model, "low and slanted"), 0, 0, PINHOLE.height)
    tiles = next(iter(stage._tiles.values()))
    call = tiles._gl.glCallLists
    monkeypatch.setattr(tiles._gl, "glCallLists", lambda n, *a: drawn.append(n) or call(n, *a))
    for pose in ("low and slanted", "level"):
        stage.colour(snapshot_at(stage._model, pose), 0, 0, PINHOLE.height)
    assert 0 < drawn[0] <= 5 and 4 <= drawn[1] < 17  # with the list that ends them
    monkeypatch.setattr(ground_picture, "_MAX_TEXELS", 0)
    stage.colour(snapshot_at(stage._model, "low and slanted"), 0, 0, PINHOLE.height)
    assert len(stage._pictures[0]._parts) == drawn[2] - 1


def test_from_afar_every_second_node_is_drawn_and_no_gap_shows(
    plain: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    snapshot = snapshot_at(plain._model, "from afar")
    _, far = by_mujoco(plain, snapshot, monkeypatch)
    plain.colour(snapshot, 0, 0, PINHOLE.height)
    tiles, drawn = next(iter(plain._tiles.values())), []
    call = tiles._gl.glCallLists
    monkeypatch.setattr(tiles._gl, "glCallLists", lambda n, k, a: drawn.append(a) or call(n, k, a))
    for pose, stride in (("straight down", 1), ("from afar", 2), ("straight down", 1)):
        plain.colour(snapshot_at(plain._model, pose), 0, 0, PINHOLE.height)
        numbers = drawn[-1] - tiles._lists[stride]
        assert numbers.size and numbers.min() >= 0 and numbers.max() < len(tiles._boxes)
        if stride == 2:
            depth = plain.inverse_depth_of_last(PINHOLE.height).metres()
            ground = binary_erosion(far < 190.0)  # its edge is a straight line by fewer nodes
            assert ground.any() and (depth[ground] < 190.0).all()
            assert 0.02 < np.median(np.abs(depth - far)[ground]) < 0.5


def test_terrain_that_is_tilted_or_shown_twice_is_left_to_mujoco() -> None:
    field = '<asset><hfield name="f" nrow="3" ncol="3" size="1 1 1 1"/></asset>'
    shown = '<geom type="hfield" hfield="f" {}/>'
    for geoms, found in (
        ([""], {0}), (['euler="0 10 0"'], set()), (["", 'pos="5 0 0"'], set()),
    ):  # fmt: skip
        bodies = "".join(shown.format(geom) for geom in geoms)
        model = mujoco.MjModel.from_xml_string(
            f"<mujoco>{field}<worldbody>{bodies}</worldbody></mujoco>"
        )
        assert set(Terrain.all_of(model)) == found


def test_a_context_used_before_in_another_thread_draws_the_same_and_keeps_nothing() -> None:
    from OpenGL import GL

    def draw(left: list[list[int]], pictures: list[NDArray[np.uint8]]) -> None:
        stage = Stage(make_model(), PINHOLE, 0)
        snapshot = snapshot_at(stage._model, "low and slanted")
        pictures.append(stage.colour(snapshot, 0, 0, PINHOLE.height).copy())
        stage.close()
        context = gl_context(8, 8)
        left.append([GL.glIsList(n) for n in range(1, 2000)])
        left.append([GL.glIsTexture(n) for n in range(99)])
        put_back(context)
        contexts.add(id(context))
        if egl is not None:
            current.append(bool(egl.EGL.eglGetCurrentContext()))

    egl = sys.modules.get("mujoco.egl")
    current: list[bool] = []
    contexts: set[int] = set()
    left: list[list[int]] = []
    pictures: list[NDArray[np.uint8]] = []
    for _ in range(2):
        thread = threading.Thread(target=draw, args=(left, pictures))
        thread.start()
        thread.join()
    assert len(contexts) == 1 or os.environ.get("MUJOCO_GL", "egl") != "egl"
    np.testing.assert_array_equal(*pictures)
    assert not any(map(any, left)), "lists and textures"
    assert not any(current), "another thread may not take a context that is current in this one"
