"""A seed is a promise: what it draws today, it draws tomorrow.

``seeds.json`` holds a few numbers of each part of some scenes. After a wanted change of a scene,
``python tests/scenes/test_seeds_stay.py`` writes them anew; the changelog then names the scene.
"""

import dataclasses
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import pytest

from touchdown.scenes.api import Light, RuggedParams, Scene, TrafficParams
from touchdown.scenes.cache import cached_scene
from touchdown.sim.typing import Array

FILE = Path(__file__).with_name("seeds.json")
PERIOD = 10007
"""a prime, so that no row or column of a picture meets one weight alone"""
WEIGHTS = np.random.default_rng(20).standard_normal((3, PERIOD))
PICTURES = ("tex_data",)
"""parts of which processors may round single values differently"""
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


def numbers(value: Any) -> Iterator[Array]:
    """All numbers in a value, texts as their checksums."""
    if isinstance(value, str):
        yield np.array([crc32(value.encode()) / 2**32])
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from numbers(getattr(value, field.name))
    elif isinstance(value, Mapping):
        yield from numbers([item for key in sorted(value) for item in (key, value[key])])
    elif isinstance(value, list | tuple):
        for item in value:
            yield from numbers(item)
    else:
        yield np.ravel(np.asarray(-1.0 if value is None else value))


def parts_of(scene: Scene) -> dict[str, Array]:
    """Numbers of each part, those of the vehicle left out."""
    model = scene.model
    own = np.array([not model.geom(i).name.startswith("vehicle/") for i in range(model.ngeom)])
    meshes = np.array([not model.mesh(i).name.startswith("vehicle/") for i in range(model.nmesh)])
    of_mesh = np.repeat(meshes, model.mesh_vertnum) if model.nmesh else slice(None)
    found = {
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
    return {name: np.concatenate([np.zeros(0, np.uint8), *numbers(value)])
            for name, value in found.items()}  # fmt: skip


def marks(values: Array) -> list[float]:
    """How many there are, their norm, and three weighted sums."""
    folded = np.pad(values, (0, -values.size % PERIOD)).reshape(-1, PERIOD)
    sums = WEIGHTS @ folded.sum(axis=0, dtype=np.float64)
    square = np.einsum("i,i", values, values, dtype=np.float64, casting="unsafe")
    return [float(f"{one:.9g}") for one in (values.size, np.sqrt(square), *sums)]


@pytest.mark.parametrize("what", PLACES)
def test_a_seed_draws_what_it_drew(what: str) -> None:
    told, found = json.loads(FILE.read_text())[what], parts_of(made(what))
    assert told.keys() == found.keys()
    for name, (size, norm, *sums) in told.items():
        assert found[name].size == size, name
        within = (1e-4 if name in PICTURES else 1e-6) * norm + 1e-9
        assert marks(found[name])[1:] == pytest.approx([norm, *sums], abs=within, rel=0.0), name


if __name__ == "__main__":
    drawn = {what: {k: marks(v) for k, v in parts_of(made(what)).items()} for what in PLACES}
    lines = (f'"{what}": {json.dumps(parts)}' for what, parts in drawn.items())
    FILE.write_text("{\n" + ",\n".join(lines) + "\n}\n")
