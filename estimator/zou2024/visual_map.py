"""The visual map: SIFT and BRISK landmarks of keyframes (paper, section 3.3.2), projected (Eq. 2)
and matched near their predicted pixels.

The paper names SURF as well. OpenCV's wheels are built without it (its patented build flag is off;
``cv2.xfeatures2d.SURF_create`` raises), so that SIFT is the only real-valued descriptor.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array, Bytes, Grey, Indices, Mask

SIFT, BRISK = 0, 1
SIFT_BYTES, BRISK_BYTES = 128, 64


@dataclass(frozen=True, slots=True)
class Features:
    """Landmark features of one kind in one image."""

    pixels: Array
    """(N, 2), full size"""
    descriptors: Bytes
    """(N, 128) SIFT, numbers 0..255; (N, 64) BRISK, bits"""

    def __len__(self) -> int:
        return len(self.pixels)


def spread(
    pixels: Array, responses: Array, size: tuple[int, int], cell_px: int, maximum: int
) -> Indices:
    """Returns indices of up to ``maximum`` of (N, 2) keypoints, the strongest of every cell first,
    then the second of every cell, and so on: evenly spread over the image, and deterministic."""
    if len(pixels) == 0:
        return np.zeros(0, dtype=np.int64)
    columns = -(-size[0] // cell_px)
    cell = (pixels[:, 1] // cell_px).astype(np.int64) * columns
    cell += (pixels[:, 0] // cell_px).astype(np.int64)
    order = np.lexsort((np.arange(len(cell)), -responses, cell))
    starts = np.flatnonzero(np.diff(cell[order], prepend=-1))
    rank = np.arange(len(order)) - np.repeat(starts, np.diff(starts, append=len(order)))
    by_rank = order[np.lexsort((-responses[order], rank))]
    return np.sort(by_rank[:maximum])


class LandmarkDetector:
    """Finds SIFT features of an image and BRISK features, whose threshold follows the texture so
    that its time stays bounded.

    SIFT is given the image at a quarter of its size, which it doubles before it begins (Lowe 2004,
    section 3.3): its finest octave is that of half the size. Given half the size, it takes three
    times as long, and positions are no better."""

    def __init__(self, sift: int, brisk: int, border_px: float = 10.0) -> None:
        self._counts = (sift, brisk)
        self._border = border_px
        # OpenCV's plain doubling shifts features by a quarter of a pixel of what it is given
        self._sift: cv2.Feature2D = cv2.SIFT.create(
            nfeatures=2 * sift, contrastThreshold=0.02, enable_precise_upscale=True
        )
        self._brisk_threshold = 50
        self._brisk = cv2.xfeatures2d.BRISK.create(self._brisk_threshold, 2)

    def __call__(self, grey: Grey) -> tuple[Features, Features]:
        """(SIFT, BRISK) features of a (H, W) uint8 image."""
        quarter = cv2.resize(grey, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
        sift = self._find(SIFT, self._sift, np.asarray(quarter, dtype=np.uint8), 4.0, 64)
        brisk = self._find(BRISK, self._brisk, grey, 1.0, 64)
        return sift, brisk

    def _find(
        self, kind: int, detector: cv2.Feature2D, image: Grey, scale: float, cell_px: int
    ) -> Features:
        maximum, descriptors = self._counts[kind], None
        keypoints: Sequence[cv2.KeyPoint] = ()
        if maximum > 0 and kind == SIFT:
            keypoints, descriptors = detector.detectAndCompute(image, None)
        elif maximum > 0:
            keypoints = detector.detect(image, None)
            self._adapt_threshold(len(keypoints))
        pixels = np.array([k.pt for k in keypoints], dtype=np.float64).reshape(-1, 2)
        # the centre of a pixel of the smaller image lies between those that it covers
        pixels = scale * pixels + 0.5 * (scale - 1.0)
        height, width = round(scale * image.shape[0]), round(scale * image.shape[1])
        inside = (pixels >= self._border).all(axis=1)
        inside &= (pixels <= np.array([width, height]) - 1 - self._border).all(axis=1)
        usable = np.flatnonzero(inside)
        responses = np.array([keypoints[i].response for i in usable.tolist()])
        chosen = usable[spread(pixels[usable], responses, (width, height), cell_px, maximum)]
        if kind == BRISK and len(chosen):
            # most of the keypoints are not wanted, and need no descriptors
            _, descriptors = detector.compute(image, [keypoints[i] for i in chosen.tolist()])
            pixels, chosen = pixels[chosen], np.arange(len(chosen))
        if descriptors is None:
            descriptors = np.zeros((0, SIFT_BYTES if kind == SIFT else BRISK_BYTES))
        return Features(pixels[chosen], np.asarray(descriptors)[chosen].astype(np.uint8))

    def _adapt_threshold(self, found: int) -> None:
        """Aims at 1.7 times the features wanted, of which ten grey levels keep one in e."""
        step = round(10.0 * float(np.log(max(found, 1) / (1.7 * self._counts[BRISK]))))
        step = min(max(step, -16), 16)
        threshold = min(max(self._brisk_threshold + step, 10), 120)
        if threshold != self._brisk_threshold:
            self._brisk_threshold = threshold
            self._brisk.setThreshold(threshold)


NEAREST_DEPTH_M = 0.05


def project(points_camera: Array, matrix: Array) -> tuple[Array, Mask]:
    """Eq. 2: pixels (N, 2) of camera points (N, 3) by the intrinsic matrix K (3, 3), skew included.

    The paper leaves the division by depth implicit (its ``uv`` has a third component 1). Also
    returns the mask (N,) of points in front of the camera; the pixels of the others are
    meaningless.
    """
    depth = points_camera[:, 2]
    front = depth > NEAREST_DEPTH_M
    rays = points_camera / np.where(front, depth, 1.0)[:, None]
    return rays @ matrix[:2].T, front


def inside_image(pixels: Array, front: Mask, size: tuple[int, int], margin: float = 0.0) -> Mask:
    """Mask (N,) of the pixels (N, 2) inside an image of ``size`` (width, height)."""
    u, v = pixels[:, 0], pixels[:, 1]
    inside = front & (u >= margin) & (v >= margin)
    inside &= (u <= size[0] - 1 - margin) & (v <= size[1] - 1 - margin)
    return inside


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

    def select(self, keep: NDArray[np.generic]) -> "Sightings":
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
