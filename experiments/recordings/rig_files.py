"""Files that describe a rig: Kalibr's ``camchain-imucam.yaml``, our TOML, and ``rig.json`` of our
exports. Each comes from a stranger."""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from touchdown.experiments.config.files import read_tree
from touchdown.experiments.errors import UsageError, reason_of
from touchdown.experiments.io.dataclass_json import from_plain
from touchdown.experiments.io.sensor_log_reader import check_rig
from touchdown.experiments.io.untrusted import shown
from touchdown.experiments.recordings.contract import Lens, RigParts
from touchdown.sim.api import CameraIntrinsics, ImuSheet, LidarSheet, MagnetometerParams, SensorRig
from touchdown.sim.files.opening import check_file
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array

_MAX_BYTES = 1 << 20
_MAX_SIDE = 1 << 14
_ROTATION_SLACK = 1e-3
"""largest entry of R R^T - 1 of a matrix that is given with few digits"""
_FISHEYE = ("equidistant", "fisheye", "kannala-brandt")
_LENSES = (*_FISHEYE, "radtan", "radial-tangential", "plumb_bob", "none")


class RigError(ValueError):
    """What a description of a rig lacks or says wrong, in a few words."""


def read_rig(path: Path) -> RigParts:
    """What a file says of a rig. Raises UsageError, one line."""
    try:
        check_file(path, "rig", _MAX_BYTES)
        if path.suffix == ".json":
            return RigParts(whole=whole_rig(read_tree(path)))
        if path.suffix == ".toml":
            return _of_toml(read_tree(path))
        return _of_kalibr(read_yaml(path))
    except UsageError:
        raise
    except KeyError as error:
        raise UsageError(f"rig '{path}' lacks {shown(error.args[0])}") from error
    except (ValueError, TypeError, OSError) as error:
        raise UsageError(f"rig '{path}': {reason_of(error)}") from error


def whole_rig(tree: object) -> SensorRig:
    """The rig that our exports write. Raises ValueError, TypeError or KeyError for another tree."""
    rig: SensorRig = from_plain(SensorRig, tree)
    check_rig(rig)
    return rig


def read_yaml(path: Path) -> Mapping[str, Any]:
    """The mapping of a YAML file, also of one that OpenCV wrote. Raises ValueError, OSError."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    check_file(path, "file", _MAX_BYTES)
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    text = "\n".join("" if line.startswith("%") else line for line in lines)
    try:
        tree = YAML(typ="safe", pure=True).load(text)
    except (YAMLError, RecursionError, AttributeError) as error:
        raise RigError(f"'{path.name}' is no YAML") from error
    if not isinstance(tree, dict):
        raise RigError(f"'{path.name}' holds no keys and values")
    return tree


def numbers(given: object, count: int, what: str) -> Array:
    """(count,) finite numbers. Raises RigError."""
    try:
        array = np.array(given, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        array = np.zeros(0)
    if len(array) != count or not np.isfinite(array).all():
        raise RigError(f"{what} is not {count} finite numbers")
    return array


def pose_of(given: object, what: str) -> Pose:
    """The pose of 16 or 12 numbers, row by row, or of 7: x y z qx qy qz qw. Raises RigError."""
    from scipy.spatial.transform import Rotation

    count = np.size(np.array(given, dtype=object)) if not isinstance(given, list) else _size(given)
    if count == 7:
        x = numbers(given, 7, what)
        if not 0.5 < np.linalg.norm(x[3:]) < 2.0:
            raise RigError(f"{what} has no unit quaternion (x y z qx qy qz qw)")
        return Pose(Rotation.from_quat(x[3:]).as_matrix(), x[:3])
    whole = numbers(given, 12 if count == 12 else 16, what).reshape(-1, 4)[:3]
    rotation = whole[:, :3]
    slack = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if slack > _ROTATION_SLACK or np.linalg.det(rotation) < 0.0:
        raise RigError(f"{what} has no rotation in its first three columns")
    if slack < 1e-9:  # as our exports write it
        return Pose(rotation.copy(), whole[:, 3].copy())
    return Pose(Rotation.from_matrix(rotation).as_matrix(), whole[:, 3].copy())


def _size(given: list[Any]) -> int:
    return sum(_size(one) if isinstance(one, list) else 1 for one in given)


def intrinsics_of(
    model: str, size: object, four: object, distortion: object, what: str
) -> CameraIntrinsics:
    """A camera. Raises RigError."""
    if model not in _LENSES:
        raise RigError(f"{what}: distortion {shown(model)} is none of {', '.join(_LENSES)}")
    width, height = numbers(size, 2, f"resolution of {what}").astype(int).tolist()
    fx, fy, cx, cy = numbers(four, 4, f"intrinsics of {what} (fx, fy, cx, cy)").tolist()
    if not (0 < width <= _MAX_SIDE and 0 < height <= _MAX_SIDE and fx > 0.0 and fy > 0.0):
        raise RigError(f"{what} has no image size or focal length")
    given = list(distortion) if isinstance(distortion, list | tuple) else []
    if len(given) not in (0, 4, 5) or (model in _FISHEYE and len(given) != 4):
        raise RigError(f"{what}: {len(given)} coefficients of distortion are not {model}")
    coefficients = np.zeros(5)
    coefficients[: len(given)] = numbers(given, len(given), f"distortion of {what}")
    return CameraIntrinsics(
        width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, distortion=coefficients,
        lens="fisheye" if model in _FISHEYE else "pinhole",
    )  # fmt: skip


def _of_kalibr(tree: Mapping[str, Any]) -> RigParts:
    topics, before = {}, Pose.identity()
    cameras = [tree[name] for name in ("cam0", "cam1") if name in tree]
    if not cameras:
        raise RigError("it has no cam0; is it Kalibr's camchain-imucam.yaml?")
    lenses: list[Lens] = []
    for n, camera in enumerate(cameras):
        what = f"cam{n}"
        if camera.get("camera_model", "pinhole") != "pinhole":
            raise RigError(f"{what} is {shown(camera['camera_model'])}, not pinhole")
        if "T_cam_imu" in camera:
            from_imu = pose_of(camera["T_cam_imu"], f"T_cam_imu of {what}")
        elif n == 0:
            raise RigError("cam0 has no T_cam_imu: give camchain-imucam.yaml, not camchain.yaml")
        else:
            from_imu = pose_of(camera["T_cn_cnm1"], f"T_cn_cnm1 of {what}") @ before
        before = from_imu
        lens = intrinsics_of(
            camera.get("distortion_model", "none"), camera["resolution"], camera["intrinsics"],
            camera.get("distortion_coeffs", []), what,
        )  # fmt: skip
        shift = float(numbers(camera.get("timeshift_cam_imu", 0.0), 1, f"timeshift of {what}")[0])
        lenses.append(Lens(intrinsics=lens, body_from_camera=from_imu.inverse(), offset_s=shift))
        if isinstance(camera.get("rostopic"), str):
            topics["camera" if n == 0 else "camera_right"] = camera["rostopic"]
    right = lenses[1] if len(lenses) > 1 else None
    return RigParts(camera=lenses[0], right=right, topics=topics)


_TABLES = ("topics", "imu", "lidar", "camera", "camera_right", "magnetometer")
_OWN = {"moving": bool, "latency_s": float}


def _of_toml(tree: Mapping[str, Any]) -> RigParts:
    if unknown := [key for key in tree if key not in (*_TABLES, *_OWN)]:
        raise RigError(f"{shown(unknown[0])} is none of {', '.join((*_TABLES, *_OWN))}")
    tables = {name: dict(tree.get(name, {})) for name in _TABLES}
    said: dict[str, Any] = {}
    for key, kind in _OWN.items():
        if key in tree:
            said[key] = TypeAdapter(kind).validate_python(tree[key])
    if not 0.0 <= said.get("latency_s", 0.0) < math.inf:
        raise RigError("latency_s is negative")
    said["topics"] = TypeAdapter(dict[str, str]).validate_python(tables["topics"])
    if "body_from_imu" in tables["imu"]:
        said["body_from_imu"] = pose_of(tables["imu"].pop("body_from_imu"), "imu.body_from_imu")
    lidar = tables["lidar"]
    if "body_from_lidar" in lidar:
        said["body_from_lidar"] = pose_of(lidar.pop("body_from_lidar"), "lidar.body_from_lidar")
    if "time_offset_s" in lidar:
        said["lidar_offset_s"] = float(numbers(lidar.pop("time_offset_s"), 1, "lidar offset")[0])
    if tables["imu"]:
        said["imu"] = TypeAdapter(ImuSheet).validate_python(tables["imu"])
    if tables["magnetometer"]:
        nav = RigParts().nav
        given = {"latency_ticks": 0, "declination_deg": 0.0} | tables["magnetometer"]
        field = TypeAdapter(MagnetometerParams).validate_python(given)
        said["nav"] = dataclasses.replace(nav, magnetometer=field)
    if lidar:
        said["lidar"] = TypeAdapter(LidarSheet).validate_python(lidar)
    for table, name in (("camera", "camera"), ("camera_right", "right")):
        if tables[table]:
            said[name] = _lens_of_toml(tables[table], table)
    return RigParts(**said)


def _lens_of_toml(table: Mapping[str, Any], what: str) -> Lens:
    known = {"resolution", "intrinsics", "distortion_model", "distortion", "body_from_camera",
             "time_offset_s"}  # fmt: skip
    if unknown := set(table) - known:
        raise RigError(f"{what}.{min(unknown)[:40]} is none of {', '.join(sorted(known))}")
    given = table.get("distortion", [])
    model = table.get("distortion_model", "radtan" if given else "none")
    lens = intrinsics_of(model, table["resolution"], table["intrinsics"], given, what)
    mount = pose_of(table["body_from_camera"], f"{what}.body_from_camera")
    offset = float(numbers(table.get("time_offset_s", 0.0), 1, f"{what}.time_offset_s")[0])
    return Lens(intrinsics=lens, body_from_camera=mount, offset_s=offset)
