"""Makes the scene of a file flyable: a take-off where none is named, classes where names say
nothing, ground that sensors can hold on to, contacts where the ground is seen, light. What is done
is said, in one line."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from touchdown.scenes.api import Array, ImportOptions, Surface
from touchdown.scenes.authoring.builder import quat_z
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.importers.classes import Inferred, infer_classes, read_given_classes
from touchdown.scenes.importers.ground_texturing import (
    end_planes,
    featureless_ground,
    texture_ground,
    touch_meshes,
)
from touchdown.scenes.importers.top_view import Place, takeoff_spot
from touchdown.sim.files.opening import printable

DARK = 0.15
"""Light on level ground, 1 for a white one: below it pictures are mostly noise."""


def move_inside(body: Any, offset_m: Array) -> None:
    """Moves all elements of a body, and the bodies in it, by (3,) metres of its axes."""
    for element in (*body.geoms, *body.bodies, *body.sites, *body.cameras, *body.lights):
        if element.frame is not None:
            continue
        ends = getattr(element, "fromto", np.full(6, np.nan))
        if np.isfinite(ends[0]):
            element.fromto = ends + np.tile(offset_m, 2)
        else:
            element.pos = element.pos + offset_m
    for frame in body.frames:
        if frame.frame is None:
            frame.pos = frame.pos + offset_m


def add_sun(spec: Any) -> None:
    """Adds a sun to ``spec``, and the light of the sky."""
    taken = any(light.name == "sun" for light in spec.lights)
    spec.worldbody.add_light(
        name="" if taken else "sun", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        dir=[-0.4, 0.3, -0.86],
        diffuse=[0.62, 0.60, 0.55], ambient=[0.20, 0.20, 0.22], castshadow=False,
    )  # fmt: skip


def ground_light(place: Place) -> float:
    """Returns the light on most of the ground that is seen, were it level, without shadows: the
    median of the sums over lamps and the camera's light (OpenGL 2.1 specification, section
    2.14.1, which MuJoCo draws by)."""
    model, data, points = place.model, place.data, place.points()
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)
    head = model.vis.headlight
    light = np.full(len(points), head.active * (np.mean(head.ambient) + np.mean(head.diffuse)))
    for lamp in range(model.nlight):
        if model.light_active[lamp]:
            falls = _falling(model, data, lamp, points)
            light += falls * model.light_diffuse[lamp].mean() + model.light_ambient[lamp].mean()
    return float(np.median(light)) if len(light) else 0.0


def _falling(model: Any, data: Any, lamp: int, points: Array) -> Array:
    """(N,) fraction of a lamp's light that falls on level ground at (N, 3) points."""
    kind, axis = int(model.light_type[lamp]), data.light_xdir[lamp]
    if kind == int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL):
        return np.full(len(points), max(-axis[2], 0.0))
    way = points - data.light_xpos[lamp]
    far = np.maximum(np.linalg.norm(way, axis=1), 1e-6)
    fall = np.maximum(-way[:, 2] / far, 0.0)
    weaker = np.stack([far**0, far, far**2], axis=1) @ model.light_attenuation[lamp]
    fall /= np.maximum(weaker, 1e-6)
    if kind == int(mujoco.mjtLightType.mjLIGHT_SPOT):
        along = np.maximum(way @ axis / far, 0.0)
        inside = along >= np.cos(np.deg2rad(model.light_cutoff[lamp]))
        fall *= inside * along ** model.light_exponent[lamp]
    return np.asarray(fall)


def movable_bodies(spec: Any) -> set[str]:
    """Names of the bodies of the world with joints, at them or below; those without get one."""
    found = [body for body in spec.worldbody.bodies if _has_joint(body)]
    for number, body in enumerate(found):
        body.name = body.name or f"moving body {number}"
    return {body.name for body in found}


def _has_joint(body: Any) -> bool:
    return bool(body.joints) or any(map(_has_joint, body.bodies))


def movable_at(model: Any, data: Any, xy_m: np.ndarray, movable: set[str]) -> str:
    """The name of the body of ``movable`` that is the highest at (2,) ``xy_m``; "" of others."""
    start = np.array([*xy_m, top_m(model, data)])
    hit = np.full(1, -1, np.int32)
    mujoco.mj_ray(model, data, start, np.array([0.0, 0.0, -1.0]), None, 1, -1, hit)
    if hit[0] < 0:
        return ""
    name = model.body(model.body_rootid[model.geom_bodyid[hit[0]]]).name
    return name if name in movable else ""


def top_m(model: Any, data: Any) -> float:
    """A height above everything."""
    return float(np.max(data.geom_xpos[:, 2] + model.geom_rbound, initial=0.0)) + 1.0


def make_flyable(
    draft: SceneDraft,
    unknown: list[str],
    options: ImportOptions,
    *,
    named: bool,
    surface: Callable[[str], Surface],
    say: Callable[[str], None],
) -> SceneDraft:
    """Returns ``draft`` with its spec changed. ``unknown``: the geoms without a class; ``named``: a
    take-off is; ``surface``: that of a class; ``say`` takes one line on what was done. Raises
    ValueError and FileNotFoundError for a file of classes that cannot be used."""
    spec = draft.spec
    place = Place.of(spec, draft.bounds_xy_m)
    if not (place.seen.geom >= 0).any():
        raise ValueError(
            "no ground under the take-off spot: add a floor, or a site named 'takeoff' above the "
            "ground"
        )
    notes: list[str] = []

    takeoff_xy = draft.takeoff_xy_m if named else _placed_takeoff(draft, place, notes)

    given = read_given_classes(options.classes, place)
    start = int(place.seen.geom[place.seen.cell_of(takeoff_xy)])
    ids = [place.model.geom(name).id for name in unknown]
    inferred = infer_classes(place, ids, start)
    inferred = {geom: found for geom, found in inferred.items() if geom not in given.classes}
    classes = {geom: found.land_class for geom, found in inferred.items()} | given.classes
    surfaces = draft.surfaces | {
        place.name(geom): surface(land_class) for geom, land_class in classes.items()
    }
    notes += _inference_note(inferred)

    plain = featureless_ground(place, surfaces)
    touch_meshes(spec, place, plain)
    textured = texture_ground(spec, place, plain)
    if ended := end_planes(spec, place, textured):
        notes.append(f"{_listed(ended)}: planes that collide only where they are drawn")
    for name, land_class in textured.items():
        beyond = f"{land_class}_beyond_{name}"
        if spec.geom(beyond) is not None:
            surfaces[beyond] = surfaces[name]
    for geom in spec.geoms:
        surfaces.setdefault(geom.name, surface("other"))
    if textured:
        notes.append(
            f"featureless ground is dressed "
            f"({_listed(textured, [f' as {kind}' for kind in textured.values()])}): a texture "
            "of real ground and a relief of centimetres (--as-is keeps the file as it is)"
        )

    if ground_light(place) < DARK:
        add_sun(spec)
        notes.append("its lamps leave the ground dark: a sun is added")

    if notes:
        say("; ".join(notes))
    if not named:
        quat = quat_z(draft.takeoff_yaw)
        spec.worldbody.add_site(name="takeoff", pos=[*takeoff_xy, 0.0], quat=quat)
    return replace(
        draft,
        takeoff_xy_m=takeoff_xy,
        surfaces=surfaces,
        ground=given.raster(surface),
        inferred={
            place.name(geom): (found.land_class, found.why) for geom, found in inferred.items()
        },
        textured=tuple(textured),
    )


def _placed_takeoff(draft: SceneDraft, place: Place, notes: list[str]) -> Array:
    """The take-off spot (2,) of a file that names none."""
    xy = takeoff_spot(place.with_small_things(), draft.takeoff_xy_m)
    if np.hypot(*(xy - draft.takeoff_xy_m)) > 0.1:
        notes.append(
            f"no take-off is named and the origin is none: it is {xy[0]:.1f}, {xy[1]:.1f} "
            "(name a site 'takeoff' for another)"
        )
    return xy


def _inference_note(inferred: dict[int, Inferred]) -> list[str]:
    if not inferred:
        return []
    count = Counter(found.land_class for found in inferred.values())
    kinds = ", ".join(f"{number} {name}" for name, number in count.most_common())
    what = f"classes of {len(inferred)} geoms are" if len(inferred) > 1 else "class of 1 geom is"
    return [
        f"the {what} guessed by name, shape "
        f"and colour ({kinds}; `touchdown scenes check` lists them, --classes sets them)"
    ]


def _listed(names: Any, endings: list[str] | None = None) -> str:
    """The first four names."""
    shown = [printable(name) + (endings[k] if endings else "") for k, name in enumerate(names)]
    return ", ".join(shown[:4]) + (" ..." if len(shown) > 4 else "")
