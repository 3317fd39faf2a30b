"""A seed is a promise: what it draws today, it draws tomorrow.

``seeds.json`` holds a few numbers of each part of some scenes. After a wanted change of a scene,
``PYTHONPATH=tests python tests/scenes/test_seeds_stay.py`` writes them anew, and the changelog
names the scene.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.scenes.api import Light, RuggedParams, Scene, TrafficParams
from touchdown.scenes.cache import cached_scene

from support.marks import check, write

FILE = Path(__file__).with_name("seeds.json")
LOOSE = {"tex_data": 1e-4}
PEOPLE = TrafficParams(people=3, dogs=1, bicycles=1, cars=1)
PLACES: Mapping[str, tuple[str, int, Light, dict[str, Any] | None]] = {
    **{name: (name, 0, "day", None) for name in (
        "crossroad", "lake", "houses", "forest", "rooftop_parking", "cottage", "pools", "flat",
        "snow", "dunes", "open_water", "deck",
    )},
    **{f"turf {seed}": ("turf", seed, "day", None) for seed in (0, 1, 2)},
    **{f"footbridge {seed}": ("footbridge", seed, "day", None) for seed in (0, 1)},
    **{f"rugged {name}": ("rugged", 0, "day", {"preset": name}) for name in (
        "upland", "alpine", "quarry", "lava", "gully", "felled_forest",
    )},
    "dusk": ("pools", 0, "dusk", None),
    "overcast": ("cottage", 0, "overcast", None),
    "traffic": ("flat", 1, "day", None),
}  # fmt: skip


def made(what: str) -> Scene:
    name, seed, light, dials = PLACES[what]
    set_to = RuggedParams(**dials) if dials else None
    return cached_scene(
        name, seed, None, light, None, set_to, PEOPLE if what == "traffic" else None
    )


def parts_of(scene: Scene) -> dict[str, Any]:
    """The parts of a scene, those of the vehicle left out."""
    model = scene.model
    own = np.array([not model.geom(i).name.startswith("vehicle/") for i in range(model.ngeom)])
    meshes = np.array([not model.mesh(i).name.startswith("vehicle/") for i in range(model.nmesh)])
    of_mesh = np.repeat(meshes, model.mesh_vertnum) if model.nmesh else slice(None)
    return {
        name: getattr(model, f"geom_{name}")[own]
        for name in ("pos", "quat", "size", "rgba", "type", "contype", "conaffinity", "friction",
                     "matid")
    } | {
        "names": "\n".join(model.geom(i).name for i in np.flatnonzero(own)),
        "mesh_vert": model.mesh_vert[of_mesh],
        "hfield_data": model.hfield_data,
        "hfield_size": model.hfield_size,
        "mat": (model.mat_rgba, model.mat_texrepeat),
        "light": (model.light_dir, model.light_diffuse, model.light_ambient),
        "tex_data": model.tex_data,
        "place": (scene.takeoff_xy_m, scene.takeoff_yaw, scene.bounds_xy_m, scene.origin_m),
        "surfaces": scene.surfaces,
        "ground": scene.ground,
        "moving": scene.moving,
        "facts": scene.facts,
    }  # fmt: skip


@pytest.mark.parametrize("what", PLACES)
def test_a_seed_draws_what_it_drew(what: str) -> None:
    check(FILE, what, parts_of(made(what)), LOOSE)


if __name__ == "__main__":
    write(FILE, {what: parts_of(made(what)) for what in PLACES})
