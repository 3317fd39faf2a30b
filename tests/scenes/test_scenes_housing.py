"""`houses`, `cottage` and `pools`: safe ground, classes, surfaces and determinism."""

import functools

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from touchdown.scenes.api import LAND_CLASSES, Scene, TruthMaps
from touchdown.scenes.authoring.plots import Plot
from touchdown.scenes.authoring.streets import STEP_M, Street, smooth_line
from touchdown.scenes.truth.maps import judge_touchdown, truth_maps
from touchdown.scenes.truth.static_surface import cast_down

from support.places import cached_scene

NAMES = ("cottage", "houses", "pools")
CELL_M = 0.25


@functools.cache
def survey_maps(name: str, seed: int) -> TruthMaps:
    """Truth within the rectangle around the standard survey, 50 m ahead and 40 m to the left."""
    scene = cached_scene(name, seed)
    yaw = scene.takeoff_yaw
    ahead = np.array([np.cos(yaw), np.sin(yaw)])
    left = np.array([-ahead[1], ahead[0]])
    corners = np.array(
        [scene.takeoff_xy_m + a * ahead + b * left for a in (0, 50) for b in (0, 40)]
    )
    return truth_maps(scene, CELL_M, np.array([corners.min(axis=0), corners.max(axis=0)]))


def share(maps: TruthMaps, land_class: str) -> float:
    return float((maps.class_id == LAND_CLASSES.index(land_class)).mean())


def test_cottage_lane_is_level_and_the_meadow_is_not() -> None:
    maps = survey_maps("cottage", 0)
    lawn = maps.class_id == LAND_CLASSES.index("lawn")
    lane = maps.class_id == LAND_CLASSES.index("road")
    assert np.nanmedian(maps.slope_deg[lane]) < 2.0
    assert np.nanmedian(maps.slope_deg[lawn]) > 4.0
    assert (maps.safe_geometry & lane).mean() > 0.01
    assert not (maps.safe & lane).any()
    assert share(maps, "building") > 0.02


def test_pools_are_water_beside_a_safe_field() -> None:
    scene, maps = cached_scene("pools"), survey_maps("pools", 0)
    field = maps.class_id == LAND_CLASSES.index("field")
    assert share(maps, "water") > 0.05
    assert (maps.safe & field).sum() > 0.3 * field.sum()
    water = [name for name, surface in scene.surfaces.items() if surface.water]
    assert len(water) >= 3
    assert all(scene.surfaces[name].land_class == "water" for name in water)
    covers = [name for name, s in scene.surfaces.items() if s.land_class == "water" and not s.water]
    assert len(covers) == 1
    # A pool is level to the millimetre: its danger is what it is, not its shape.
    centre = scene.model.geom(covers[0]).pos[:2]
    judgement = judge_touchdown(scene, centre)
    assert judgement.slope_deg < 0.1
    assert judgement.land_class == "water"
    assert not judgement.safe_geometry


@pytest.mark.parametrize("name", NAMES)
def test_thin_wires_make_the_ground_below_unsafe(name: str) -> None:
    """There is a wire thinner than a pixel from 30 m (5 cm), and the truth maps mark the
    ground below its middle as unsafe."""
    scene = cached_scene(name)
    model = scene.model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    wires = []
    for i in range(model.ngeom):
        radius, half = model.geom_size[i, :2]
        if model.geom(i).name.startswith("wire") and half > 0.8 and radius <= 0.025:
            spot = data.geom_xpos[i]
            if 0.3 < spot[2] - _ground(scene, spot[:2]) < 2.5:
                wires.append(i)
    assert wires
    longest = max(wires, key=lambda i: model.geom_size[i, 1])
    assert not judge_touchdown(scene, data.geom_xpos[longest, :2].copy()).safe_geometry


def _ground(scene: Scene, xy: NDArray[np.float64]) -> float:
    offsets = np.array([[0.6, 0.6], [-0.6, 0.6], [0.6, -0.6], [-0.6, -0.6]])
    cells = [cast_down(scene, xy + o, 0.05, (1, 1))[0][0, 0] for o in offsets]
    return float(np.min(cells))


def test_lot_coordinates_invert_and_mirror() -> None:
    for mirrored in (False, True):
        plot = Plot(origin_xy_m=np.array([3.0, -2.0]), angle=0.7, mirrored=mirrored)
        uv = np.array([[0.0, 0.0], [4.0, -1.5], [2.0, 9.0]])
        np.testing.assert_allclose(plot.coordinates(plot.points(uv)), uv, atol=1e-12)
        expected = np.array([np.cos(plot.away), np.sin(plot.away)])
        np.testing.assert_allclose(plot.at(0.0, 1.0) - plot.origin_xy_m, expected, atol=1e-12)


def test_street_offsets_and_distances_agree() -> None:
    line = smooth_line(np.array([[-40.0, 0.0], [0.0, 8.0], [40.0, 0.0]]))
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    np.testing.assert_allclose(steps, STEP_M, rtol=0.01)
    street = Street(line_m=line, width_m=6.0, pavement_m=2.0)
    for along in (5.0, 33.0, 60.0):
        for across in (-4.0, 2.5):
            distance, where = street.nearest(street.point(along, across))
            assert abs(float(distance) - abs(across)) < 0.05
            assert abs(float(where) - along) < 0.6
    assert abs(float(street.kerb_distance(street.point(20.0, 3.0)))) < 0.05
