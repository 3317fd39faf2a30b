"""Vehicles from MJCF files: a shipped one by its name, or any file with the sites of
docs/vehicles.md. What a flight needs beside them is added here: feet, propeller discs, cameras."""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from touchdown.scenes.api import VEHICLE_FOLDER, VEHICLE_GROUP, vehicle_file
from touchdown.scenes.authoring.builder import quat_z
from touchdown.scenes.importers.ground_texturing import quat_of
from touchdown.scenes.importers.import_pass import move_inside
from touchdown.scenes.importers.mjcf import compiled, delete_motion, read_spec
from touchdown.scenes.importers.model_check import MAX_TEXT_BYTES, check_spec, check_texts
from touchdown.sim.files.child import run_limited
from touchdown.sim.files.opening import check_file
from touchdown.sim.typing import Array

_SMALLER = "simplify its meshes (decimate), or leave them out"
_KEPT_CAMERAS = ("camera", "camera_right")
_STEREO_M = 0.05
"""from ``camera_0`` to the right camera, where there is no ``camera_1``"""
_FOOT_M = 0.012
"""radius of a foot"""
_CENTRED_M = 1e-4
_BLADES = (0.97, 0.06, 0.012)
"""half length and half width of a blade's box over the rotor's radius, and its half height"""


def read_vehicle(name_or_path: str) -> Any:
    """The MjSpec of a vehicle: one body ``quadrotor`` whose origin is the centre of mass, without
    joints, with all that a flight needs. Raises FileNotFoundError for a missing file, ValueError
    for one that MuJoCo cannot read, beyond the limits of files of others, or without a site that a
    vehicle needs."""
    path = vehicle_file(name_or_path)
    check_file(path, "a vehicle", MAX_TEXT_BYTES)
    if path.parent != VEHICLE_FOLDER:  # not shipped: nothing is known of it
        run_limited(lambda: _tried(path), path, "to compile it", _SMALLER)
    try:
        return _complete(read_spec(path), path)
    except ValueError as error:
        text = str(error)
        raise ValueError(text if text.startswith(str(path)) else f"{path}: {text}") from None


def _tried(path: Path) -> None:
    check_texts(path)
    spec = read_spec(path)
    check_spec(spec, path)
    delete_motion(spec)
    compiled(spec, path)


def _complete(spec: Any, path: Path) -> Any:
    root = _root(spec)
    _keep_alone(spec, root)
    delete_motion(spec)
    root.pos, root.quat, root.alt.type = np.zeros(3), [1.0, 0.0, 0.0, 0.0], _AS_QUAT
    _make_rigid(root, *compiled(spec, path))
    model, data = compiled(spec, path)
    _gather_sites(spec, root, model, data)
    _add_rotors(spec, root)
    _add_feet(spec, root)
    _add_cameras(spec, root)
    for number, geom in enumerate(root.find_all("geom")):
        geom.name, geom.group = geom.name or f"body_{number}", VEHICLE_GROUP
    for site in root.find_all("site"):
        site.group = VEHICLE_GROUP
    root.name = "quadrotor"
    return spec


_AS_QUAT = mujoco.mjtOrientation.mjORIENTATION_QUAT


def _root(spec: Any) -> Any:
    """The body of the world that holds the site ``rotor_0``, itself or in a body inside."""
    for body in spec.worldbody.bodies:
        if any(site.name == "rotor_0" for site in body.find_all("site")):
            return body
    raise ValueError("no site 'rotor_0' in a body; add <site name='rotor_0' pos='...'/> at a hub")


def _keep_alone(spec: Any, root: Any) -> None:
    """Deletes all of the world but the vehicle: a floor, lights, other bodies."""
    world = spec.worldbody
    for body in [body for body in world.bodies if body.name != root.name]:
        spec.delete(body)
    for element in (*world.geoms, *world.sites, *world.cameras, *spec.lights):
        spec.delete(element)


def _make_rigid(root: Any, model: Any, data: Any) -> None:
    """Moves the body's origin to the centre of mass, and gives the mass of bodies inside to it."""
    body = model.body(root.name).id
    if root.bodies:
        own = range(1, model.nbody)
        mass, com = model.body_mass, data.xipos
        total = float(mass.sum())
        if total > 0.0:
            centre = (mass[:, None] * com).sum(axis=0) / total
            inertia = np.sum([_inertia(model, data, i, centre) for i in own], axis=0)
            root.explicitinertial = True
            root.mass, root.ipos = total, centre
            root.iquat, root.inertia = _principal(inertia)
        for inner in root.find_all("body"):
            inner.explicitinertial, inner.mass, inner.inertia = True, 0.0, np.zeros(3)
    else:
        centre = model.body_ipos[body].copy()
        if root.explicitinertial:
            root.ipos = centre
    if np.linalg.norm(centre) > _CENTRED_M:
        move_inside(root, -centre)
        if root.explicitinertial:
            root.ipos = np.zeros(3)


def _inertia(model: Any, data: Any, body: int, about: Array) -> Array:
    """(3, 3) kg m^2 of one body about a point, root's axes."""
    axes = data.ximat[body].reshape(3, 3)
    arm = data.xipos[body] - about
    own = axes @ np.diag(model.body_inertia[body]) @ axes.T
    return own + model.body_mass[body] * (arm @ arm * np.eye(3) - np.outer(arm, arm))


def _principal(inertia: Array) -> tuple[Array, Array]:
    """Quaternion (4,) wxyz of the principal axes, and the moments (3,) about them."""
    moments, axes = np.linalg.eigh(inertia)
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return quat_of(axes), moments


def _gather_sites(spec: Any, root: Any, model: Any, data: Any) -> None:
    """Puts all named sites, those of bodies inside too, on the body itself."""
    for site in [site for site in root.find_all("site") if site.name]:
        index, name = model.site(site.name).id, site.name
        quat = quat_of(data.site_xmat[index])
        spec.delete(site)
        root.add_site(name=name, pos=data.site_xpos[index], quat=quat, size=[0.008, 0.0, 0.0])


def _sites(root: Any, kind: str) -> list[Any]:
    """The sites ``kind_0``, ``kind_1`` ..."""
    named = {site.name: site for site in root.sites}
    found: list[Any] = []
    while (name := f"{kind}_{len(found)}") in named:
        found.append(named[name])
    return found


def _add_rotors(spec: Any, root: Any) -> None:
    """A swept disc, which touches, and blades, at each rotor that has no geom of its name."""
    numbers = {numeric.name: numeric.data for numeric in spec.numerics}
    radius = float(numbers["rotor_radius"][0]) if "rotor_radius" in numbers else 0.0
    if not radius > 0.0:
        raise ValueError("no <numeric name='rotor_radius' data='METRES'/> in <custom>; add it")
    for number, site in enumerate(_sites(root, "rotor")):
        if spec.geom(f"rotor_{number}") is not None:
            continue
        common: dict[str, Any] = {"pos": site.pos, "mass": 0.0, "contype": 0}
        root.add_geom(
            name=f"rotor_{number}", type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[radius, 0.004, 0.0], rgba=[0.25, 0.30, 0.36, 0.25], conaffinity=1, **common,
        )  # fmt: skip
        half, width, height = _BLADES
        root.add_geom(
            name=f"rotor_{number}_blades", type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[half * radius, width * radius, height * radius],
            quat=quat_z(np.radians(20.0 + 55.0 * number)), rgba=[0.12, 0.13, 0.15, 1.0],
            conaffinity=0, **common,
        )  # fmt: skip


def _add_feet(spec: Any, root: Any) -> None:
    """A rubber foot whose lowest point is the site, at each ``leg_*``."""
    for number, site in enumerate(_sites(root, "leg")):
        if spec.geom(f"leg_{number}_foot") is None:
            root.add_geom(
                name=f"leg_{number}_foot", type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=[_FOOT_M, 0.0, 0.0], pos=site.pos + [0.0, 0.0, _FOOT_M], mass=0.0,
                rgba=[0.05, 0.05, 0.05, 1.0], contype=0, conaffinity=1, condim=4, priority=1,
                friction=[0.9, 0.005, 0.0001], solref=[0.03, 1.0],
                solimp=[0.9, 0.95, 0.002, 0.5, 2.0],
            )  # fmt: skip


def _add_cameras(spec: Any, root: Any) -> None:
    """MuJoCo's cameras at the sites ``camera_0`` and ``camera_1``; their field of view is that of
    the keys ``camera.*``."""
    for camera in [c for c in root.find_all("camera") if c.name not in _KEPT_CAMERAS]:
        spec.delete(camera)
    sites = _sites(root, "camera")
    if not sites:
        raise ValueError(
            "no site 'camera_0'; add one at the lens: x right and y down in the image, z along the "
            "view, such as xyaxes='0 -1 0 -1 0 0' for straight down"
        )
    frame = np.empty(9)
    mujoco.mju_quat2Mat(frame, sites[0].quat)
    if len(sites) == 1:
        right = sites[0].pos + _STEREO_M * frame.reshape(3, 3)[:, 0]
        sites.append(root.add_site(name="camera_1", pos=right, quat=sites[0].quat))
    for name, site in zip(_KEPT_CAMERAS, sites, strict=False):
        if spec.camera(name) is None:
            quat = np.empty(4)  # MuJoCo's cameras look along -z with +y up
            mujoco.mju_mulQuat(quat, site.quat, np.array([0.0, 1.0, 0.0, 0.0]))
            root.add_camera(name=name, pos=site.pos, quat=quat)
