"""Composes a scene and the vehicle into one compiled model."""

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from touchdown.scenes import api
from touchdown.scenes.authoring.builder import quat_z
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.light import light_file, lit_by, set_sky
from touchdown.scenes.authoring.mounts import mount_sensors
from touchdown.scenes.authoring.plane import unit_circle
from touchdown.scenes.registry import dials_of, scene_generator
from touchdown.scenes.traffic.routes import Traffic

VEHICLE_XML = api.VEHICLE_FOLDER / "quadrotor.xml"
TICK_HZ = 600
AIR_DENSITY_KGPM3 = 1.225
AIR_VISCOSITY_PAS = 1.8e-5
START_GAP_M = 0.003
"""The legs start this far above the ground and settle."""
NEAR_M, FAR_M = 0.05, 400.0
_PROBE_HEIGHT_M = 500.0
_CARRIER_KG = 1000.0
"""of a deck whose motion is given: much more than a vehicle, so that one leaves it alone"""


def _warn(message: str) -> None:
    warnings.warn(f"MuJoCo: {' '.join(message.split())}", stacklevel=2)


# Otherwise MuJoCo appends to MUJOCO_LOG.TXT in the current folder.
mujoco.set_mju_user_warning(_warn)


def load_scene(
    name_or_path: str,
    seed: int,
    sun: api.LowSun | None = None,
    light: api.Light = "day",
    options: api.ImportOptions | None = None,
    dials: api.Dials | None = None,
    traffic: api.TrafficParams | None = None,
    guests: api.Guests = api.NO_GUESTS,
) -> api.Scene:
    """Loads the scene ``name_or_path`` with the vehicle on its take-off spot.

    name_or_path: a name of `scenes.registry.scene_names` or the path of an MJCF file (a path has
    a slash or ends in .xml). seed: non-negative; the same seed gives the same model to the byte.
    Of a scene from a file it draws where movers start, nothing else. sun: replaces the scene's own;
    named scenes bake their shadows with it, scenes from files have no baked shadows. light: of the
    sky; ``sun`` is that of ``day``. Neither changes what stands where. options: how a scene from a
    file is made flyable; None takes the file as it is. dials: of a scene that has any.
    traffic: who moves through it. guests: the vehicle and who waits for a fault.
    Raises ValueError (unknown name, negative seed, malformed MJCF) and FileNotFoundError.
    """
    name = Path(name_or_path).stem
    movers = Traffic(traffic or api.TrafficParams(), guests.intruders, name, seed)
    with lit_by(light, sun):
        spec, draft = compose_spec(name_or_path, seed, options, dials, guests.vehicle)
    mount_sensors(spec, guests)
    movers.add_bodies(spec, draft.surfaces)
    scene = movers.routed(compile_scene(spec, draft, name, seed, name_or_path))
    return replace(
        scene,
        traffic=traffic or api.TrafficParams(),
        vehicle=guests.vehicle,
        light=light,
        options=options if _is_file(name_or_path) else None,
        dials=dials_of(name_or_path, dials),
    )


def compile_scene(spec: Any, draft: SceneDraft, name: str, seed: int, source: str) -> api.Scene:
    """Compiles a spec that holds the vehicle and puts the vehicle on the ground. Raises ValueError
    for a spec that does not compile or has no ground below the vehicle."""
    try:
        model = spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise ValueError(f"scene '{source}' does not compile: {_one_line(error)}") from error
    draft.fill_model(model)
    _stand_on_ground(model, draft)
    return api.Scene(
        name=name,
        seed=seed,
        model=model,
        takeoff_xy_m=draft.takeoff_xy_m,
        takeoff_yaw=draft.takeoff_yaw,
        bounds_xy_m=draft.bounds_xy_m,
        surfaces=draft.surfaces,
        ground=draft.ground,
        moving=draft.moving,
        source=source,
        origin_m=draft.origin_m,
        inferred=draft.inferred,
        textured=draft.textured,
        facts=draft.facts,
    )


def compose_spec(
    name_or_path: str,
    seed: int,
    options: api.ImportOptions | None = None,
    dials: api.Dials | None = None,
    vehicle: str = api.DEFAULT_VEHICLE,
) -> tuple[Any, SceneDraft]:
    """Returns the uncompiled MjSpec, with the vehicle at height 0 over the take-off spot, and its
    draft, which holds the large textures (`SceneDraft.pictures`).

    Raises as `load_scene`.
    """
    draft = _draft(name_or_path, seed, options, dials)
    prepare_spec(draft, vehicle)
    return draft.spec, draft


def bare_spec(name_or_path: str, seed: int) -> Any:
    """Returns the uncompiled MjSpec of a scene without the vehicle, with the site ``takeoff`` at
    height 0. Raises as `load_scene`."""
    draft = _draft(name_or_path, seed)
    draft.fill()
    spec = draft.spec
    _set_options(spec)
    if spec.site("takeoff") is None:
        quat = quat_z(draft.takeoff_yaw)
        spec.worldbody.add_site(name="takeoff", pos=[*draft.takeoff_xy_m, 0.0], quat=quat)
    return spec


def _draft(
    name_or_path: str,
    seed: int,
    options: api.ImportOptions | None = None,
    dials: api.Dials | None = None,
) -> SceneDraft:
    if seed < 0:
        raise ValueError(f"seed {seed} is negative: give an integer from 0 up")
    if _is_file(name_or_path):
        from touchdown.scenes.importers.mjcf import read_mjcf

        draft = read_mjcf(Path(name_or_path), options, seed)
        light_file(draft.spec)
    else:
        draft = scene_generator(name_or_path, dials)(seed)
    set_sky(draft.spec)
    return draft


def _is_file(name_or_path: str) -> bool:
    return name_or_path.endswith(".xml") or "/" in name_or_path


def spec_of_scene(scene: api.Scene) -> Any:
    """Returns the MjSpec of a scene of `load_scene`, composed anew from its source and seed; the
    vehicle stands where the scene starts it."""
    source = scene.source or scene.name
    spec, draft = compose_spec(source, scene.seed, scene.options, scene.dials, scene.vehicle)
    draft.fill()
    spec.body(api.VEHICLE_BODY).pos = scene.model.body_pos[scene.model.body(api.VEHICLE_BODY).id]
    return spec


def prepare_spec(draft: SceneDraft, vehicle: str = api.DEFAULT_VEHICLE) -> None:
    """Sets a draft's physics and visual options and puts the vehicle over its take-off spot."""
    spec = draft.spec
    _set_options(spec)
    for geom in spec.geoms:
        # The vehicle's group, which sensors do not see.
        geom.group = 0 if geom.group == api.VEHICLE_GROUP else geom.group
        if geom.contype or geom.conaffinity:
            geom.contype, geom.conaffinity = 1, 0
    _attach_vehicle(spec, draft, vehicle)
    for body in draft.moving:
        if body.carries:
            _add_carrier(spec, draft, body.body_name)


def _add_carrier(spec: Any, draft: SceneDraft, name: str) -> None:
    """Moves what of a mocap body can be touched to a free body, which `sim.moving` moves along."""
    body = spec.worldbody.add_body(name=f"{name}{api.CARRIER}", gravcomp=1.0)
    body.mass, body.inertia = _CARRIER_KG, [_CARRIER_KG] * 3
    body.explicitinertial = True
    body.add_freejoint()
    for geom in spec.body(name).geoms:
        if not geom.contype:
            continue
        touched = f"{geom.name}{api.TOUCHED}"
        draft.surfaces[touched] = draft.surfaces[geom.name]
        body.add_geom(
            name=touched, type=geom.type, size=geom.size, pos=geom.pos, quat=geom.quat,
            fromto=geom.fromto, friction=geom.friction, solref=geom.solref, condim=geom.condim,
            contype=1, conaffinity=0, group=api.VEHICLE_GROUP, rgba=[0.0, 0.0, 0.0, 0.0],
        )  # fmt: skip
        geom.contype = 0


def _set_options(spec: Any) -> None:
    """Sets physics, clip planes and quality. Clip planes are in units of the model's extent, which
    is fixed here to keep them absolute. Real-time shadows and multisampling would each more than
    double the render time on a software renderer; `scenes.render` renders large and scales down
    instead."""
    option = spec.option
    option.timestep = 1.0 / TICK_HZ
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.gravity = [0.0, 0.0, -9.81]
    option.density, option.viscosity = AIR_DENSITY_KGPM3, AIR_VISCOSITY_PAS
    spec.stat.extent = 100.0
    visual = spec.visual
    visual.map.znear, visual.map.zfar = NEAR_M / 100.0, FAR_M / 100.0
    visual.quality.shadowsize = 0
    visual.quality.offsamples = 0
    visual.global_.offwidth = max(int(visual.global_.offwidth), 1920)
    visual.global_.offheight = max(int(visual.global_.offheight), 1080)


def vehicle_spec(name_or_path: str) -> Any:
    """The MjSpec of a vehicle, its body named ``quadrotor``. Raises as `load_scene`."""
    if name_or_path == api.DEFAULT_VEHICLE:
        return mujoco.MjSpec.from_file(str(VEHICLE_XML))
    from touchdown.scenes.importers.vehicle import read_vehicle

    return read_vehicle(name_or_path)


def _attach_vehicle(spec: Any, draft: SceneDraft, vehicle: str) -> None:
    own = vehicle_spec(vehicle)
    own.option = spec.option
    spec.attach(own, prefix="vehicle/", frame=spec.worldbody.add_frame())
    body = spec.body(api.VEHICLE_BODY)
    body.pos = [*draft.takeoff_xy_m, 0.0]
    body.quat = quat_z(draft.takeoff_yaw)
    if not body.joints:
        body.add_freejoint(name="vehicle/free")
    for geom in body.find_all("geom"):
        if geom.contype or geom.conaffinity:
            geom.contype, geom.conaffinity = 0, 1


def _stand_on_ground(model: Any, draft: SceneDraft) -> None:
    """Moves the vehicle's reference pose so that its lowest point is just above the ground."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    body = model.body(api.VEHICLE_BODY).id
    lowest, radius = _underside(model, data, body)
    ring = unit_circle(12)
    points = draft.takeoff_xy_m + np.concatenate(
        [np.zeros((1, 2)), 0.5 * radius * ring, radius * ring]
    )
    ground = max(_height_below(model, data, point, body) for point in points)
    z = model.body_pos[body, 2] + ground - lowest + START_GAP_M
    model.body_pos[body, 2] = z
    model.qpos0[2] = z
    model.qpos_spring[2] = z


def _underside(model: Any, data: Any, body: int) -> tuple[float, float]:
    """Lowest z (m, world) and horizontal reach (m) from the body origin of the legs' bounding
    boxes, or of every colliding vehicle geom where none is named ``leg``."""
    own = [g for g in range(model.ngeom) if model.body_rootid[model.geom_bodyid[g]] == body]
    legs = [g for g in own if "leg" in model.geom(g).name and model.geom_conaffinity[g]]
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    corners = []
    for geom in legs or own:
        centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        rotation = data.geom_xmat[geom].reshape(3, 3)
        corners.append((centre + signs * half) @ rotation.T + data.geom_xpos[geom])
    points = np.concatenate(corners)
    reach = np.linalg.norm(points[:, :2] - data.xpos[body, :2], axis=1).max()
    return float(points[:, 2].min()), float(reach)


def _height_below(model: Any, data: Any, xy_m: api.Array, vehicle_body: int) -> float:
    """World height of the first static surface below (x, y)."""
    groups = np.ones(6, np.uint8)
    geom_id = np.array([-1], np.int32)
    z = _PROBE_HEIGHT_M
    for _ in range(64):
        start = np.array([*xy_m, z])
        down = np.array([0.0, 0.0, -1.0])
        distance = mujoco.mj_ray(model, data, start, down, groups, 1, -1, geom_id)
        if distance < 0.0:
            raise ValueError(
                f"no ground under the take-off spot {np.round(xy_m, 2).tolist()}: add a floor, or "
                "a site named 'takeoff' above the ground"
            )
        z -= distance
        if model.body_rootid[model.geom_bodyid[geom_id[0]]] != vehicle_body:
            return z
        z -= 1e-4
    return z


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
