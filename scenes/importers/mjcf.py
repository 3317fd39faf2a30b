"""Imports any MJCF file as a scene.

Content far from the origin, as in map coordinates, is moved there: single precision, in which
images are drawn and LIDAR rays are cast, resolves half a metre at the northing of a map grid.
"""

import warnings
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import LAND_CLASSES, Array, ImportOptions, Surface
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.importers.import_pass import (
    add_sun,
    make_flyable,
    movable_at,
    movable_bodies,
    move_inside,
    top_m,
)
from touchdown.scenes.importers.model_check import (
    MAX_TEXT_BYTES,
    blame_asset,
    check_model,
    check_spec,
    check_texts,
)
from touchdown.scenes.importers.movers import movers
from touchdown.sim.files.child import run_limited
from touchdown.sim.files.opening import check_file, printable, quiet_libraries

FAR_M = 1000.0
"""Single precision is exact to a tenth of a millimetre up to there."""
_COARSE_M = 0.005


def far_origin(model: Any, data: Any, takeoff_xy_m: Array | None) -> Array:
    """The point (2,) of the file, in whole metres, that becomes the world's origin: the take-off
    spot, or the middle of everything where the file names none. Zero where that is not far off, or
    where the origin lies amid things."""
    if takeoff_xy_m is not None:
        middle = takeoff_xy_m
    else:
        box = finite_box(model, data)
        if box is None or bool(((box[0] <= 0.0) & (box[1] >= 0.0)).all()):
            return np.zeros(2)
        middle = box.mean(axis=0)
    far = float(np.abs(middle).max()) > FAR_M
    return np.round(middle) if far else np.zeros(2)


def finite_box(model: Any, data: Any) -> Array | None:
    """[[x_min, y_min], [x_max, y_max]] of all geoms but infinite planes; None without such."""
    planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    finite = ~infinite_planes(model)
    if not finite.any():
        return None
    # Of a plane MuJoCo's box is that of the solid half space below it.
    centres = np.where(planes[:, None], 0.0, model.geom_aabb[:, :3])
    half = np.where(planes[:, None], model.geom_size * [1.0, 1.0, 0.0], model.geom_aabb[:, 3:])
    rotations = data.geom_xmat.reshape(-1, 3, 3)
    world = np.einsum("nij,nj->ni", rotations, centres) + data.geom_xpos
    reach = np.einsum("nij,nj->ni", np.abs(rotations), half)
    low, high = (world - reach)[finite].min(axis=0), (world + reach)[finite].max(axis=0)
    return np.stack([low[:2], high[:2]])


def infinite_planes(model: Any) -> NDArray[np.bool_]:
    """(G,) planes that are unbounded in at least one direction."""
    planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    return planes & (model.geom_size[:, :2] == 0.0).any(axis=1)


def coarse_meshes(model: Any) -> list[str]:
    """Meshes whose own vertices lie so far from their origin that MuJoCo, which reads them in
    single precision, keeps them to more than 5 mm; with that precision."""
    far = np.abs(model.mesh_pos).max(axis=1).astype(np.float32)
    return [
        f"'{model.mesh(index).name}' to {step:.2g} m"
        for index, step in enumerate(np.spacing(far).tolist())
        if step > _COARSE_M
    ]


REFLECTIVITY_905NM = {
    "lawn": 0.45,
    "field": 0.25,
    "path": 0.30,
    "road": 0.15,
    "building": 0.35,
    "water": 0.03,
    "trees": 0.40,
    "other": 0.30,
}
"""Typical diffuse reflectivity at 905 nm by class (vegetation is bright in the near infrared)."""
DEFAULT_SURFACE = Surface(land_class="other", reflectivity=REFLECTIVITY_905NM["other"])
_HALF_BOUNDS_M = 80.0
_SMALL_M, _HUGE_M = 20.0, 20_000.0
_MAX_GROUND_M = 50.0
"""Rays from above and the camera's clip planes count on ground near height 0."""
_VEHICLE_PREFIX = "vehicle/"
_MOVING_KINDS = (
    "keys", "sensors", "actuators", "equalities", "tendons", "excludes", "pairs", "tuples",
    "flexes", "skins", "joints",
)  # fmt: skip
"""Ordered so that no element refers to one deleted before it."""

_MUJOCO_ERRORS = (ValueError, MemoryError, RuntimeError, mujoco.FatalError)
"""MuJoCo raises RuntimeError for any exception that it does not know, such as one of memory."""
_NO_MEMORY = "MuJoCo needs more memory than there is"
_UNKNOWN = "Schema violation: unrecognized"
"""MuJoCo's words for elements and attributes that it does not know"""
_SMALLER = (
    "simplify its meshes (decimate), shrink its textures and height fields, or cut out the part "
    "around the take-off"
)
_MAX_BUFFER, _MAX_SLICES = 4096, 64
"""pixels along a side of an image, and pieces of a round geom, that a file may ask for"""

_warned: set[tuple[str, str]] = set()
"""Files and the warnings given for them."""


def surface_of_name(name: str) -> Surface | None:
    """Returns the surface for a material's or geom's name that begins with a land class
    (``lawn_2``, ``roadway``; ``water`` also sets the water flag, ``trees`` a porosity of 0.35);
    else None."""
    for land_class in LAND_CLASSES:
        if name.lower().startswith(land_class):
            return _surface(land_class)
    return None


def _surface(land_class: str) -> Surface:
    return Surface(
        land_class=land_class,
        reflectivity=REFLECTIVITY_905NM[land_class],
        porosity=0.35 if land_class == "trees" else 0.0,
        water=land_class == "water",
    )


def read_mjcf(path: Path, ready: ImportOptions | None = None, seed: int = 0) -> SceneDraft:
    """Reads an MJCF file as a scene, as it is or made ``ready`` (`scenes.importers.import_pass`).

    The take-off spot is the site or body named ``takeoff``, else the position of the vehicle in a
    file written by `scenes.export`, else the origin. Classes follow from names
    (`surface_of_name`); other geoms get class ``other`` with reflectivity 0.30, and one warning
    names them. Joints and actuators are left out: bodies keep the pose that the file gives them,
    but for mocap bodies with a path (`scenes.importers.movers`), of which ``seed`` may draw starts.
    One with joints that stands at the take-off spot, as a vehicle of the file's own does, is left
    out. A file without a light gets a sun. Ground far from height 0 is moved there, and so is a
    scene more than 1 km from the origin, such as one in map coordinates: `scenes.importers.mjcf`.

    Raises FileNotFoundError for a missing file or asset, ValueError for a file that MuJoCo cannot
    read, for one beyond the limits of `scenes.importers.model_check` or of `sim.files.child`, in
    which it is compiled first, and for a take-off spot without ground.
    """
    check_file(path, "a scene", MAX_TEXT_BYTES)
    model = run_limited(lambda: _first_compiled(path), path, "to compile it", _SMALLER)
    data = _posed(model)
    spec = read_spec(path)
    movable = movable_bodies(spec)
    remove_motion(spec, path)
    takeoff = _takeoff(model, data)
    if _remove_vehicle(spec):
        model, data = compiled(spec, path)
    start = np.zeros(2) if takeoff is None else takeoff.xy_m
    movable = movable if ready is None or takeoff is not None else set()  # it starts elsewhere
    while name := movable_at(model, data, start, movable):
        _warn_once(
            path, f"{printable(name)} moves, and stands at the take-off spot: it is left out"
        )
        spec.delete(spec.body(name))
        model, data = compiled(spec, path)
    origin_xy = far_origin(model, data, None if takeoff is None else takeoff.xy_m)
    xy, yaw = takeoff or _Takeoff(_amid(model, data, origin_xy) if ready else origin_xy, 0.0)
    if coarse := coarse_meshes(model):
        _warn_once(
            path,
            f"meshes are read in single precision ({', '.join(coarse[:4])}); subtract a common "
            "offset from their vertices and give it to the geoms as pos",
        )
    ground = _ground_height(model, data, xy, needed=ready is None or takeoff is not None)
    origin = np.array([*origin_xy, ground if abs(ground) > _MAX_GROUND_M else 0.0])
    if origin.any():
        move_inside(spec.worldbody, -origin)
    if origin_xy.any():
        _warn_once(
            path,
            f"the world's origin is moved to x {origin[0]:.0f}, y {origin[1]:.0f} of the file; "
            "sites and results count from there",
        )
    if not spec.lights:
        add_sun(spec)
    surfaces, unknown = _surfaces(spec)
    if ready is None:
        _warn_of_unknown(path, unknown)
    try:
        moving = movers(spec, seed, origin)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    draft = SceneDraft(
        spec=spec,
        takeoff_xy_m=xy - origin_xy,
        takeoff_yaw=yaw,
        bounds_xy_m=_bounds(model, data, xy, path) - origin_xy,
        surfaces=surfaces,
        ground=None,
        moving=moving,
        origin_m=origin,
    )
    if ready is None:
        return draft
    say = partial(_warn_once, path)
    try:
        return make_flyable(
            draft, unknown, ready, named=takeoff is not None, surface=_surface, say=say
        )
    except (MemoryError, RuntimeError, mujoco.FatalError) as error:
        raise ValueError(f"{path}: it cannot be made ready: {_one_line(error)}") from error


def _first_compiled(path: Path) -> Any:
    """The model of a file that nothing is known of, without what moves."""
    check_texts(path)
    spec = read_spec(path)
    check_spec(spec, path)
    movable_bodies(spec)  # names are those of the spec that the scene is made of
    remove_motion(spec, path)
    return compiled(spec, path)[0]


def read_spec(path: Path) -> Any:
    try:
        with quiet_libraries():
            return mujoco.MjSpec.from_file(str(path))
    except _MUJOCO_ERRORS as error:
        raise _refusal(path, error) from error


def remove_motion(spec: Any, path: Path) -> None:
    """Deletes joints, soft bodies and all that refers to them, and resets options that would
    change the vehicle or hide geoms."""
    # The vehicle of an exported scene is replaced: no warning for its joint.
    joints = [joint for joint in spec.joints if not joint.parent.name.startswith(_VEHICLE_PREFIX)]
    moving = len(joints) + len(spec.flexes)
    delete_motion(spec)
    if moving:
        _warn_once(
            path,
            f"its {moving} joints and soft bodies are left out; what moves has a path",
        )


def delete_motion(spec: Any) -> None:
    """Deletes joints, soft bodies and all that refers to them, and resets options."""
    for kind in _MOVING_KINDS:
        for element in list(getattr(spec, kind)):
            spec.delete(element)
    compiler, option = spec.compiler, spec.option
    compiler.settotalmass = -1.0
    compiler.boundmass = compiler.boundinertia = 0.0
    compiler.discardvisual = compiler.fusestatic = False
    compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    usual = mujoco.MjSpec().option
    for name in dir(usual):
        if not name.startswith("_"):
            setattr(option, name, getattr(usual, name))
    spec.memory = spec.njmax = spec.nconmax = -1
    spec.nuserdata = spec.nkey = 0
    for name in ("body", "jnt", "geom", "site", "cam", "tendon", "actuator", "sensor"):
        setattr(spec, f"nuser_{name}", -1)
    visual = spec.visual
    for name in ("offwidth", "offheight"):
        setattr(visual.global_, name, min(int(getattr(visual.global_, name)), _MAX_BUFFER))
    for name in ("numslices", "numstacks", "numquads"):
        pieces = int(getattr(visual.quality, name))
        setattr(visual.quality, name, min(max(pieces, 1), _MAX_SLICES))


def _remove_vehicle(spec: Any) -> bool:
    """Deletes the vehicle of an exported scene with its assets. True if there was one."""
    bodies = [body for body in spec.worldbody.bodies if body.name.startswith(_VEHICLE_PREFIX)]
    for body in bodies:
        spec.delete(body)
    default = spec.find_default(f"{_VEHICLE_PREFIX}main")
    if default is not None:
        spec.delete(default)
    for kind in ("materials", "textures", "meshes", "hfields", "numerics", "texts"):
        for element in [e for e in getattr(spec, kind) if e.name.startswith(_VEHICLE_PREFIX)]:
            spec.delete(element)
    return bool(bodies)


def compiled(spec: Any, path: Path) -> tuple[Any, Any]:
    """Returns the model, and its data with the poses of time 0."""
    try:
        with quiet_libraries():
            model = spec.copy().compile()
    except _MUJOCO_ERRORS as error:
        blame_asset(spec, path)
        raise _refusal(path, error) from error
    data = _posed(model)
    check_model(model, data, path)
    return model, data


def _posed(model: Any) -> Any:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return data


def _amid(model: Any, data: Any, xy_m: np.ndarray) -> np.ndarray:
    """The point (2,) where it lies amid the scene, else the middle of everything."""
    box = finite_box(model, data)
    if box is None or infinite_planes(model).any() or ((box[0] <= xy_m) & (xy_m <= box[1])).all():
        return xy_m
    return np.asarray(box.mean(axis=0))


def _ground_height(model: Any, data: Any, xy_m: np.ndarray, *, needed: bool) -> float:
    """World height of the highest surface at (2,) ``xy_m``; 0 where nothing is ``needed`` there."""
    top = top_m(model, data)
    start, down = np.array([*xy_m, top]), np.array([0.0, 0.0, -1.0])
    hit = np.full(1, -1, np.int32)
    distance = mujoco.mj_ray(model, data, start, down, None, 1, -1, hit)
    if distance < 0.0 and not needed:
        return 0.0
    if distance < 0.0:
        raise ValueError(
            f"no ground under the take-off spot {np.round(xy_m, 2).tolist()}: add a floor, or a "
            "site named 'takeoff' above the ground"
        )
    return top - float(distance)


def _warn_once(path: Path, text: str) -> None:
    """Warns once in a process, since a file is read several times."""
    if (key := (str(path.resolve()), text)) not in _warned:
        _warned.add(key)
        warnings.warn(f"{path}: {text}", stacklevel=4)


def _refusal(path: Path, error: Exception) -> Exception:
    """An error of MuJoCo as that of the file, or of memory, which it does not tell apart."""
    text = _one_line(error)
    if text == _NO_MEMORY:
        return MemoryError(text)
    newer = f"; this is MuJoCo {mujoco.__version__}, a newer one may know it" * (_UNKNOWN in text)
    return ValueError(f"{path}: not a valid MJCF file: {text}{newer}")


def _one_line(error: Exception) -> str:
    text = " ".join(str(error).split())
    if "qhull error" in text:
        text = text.replace(
            "qhull error", "a mesh is flat, or has too few points: give it a volume"
        )
    return _NO_MEMORY if isinstance(error, MemoryError) or "unknown exception" in text else text


class _Takeoff(NamedTuple):
    xy_m: np.ndarray
    yaw: float


def _takeoff(model: Any, data: Any) -> _Takeoff | None:
    """The take-off spot that the file names, if it does."""
    for kind, name, positions, matrices in (
        (mujoco.mjtObj.mjOBJ_SITE, "takeoff", data.site_xpos, data.site_xmat),
        (mujoco.mjtObj.mjOBJ_BODY, "takeoff", data.xpos, data.xmat),
        (mujoco.mjtObj.mjOBJ_BODY, f"{_VEHICLE_PREFIX}quadrotor", data.xpos, data.xmat),
    ):
        index = mujoco.mj_name2id(model, kind, name)
        if index >= 0:
            rotation = matrices[index].reshape(3, 3)
            yaw = float(np.arctan2(rotation[1, 0], rotation[0, 0]))
            return _Takeoff(positions[index, :2].copy(), yaw)
    return None


def _surfaces(spec: Any) -> tuple[dict[str, Surface], list[str]]:
    """The surface of each geom, all of which are named, and the geoms without a class."""
    surfaces: dict[str, Surface] = {}
    unknown: list[str] = []
    taken = {geom.name for geom in spec.geoms if geom.name}
    for index, geom in enumerate(spec.geoms):
        if not geom.name:
            stem = geom.material or "geom"
            name = f"{stem}_{index}"
            while name in taken:
                name += "_unnamed"
            geom.name = name
            taken.add(name)
        found = surface_of_name(geom.material or "") or surface_of_name(geom.name)
        if found is None:
            unknown.append(geom.name)
        surfaces[geom.name] = found or DEFAULT_SURFACE
    return surfaces, unknown


def _warn_of_unknown(path: Path, unknown: list[str]) -> None:
    if unknown:
        shown = ", ".join(printable(name) for name in unknown[:4])
        names = shown + (" ..." if len(unknown) > 4 else "")
        one = len(unknown) == 1
        _warn_once(
            path,
            f"{len(unknown)} {'geom has' if one else 'geoms have'} no known class ({names}): "
            f"{'it counts' if one else 'they count'} as 'other' with reflectivity "
            f"{DEFAULT_SURFACE.reflectivity}; begin a material's or geom's name with one of "
            f"{', '.join(LAND_CLASSES)}",
        )


def _bounds(model: Any, data: Any, takeoff_xy_m: np.ndarray, path: Path) -> np.ndarray:
    """The horizontal box around all finite geoms, cut to 160 m around the take-off spot; that
    whole square where an infinite plane lies below. Warns of a size that is unlikely in metres."""
    window = np.stack([takeoff_xy_m - _HALF_BOUNDS_M, takeoff_xy_m + _HALF_BOUNDS_M])
    box = finite_box(model, data)
    if box is None or infinite_planes(model).any():
        return window
    size = float((box[1] - box[0]).max())
    if not _SMALL_M <= size <= _HUGE_M:
        _warn_once(path, f"the scene is {size:.3g} m across; are its lengths in metres?")
    return np.stack([np.maximum(box[0], window[0]), np.minimum(box[1], window[1])])
