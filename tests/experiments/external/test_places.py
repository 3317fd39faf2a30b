"""Scenes of code, and scenes as PyMJCF models."""

import json
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest

from touchdown.experiments.campaign.directory import check_external_code
from touchdown.experiments.campaign.plan import load_plan
from touchdown.experiments.campaign.results_table import make_row, write_table
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.errors import UsageError
from touchdown.experiments.external.loading import code_now
from touchdown.experiments.flight.wiring import build_scene
from touchdown.experiments.io.results import load_result
from touchdown.experiments.io.run_directory import default_out_dir
from touchdown.experiments.scene_tools.flyability import check_scene_file
from touchdown.scenes.authoring import ground
from touchdown.scenes.compose import load_scene

from support.command import Says
from support.docs_support import ROOT, blocks_of

pytest.importorskip("dm_control")
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")

FLOOR = '<mujoco><worldbody><geom name="lawn" type="plane" size="40 40 1"/></worldbody></mujoco>'
PLACES = f'''
import mujoco
import numpy as np
from dm_control import composer, mjcf
from dm_control.entities.props import primitive

class Ramp(composer.Arena):
    """Rises by 4 % to the east, 5 m high at the origin, with a block 1 m into the ramp."""

    def _build(self, block_x):
        super()._build(name="ramp")
        self.field = self._mjcf_root.asset.add(
            "hfield", name="field", nrow=5, ncol=5, size=(50, 50, 8, 0.1))
        self._mjcf_root.worldbody.add(
            "geom", name="lawn_ramp", type="hfield", hfield="field", pos=(0, 0, 1))
        self.block, self.x = primitive.Primitive("box", (1, 1, 1), name="building"), block_x
        self.add_free_entity(self.block)

    def initialize_episode(self, physics, random_state):
        start = physics.bind(self.field).adr
        physics.model.hfield_data[start : start + 25] = np.tile(np.linspace(0.25, 0.75, 5), 5)
        self.block.set_pose(physics, position=(self.x, 10, 7))

def ramp(seed): return Ramp(20 + seed)
def root(): return mjcf.from_xml_string({FLOOR!r})
def spec(random_state):
    spec = mujoco.MjSpec.from_string({FLOOR!r})
    spec.worldbody.add_geom(name="road", type=mujoco.mjtGeom.mjGEOM_BOX, size=[2, 2, 1],
                            pos=[9, 0, random_state.randint(100)])
    return spec
def words(): return "a scene"
def sized(size): return root()
def failing(): raise RuntimeError("no terrain")
def empty(): return mjcf.RootElement()
'''


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Modules in the current directory; what is written for them is removed."""
    (tmp_path / "my_places.py").write_text(PLACES)
    page = blocks_of(ROOT / "docs" / "your-own-place.md", "python")[0]
    (tmp_path / "page_places.py").write_text(page)
    (tmp_path / "floor.xml").write_text(FLOOR)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "scratch").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "scratch"))
    yield
    sys.modules.pop("my_places", None), sys.modules.pop("page_places", None)
    assert list((tmp_path / "scratch").iterdir()) == []


def height(model: mujoco.MjModel, x: float, y: float) -> float:
    data, geom = mujoco.MjData(model), np.zeros(1, np.int32)
    mujoco.mj_forward(model, data)
    start, down = np.array([x, y, 200.0]), np.array([0.0, 0.0, -1.0])
    return 200.0 - mujoco.mj_ray(model, data, start, down, None, 1, -1, geom)


def test_an_arena_is_as_its_episode_begins(says: Says) -> None:
    """Heights that it writes into the compiled model, and poses of free bodies, are taken."""
    for seed in (0, 7):
        scene = build_scene(load_config(scene="my_places:ramp", seed=seed))
        heights = [height(scene.model, x, y) for x, y in ((-20, 5), (25, -5), (20.0 + seed, 10))]
        np.testing.assert_allclose(heights, [4.2, 6.0, 8.0], atol=1e-3)
        assert (scene.name, scene.source) == ("ramp", "my_places:ramp")
        assert {s.land_class for s in scene.surfaces.values()} == {"lawn", "building"}
    says(0, "scenes", "export", "my_places:ramp", "--seed", "7", "--out", "exported")
    assert height(load_scene("exported/scene.xml", 0).model, 27, 10) == pytest.approx(8.0, abs=1e-3)
    assert default_out_dir("my_places:ramp", "livo", 3) == Path("runs/my_places.ramp-livo-3")


def test_roots_and_specs_are_scenes() -> None:
    models = [build_scene(load_config(scene=f"my_places:{name}", seed=4, as_is=True)).model
              for name in ("root", "spec")]  # fmt: skip
    assert height(models[0], 9, 0) == 0.0
    assert height(models[1], 9, 0) == np.random.RandomState(4).randint(100) + 1.0
    axes = '[axes]\nscene = ["my_places:root", "my_places:spec"]\n'
    Path("plan.toml").write_text(f'name = "test"\n{axes}estimator = ["oracle"]\n')
    plan = load_plan(Path("plan.toml"))
    assert [r.run_id for r in plan.runs] == [f"my_places.{n}-oracle-s0" for n in ("root", "spec")]
    _write_run("my_places:root", code_now("my_places:root"))
    check_external_code(plan, Path("out"))
    _write_run("my_places:spec", "of other code")
    with pytest.raises(UsageError, match="the code of my_places:spec has changed since runs of"):
        check_external_code(plan, Path("out"))


def _write_run(scene: str, sha: str) -> None:
    folder = Path("out/runs") / scene.replace(":", "-")
    folder.mkdir(parents=True)
    result = {"scene": scene, "scene_sha": sha, "estimator": "oracle", "seed": 0}
    (folder / "result.json").write_text(json.dumps({**result, "outcome": "COMPLETED"}))
    row = make_row(load_result(folder / "result.json"), folder.name, "fly", "0")
    write_table([row], folder / "row.parquet")
    (folder.parents[1] / "campaign.json").write_text("{}")


@pytest.mark.parametrize(("name", "message"), [
    ("my_places:rampe", "has no function 'rampe' (did you mean 'ramp'?)"),
    ("no_places:ramp", "there is no module 'no_places' here or among what is installed"),
    ("my_places:words", "returned a str; return a PyMJCF root, a Composer entity or an MjSpec"),
    ("my_places:sized", "it needs size; only seed and random_state are given to it"),
    ("my_places:failing", "raised RuntimeError: no terrain (my_places.py:3"),
    ("my_places:empty", "no ground under the take-off spot"),
])  # fmt: skip
def test_what_is_no_scene_is_one_line(says: Says, name: str, message: str) -> None:
    error = says(2, "land", "--scene-from", name, "--out", "out").err
    assert error.startswith(f"touchdown: error: scene '{name}'") and message in error
    assert error.count("\n") == 1 and "scratch" not in error and not Path("out").exists()
    assert "leave out 'flat'" in says(2, "fly", "flat", "--scene-from", name).err


@pytest.mark.parametrize("name", ["hollow", "walls", "blocks"])
def test_the_scenes_of_the_page_can_be_flown(name: str) -> None:
    row = check_scene_file(f"page_places:{name}", ["survey.legs=1", "survey.leg_length_m=12"])
    assert row["problems"] == []


def test_entities_attach_to_our_scenes() -> None:
    """A crate falls on the floor of a scene; the vehicle keeps its name; the block of the page."""
    from dm_control import composer, mjcf
    from dm_control.entities.props import primitive

    from touchdown import pymjcf

    arena = pymjcf.SceneArena("floor.xml")
    crate = primitive.Primitive("box", (0.3, 0.3, 0.3), name="crate")
    arena.add_free_entity(crate).pos = (3, 1, 0.5)
    arena.mjcf_model.attach(pymjcf.vehicle()).add("freejoint")
    environment = composer.Environment(composer.NullTask(arena))
    environment.reset()
    environment.physics.step(1200)
    at = environment.physics.bind(crate.geom).xpos
    np.testing.assert_allclose(at, [3.0, 1.0, 0.3], atol=0.01)
    assert environment.physics.named.data.xpos["vehicle/quadrotor"].shape == (3,)
    assert isinstance(pymjcf.scene("floor.xml"), mjcf.RootElement)
    with pytest.raises(ValueError, match="did you mean 'crossroad'"):
        pymjcf.scene("crosroad")


def test_the_page_prints_what_it_says(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    page = ROOT / "docs" / "your-own-place.md"
    monkeypatch.setattr(ground, "TEXELS", 1024)
    exec(blocks_of(page, "python")[1], {"__name__": "block"})
    assert f"It prints `{capsys.readouterr().out.strip()}`" in page.read_text()
