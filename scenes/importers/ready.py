"""Makes the scene of a file ready to be flown over: a take-off where none is named, classes where
names say nothing, and ground that sensors can hold on to. What is done is said, in one line."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import LAND_CLASSES, OTHER_CLASS_ID, GroundRaster, Readying, Surface
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.importers.above import (
    FromAbove,
    from_above,
    grounds,
    is_seen,
    largest,
)
from touchdown.scenes.importers.class_files import (
    class_in_table,
    read_class_picture,
    read_class_table,
)
from touchdown.scenes.importers.dress import (
    LEAST_M2,
    MATERIALS,
    MOST,
    Chosen,
    bounded,
    dress,
    touchable,
)
from touchdown.scenes.importers.guess import Guess, guess_classes, look_of, names_of
from touchdown.scenes.importers.lights import DARK, add_sun, ground_light
from touchdown.scenes.importers.takeoff import takeoff_spot
from touchdown.sim.files.opening import printable, quiet_libraries

Array = NDArray[np.float64]
Say = Callable[[str], None]

_RASTER_CELLS = 640
"""along the longer side of a picture of classes: a quarter of a metre"""
_BEHIND_M = 0.05
"""below a plane, of what is seen there"""
_SMALL_M = 4.0
"""Bounding radius of things that cells may miss."""


class _Compiled(NamedTuple):
    model: Any
    data: Any


def made_ready(
    draft: SceneDraft,
    unknown: list[str],
    ready: Readying,
    *,
    named: bool,
    surface: Callable[[str], Surface],
    say: Say,
) -> SceneDraft:
    """Returns ``draft`` with its spec changed. ``unknown``: the geoms without a class; ``named``: a
    take-off is; ``surface``: that of a class; ``say`` takes one line on what was done. Raises
    ValueError and FileNotFoundError for a file of classes that cannot be used."""
    spec = draft.spec
    model, data = _compile(spec)
    seen = from_above(model, data, draft.bounds_xy_m)
    if not (seen.geom >= 0).any():
        raise ValueError(
            "no ground under the take-off spot: add a floor, or a site named 'takeoff' above the "
            "ground"
        )
    xy, told = draft.takeoff_xy_m, list[str]()
    if not named:
        xy = takeoff_spot(_with_small_things(seen, model, data), xy)
        if np.hypot(*(xy - draft.takeoff_xy_m)) > 0.1:
            told.append(
                f"no take-off is named and the origin is none: it is {xy[0]:.1f}, {xy[1]:.1f} "
                "(name a site 'takeoff' for another)"
            )
    start = int(seen.geom[seen.cell_of(xy)])
    ids = [model.geom(name).id for name in unknown]
    guesses = guess_classes(model, data, seen, ids, start)
    surfaces = dict(draft.surfaces)
    given = _Given.read(ready, model, seen)
    guesses = {geom: guess for geom, guess in guesses.items() if geom not in given.classes}
    found = {geom: guess.land_class for geom, guess in guesses.items()} | given.classes
    for geom, land_class in found.items():
        surfaces[model.geom(geom).name] = surface(land_class)
    told += _of_guesses(guesses)
    chosen = _featureless(model, data, seen, surfaces)
    _stand_on_meshes(spec, _Compiled(model, data), seen, chosen, draft.bounds_xy_m)
    done = dress(spec, model, data, chosen, draft.bounds_xy_m)
    for one in done:
        beyond = f"{one.land_class}_beyond_{one.name}"
        if spec.geom(beyond) is not None:
            surfaces[beyond] = surfaces[one.name]
    if short := _end_planes(spec, _Compiled(model, data), seen, {one.name for one in done}):
        told.append(
            f"{', '.join(map(printable, short[:4]))}{' ...' if len(short) > 4 else ''}: planes "
            "that collide only where they are drawn"
        )
    for geom in spec.geoms:
        surfaces.setdefault(geom.name, surface("other"))
    if done:
        kinds = ", ".join(f"{printable(one.name)} as {one.land_class}" for one in done[:4])
        told.append(
            f"featureless ground is dressed ({kinds}{' ...' if len(done) > 4 else ''}): a texture "
            "of real ground and a relief of centimetres (--as-is keeps the file as it is)"
        )
    if ground_light(model, data, seen) < DARK:
        add_sun(spec)
        told.append("its lamps leave the ground dark: a sun is added")
    if told:
        say("; ".join(told))
    if not named:
        _name_takeoff(spec, xy, draft.takeoff_yaw)
    guessed = {model.geom(geom).name: guess for geom, guess in guesses.items()}
    return replace(
        draft, takeoff_xy_m=xy, surfaces=surfaces, ground=given.raster(surface),
        guessed={name: (guess.land_class, guess.why) for name, guess in guessed.items()},
        dressed=tuple(one.name for one in done),
    )  # fmt: skip


def _with_small_things(seen: FromAbove, model: Any, data: Any) -> FromAbove:
    """``seen`` with the boxes of geoms that are narrower than its cells, or nearly so."""
    height = seen.height_m.copy()
    for geom in np.flatnonzero((model.geom_rbound > 0.0) & (model.geom_rbound < _SMALL_M)).tolist():
        if not is_seen(model, geom):
            continue
        rotation = data.geom_xmat[geom].reshape(3, 3)
        middle = rotation @ model.geom_aabb[geom, :3] + data.geom_xpos[geom]
        reach = np.abs(rotation) @ model.geom_aabb[geom, 3:]
        first, last = (seen.cell_of(middle[:2] + side * reach[:2]) for side in (-1.0, 1.0))
        part = height[first[0] : last[0] + 1, first[1] : last[1] + 1]
        np.maximum(part, middle[2] + reach[2], out=part, where=np.isfinite(part))
    return seen._replace(height_m=height)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Given:
    """Classes that the user gives."""

    classes: dict[int, str]
    """of geoms"""
    ground: str = ""
    """the widest geom, which a picture of classes lies on"""
    picture: NDArray[np.uint8] | None = None
    """(rows, cols) of indices into LAND_CLASSES, or their number"""
    bounds_xy_m: Array | None = None

    @staticmethod
    def read(ready: Readying, model: Any, seen: FromAbove) -> _Given:
        """The classes of ``ready.classes``; of a picture, the most frequent one of each geom."""
        if not ready.classes:
            return _Given(classes={})
        path = Path(ready.classes)
        if path.suffix.lower() == ".toml":
            table = read_class_table(path)
            named = {geom: class_in_table(table, *names_of(model, geom))
                     for geom in range(model.ngeom)}  # fmt: skip
            return _Given(classes={geom: name for geom, name in named.items() if name})
        picture, known = read_class_picture(path), (*LAND_CLASSES, "other")
        rows, cols = np.indices(seen.geom.shape)
        share = np.array(picture.shape) / np.array(seen.geom.shape)
        cell = ((rows + 0.5) * share[0]).astype(int), ((cols + 0.5) * share[1]).astype(int)
        painted, classes = picture[cell], {}
        for geom in np.unique(seen.geom[seen.geom >= 0]).tolist():
            counts = np.bincount(painted[seen.geom == geom], minlength=len(known))
            classes[geom] = known[int(counts.argmax())]
        widest = int(np.bincount(seen.geom[seen.geom >= 0]).argmax()) if classes else 0
        high = seen.origin_xy_m + seen.cell_m * np.array(seen.geom.shape)[::-1]
        return _Given(
            classes=classes, ground=model.geom(widest).name, picture=picture,
            bounds_xy_m=np.stack([seen.origin_xy_m, high]),
        )  # fmt: skip

    def raster(self, surface: Callable[[str], Surface]) -> GroundRaster | None:
        """The picture as the classes of the widest geom."""
        if self.picture is None or self.bounds_xy_m is None:
            return None
        size = self.bounds_xy_m[1] - self.bounds_xy_m[0]
        cell = float(size.max()) / _RASTER_CELLS
        cols, rows = np.ceil(size / cell).astype(int)
        own = np.array(self.picture.shape)
        row = np.minimum((np.arange(rows) + 0.5) * cell / size[1] * own[0], own[0] - 1).astype(int)
        col = np.minimum((np.arange(cols) + 0.5) * cell / size[0] * own[1], own[1] - 1).astype(int)
        index = self.picture[np.ix_(row, col)]
        shine = [surface(name).reflectivity for name in (*LAND_CLASSES, "other")]
        ids = np.array([*range(len(LAND_CLASSES)), OTHER_CLASS_ID], np.uint8)
        return GroundRaster(
            geom_name=self.ground, origin_xy_m=self.bounds_xy_m[0].copy(), cell_m=cell,
            class_id=ids[index], reflectivity=np.array(shine, np.float32)[index],
        )  # fmt: skip


def _featureless(
    model: Any, data: Any, seen: FromAbove, surfaces: dict[str, Surface]
) -> dict[int, Chosen]:
    """Ground without features, the widest first."""
    area = np.bincount(seen.geom[seen.geom >= 0], minlength=model.ngeom) * seen.cell_m**2
    found: dict[int, str] = {}
    for geom in np.argsort(-area, kind="stable").tolist():
        land_class = surfaces[model.geom(geom).name].land_class
        if area[geom] < LEAST_M2 or len(found) == MOST:
            break
        if land_class in MATERIALS and look_of(model, geom).plain:
            found[geom] = land_class
    whole = sum(area[geom] for geom in found)
    return {geom: Chosen(kind, float(area[geom] / whole)) for geom, kind in found.items()}


def _stand_on_meshes(
    spec: Any, compiled: _Compiled, seen: FromAbove, dressed: dict[int, Chosen], bounds: Array
) -> None:
    """Ground meshes that keep their look are touched where they are seen, not at their hull."""
    model, data = compiled
    label = grounds(seen)
    main = label == largest(label)
    for geom in np.unique(seen.geom[main]).tolist():
        mesh = int(model.geom_type[geom]) == int(mujoco.mjtGeom.mjGEOM_MESH)
        touched = bool(model.geom_contype[geom] or model.geom_conaffinity[geom])
        wide = (seen.geom == geom).sum() * seen.cell_m**2 >= LEAST_M2
        if mesh and touched and wide and geom not in dressed and is_seen(model, geom):
            touchable(spec, model, data, geom, bounds)


def _end_planes(spec: Any, compiled: _Compiled, seen: FromAbove, dressed: set[str]) -> list[str]:
    """MuJoCo draws a plane as wide as its size, but everything behind it collides with it (XML
    reference, geom): a vehicle that stands behind a sloping one is thrown away. Those with ground
    behind them then collide only where they are drawn; returns their names."""
    model, data = compiled
    points = np.dstack([seen.centres(), seen.height_m])[np.isfinite(seen.height_m)]
    ended = []
    for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE).tolist():
        name, normal = model.geom(geom).name, data.geom_xmat[geom].reshape(3, 3)[:, 2]
        touched = bool(model.geom_contype[geom] or model.geom_conaffinity[geom])
        behind = (points - data.geom_xpos[geom]) @ normal < -_BEHIND_M
        if touched and name not in dressed and behind.any():
            bounded(spec, model, data, geom)
            ended.append(name)
    return ended


def _of_guesses(guesses: dict[int, Guess]) -> list[str]:
    if not guesses:
        return []
    count = Counter(guess.land_class for guess in guesses.values())
    kinds = ", ".join(f"{number} {name}" for name, number in count.most_common())
    what = f"classes of {len(guesses)} geoms are" if len(guesses) > 1 else "class of 1 geom is"
    return [
        f"the {what} guessed by name, shape "
        f"and colour ({kinds}; `touchdown scenes check` lists them, --classes sets them)"
    ]


def _name_takeoff(spec: Any, xy: Array, yaw: float) -> None:
    quat = [float(np.cos(0.5 * yaw)), 0.0, 0.0, float(np.sin(0.5 * yaw))]
    spec.worldbody.add_site(name="takeoff", pos=[*xy, 0.0], quat=quat)


def _compile(spec: Any) -> _Compiled:
    with quiet_libraries():
        model = spec.copy().compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return _Compiled(model, data)
