"""The visual map: keyframes with their landmarks, matched near their predicted pixels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from touchdown.estimator.typing import Array, Bytes, Indices
from touchdown.estimator.zou2024.landmarks import SIFT, Features
from touchdown.estimator.zou2024.pnp import inside_image, project
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose

_TWIN_PX = 6.0
"""candidates closer than this to the best one may be duplicates of it in the map"""
_SIFT_LIMIT = 300.0
_BRISK_LIMIT = 140.0
_RATIO = 0.85


def _descriptor_distances(own: Bytes, other: Bytes, binary: bool) -> Array:
    """Hamming distances (N,) of bit strings (N, D), else squared Euclidean ones."""
    if binary:
        return np.bitwise_count(own ^ other).sum(axis=1, dtype=np.float64)
    return np.square(own.astype(np.float32) - other).sum(axis=1).astype(np.float64)


def match_near(
    kind: int, pixels: Array, descriptors: Bytes, expected: Array, known: Bytes, radius_px: float
) -> Indices:
    """Returns, for each of (F, 2) features, the index of its landmark, or -1.

    ``expected`` (L, 2): predicted pixels of the landmarks with descriptors ``known`` (L, D); only
    those within ``radius_px`` of a feature are compared. A match must be clearly better (by a ratio
    of descriptor distances) than any candidate elsewhere, and each landmark matches once.
    """
    binary, result = kind != SIFT, np.full(len(pixels), -1)
    limit, ratio = (_BRISK_LIMIT, _RATIO) if binary else (_SIFT_LIMIT**2, _RATIO**2)
    if len(expected) == 0 or len(pixels) == 0:
        return result
    near = cKDTree(expected).query_ball_point(pixels, radius_px)
    counts = np.array([len(candidates) for candidates in near])
    feature, landmark = np.repeat(np.arange(len(pixels)), counts), np.concatenate(near).astype(int)
    if len(landmark) == 0:
        return result
    length = _descriptor_distances(descriptors[feature], known[landmark], binary)
    # the nearest of each feature first; of equals that of the first cell of the image
    column, row = ((expected - expected.min(axis=0)) // radius_px)[landmark].T
    order = np.lexsort((landmark, column, row, length, feature))
    feature, landmark, length = feature[order], landmark[order], length[order]
    best = np.flatnonzero(np.diff(feature, prepend=-1))
    own = np.repeat(best, counts[counts > 0])
    apart = np.square(expected[landmark] - expected[landmark[own]]).sum(axis=1) > _TWIN_PX**2
    rivalled = own[apart & (length[own] > ratio * length)]
    sure = np.setdiff1d(best[length[best] <= limit], rivalled)
    sure = sure[np.lexsort((length[sure], landmark[sure]))]
    sure = sure[np.diff(landmark[sure], prepend=-1) > 0]
    result[feature[sure]] = landmark[sure]
    return result


@dataclass(slots=True)
class LandmarkSet:
    """Landmarks of one kind, hosted by the keyframe that saw them first."""

    points: Array
    """(L, 3) m, IMU frame of the keyframe"""
    pixels: Array
    """(L, 2) in the keyframe"""
    descriptors: Bytes
    """(L, D)"""
    depths: Array
    """(L,) m along the optical axis by the LIDAR (Eq. 12)"""


@dataclass(frozen=True, slots=True)
class Sightings:
    """Landmarks of the map found in one image: landmark ``indices[n]`` of kind ``kinds[n]`` hosted
    by keyframe number ``hosts[n]`` at ``pixels[n]``."""

    hosts: Indices
    kinds: Indices
    indices: Indices
    pixels: Array

    def __len__(self) -> int:
        return len(self.hosts)

    def select(self, keep: NDArray[np.generic]) -> Sightings:
        """Returns the subset picked by a mask or an index array (N,)."""
        picked = np.asarray(keep)
        return Sightings(
            self.hosts[picked], self.kinds[picked], self.indices[picked], self.pixels[picked]
        )


def no_sightings() -> Sightings:
    """Returns an empty set."""
    empty = np.zeros(0, dtype=np.int64)
    return Sightings(empty, empty, empty, np.zeros((0, 2)))


def joined(parts: list[Sightings]) -> Sightings:
    """Returns the sightings of all parts, in order."""
    return Sightings(
        np.concatenate([p.hosts for p in parts]), np.concatenate([p.kinds for p in parts]),
        np.concatenate([p.indices for p in parts]), np.concatenate([p.pixels for p in parts]),
    )  # fmt: skip


@dataclass(slots=True)
class MapKeyframe:
    """A keyframe of the map; poses are of the IMU."""

    number: int
    odom_from_imu: Pose
    """pose by the filter, refined by the bundle adjustment while the keyframe is in the window"""
    map_from_imu: Pose
    """pose after loop closures"""
    depth_m: float
    landmarks: tuple[LandmarkSet, LandmarkSet]
    sightings: Sightings = field(default_factory=no_sightings)
    twist: Array = field(default_factory=lambda: np.zeros(6))
    """motion of the IMU: angular rate in its frame, velocity in the odometry frame"""
    calibration: Array = field(default_factory=lambda: np.zeros(0))
    """calibration of the filter when the depths were measured"""


def by_host(
    sightings: Sightings, known: dict[int, MapKeyframe]
) -> Iterator[tuple[Indices, LandmarkSet]]:
    """Yields the sightings (N,) of each host and kind, and the landmarks that they index."""
    for host in np.unique(sightings.hosts).tolist():
        for kind, landmarks in enumerate(known[host].landmarks):
            mine = np.flatnonzero((sightings.hosts == host) & (sightings.kinds == kind))
            if len(mine):
                yield mine, landmarks


class VisualMap:
    """The keyframes, oldest first, and matching against their landmarks."""

    def __init__(self, camera: CameraIntrinsics, imu_from_camera: Pose) -> None:
        self._camera = camera
        self._matrix = camera.matrix()
        self._camera_from_imu = imu_from_camera.inverse()
        self._size = (camera.width, camera.height)
        self.keyframes: list[MapKeyframe] = []

    def by_number(self) -> dict[int, MapKeyframe]:
        """Returns the keyframes by their numbers."""
        return {keyframe.number: keyframe for keyframe in self.keyframes}

    def positions(
        self, sightings: Sightings, frames: dict[int, Pose], sets: dict[int, MapKeyframe]
    ) -> Array:
        """(N, 3) landmark positions in the frame of ``frames``: poses frame_from_imu by keyframe
        number."""
        out = np.zeros((len(sightings), 3))
        for mine, landmarks in by_host(sightings, sets):
            frame = frames[int(sightings.hosts[mine[0]])]
            out[mine] = frame.apply(landmarks.points[sightings.indices[mine]])
        return out

    def expected_pixels(
        self, keyframe: MapKeyframe, kind: int, frame_from_host: Pose, frame_from_imu: Pose
    ) -> tuple[Indices, Array]:
        """Landmarks of one keyframe predicted in view: indices (M,) and pixels (M, 2)."""
        camera_from_host = self._camera_from_imu @ frame_from_imu.inverse() @ frame_from_host
        points = camera_from_host.apply(keyframe.landmarks[kind].points)
        pixels, front = project(points, self._matrix)
        visible = np.flatnonzero(inside_image(pixels, front, self._size, margin=-20.0))
        return visible, pixels[visible]

    def match(
        self,
        features: tuple[Features, Features],
        hosts: list[MapKeyframe],
        frames: dict[int, Pose],
        frame_from_imu: Pose,
        radius_px: float,
    ) -> tuple[Sightings, tuple[Indices, Indices]]:
        """Finds the landmarks of ``hosts`` among the features of an image.

        ``frames``: pose of every host; ``frame_from_imu``: predicted pose of the image, same frame.
        Returns the sightings and, for both kinds, the feature (N,) behind each.
        """
        parts: list[Sightings] = []
        behind: list[Indices] = []
        for kind, found in enumerate(features):
            numbers, indices = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
            expected, known = [np.zeros((0, 2))], [found.descriptors[:0]]
            for host in hosts:
                where, pixels = self.expected_pixels(
                    host, kind, frames[host.number], frame_from_imu
                )
                numbers.append(np.full(len(where), host.number, dtype=np.int64))
                indices.append(where)
                expected.append(pixels)
                known.append(host.landmarks[kind].descriptors[where])
            matched = match_near(
                kind, found.pixels, found.descriptors,
                np.concatenate(expected), np.concatenate(known), radius_px,
            )  # fmt: skip
            good = np.flatnonzero(matched >= 0)
            at = matched[good]
            parts.append(
                Sightings(
                    np.concatenate(numbers)[at],
                    np.full(len(at), kind, dtype=np.int64),
                    np.concatenate(indices)[at],
                    found.pixels[good],
                )
            )
            behind.append(good)
        return joined(parts), (behind[0], behind[1])
