"""Scenes in map coordinates are moved to the world's origin and stay what they are."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.flight.run import fly
from touchdown.experiments.flight.wiring import build_scene
from touchdown.scenes.compose import load_scene
from touchdown.scenes.truth.maps import truth_maps
from touchdown.sim.lidar.raycast_scene import LidarScene

from support.places import load_quietly
from support.truth_rays import SingleRays
from support.worlds import load_ideal_config as load_config

MAP = (500_000.0, 5_300_000.0)
TAKEOFF = "<site name='takeoff' pos='{x} {y} 0.1' euler='0 0 30'/>"
FLOORS = {
    "finite": "<geom name='lawn' type='plane' size='60 60 1' pos='{x} {y} 0'/>",
    "infinite": "<geom name='lawn' type='plane' size='0 0 1'/>",
    "solid": "<geom name='lawn' type='box' size='60 60 1' pos='{x} {y} -1'/>",
}


def place(
    folder: Path, at: tuple[float, float], floor: str = "finite", takeoff: bool = True
) -> str:
    """A file with things on the world, on bodies, in frames and between two ends, around ``at``."""
    x, y = at
    ends = f"{x + 12} {y - 3} 1 {x + 14} {y + 1} 2.5"
    things = (
        f"<body pos='{x} {y} 0'><geom name='building' type='box' size='1 1 1' pos='6 2 1'/>"
        "<body pos='3 9 0.5' euler='0 0 20'><geom name='road' type='sphere' size='1.5'/></body>"
        "</body>"
        f"<geom name='trees' type='capsule' size='0.5' fromto='{ends}'/>"
        f"<frame pos='{x} {y} 0' euler='0 0 45'><geom name='path' type='cylinder' size='1 0.5' "
        "pos='-7 4 0.5'/><body pos='-9 -9 0'><geom name='field' type='box' size='2 2 1'/></body>"
        "</frame>"
        f"<light pos='{x} {y} 20'/>"
    )
    spot = TAKEOFF.format(x=x, y=y) if takeoff else ""
    body = FLOORS[floor].format(x=x, y=y) + things + spot
    path = folder / f"at_{x:.0f}" / f"place_{floor}.xml"  # draws are by the scene's name
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>", encoding="utf-8")
    return str(path)


@pytest.mark.parametrize("floor", FLOORS)
def test_map_coordinates_give_the_same_scene(tmp_path: Path, floor: str) -> None:
    """Truth maps and LIDAR ranges to the bit, and what single rays say."""
    near = load_quietly(place(tmp_path, (0.0, 0.0), floor))
    with pytest.warns(UserWarning, match="origin is moved to x 500000, y 5300000 of the file"):
        far = load_scene(place(tmp_path, MAP, floor), 0)
    np.testing.assert_array_equal(near.origin_m, np.zeros(3))
    np.testing.assert_array_equal(far.origin_m, [*MAP, 0.0])
    np.testing.assert_array_equal(far.takeoff_xy_m, near.takeoff_xy_m)
    assert far.takeoff_yaw == pytest.approx(near.takeoff_yaw)
    np.testing.assert_array_equal(far.bounds_xy_m, near.bounds_xy_m)
    maps = [truth_maps(scene, 0.25) for scene in (near, far)]
    for name in ("height_m", "slope_deg", "class_id", "safe_geometry", "safe", "origin_xy_m"):
        np.testing.assert_array_equal(getattr(maps[0], name), getattr(maps[1], name))
    rng = np.random.default_rng(3)
    rays = np.zeros((4000, 6), np.float32)
    rays[:, 2], rays[:, 3:] = 25.0, rng.normal(size=(4000, 3)) - [0.0, 0.0, 2.0]
    rays[:, 3:] /= np.linalg.norm(rays[:, 3:], axis=1, keepdims=True)
    ranges = [LidarScene(scene).static.cast(rays).distance for scene in (near, far)]
    np.testing.assert_array_equal(ranges[0], ranges[1])
    points = rng.uniform(-15.0, 15.0, (300, 2))
    np.testing.assert_array_equal(SingleRays(near).heights(points), SingleRays(far).heights(points))


def test_the_middle_is_the_take_off_where_none_is_named(tmp_path: Path) -> None:
    scene = load_quietly(place(tmp_path, MAP, takeoff=False))
    np.testing.assert_array_equal(scene.origin_m, [*MAP, 0.0])
    np.testing.assert_array_equal(scene.takeoff_xy_m, np.zeros(2))


@pytest.mark.parametrize(("at", "moved"), [((900.0, -400.0), False), ((1200.4, -400.0), True)])
def test_near_places_stay_where_they_are(
    tmp_path: Path, at: tuple[float, float], moved: bool
) -> None:
    scene = load_quietly(place(tmp_path, at))
    np.testing.assert_array_equal(scene.origin_m, [1200.0, -400.0, 0.0] if moved else np.zeros(3))
    np.testing.assert_allclose(scene.takeoff_xy_m + scene.origin_m[:2], at, atol=1e-9)


def test_a_raised_place_says_by_how_much(tmp_path: Path) -> None:
    """The height of the take-off, 812 m in the file, counts as well."""
    text = Path(place(tmp_path, MAP)).read_text(encoding="utf-8")
    path = tmp_path / "high.xml"
    path.write_text(
        text.replace("<worldbody>", "<worldbody><frame pos='0 0 812'>").replace(
            "</worldbody>", "</frame></worldbody>"
        ),
        encoding="utf-8",
    )
    np.testing.assert_allclose(load_quietly(path).origin_m, [*MAP, 812.0], atol=1e-6)


def test_a_site_counts_from_the_world_s_origin(tmp_path: Path) -> None:
    """A site in the file's coordinates is named with its remedy; one far from both is left to the
    lander, as in every scene."""
    path = place(tmp_path, MAP)

    def built(site: str) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return build_scene(load_config(None, [f"landing.site_xy_m={site}"], scene=path))

    with pytest.raises(ValueError, match=r"origin lies at 500000,5300000 there: give 10,-4$"):
        built("[500010, 5299996]")
    built("[10, -4]")
    built("[7000, 7000]")


def test_meshes_in_map_coordinates_are_named(tmp_path: Path) -> None:
    """MuJoCo reads their vertices in single precision."""
    corners = [f"v {MAP[0] + x} {MAP[1] + y} {z}" for x, y, z in np.eye(3) * 40.0]
    faces = ["f 1 2 3", "f 1 3 4", "f 1 4 2", "f 2 4 3"]
    lines = [f"v {MAP[0]} {MAP[1]} 0", *corners, *faces]
    (tmp_path / "hill.obj").write_text("\n".join(lines) + "\n", encoding="utf-8")
    path = tmp_path / "place.xml"
    path.write_text(
        "<mujoco><asset><mesh name='hill' file='hill.obj'/></asset><worldbody>"
        "<geom name='lawn' type='plane' size='0 0 1'/><geom name='field' type='mesh' mesh='hill'/>"
        "</worldbody></mujoco>",
        encoding="utf-8",
    )
    with pytest.warns(UserWarning, match=r"single precision \('hill' to 0\.5 m\)"):
        load_scene(str(path), 0)


def test_a_flight_is_the_same(tmp_path: Path) -> None:
    texts, results = [], []
    for folder, at in (("near", (0.0, 0.0)), ("far", MAP)):
        changes = ["referee.timeout_s=1.5", "record=false"]
        config = load_config(None, changes, scene=place(tmp_path, at), estimator="oracle")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            results.append(fly(config, tmp_path / folder))
        texts.append((tmp_path / folder / "truth.tum").read_bytes())
    assert texts[0] == texts[1] and texts[0].count(b"\n") > 72
    assert "origin_m" not in results[0].plain()
    assert results[1].plain()["origin_m"] == [*MAP, 0.0]
