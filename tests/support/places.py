"""What holds for every shipped scene, and scenes that are built once a process."""

import functools
import tempfile
import warnings
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from touchdown.scenes.api import Scene
from touchdown.scenes.cache import cached_scene as scene_on_disk
from touchdown.scenes.compose import load_scene
from touchdown.scenes.truth.maps import judge_touchdown
from touchdown.scenes.truth.static_surface import cast_points

PARTS = ("tex_data", "geom_pos", "hfield_data", "mesh_vert", "light_dir", "qpos0")


@functools.lru_cache(maxsize=2)
def cached_scene(name: str, seed: int = 0) -> Scene:
    """From the disk where another process has generated it; two of 0.2 GB are kept."""
    return scene_on_disk(name, seed, None, "day")


def scene_of(xml: str, seed: int = 0, **options: Any) -> Scene:
    """The scene of a file with this text."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "place.xml"
        path.write_text(xml, encoding="utf-8")
        return load_scene(str(path), seed, **options)


def scene_on_lawn(things: str, assets: str = "") -> Scene:
    """The scene of a file with a lawn of 120 m and these things."""
    return scene_of(
        f"<mujoco><asset>{assets}</asset><worldbody><geom name='lawn' type='plane' size='60 60 1'/>"
        f"{things}</worldbody></mujoco>"
    )


def bare_scene(model: mujoco.MjModel, **parts: Any) -> Scene:
    """A model as a scene of which nothing is known but ``parts``."""
    rest = {
        "name": "test", "seed": 0, "takeoff_xy_m": np.zeros(2), "takeoff_yaw": 0.0,
        "bounds_xy_m": np.array([[-60.0, -60.0], [60.0, 60.0]]), "surfaces": {}, "ground": None,
        "moving": (),
    }  # fmt: skip
    return Scene(model=model, **(rest | parts))


def load_quietly(path: str | Path, **options: Any) -> Scene:
    """The scene of a file, whatever there is to say of it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return load_scene(str(path), 0, **options)


def height_at(scene: Scene, x: float, y: float) -> float:
    """Of what is seen from above."""
    return float(cast_points(scene, np.array([[x, y]]))[0][0])


def check_takeoff(scene: Scene, clear_m: float, slope_deg: float = 2.0) -> None:
    """The take-off spot is level, safe and clear, in a scene that is large enough."""
    judged = judge_touchdown(scene, scene.takeoff_xy_m)
    assert judged.safe and judged.slope_deg < slope_deg and judged.obstacle_distance_m > clear_m
    assert (np.ptp(scene.bounds_xy_m, axis=0) >= 120.0).all()


def check_surfaces(scene: Scene, maximum: int = 620) -> None:
    """Every geom has a surface, and there are few of them."""
    names = {scene.model.geom(i).name for i in range(scene.model.ngeom)}
    own = {name for name in names if not name.startswith("vehicle/")}
    assert own == set(scene.surfaces) and len(own) <= maximum


def check_survey(scene: Scene, free_m: float = 18.0, trees_m: float = np.inf) -> None:
    """The legs of the standard survey lie inside, and no geom is higher than ``free_m``."""
    c, s = np.cos(scene.takeoff_yaw), np.sin(scene.takeoff_yaw)
    corners = np.array([[u, v] for u in (-16.0, 66.0) for v in (0.0, 40.0)])
    world = scene.takeoff_xy_m + corners @ np.array([[c, s], [-s, c]])
    assert (world > scene.bounds_xy_m[0]).all() and (world < scene.bounds_xy_m[1]).all()
    model, data = scene.model, mujoco.MjData(scene.model)
    mujoco.mj_kinematics(model, data)
    for geom in range(model.ngeom):
        rotation = data.geom_xmat[geom].reshape(3, 3)
        centre = data.geom_xpos[geom] + rotation @ model.geom_aabb[geom, :3]
        top = centre[2] + np.abs(rotation[2]) @ model.geom_aabb[geom, 3:]
        assert top < (trees_m if model.geom(geom).name.startswith("trees_") else free_m)


def check_seeds(name: str, seed: int = 0, other: int | None = None) -> None:
    """The same seed gives the same bytes, another one another scene."""
    first, again = cached_scene(name, seed).model, load_scene(name, seed).model
    for part in PARTS:
        assert getattr(first, part).tobytes() == getattr(again, part).tobytes(), part
    if other is not None:
        model = cached_scene(name, other).model
        assert model.tex_data.tobytes() != first.tex_data.tobytes()
        assert (model.light_dir.tobytes(), model.qpos0.tobytes()) != (
            first.light_dir.tobytes(), first.qpos0.tobytes()
        )  # fmt: skip
