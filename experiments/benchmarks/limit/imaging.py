"""Features of the true surface in the images of a camera along the true path.

The image is divided into cells. In each, one point of the surface is followed for as long as it is
in view, and found again when it comes back at about the distance that it was first seen from.
Points on crowns, which sway, are left out. So is what light and texture do: every cell has a
feature, and so has the ground that the rangefinder measures.
"""

from typing import NamedTuple

import numpy as np

from touchdown.experiments.benchmarks.limit.information import (
    CLOCK,
    CONSTANTS,
    EYE_MOUNT,
    LANDMARK,
    LENS,
    Indices,
    Rows,
    skews,
)
from touchdown.experiments.benchmarks.limit.ranging import Flight, rates_at, tangents, voxel_names
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array

COLUMNS, LINES = 16, 12
"""cells of an image, each with one feature at most"""
PIXEL_SIGMA = 0.3
"""of either coordinate of a feature in one image, assumed"""
_MARGIN_PX = 4.0
_NEAREST_M, _FARTHEST_M = 0.2, 1e3
_SAME = 0.02
_FARTHER = 2.0
"""ratio of distances up to which a feature is found again"""
_MIN_COSINE = 0.1


class Features(NamedTuple):
    """Points of the surface, and when each was seen."""

    points: Array
    """(F, 3) world"""
    normals: Array
    """(F, 3)"""
    state: Indices
    """(N,) of a sighting"""
    feature: Indices
    """(N,)"""


def pixels(lens: CameraIntrinsics, eye: Pose, points: Array) -> tuple[Array, Array]:
    """(N, 2) pixels of an undistorted lens at ``eye`` (world_from_camera), and (N, 3) camera
    coordinates."""
    local = eye.inverse().apply(points)
    depth = np.where(np.abs(local[:, 2:]) > 1e-9, local[:, 2:], 1e-9)
    return local[:, :2] / depth * [lens.fx, lens.fy] + [lens.cx, lens.cy], local


def follow(flight: Flight, lens: CameraIntrinsics, states: int) -> Features:
    """Follows features through the images at all states; one a voxel at most."""
    times: Array = flight.period_s * np.arange(states, dtype=np.float64)
    position, rotation = flight.path.at(times)
    mount = flight.surface.mounts.camera
    points, normals, first = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    names: Indices = np.zeros(0, dtype=np.int64)
    seen: list[tuple[int, Indices]] = []
    for k in range(states):
        eye = Pose(rotation[k], position[k]) @ mount
        visible, cells = _visible(flight, lens, eye, points, first)
        free = np.setdiff1d(np.arange(COLUMNS * LINES), cells)
        down = eye.rotation.T @ (_below(flight, position[k], rotation[k]) - eye.translation)
        new, facing, distance = _new(flight, eye, np.vstack([_middles(lens, free), down]))
        own = voxel_names(new, facing)
        _, fresh = np.unique(own, return_index=True)
        fresh = fresh[~np.isin(own[fresh], names)]
        seen.append((k, np.append(visible, len(points) + np.arange(len(fresh)))))
        points, normals = np.vstack([points, new[fresh]]), np.vstack([normals, facing[fresh]])
        first, names = np.append(first, distance[fresh]), np.append(names, own[fresh])
    counts = [len(which) for _, which in seen]
    feature = np.concatenate([which for _, which in seen])
    return Features(points, normals, np.repeat(np.arange(states), counts), feature)


def _visible(
    flight: Flight, lens: CameraIntrinsics, eye: Pose, points: Array, first: Array
) -> tuple[Indices, Indices]:
    """The features in view, the oldest of each cell, and these cells."""
    none = np.zeros(0, dtype=np.int64)
    if not len(points):
        return none, none
    pixel, local = pixels(lens, eye, points)
    size = np.array([lens.width, lens.height])
    inside = ((pixel > _MARGIN_PX) & (pixel < size - 1.0 - _MARGIN_PX)).all(axis=1)
    inside &= local[:, 2] > _NEAREST_M
    distance = np.linalg.norm(local, axis=1)
    ratio = distance / first
    inside &= (ratio < _FARTHER) & (ratio > 1.0 / _FARTHER)
    k = np.flatnonzero(inside)
    if not k.size:
        return none, none
    towards = (points[k] - eye.translation) / distance[k, None]
    struck = flight.surface.strike(
        flight.surface.seen, np.tile(eye.translation, (len(k), 1)), towards
    )
    k = k[np.abs(struck.distance - distance[k]) < _SAME * distance[k]]
    col, line = (pixel[k] / size * [COLUMNS, LINES]).astype(np.int64).T
    cells, oldest = np.unique(line * COLUMNS + col, return_index=True)
    return k[oldest], cells


def _middles(lens: CameraIntrinsics, cells: Indices) -> Array:
    """(N, 3) directions, camera axes, of the middles of these cells of the image."""
    line, col = np.divmod(cells, COLUMNS)
    u, v = (col + 0.5) / COLUMNS * lens.width, (line + 0.5) / LINES * lens.height
    return np.column_stack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, np.ones(len(u))])


def _below(flight: Flight, position: Array, rotation: Array) -> Array:
    """(3,) where the rangefinder's beam meets the surface, or a point far down."""
    start = position + rotation @ np.array(flight.config.rangefinder.position_body_m)
    surface, down = flight.surface, -rotation[:, 2]
    distance = surface.strike(surface.seen, start[None], down[None]).distance
    return start + np.minimum(distance, _FARTHEST_M) * down


def _new(flight: Flight, eye: Pose, local: Array) -> tuple[Array, Array, Array]:
    """Points, normals and distances of the surface in these directions (N, 3), camera axes."""
    ahead = (local / np.linalg.norm(local, axis=1)[:, None]) @ eye.rotation.T
    surface, origins = flight.surface, np.tile(eye.translation, (len(local), 1))
    struck = surface.strike(surface.seen, origins, ahead)
    good = np.isfinite(struck.distance) & (struck.distance > _NEAREST_M)
    good &= ~((surface.optics.porosity > 0.0) | surface.optics.water)[struck.hits.geom]
    good &= -np.einsum("ni,ni->n", struck.normal, ahead) > _MIN_COSINE
    points = eye.translation + struck.distance[good, None] * ahead[good]
    return points, struck.normal[good], struck.distance[good]


def image_rows(flight: Flight, lens: CameraIntrinsics, features: Features, images: float) -> Rows:
    """Two rows a sighting: pixels to the right and down, of ``images`` images a state."""
    times = flight.period_s * np.arange(features.state.max() + 1)
    position, rotation = flight.path.at(times)
    mount, state = flight.surface.mounts.camera, features.state
    turned = rotation @ mount.rotation
    points = features.points[features.feature]
    arm = points - position[state]
    center = (position + rotation @ mount.translation)[state]
    back = np.swapaxes(turned, 1, 2)[state]
    local = np.einsum("nij,nj->ni", back, points - center)
    shrink = _projection(lens, local)
    pose = np.concatenate([-back, back @ skews(arm)], axis=2)
    frame = np.concatenate([tangents(features.normals), features.normals[:, None]], axis=1)
    landmark = np.zeros((len(state), 3, LANDMARK))
    landmark[:, :, :3] = back @ np.swapaxes(frame, 1, 2)[features.feature]
    constant = np.zeros((len(state), 3, CONSTANTS))
    constant[:, :, EYE_MOUNT] = np.concatenate([skews(local), -np.eye(3) + 0.0 * back], axis=2)
    rates = rates_at(flight.path, times)[state]
    constant[:, :, CLOCK] = np.einsum("nij,nj->ni", pose, rates)[..., None]
    constant = shrink @ constant
    constant[:, :, LENS] = _lens_columns(lens, local)
    count = 2 * len(state)
    return Rows(
        np.repeat(state, 2),
        np.repeat(features.feature, 2),
        (shrink @ pose).reshape(count, 6),
        constant.reshape(count, CONSTANTS),
        (shrink @ landmark).reshape(count, LANDMARK),
        np.full(count, images / PIXEL_SIGMA**2),
        np.ones(count),
    )


def _projection(lens: CameraIntrinsics, local: Array) -> Array:
    """(N, 2, 3) derivative of the pixel by camera coordinates (N, 3)."""
    x, y, z = local.T
    zero = np.zeros_like(x)
    right = np.stack([lens.fx / z, zero, -lens.fx * x / z**2], axis=-1)
    down = np.stack([zero, lens.fy / z, -lens.fy * y / z**2], axis=-1)
    return np.stack([right, down], axis=1)


def _lens_columns(lens: CameraIntrinsics, local: Array) -> Array:
    """(N, 2, 8) derivative of the pixel by principal point, relative focal lengths, k1, k2, p1 and
    p2 (OpenCV's model)."""
    x, y = (local[:, :2] / local[:, 2:]).T
    square, zero, one = x * x + y * y, np.zeros_like(x), np.ones_like(x)
    right = np.stack(
        [one / lens.fx, zero, x, zero, x * square, x * square**2, 2 * x * y, square + 2 * x * x], -1
    )
    down = np.stack(
        [zero, one / lens.fy, zero, y, y * square, y * square**2, square + 2 * y * y, 2 * x * y], -1
    )
    return np.stack([lens.fx * right, lens.fy * down], axis=1)
