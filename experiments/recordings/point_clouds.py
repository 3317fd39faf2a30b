"""Scans of LIDAR drivers: the times of Velodyne, Ouster, Hesai and Livox in ``PointCloud2``, and
Livox's own messages."""

from typing import Any

import numpy as np

from touchdown.experiments.recordings.contract import RawScan
from touchdown.sim.typing import Array, Float32

_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""of ``sensor_msgs/PointField``"""
_TIMES = ("time", "t", "timestamp", "offset_time", "time_stamp", "time_offset", "timeoffset")
_LEVELS = ("intensity", "reflectivity", "i")
_SWEEP_S = (2e-3, 2.0)
"""a sweep lasts so long: by this the unit of a time is known, which no field states"""
_UNITS_S = (1.0, 1e-3, 1e-6, 1e-9)
_MAX_POINTS = 1 << 24


def seconds_after(stamp_ns: int, times: Array) -> Float32:
    """(N,) s after the stamp of a scan, of times (N,) in any unit that a sweep of 2 ms to 2 s
    allows, after the stamp or of the day. Raises ValueError for others."""
    if not np.isfinite(times).all():
        raise ValueError("its times are not finite")
    if not len(times):  # of a sweep that met nothing
        return np.zeros(0, np.float32)
    first, span = float(times.min()), float(np.ptp(times))
    if span == 0.0:  # moved to one instant already
        return np.zeros(len(times), np.float32)
    for unit in _UNITS_S:
        if _SWEEP_S[0] <= span * unit <= _SWEEP_S[1]:
            break
    else:
        raise ValueError(f"its times span {span:g}, which is no sweep in s, ms, us or ns")
    offsets = (times - first) * unit
    start = first * unit
    if abs(start) > _SWEEP_S[1]:  # of the day or of an epoch
        start -= stamp_ns * 1e-9
        if abs(start) > _SWEEP_S[1]:  # of a clock of its own: the stamp is the start
            start = 0.0
    return (offsets + start).astype(np.float32)


def scan_of_cloud(message: Any, stamp_ns: int) -> RawScan:
    """The scan of a ``sensor_msgs/msg/PointCloud2``, of which a width of 0 is a sweep that met
    nothing. Raises ValueError where it contradicts itself."""
    count = int(message.width) * int(message.height)
    fields = {one.name: one for one in message.fields}
    step, data = int(message.point_step), np.asarray(message.data, np.uint8)
    missing = [name for name in "xyz" if name not in fields]
    if missing or not 0 <= count <= _MAX_POINTS or len(data) < count * step:
        raise ValueError("a cloud lacks x, y or z, or its points")
    order = ">" if message.is_bigendian else "<"
    if any(one.datatype not in _KINDS for one in fields.values()):
        raise ValueError("a cloud has a field of an unknown type")
    kinds = {name: order + _KINDS[one.datatype] for name, one in fields.items()}
    if any(one.offset + np.dtype(kinds[name]).itemsize > step for name, one in fields.items()):
        raise ValueError("a cloud has a field beyond its points")
    table = np.frombuffer(
        data[: count * step].tobytes(),
        np.dtype({"names": list(fields), "formats": list(kinds.values()),
                  "offsets": [one.offset for one in fields.values()], "itemsize": step}),
    )  # fmt: skip
    named = next((name for name in _TIMES if name in fields), None)
    times = np.zeros(count) if named is None else table[named].astype(np.float64)
    level = next((name for name in _LEVELS if name in fields), None)
    strength = np.zeros(count) if level is None else table[level].astype(np.float64)
    return RawScan(
        stamp_ns=stamp_ns,
        points=np.column_stack([table[name] for name in "xyz"]).astype(np.float32),
        offsets_s=seconds_after(stamp_ns, times), intensity=_levels(strength),
    )  # fmt: skip


def _levels(strength: Array) -> Any:
    """0..255; drivers that state fractions never exceed 1."""
    strength = np.nan_to_num(strength)
    if strength.max(initial=0.0) <= 1.0:
        strength = 255.0 * strength
    return np.clip(strength, 0.0, 255.0).astype(np.uint8)


def scan_of_livox(message: Any, stamp_ns: int) -> RawScan:
    """The scan of a ``CustomMsg`` of ``livox_ros_driver`` or ``livox_ros_driver2``. Raises
    ValueError for one without points."""
    points = message.points
    if not len(points):
        raise ValueError("a scan has no points")
    table = np.array([(p.x, p.y, p.z, p.offset_time, p.reflectivity) for p in points])
    return RawScan(
        stamp_ns=stamp_ns, points=table[:, :3].astype(np.float32),
        offsets_s=(1e-9 * table[:, 3]).astype(np.float32),
        intensity=table[:, 4].astype(np.uint8),
    )  # fmt: skip
