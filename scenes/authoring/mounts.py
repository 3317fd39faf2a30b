"""Sensors of a vehicle that are turned from their mounts."""

from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from touchdown.scenes.api import NO_GUESTS, VEHICLE_BODY, Guests
from touchdown.sim.typing import Array

_QUAT = mujoco.mjtOrientation.mjORIENTATION_QUAT
_CAMERAS = {"camera": "cameras", "camera_right": "cameras", "camera_0": "sites",
            "camera_1": "sites"}  # fmt: skip
_LEAST_DOWN = 0.5
"""of a camera's view: the images are to show the ground"""
_LEAST_ASIDE = -0.05
"""of a LIDAR's axis: one that looks all round may lie on its side"""


def mount_sensors(spec: Any, guests: Guests) -> None:
    """Turns the cameras and LIDARs of the vehicle in a spec as ``guests`` say, and adds the site
    ``lidar_1`` where a second LIDAR is asked for. Raises ValueError for a turn after which a camera
    does not see the ground, or a LIDAR looks up."""
    if (guests.camera_turn_deg, guests.lidar_turns_deg) == (
        NO_GUESTS.camera_turn_deg, NO_GUESTS.lidar_turns_deg,
    ):  # fmt: skip
        return
    body = spec.body(VEHICLE_BODY)
    sites = {site.name.removeprefix("vehicle/"): site for site in body.sites}
    cameras = {camera.name.removeprefix("vehicle/"): camera for camera in body.cameras}
    if any(guests.camera_turn_deg):
        for name, kind in _CAMERAS.items():
            found = (cameras if kind == "cameras" else sites)[name]
            view = _turn(found, guests.camera_turn_deg)[:, 2]
            down = view[2] if kind == "cameras" else -view[2]
            if down < _LEAST_DOWN:
                raise ValueError(
                    f"camera.mount_deg {guests.camera_turn_deg} turns the camera from the ground; "
                    "turn it by less"
                )
    first, second = guests.lidar_turns_deg
    if second is not None and "lidar_1" not in sites:
        old = sites["lidar_0"]
        sites["lidar_1"] = body.add_site(name="vehicle/lidar_1", pos=old.pos, quat=_quat(old))
    for name, key, turn in (
        ("lidar_0", "mount_deg", first),
        ("lidar_1", "second_mount_deg", second),
    ):
        if turn is not None and any(turn) and -_turn(sites[name], turn)[2, 2] < _LEAST_ASIDE:
            raise ValueError(f"lidar.{key} {turn} turns the LIDAR up; turn it by less")


def _turn(element: Any, degrees: tuple[float, float, float]) -> Array:
    """Turns a site or camera about the body's axes. Returns its new axes (3, 3), columns."""
    turned = Rotation.from_euler("xyz", degrees, degrees=True) * Rotation.from_quat(
        _quat(element), scalar_first=True
    )
    element.alt.type = _QUAT
    element.quat = turned.as_quat(scalar_first=True)
    return turned.as_matrix()


def _quat(element: Any) -> Array:
    """(4,) wxyz of a site or camera, however its file gives it."""
    kind, alt = element.alt.type, element.alt
    if kind == _QUAT:
        return np.array(element.quat)
    if kind != mujoco.mjtOrientation.mjORIENTATION_XYAXES:
        raise ValueError(f"give '{element.name}' its attitude as xyaxes or quat to turn it")
    x, y = np.array(alt.xyaxes[:3]), np.array(alt.xyaxes[3:])
    x /= np.linalg.norm(x)
    y -= (x @ y) * x
    y /= np.linalg.norm(y)
    axes = np.column_stack([x, y, np.cross(x, y)])
    return np.asarray(Rotation.from_matrix(axes).as_quat(scalar_first=True))
