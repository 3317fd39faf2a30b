"""Images of scenes show what is there; seeds are distinguished."""

import json
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest

from touchdown.experiments.flight.survey_fit import fit_survey
from touchdown.experiments.scene_tools.flyability import check_scene, check_scene_file
from touchdown.experiments.scene_tools.posed_views import HoverView, hover_view
from touchdown.experiments.scene_tools.render import load_configured_scene, render_view
from touchdown.experiments.scene_tools.views import CLASS_RGB, VIEWS, SceneViews
from touchdown.scenes.api import Scene
from touchdown.scenes.compose import load_scene
from touchdown.scenes.registry import scene_names
from touchdown.scenes.render import render_scene
from touchdown.scenes.truth.survey_facts import survey_facts

from support.command import Says
from support.worlds import load_ideal_config as load_config

PLACE = """
<mujoco>
  <worldbody>
    <geom name="lawn" type="plane" size="25 25 1" rgba="0 1 0 1"/>
    <geom name="road_slab" type="box" pos="0 10 0.25" size="4 3 0.25" rgba="1 0 0 1"/>
    <geom name="water_pool" type="box" pos="10 -10 0.001" size="5 5 0.001" rgba="0 0 1 1"/>
    <site name="takeoff" pos="0 0 0"/>
  </worldbody>
</mujoco>
"""
LEGEND_ROWS = 46


@pytest.fixture(scope="module")
def place_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("place") / "place.xml"
    path.write_text(PLACE)
    return path


@pytest.fixture(scope="module")
def place(place_file: Path) -> Scene:
    return load_scene(str(place_file), 0)


@pytest.fixture(scope="module")
def views(place_file: Path, place: Scene) -> SceneViews:
    return SceneViews(place, load_config(scene=str(place_file)))


@pytest.fixture(scope="module")
def hover(place: Scene) -> HoverView:
    return hover_view(load_config(), place, height_m=30.0, seconds=0.2)


def pixel(image: np.ndarray, x: float, y: float, half: float = 25.0) -> np.ndarray:
    """The colour of world point (x, y) in a map with north up that covers +-half."""
    rows, cols = image.shape[0], image.shape[1]
    row = int((half - y) / (2.0 * half) * rows)
    return image[row, int((x + half) / (2.0 * half) * cols)].astype(int)


def test_from_above_north_is_up_and_east_is_right(place: Scene) -> None:
    before = place.model.vis.map.zfar, place.model.vis.global_.offwidth
    image = render_scene(place, "above", 400)
    assert image.shape == (400, 400, 3)
    assert before == (place.model.vis.map.zfar, place.model.vis.global_.offwidth)
    assert pixel(image, 0.0, 10.0).argmax() == 0 and pixel(image, 0.0, -10.0).argmax() == 1
    assert pixel(image, 10.0, -10.0).argmax() == 2
    with pytest.raises(ValueError, match="above, oblique"):
        render_scene(place, "below")


def test_hover_sees_true_depth_and_true_points(place: Scene, hover: HoverView) -> None:
    lens_m = 30.0 + float(place.model.qpos0[2])
    # The camera hangs below the body's origin by less than 0.3 m.
    assert lens_m - 0.3 < np.median(hover.depth_m) < lens_m
    # The heading is east, so the slab in the north is on the left: 0.5 m nearer than the ground.
    row, col = hover.depth_m.shape[0] // 2, hover.depth_m.shape[1] // 2
    slab = hover.depth_m[row, col - round(10.0 / lens_m * 617.0)]
    assert np.median(hover.depth_m) - slab == pytest.approx(0.5, abs=0.02)
    assert len(hover.points_world) == len(hover.intensity)
    x, y, z = hover.points_world.T
    lawn = (np.abs(y) < 5.0) & (np.abs(x) < 4.0)
    assert abs(z[lawn].mean()) < 0.005 and z[lawn].std() < 0.05
    on_slab = (np.abs(y - 10.0) < 2.5) & (np.abs(x) < 3.5)
    assert on_slab.sum() > 100 and z[on_slab].mean() == pytest.approx(0.5, abs=0.01)


def test_maps_show_class_height_and_safe_ground(views: SceneViews) -> None:
    def near(colour: np.ndarray, name: str) -> bool:
        return bool(np.abs(colour - np.array(CLASS_RGB[name])).max() < 12)

    classes = views.draw("class")[:-LEGEND_ROWS]
    assert near(pixel(classes, -10.0, -10.0), "lawn") and near(pixel(classes, 0.0, 10.0), "road")
    assert near(pixel(classes, 10.0, -10.0), "water")
    safe = views.draw("safe")[:-LEGEND_ROWS]
    assert pixel(safe, -10.0, -10.0).argmax() == 1  # lawn: green
    level = pixel(safe, 0.0, 10.0)  # the slab's middle: level, no safe class: yellow
    assert level[0] > level[1] > level[2] + 60
    assert np.ptp(pixel(safe, 0.0, 6.9)) == 0  # its edge: grey
    assert np.ptp(pixel(safe, 10.0, -10.0)) == 0
    height = views.draw("height")[:-LEGEND_ROWS]
    assert np.abs(pixel(height, 0.0, 10.0) - pixel(height, -10.0, -10.0)).max() > 60


def test_all_views_of_a_file_are_written_and_listed(
    place_file: Path, tmp_path: Path, says: Says
) -> None:
    out = tmp_path / "views"
    printed = says(0, "scenes", "render", place_file, "--all-views", "--out", out, "--json").out
    assert json.loads(printed) == {"directory": str(out)}
    assert {path.stem for path in out.iterdir()} == set(VIEWS)
    assert cv2.imread(str(out / "camera.png")).shape == (480, 848, 3)


def test_survey_facts_of_known_ground(place: Scene) -> None:
    facts = survey_facts(place, 8.0, 0.0, 2.0, 4.0)
    assert facts.seen_m2 == pytest.approx(12.0 * 8.0, rel=0.02)
    assert facts.safe_fraction == facts.safe_geometry_fraction == 1.0 and facts.safe_sites == 1
    assert facts.takeoff_safe
    # Legs towards the slab in the north, to the left of the heading: 48 m^2 of road are no safe
    # class; within 1.5 m of its step there is no safe geometry.
    wide = survey_facts(place, 8.0, 16.0, 2.0, 4.0)
    assert wide.safe_fraction < wide.safe_geometry_fraction < 1.0


def write_place(tmp_path: Path, geoms: str) -> str:
    path = tmp_path / "place.xml"
    path.write_text(f"<mujoco><worldbody>{geoms}</worldbody></mujoco>")
    return str(path)


LAWN = '<geom name="lawn" type="plane" size="0 0 1"/>'
SMALL_LAWN = '<geom name="lawn" type="box" size="20 20 1" pos="0 0 -1"/>'


@pytest.mark.parametrize(
    ("geoms", "problem", "remark"),
    [
        (LAWN, "", ""),
        # Legs of 50 x 40 m from the middle of 40 x 40 m of ground: 20 x 20 m have some below.
        (SMALL_LAWN, "ground under 20% of the survey, 50 x 40 m", ""),
        (
            f'{LAWN}<geom name="building_x" type="box" size="3 3 3" pos="0 0 3"/>',
            "",
            "on 'building_x' (building), 6.0 m above the ground",
        ),
        (
            f'{LAWN}<geom name="building_mast" type="box" size="1 1 16" pos="30 20 16"/>',
            "32.0 m higher than the take-off",
            "",
        ),
        ('<geom name="road" type="plane" size="0 0 1"/>', "no safe ground", ""),
        (
            f'{LAWN}<geom name="path_apron" type="box" size="9 9 .2" pos="20 15 0" contype="0" '
            'conaffinity="0"/><geom name="water" type="box" size="4 4 .1" pos="40 30 0" '
            'contype="0" conaffinity="0"/>',
            "",
            "path_apron: seen below the legs, but not touched",
        ),
        # 60 x 60 m of ground hold the legs, but not all of the 5821 m2 that are seen from them.
        (
            '<geom name="lawn" type="box" size="30 30 1" pos="25 20 -1"/>',
            "",
            "ground under 62% of what LIDAR and camera see",
        ),
    ],
)
def test_a_file_is_judged_by_what_a_survey_needs(
    geoms: str, problem: str, remark: str, tmp_path: Path
) -> None:
    row = check_scene_file(write_place(tmp_path, geoms), as_is=True)
    for found, expected in ((row["problems"], problem), (row["remarks"], remark)):
        assert len(found) == bool(expected), found
        assert expected in "".join(found)


def test_the_check_of_a_file_is_a_table_and_an_exit_code(tmp_path: Path, says: Says) -> None:
    place = write_place(tmp_path, f'{SMALL_LAWN}<geom name="heap" size="1" pos="6 5 0"/>')
    with pytest.warns(UserWarning, match=r"1 geom has no known class \(heap\): it counts"):
        printed = says(1, "scenes", "check", place, "--as-is", "--json").out
    (row,) = json.loads(printed)["places"]
    assert row["facts"]["without_class"] == ["heap"]
    assert row["facts"]["legs_fraction"] == pytest.approx(0.2, abs=0.01)
    short = ["--as-is", "--set", "survey.legs=1", "--set", "survey.leg_length_m=12"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # the heap was reported already
        shown = says(0, "scenes", "check", place, *short).out
    assert "lawn (lawn)" in shown and "heap" in shown and "remark: there is ground under" in shown
    says(2, "scenes", "check", "crosroad")


def test_guesses_alike_share_a_row(tmp_path: Path, says: Says) -> None:
    heaps = "".join(f'<geom name="heap{i}" size="0.4" pos="{i} 5 0"/>' for i in range(7))
    with pytest.warns(UserWarning, match="the classes of 7 geoms are guessed"):
        shown = says(0, "scenes", "check", write_place(tmp_path, LAWN + heaps)).out
    (row,) = (line for line in shown.splitlines() if "guessed" in line)
    assert "heap0, heap1, heap2, heap3, 3 more" in row and "other (a thing on the ground)" in row


@pytest.mark.slow
@pytest.mark.parametrize("name", scene_names())
def test_25_seeds_build_and_differ(name: str) -> None:
    row = check_scene(name, 25, lambda _note: None)
    assert row["failed"] == {}
    assert row["differ"], row["closest"]


def test_a_map_shows_the_legs_that_would_be_flown(place_file: Path, tmp_path: Path) -> None:
    """Over 25 m ahead of the take-off the standard leg of 50 m would not fit."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        render_view(str(place_file), 0, "above", tmp_path / "above.png")
        config = load_config(scene=str(place_file))
        scene = load_configured_scene(config)
        fitted = fit_survey(config, scene)
    assert fitted is not None and fitted.survey.leg_length_m <= 26.0
    shown = cv2.imread(str(tmp_path / "above.png"))[..., ::-1]
    for survey, same in ((fitted.survey, True), (config.survey, False)):
        views = SceneViews(scene, config.model_copy(update={"survey": survey}))
        assert np.array_equal(shown, views.framed("above", views.above())) == same
