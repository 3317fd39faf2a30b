"""Rolling shutter and motion blur: rows out of one drawn raster, each from its own poses.

A raster is drawn once, in the middle of the readout, with its depth. Pixel x of a row that is
exposed dt later shows the drawn pixel X + rho (K p - p_z X), X = K R K^-1 x, where X_ref = R X + p
is the camera's motion in dt and rho the inverse depth that is drawn there. This is exact for a
static scene but within a displacement's width of an edge in depth, where the drawn raster does not
show what the edge hides. A body that moves by itself is shown where it is at the middle of the
readout: a row that is exposed dt later shows it too far back by its speed times dt f / depth.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.camera.gl import Snapshot
from touchdown.sim.frames import Pose, matrices_from_quats_wxyz
from touchdown.sim.moving import BodyTrack
from touchdown.sim.typing import Array, Float32

_MARGIN_RATE = 1.45
"""rad/s, of view and ground against one another: seldom more in the images of flights"""
_MAX_MARGIN_PX = 64

_OPTICAL_FROM_GL = np.diag([1.0, -1.0, -1.0])
_BLOCK = 16
"""pixels over which the shift by rotation is interpolated; error below 0.01 px at 0.05 rad"""
_RIGID_PX = 1.0 / 16.0
"""A block of pixels whose places in the drawing move by less than this against one another moves as
a whole: they are off by half of it at most"""


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraMotion:
    """Motion of a camera about the instant at which it was drawn: X_ref = R X + p at each node, R
    as a rotation vector."""

    offsets_s: Array
    """(M,) seconds after that instant, ascending"""
    rotations: Array
    """(M, 3) rad"""
    translations: Array
    """(M, 3) m, optical frame"""


def margin_px(camera: CameraIntrinsics, readout_s: float, exposure_s: float) -> int:
    """By how much a raster is wider at each side, so that shifted rows find pixels: the way of the
    image from the instant that is drawn, in the middle of the readout, to the first row's longest
    exposure."""
    way = _MARGIN_RATE * (0.5 * readout_s + exposure_s)
    return min(math.ceil(max(camera.fx, camera.fy) * way), _MAX_MARGIN_PX)


def camera_motion(
    track: BodyTrack, snapshot: Snapshot, camera_id: int, at_s: float
) -> CameraMotion:
    """The motion of the camera that is fixed to a body, whose track covers ``at_s``, the instant of
    ``snapshot``."""
    world_from_body = matrices_from_quats_wxyz(track.quats_wxyz)
    node = int(np.abs(track.times_s - at_s).argmin())
    camera = Pose(
        snapshot.cam_xmat[camera_id].reshape(3, 3) @ _OPTICAL_FROM_GL, snapshot.cam_xpos[camera_id]
    )
    mount = Pose(world_from_body[node], track.positions[node]).inverse() @ camera
    from_world = camera.inverse()
    rotations = from_world.rotation @ world_from_body @ mount.rotation
    carried = world_from_body @ mount.translation + track.positions
    vectors, positions = _rotation_vectors(rotations), from_world.apply(carried)
    return CameraMotion(offsets_s=track.times_s - at_s, rotations=vectors, translations=positions)


def _rotation_vectors(rotations: Array) -> Array:
    """(M, 3) rotation vectors of (M, 3, 3) rotations by less than 90 degrees."""
    skew = 0.5 * (rotations - np.swapaxes(rotations, 1, 2))
    axes = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    sines = np.linalg.norm(axes, axis=1, keepdims=True)
    safe = np.clip(sines, 1e-12, 1.0)
    return axes * (np.arcsin(safe) / safe)


def row_shifts(motion: CameraMotion, raster: CameraIntrinsics, offsets_s: Array) -> Array:
    """(..., 12) coefficients at ``offsets_s`` (...): the nine of K R K^-1, then K p."""
    flat = np.ascontiguousarray(offsets_s, dtype=np.float64).ravel()
    out = np.empty((len(flat), 12))
    lens = (raster.fx, raster.fy, raster.cx, raster.cy)
    _row_shifts(flat, motion.offsets_s, motion.rotations, motion.translations, *lens, out)
    return out.reshape(*offsets_s.shape, 12)


def longest_shift(coefficients: Array, raster: CameraIntrinsics, inverse_depth: float) -> Array:
    """(N,) largest displacement in pixels, of five pixels of the raster, between the first and the
    last of (N, K, 12) coefficients at one inverse depth."""
    w, h = raster.width - 1.0, raster.height - 1.0
    spots = np.array([[0, 0, 1], [w, 0, 1], [0, h, 1], [w, h, 1], [raster.cx, raster.cy, 1]]).T
    ends = []
    for c in (coefficients[:, 0], coefficients[:, -1]):
        moved = c[:, :9].reshape(-1, 3, 3) @ spots + inverse_depth * c[:, 9:, None]
        ends.append(moved[:, :2] / moved[:, 2:])
    return np.linalg.norm(ends[1] - ends[0], axis=1).max(axis=1)


def identity_shifts(rows: int) -> Array:
    """(rows, 1, 12) coefficients of no motion."""
    identity = np.concatenate([np.eye(3).ravel(), np.zeros(3)])
    return np.tile(identity, (rows, 1, 1))


@njit(cache=True, nogil=True, error_model="numpy")
def _row_shifts(
    at: Array,
    nodes: Array,
    rotations: Array,
    translations: Array,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    out: Array,
) -> None:
    last = len(nodes) - 2
    for n in range(len(at)):
        i = min(max(np.searchsorted(nodes, at[n], side="right") - 1, 0), max(last, 0))
        k = min(i + 1, len(nodes) - 1)
        span = nodes[k] - nodes[i]
        f = min(max((at[n] - nodes[i]) / span, 0.0), 1.0) if span > 0.0 else 0.0
        x, y, z = (1.0 - f) * rotations[i] + f * rotations[k]
        squared = x * x + y * y + z * z
        angle = np.sqrt(squared)
        a, b = 1.0, 0.5
        if angle > 1e-8:
            a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / squared
        r00, r01, r02 = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
        r10, r11, r12 = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
        r20, r21, r22 = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)
        # K R, then times K^-1 from the right
        k00, k01, k02 = fx * r00 + cx * r20, fx * r01 + cx * r21, fx * r02 + cx * r22
        k10, k11, k12 = fy * r10 + cy * r20, fy * r11 + cy * r21, fy * r12 + cy * r22
        out[n, 0], out[n, 1] = k00 / fx, k01 / fy
        out[n, 2] = k02 - k00 * cx / fx - k01 * cy / fy
        out[n, 3], out[n, 4] = k10 / fx, k11 / fy
        out[n, 5] = k12 - k10 * cx / fx - k11 * cy / fy
        out[n, 6], out[n, 7] = r20 / fx, r21 / fy
        out[n, 8] = r22 - r20 * cx / fx - r21 * cy / fy
        p = (1.0 - f) * translations[i] + f * translations[k]
        out[n, 9], out[n, 10], out[n, 11] = fx * p[0] + cx * p[2], fy * p[1] + cy * p[2], p[2]


@njit(cache=True, nogil=True, fastmath=True, forceinline=True, error_model="numpy")
def trace_row(
    c: Array,
    xs: Float32,
    ys: Float32,
    depth: Float32,
    far: float,
    per_step: float,
    sx: Float32,
    sy: Float32,
) -> None:
    """Writes the drawn places (sx, sy) that the raster places (xs, ys) of a row show, one instant
    with the coefficients ``c``. ``depth``: buffer of the drawing, bottom row first; inverse depth
    is ``far + per_step * depth``."""
    rows, cols = depth.shape
    width = len(xs)
    turn = c.astype(np.float32)
    kx, ky, pz = turn[9], turn[10], turn[11]
    flat, slope = np.float32(far), np.float32(per_step)
    right, low = np.float32(cols - 1.01), np.float32(rows - 1.01)
    half, zero = np.float32(0.5), np.float32(0.0)
    count = np.arange(_BLOCK).astype(np.float32)
    start = 0
    u1, v1 = _rotated(turn, xs[0], ys[0])
    while start < width:
        stop = min(start + _BLOCK, width)
        last = min(stop, width - 1)
        u0, v0 = u1, v1
        u1, v1 = _rotated(turn, xs[last], ys[last])
        part = np.float32(1.0) / np.float32(max(last - start, 1))
        du, dv = (u1 - u0) * part, (v1 - v0) * part
        # the parallax at the middle says where to look the depths up: side by side
        mid = (start + last) // 2
        part = np.float32(mid - start)
        mx, my = xs[mid] + u0 + du * part, ys[mid] + v0 + dv * part
        gx, gy = zero, zero
        for _ in range(2):
            col = np.intp(min(max(mx + gx + half, zero), right))
            row = np.intp(min(max(my + gy + half, zero), low))
            rho = flat + slope * depth[rows - 1 - row, col]
            gx, gy = rho * (kx - pz * mx), rho * (ky - pz * my)
        size = stop - start
        col = np.intp(min(max(mx + gx + half, zero), right)) - (mid - start)
        row = rows - 1 - np.intp(min(max(my + gy + half, zero), low))
        near = depth[row, max(min(col, cols - size), 0) :]
        bx, by, tx, ty = xs[start:stop], ys[start:stop], sx[start:stop], sy[start:stop]
        for j in range(size):
            px, py = bx[j] + u0 + du * count[j], by[j] + v0 + dv * count[j]
            rho = flat + slope * near[j]
            tx[j] = min(max(px + rho * (kx - pz * px), zero), right)
            ty[j] = min(max(py + rho * (ky - pz * py), zero), low)
        start = stop


@njit(cache=True, nogil=True, fastmath=True, inline="always")
def _rotated(c: Float32, x: np.float32, y: np.float32) -> tuple[np.float32, np.float32]:
    """Displacement by rotation of the raster place (x, y)."""
    w = np.float32(1.0) / (c[6] * x + c[7] * y + c[8])
    return (c[0] * x + c[1] * y + c[2]) * w - x, (c[3] * x + c[4] * y + c[5]) * w - y


@njit(cache=True, nogil=True, fastmath=True, forceinline=True, error_model="numpy")
def sample_row(raw: NDArray[Any], sx: Float32, sy: Float32, levels: Float32) -> None:
    """Writes (3 W) ``levels`` of (h, w, 3) ``raw``, bottom row first, interpolated at the places
    (sx, sy)."""
    rows, width = raw.shape[0], len(sx)
    stride = 3 * raw.shape[1]
    flat = raw.reshape(rows * stride)
    count, one = np.arange(_BLOCK).astype(np.float32), np.float32(1.0)
    start = 0
    while start < width:
        stop = min(start + _BLOCK, width)
        tx, ty = sx[start:stop], sy[start:stop]
        left, right = tx[0], tx[0]
        upper, lower = ty[0], ty[0]
        for j in range(stop - start):
            x = tx[j] - count[j]
            left, right = min(left, x), max(right, x)
            upper, lower = min(upper, ty[j]), max(lower, ty[j])
        # a block that moves as a whole is one run of the drawing; else each pixel is its own
        whole = right - left < np.float32(_RIGID_PX) and lower - upper < np.float32(_RIGID_PX)
        size = stop - start if whole else 1
        for k in range(0, stop - start, size):
            x = np.float32(0.5) * (left + right) if whole else tx[k]
            y = np.float32(0.5) * (upper + lower) if whole else ty[k]
            col, row = np.int64(x), np.int64(y)
            a, b = x - np.float32(col), y - np.float32(row)
            w, v = (one - a) * (one - b), a * (one - b)
            p, q = (one - a) * b, a * b
            top = np.uintp((rows - 1 - row) * stride + 3 * col)
            low = np.uintp((rows - 2 - row) * stride + 3 * col)
            into, length = np.uintp(3 * (start + k)), np.uintp(3 * size)
            above, under = (
                flat[top : top + length + np.uintp(3)],
                flat[low : low + length + np.uintp(3)],
            )
            target = levels[into : into + length]
            for n in range(length):
                m = n + np.uintp(3)
                target[n] = (
                    w * np.float32(above[n]) + v * np.float32(above[m])
                    + p * np.float32(under[n]) + q * np.float32(under[m])
                )  # fmt: skip
        start = stop
