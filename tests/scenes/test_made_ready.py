"""Scenes of other people: what is dressed, guessed and moved before a flight."""

import functools
import tempfile
from pathlib import Path

import cv2
import mujoco
import numpy as np
import pytest

from touchdown.scenes.api import CLASS_RGB, LAND_CLASSES, ImportOptions, Scene
from touchdown.scenes.compose import load_scene
from touchdown.scenes.importers.classes import Look, class_of_words, ground_class, is_blue, look_of
from touchdown.scenes.truth.maps import judge_touchdown
from touchdown.scenes.truth.static_surface import cast_points, class_ids

from support.own_places import PLACES
from support.places import load_quietly


def load(path: Path, ready: ImportOptions | None = ImportOptions()) -> Scene:  # noqa: B008
    return load_quietly(path, options=ready)


@functools.lru_cache(maxsize=2)
def place(name: str) -> Scene:
    with tempfile.TemporaryDirectory() as folder:
        return load(PLACES[name](Path(folder) / name))


def write(folder: Path, body: str, asset: str = "") -> Path:
    path = folder / "place.xml"
    path.write_text(f"<mujoco><asset>{asset}</asset><worldbody>{body}</worldbody></mujoco>")
    return path


def classes(scene: Scene) -> dict[str, str]:
    return {name: surface.land_class for name, surface in scene.surfaces.items()}


def test_a_checker_is_dressed_below_its_height() -> None:
    """Relief of centimetres, never above the floor; a picture instead of three colours."""
    scene = place("checker")
    assert scene.textured == ("floor",) and classes(scene)["floor"] == "lawn"
    xy = np.random.default_rng(0).uniform(-70.0, -10.0, (4000, 2))
    heights, _ = cast_points(scene, xy)
    assert heights.min() > -0.0605 and heights.max() < 0.0005 and 0.005 < heights.std() < 0.02
    assert not look_of(scene.model, scene.model.geom("floor").id).plain
    look = look_of(load_checker_as_is().model, 0)
    assert look.pattern and not look.even


def load_checker_as_is() -> Scene:
    with tempfile.TemporaryDirectory() as folder:
        return load(PLACES["checker"](Path(folder) / "checker"), None)


def test_the_take_off_leaves_what_stands_at_the_origin() -> None:
    """The robot there is 0.9 m wide; the floor around it is free from 1.5 m on."""
    scene = place("checker")
    assert 1.4 < np.hypot(*scene.takeoff_xy_m) < 4.0
    judged = judge_touchdown(scene, scene.takeoff_xy_m)
    assert judged.safe and judged.obstacle_distance_m > 1.0
    yard = place("yard").takeoff_xy_m  # legs of 50 x 40 m in a yard of 60 m
    assert (yard > -30.0).all() and (yard + [50.0, 40.0] < 30.3).all()


def test_a_plane_with_ground_behind_it_collides_where_it_is_drawn(tmp_path: Path) -> None:
    """Walls of `quadruped.xml` of dm_control: MuJoCo draws them 1 x 15 m, and all that is behind
    them collides with them. So it is with a table top, and not with a mat on the floor."""
    wall = '<geom name="wall" type="plane" size="1 15 .5" pos="-8 0 .7" zaxis="1 0 1"/>'
    top = '<geom name="top" type="plane" size="1 1 .5" pos="20 -9 1"/>'
    mat = '<geom name="mat" type="plane" size="1 1 .5" pos="20 9 .02"/>'
    floor = '<geom name="floor" type="plane" size="0 0 1"/><site name="takeoff" pos="-14 0 0"/>'
    strip = '<geom name="building" type="plane" size="0 1 .5" pos="0 -20 1"/>'  # endless along x
    path = write(tmp_path, floor + wall + top + mat + strip)
    with pytest.warns(
        UserWarning, match="wall, top, building: planes that collide only where they are draw"
    ):
        scene = load_scene(str(path), 0, options=ImportOptions())
    model, data = scene.model, mujoco.MjData(scene.model)
    names = {model.geom(g).name for g in range(model.ngeom) if model.geom_contype[g]}
    own = {name for name in names if not name.startswith("vehicle/")}
    assert own == {"floor", "mat", "wall_touched", "top_touched", "building_touched"}
    for _ in range(600):
        mujoco.mj_step(model, data)
    assert np.hypot(*(data.qpos[:2] - scene.takeoff_xy_m)) < 0.01 and data.ncon >= 3
    data.qpos[:3] = [-8.0, 0.0, 0.9]
    mujoco.mj_forward(model, data)
    of_wall = {model.geom("wall_touched").id}
    assert any(of_wall & {contact.geom1, contact.geom2} for contact in data.contact)
    assert model.geom("wall_touched").group[0] == 3


def test_lamps_that_leave_the_ground_dark_are_joined_by_a_sun(tmp_path: Path) -> None:
    """Lamps over a floor of 120 m beside a light of the camera of 0.1, which is too little."""

    def lights(lamp: str, level: float = 0.1, ready: ImportOptions | None = ImportOptions(),  # noqa: B008
               on: int = 1) -> list[str]:  # fmt: skip
        path = tmp_path / "lamp.xml"
        path.write_text(
            f"""<mujoco><visual>
            <headlight ambient="{level} {level} {level}" diffuse="0 0 0" active="{on}"/>
            </visual><worldbody><light {lamp}/><geom type="plane" size="60 60 1"/></worldbody>
            </mujoco>"""
        )
        model = load(path, ready).model
        return [model.light(number).name for number in range(model.nlight)]

    cone = 'cutoff="45" exponent="0"'
    for dark in (
        f'pos="0 0 3" {cone}', f'pos="0 0 40" {cone}', f'pos="0 0 90" {cone} active="false"',
        f'pos="0 0 90" {cone} attenuation="0 0 1"', 'directional="true" dir="0 0 1"',
    ):  # fmt: skip
        assert lights(dark) == ["", "sun"], dark
    for lit in (f'pos="0 0 90" {cone}', 'directional="true" dir="0 1 -1"'):
        assert lights(lit) == [""], lit
    assert lights(f'pos="0 0 3" {cone}', 0.2) == [""]
    assert lights(f'pos="0 0 3" {cone}', 0.2, on=0) == ["", "sun"]
    assert lights(f'pos="0 0 3" {cone}', ready=None) == [""]
    assert lights(f'name="sun" pos="0 0 3" {cone}') == ["sun", ""]
    path = tmp_path / "another.xml"
    path.write_text((tmp_path / "lamp.xml").read_text())
    with pytest.warns(UserWarning, match="its lamps leave the ground dark: a sun is added"):
        load_scene(str(path), 0, options=ImportOptions())


@pytest.mark.parametrize(("name", "expected"), [
    ("boxes", {"geom_0": "lawn", "geom_1": "building"}),
    ("mesh", {"geom_0": "field", "geom_1": "other"}),
    ("terrain", {"terrain": "lawn", "floor": "lawn"}),
    ("rooftop", {"geom_5": "lawn", "geom_1": "building", "geom_0": "lawn", "geom_10": "other"}),
    ("yard", {"floor_0": "field", "geom_5": "building", "geom_6": "other", "geom_8": "trees"}),
    ("surveyed", {"green grass_0": "lawn", "tarmac_1": "road", "brick_2": "building"}),
])  # fmt: skip
def test_classes_follow_from_words_shape_and_colour(name: str, expected: dict[str, str]) -> None:
    found = classes(place(name))
    assert {geom: found[geom] for geom in expected} == expected
    assert set(place(name).inferred) >= set(expected)
    assert judge_touchdown(place(name), place(name).takeoff_xy_m).safe


@pytest.mark.parametrize(
    ("words", "land_class"),
    [("oldOakTrees", "trees"), ("swimming_pool.2", "water"), ("Roof_12", "building"),
     ("poolish", None), ("floor", None)],
)  # fmt: skip
def test_words_mean_classes(words: str, land_class: str | None) -> None:
    assert class_of_words("", words) == land_class


def test_only_clear_colours_mean_ground() -> None:
    """A blue pattern is the floor of MuJoCo's examples; a blue surface else is water."""
    for rgb, plain, land_class in (
        ((60, 90, 40), True, "lawn"), ((120, 95, 70), False, "field"),
        ((60, 60, 62), False, "road"), ((60, 60, 62), True, "lawn"),
        ((150, 148, 140), False, "path"), ((230, 232, 235), False, "field"),
    ):  # fmt: skip
        look = Look(np.array(rgb, float), plain)
        assert ground_class(look) == land_class, rgb
    for grey, land_class in (
        (150.0, "path"),
        (60.0, "road"),
    ):  # textures of one grey, as of streets
        assert ground_class(Look(np.full(3, grey), True, True, even=True)) == land_class
    blue = np.array([40.0, 90.0, 160.0])
    assert is_blue(Look(blue, True)) and not is_blue(Look(blue, True, pattern=True))
    assert not is_blue(Look(np.array([25.0, 51.0, 76.0]), True))


def test_a_mesh_is_touched_where_it_is_seen(tmp_path: Path) -> None:
    """A valley of a mesh with a picture on it keeps its look; MuJoCo's hull would lie 4 m above."""
    cv2.imwrite(str(tmp_path / "p.png"), np.random.default_rng(0).integers(
        0, 255, (64, 64, 3)).astype(np.uint8))  # fmt: skip
    x, y = np.meshgrid(np.linspace(-40, 40, 21), np.linspace(-40, 40, 21))
    z = np.abs(x) * 0.1
    lines = [f"v {a} {b} {c}" for a, b, c in zip(x.flat, y.flat, z.flat, strict=True)]
    for k in range(20 * 21):
        if k % 21 < 20:
            lines += [f"f {k + 1} {k + 2} {k + 23}", f"f {k + 1} {k + 23} {k + 22}"]
    (tmp_path / "valley.obj").write_text("\n".join(lines))
    asset = (
        '<mesh name="valley" file="valley.obj" inertia="shell"/>'
        '<texture name="p" type="2d" file="p.png"/><material name="p" texture="p"/>'
    )
    scene = load(
        write(tmp_path, '<geom name="ground" type="mesh" mesh="valley" material="p"/>', asset)
    )
    assert scene.textured == ()
    data, hit = mujoco.MjData(scene.model), np.zeros(1, np.int32)
    mujoco.mj_forward(scene.model, data)
    touched = scene.model.geom("ground_touched").id
    assert scene.model.geom_contype[touched] and not scene.model.geom_contype[0]
    for at in (-33.3, -10.1, 0.4, 25.7):
        away = mujoco.mj_ray(scene.model, data, np.array([at, 7.0, 50.0]), np.array([0, 0, -1.0]),
                             np.array([0, 0, 0, 1, 0, 0], np.uint8), 1, -1, hit)  # fmt: skip
        assert hit[0] == touched and 50.0 - away == pytest.approx(abs(at) * 0.1, abs=0.02)


def test_a_dressed_mesh_keeps_its_heights() -> None:
    """Of the hills of 1.6 and 0.8 m, at the cells of the mesh, with a flat part at (28, 18)."""
    x, y = np.random.default_rng(1).uniform(-70.0, -20.0, (2, 500))
    heights, _ = cast_points(place("mesh"), np.stack([x, y], axis=1))
    true = 1.6 * np.sin(x / 17.0) * np.cos(y / 21.0) + 0.8 * np.sin((x + y) / 11.0)
    assert np.abs(heights - true).max() < 0.03


def test_a_user_s_classes_count(tmp_path: Path) -> None:
    body = '<geom name="pad" type="box" size="30 30 1" pos="20 20 -1"/>'
    path = write(tmp_path, body + '<geom name="hut" type="box" size="2 2 2" pos="20 20 2"/>')
    table, picture = tmp_path / "c.toml", tmp_path / "c.png"
    table.write_text('[classes]\n"p*" = "path"\n"*" = "water"\n')
    scene = load(path, ImportOptions(classes=str(table)))
    assert classes(scene) == {"pad": "path", "hut": "water"} and scene.inferred == {}
    image = np.full((60, 60, 3), CLASS_RGB["lawn"], np.uint8)
    image[:30] = CLASS_RGB["road"]  # the north
    cv2.imwrite(str(picture), image[..., ::-1])
    scene = load(path, ImportOptions(classes=str(picture)))
    pad = np.full((2, 1), scene.model.geom("pad").id, np.int32)
    ids = class_ids(scene, np.array([5.0, -10.0]), 30.0, np.zeros((2, 1)), pad)
    assert [LAND_CLASSES[k] for k in ids[:, 0]] == ["lawn", "road"]
    for text, reason in (
        ('[classes]\n"p*" = "sand"\n', "'sand' of 'p\\*' is none of"), ("[classes\n", "not valid"),
        ("a = 1\n", "no table"),
    ):  # fmt: skip
        table.write_text(text)
        with pytest.raises(ValueError, match=reason):
            load(path, ImportOptions(classes=str(table)))
    image[7, 9] = (255, 0, 0)
    cv2.imwrite(str(picture), image)
    with pytest.raises(ValueError, match="the colour 0, 0, 255 is that of no class"):
        load(path, ImportOptions(classes=str(picture)))


def test_what_is_done_is_said_in_one_line(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="is dressed") as caught:
        load_scene(str(PLACES["checker"](tmp_path)), 0, options=ImportOptions())
    (said,) = [str(w.message) for w in caught if "joints" not in str(w.message)]
    for part in ("no take-off is named", "of 9 geoms are guessed", "dressed (floor as lawn)"):
        assert part in said


def test_a_file_is_made_ready_the_same_every_time(tmp_path: Path) -> None:
    path = PLACES["boxes"](tmp_path)
    first, again = load(path).model, load(path).model
    for part in ("tex_data", "hfield_data", "geom_pos"):
        assert getattr(first, part).tobytes() == getattr(again, part).tobytes()
    plain = load(path, None)
    assert plain.model.nhfield == 0 and set(classes(plain).values()) == {"other"}
