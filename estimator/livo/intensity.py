"""Photometric update of the filter by the intensities of one scan, against images of intensity from
above, one for each clone of the filter.

A pulse's intensity is a property of the place that it hits, calibrated by the sensor to
reflectivity, so that returns of many scans form an orthographic image of the ground: without
perspective, shadows or darkness. An image lies in the horizontal plane of its clone and moves with
it. Values are logarithms: texture scales the reflectivity of what it is on.

Over ground whose shape does not show sideways motion, its reflectivity still does: the returns of a
scan are compared with the images of a few clones, and the images' gradients turn differences of
brightness into shifts (COIN-LIO, Pfreundschuh et al., ICRA 2024, which projects onto the sensor's
sphere; from above, an orthographic image needs no projection and knows no occlusion). The variance
of a difference is measured from the scan's own residuals, and what the noise of an image adds to
its gradients is taken off the information.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit

from touchdown.estimator.filtering.anchors import (
    ANCHORED_DIM,
    CLONE_AT,
    MOUNT_AT,
    Sight,
    derivatives_into,
)
from touchdown.estimator.filtering.deskew import PlacedScan
from touchdown.estimator.filtering.error_state import (
    CLONE_DIM,
    MOUNT_DIM,
    MOUNT_ROTATION,
    MOUNT_TRANSLATION,
    POSE_DIM,
    POSITION,
    ROTATION,
    Frame,
)
from touchdown.estimator.filtering.eskf import Eskf, IteratedUpdate, limit_information
from touchdown.estimator.filtering.vectors import ZERO, along, cross, dot, turned, turned_back, xyz
from touchdown.estimator.livo.scan_update import Returns, ScanErrors
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array, Bytes, Float32

SIDE = 384
"""cells of a row"""
_CELL_FRACTION = 0.006
"""side of a cell relative to the height: a few returns of a second fall into each"""
_MIN_CELL_M = 0.02
_FAINTEST = 4.0
"""weaker intensities count as this: the logarithm of single digits is mostly rounding"""
_MAX_RETURNS = 8
"""a cell takes no further ones: the oldest carry the least drift"""
_BRIGHTNESS = np.log(np.maximum(np.arange(256.0), _FAINTEST))
_WEIGHTS = np.array([0.25, 0.5, 0.25])
MIN = 1.5
"""returns that a smoothed cell needs (weighted mean over its neighbourhood)"""


def brightness(intensity: Bytes) -> Array:
    """Returns the logarithm of intensities (N,)."""
    return _BRIGHTNESS[intensity]


@njit(cache=True, error_model="numpy")
def add_returns(
    sums: Float32, counts: Bytes, points: Array, values: Array, axes: Array, centre: Array
) -> None:
    """Adds returns to an image (rows, columns): ``points`` (N, 3), ``axes`` (2, 3) of the image in
    their frame, a cell long, and its ``centre`` (2,) in cells from their origin. Returns beside the
    image are left out."""
    rows, columns = sums.shape
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        u = axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z + centre[0]
        v = axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z + centre[1]
        column, row = int(np.floor(u)) + columns // 2, int(np.floor(v)) + rows // 2
        if 0 <= row < rows and 0 <= column < columns and counts[row, column] < _MAX_RETURNS:
            sums[row, column] += values[i]
            counts[row, column] += 1


@dataclass(eq=False)
class IntensityImage:
    """The image of one clone."""

    axes: Array
    """(2, 3) horizontal axes of the image in the clone's IMU frame"""
    cell_m: float
    calibration: Array
    """(C,) shared calibration that its returns were placed with"""
    sums: Float32
    counts: Bytes
    _smoothed: tuple[Float32, Float32] | None = None

    @staticmethod
    def of(rotation: Array, height_m: float, calibration: Array) -> "IntensityImage":
        """An empty image of a clone, with ``rotation`` odom_from_imu, ``height_m`` above the
        ground."""
        sums, counts = (np.zeros((SIDE, SIDE), dtype) for dtype in (np.float32, np.uint8))
        cell = max(_CELL_FRACTION * height_m, _MIN_CELL_M)
        return IntensityImage(rotation[:2].copy(), cell, calibration.copy(), sums, counts)

    def add(self, points: Array, values: Array, pose: Pose | None = None) -> None:
        """Adds ``points`` (N, 3) of the brightness ``values`` (N,); ``pose`` moves them to the
        clone's frame."""
        pose = pose or Pose.identity()
        scaled = self.axes / self.cell_m
        add_returns(
            self.sums, self.counts, points, values, scaled @ pose.rotation,
            scaled @ pose.translation,
        )  # fmt: skip
        self._smoothed = None

    def smoothed(self) -> tuple[Float32, Float32]:
        """Mean and number of returns (SIDE, SIDE) of each cell and its neighbours, weighted 1, 2, 1
        along either axis; mean 0 where there is none."""
        if self._smoothed is None:
            sums, weights = (
                np.asarray(cv2.sepFilter2D(layer, cv2.CV_32F, _WEIGHTS, _WEIGHTS), np.float32)
                for layer in (self.sums, self.counts)
            )
            means = np.divide(sums, weights, out=np.zeros_like(sums), where=weights > 0.0)
            self._smoothed = means, weights
        return self._smoothed

    def fraction_known(self, points: Array) -> float:
        """Fraction of ``points`` (N, 3), the clone's frame, that lie on known cells."""
        at = np.floor(points @ self.axes.T / self.cell_m).astype(np.int64) + SIDE // 2
        inside = ((at >= 0) & (at < SIDE)).all(axis=1)
        known = self.counts[at[inside, 1], at[inside, 0]] > 0
        return float(known.sum()) / max(len(points), 1)


_ASIDE = slice(POSITION.start, POSITION.start + 2)
"""x and y of a pose"""
_RETURNS = 4000
"""returns of a scan that are compared with images"""
_HEIGHT = POSITION.stop - 1
_PLANE_TILT = float(np.radians(0.05))
"""rad, information floor of roll and pitch by planes where intensities measure"""
_PLANE_ASIDE_M = 0.02
"""of horizontal position, likewise: chosen with the other floors on surveys without images"""
_ITERATIONS = 4
_MIN_USED = 300
_MIN_OVERLAP, _MAX_IMAGES = 0.12, 5
"""fraction of a scan that an image covers, and number of images; by 21 replays without images"""
_MIN_CLEAR = 0.3
"""fraction of an image's squared gradients that is not noise; below, it has no texture"""
_FIRST_SIGMA, _MIN_SIGMA, _MAX_SIGMA = 0.25, 0.1, 0.3
"""errors of a brightness: the first, the least, the most; an image that fits worse shows something
else, as water does, whose brightness depends on where it is seen from"""
_ASIDE_M, _ROTATION_RAD = 0.03, 5e-4
"""errors of a measurement that do not average out over its returns: the noise of an image is the
same for all scans compared with it"""
_IMAGE_ASIDE_M, _IMAGE_ROTATION_RAD = 0.05, 5e-4
"""errors of an image as a whole: the drift while it was made"""
_GRADIENT_NOISE = 0.094
"""variance of a gradient by noise, in that of one return over their number and the cell's area: two
neighbours of an image smoothed by 1, 2, 1"""


class Photometry(NamedTuple):
    """Sums over the returns on one image. Error order: present pose, mount (rotation,
    translation), the clone: 18 coordinates."""

    information: Array
    vector: Array
    used: int
    spread: float  # robust standard deviation of the residuals
    noise_fraction: float  # of the squared gradients


class ImageView(NamedTuple):
    """An intensity image and its clone, as the kernel takes them."""

    means: Float32
    weights: Float32
    axes: Array  # (2, 3) of the image in the clone's frame
    cell: float
    clone_rotation: Array  # odom_from_clone
    mount_turn: Array  # (3,) rad, mount now less that when the image was made
    mount_shift: Array  # (3,) m


@njit(cache=True, error_model="numpy")
def photometry(
    returns: Returns,
    values: Array,
    image: ImageView,
    clone_from_imu: Frame,
    lever: Array,
    sigma: float,
) -> Photometry:
    """Returns the normal equations of the brightness (``values``) of N returns on one image.

    ``lever`` (3,): the LIDAR in the IMU frame; ``sigma``: of a residual. Cauchy weights. The mean
    of the residuals, the scan's own brightness, is marginalised.

    All returns turn as if at their mean height: by their differences in height, tilt would be told
    from a shift, but over plants that turns the vehicle.
    """
    points, beams = returns
    means, weights, axes, cell, clone_rotation, w, shift = image
    rotation, translation = clone_from_imu
    rows, columns = means.shape
    information, vector = np.zeros((ANCHORED_DIM, ANCHORED_DIM)), np.zeros(ANCHORED_DIM)
    mean_row, row = np.zeros(ANCHORED_DIM), np.zeros(ANCHORED_DIM)
    total_weight, mean_residual = 0.0, 0.0
    across, down = xyz(axes[0]), xyz(axes[1])
    up, up_now = xyz(clone_rotation[2]), turned_back(rotation, xyz(clone_rotation[2]))
    level = 0.0  # mean height of the returns above the IMU, m
    for i in range(points.shape[0]):
        for a in range(3):
            level += up_now[a] * points[i, a] / points.shape[0]
    squares, noise, absolute = 0.0, 0.0, 0.0
    used = 0
    for i in range(points.shape[0]):
        p, beam = xyz(points[i]), xyz(beams[i])
        q = along(turned(rotation, p), 1.0, xyz(translation))
        seen = along(q, -1.0, xyz(lever))
        moved = along(q, -1.0, along(cross(xyz(w), seen), 1.0, xyz(shift)))
        u, v = dot(across, moved), dot(down, moved)
        u, v = u / cell + 0.5 * columns - 0.5, v / cell + 0.5 * rows - 0.5
        c, r = int(np.floor(u)), int(np.floor(v))
        if c < 1 or r < 1 or c >= columns - 2 or r >= rows - 2:
            continue
        n = min(
            min(weights[r, c], weights[r, c + 1]), min(weights[r + 1, c], weights[r + 1, c + 1])
        )
        if n < MIN:
            continue
        fu, fv = u - c, v - r
        low = means[r, c] + fu * (means[r, c + 1] - means[r, c])
        high = means[r + 1, c] + fu * (means[r + 1, c + 1] - means[r + 1, c])
        below, above = means[r, c + 1] - means[r, c], means[r + 1, c + 1] - means[r + 1, c]
        gu = (below + fv * (above - below)) / cell
        gv = (high - low) / cell
        residual = values[i] - (low + fv * (high - low))
        scaled = residual / sigma
        weight = 1.0 / ((1.0 + 0.25 * scaled * scaled) * sigma * sigma)
        absolute += abs(residual)
        slope = along(along(ZERO, gu, across), gv, down)
        in_odom, in_imu = turned(clone_rotation, slope), turned_back(rotation, slope)
        lift = dot(up_now, p) - level
        arm, reach = along(seen, -lift, up), along(q, -lift, up)
        sight = Sight(along(p, -lift, up_now), along(beam, -lift, up_now), arm, reach)
        derivatives_into(row, in_odom, in_imu, slope, sight, False)
        for a in range(ANCHORED_DIM):
            vector[a] += weight * row[a] * residual
            mean_row[a] += weight * row[a]
            for b in range(a + 1):
                information[a, b] += weight * row[a] * row[b]
        total_weight += weight
        mean_residual += weight * residual
        squares += weight * (gu * gu + gv * gv)
        noise += weight * 2.0 * _GRADIENT_NOISE / (n * cell * cell)
        used += 1
    if used == 0:
        return Photometry(information, vector, 0, sigma, 1.0)
    for a in range(ANCHORED_DIM):
        vector[a] -= mean_row[a] * mean_residual / total_weight
        for b in range(a + 1):
            information[a, b] -= mean_row[a] * mean_row[b] / total_weight
            information[b, a] = information[a, b]
    spread = 1.2533 * absolute / used
    noise *= spread * spread
    return Photometry(information, vector, used, spread, noise / max(squares, 1e-12))


class PhotometricUpdate:
    """Images of all clones and the update by a scan; image k is of clone k."""

    def __init__(
        self, lever: Array, dark_ticks: int | None = 0, plane_height_m: float = 0.05
    ) -> None:
        """``lever`` (3,): the LIDAR in the IMU frame; ``dark_ticks``: scans measure only when for
        longer than this no image has; None: never, and no images are made. ``plane_height_m``:
        least information floor of the height by planes where intensities measure."""
        self._lever = lever
        self._dark_ticks, self._plane_height_m = dark_ticks, plane_height_m
        self._sigma = _FIRST_SIGMA
        self.images: list[IntensityImage] = []

    def measures(self, dark_ticks: int) -> bool:
        """True where scans measure the pose by their intensities, ``dark_ticks`` after an image."""
        return self._dark_ticks is not None and dark_ticks > self._dark_ticks

    def errors_of_planes(self, errors: ScanErrors, dark_ticks: int) -> ScanErrors:
        """Error model of the planes after ``dark_ticks`` without an image: intensities see the
        ground, at which tilt and translation look the same, so that planes must separate them,
        and nothing else measures walls better.
        A scan measures the height with ``plane_height_m`` at best."""
        if not self.measures(dark_ticks):
            return errors
        floor = errors.floor_sigmas.copy()
        floor[:2] = np.minimum(floor[:2], _PLANE_TILT)
        floor[_ASIDE] = np.minimum(floor[_ASIDE], _PLANE_ASIDE_M)
        floor[_HEIGHT] = max(floor[_HEIGHT], self._plane_height_m)
        return replace(errors, floor_sigmas=floor)

    def begin(self, eskf: Eskf, height_m: float, dark_ticks: int) -> None:
        """Starts an image of the newest clone. Where intensities alone hold the position, the clone
        gets the error of an image as a whole."""
        if self._dark_ticks is None:
            return
        shared = eskf.state.calibration[: eskf.shared]
        self.images.append(IntensityImage.of(eskf.clones[-1].rotation, height_m, shared))
        if self.measures(dark_ticks):
            at = eskf.clone_indices(len(eskf.clones) - 1)
            yaw, aside = at[ROTATION][2], at[_ASIDE]
            eskf.covariance[yaw, yaw] += _IMAGE_ROTATION_RAD**2
            eskf.covariance[aside, aside] += _IMAGE_ASIDE_M**2

    def drop(self, k: int) -> None:
        """Forgets the image of clone ``k``."""
        if self.images:
            del self.images[k]

    def extend(self, eskf: Eskf, points: Array, intensity: Bytes) -> None:
        """Adds the returns of the scan just used, ``points`` (N, 3) in the IMU frame, to the newest
        image."""
        if self.images:
            move = eskf.clones[-1].inverse() @ eskf.state.pose
            self.images[-1].add(points, brightness(intensity), move)

    def measure(
        self,
        eskf: Eskf,
        scan: PlacedScan,
        intensity: Bytes,
        dark_ticks: int,
        fraction: float = 1.0,
    ) -> dict[str, float]:
        """Iterated update by a scan and its ``intensity`` (N,) after ``dark_ticks`` without an
        image; returns the figures for the recording. Nothing is changed where too few returns lie
        on images with texture. ``fraction``: see ``Eskf.gains``."""
        if not self.measures(dark_ticks):
            return {}
        chosen = np.arange(0, len(scan), max(1, len(scan) // _RETURNS))
        part, values = scan.select(chosen), brightness(intensity[chosen])
        keys = self.choose(eskf, part.points)
        if not keys:
            return _figures()
        update, sigmas = IteratedUpdate(eskf, fraction), np.full(len(keys), self._sigma)
        floor = np.array([*[_ROTATION_RAD] * 3, _ASIDE_M, _ASIDE_M, 0.0])
        floors = np.concatenate([floor, np.zeros(eskf.shared + CLONE_DIM * len(keys))])
        for _ in range(_ITERATIONS):
            information, vector, used, images = self._accumulate(
                eskf, keys, Returns(part.points, part.beams), values, sigmas
            )
            sigma = float(sigmas.min())
            if used < _MIN_USED:
                update.abandon()
                return _figures(used, images, sigma)
            update.step(keys, information, vector, floors)
        self._sigma = sigma
        update.finish()
        limited = limit_information(eskf.coupled(information, vector)[0], np.diag(floors**2))
        weakest = float(np.linalg.eigvalsh(limited[_ASIDE, _ASIDE])[0])
        return _figures(used, images, sigma, 1.0 / float(np.sqrt(max(weakest, 1e-12))))

    def choose(self, eskf: Eskf, points: Array) -> list[int]:
        """Images to compare ``points`` (N, 3), IMU frame, with: the newest that covers them, then
        those best known, ascending."""
        overlaps: list[tuple[int, float]] = []
        for k, (clone, image) in enumerate(zip(eskf.clones, self.images, strict=True)):
            move = clone.inverse() @ eskf.state.pose
            far = float(np.hypot(*(image.axes @ move.translation)))
            if far > 0.5 * image.cell_m * image.sums.shape[0]:
                continue
            fraction = image.fraction_known(move.apply(points[::8]))
            if fraction >= _MIN_OVERLAP:
                overlaps.append((k, fraction))
        if len(overlaps) <= _MAX_IMAGES:
            return [k for k, _ in overlaps]
        newest = overlaps.pop()[0]
        variances = np.diag(eskf.covariance)

        def worth(entry: tuple[int, float]) -> float:
            k, fraction = entry
            return float(variances[eskf.clone_indices(k)[_ASIDE]].sum()) / fraction

        best = sorted(overlaps, key=worth)[: _MAX_IMAGES - 1]
        return sorted([newest, *(k for k, _ in best)])

    def _accumulate(
        self, eskf: Eskf, keys: list[int], returns: Returns, values: Array, sigmas: Array
    ) -> tuple[Array, Array, int, int]:
        """Sums over all images; ``sigmas`` (K,) become those of the residuals on each: an image
        that does not fit counts little."""
        shared = eskf.shared
        size = POSE_DIM + shared + CLONE_DIM * len(keys)
        information, vector = np.zeros((size, size)), np.zeros(size)
        used, images = 0, 0
        calibration = eskf.state.calibration[:shared]
        for slot, k in enumerate(keys):
            image, clone = self.images[k], eskf.clones[k]
            move = clone.inverse() @ eskf.state.pose
            change = np.zeros(MOUNT_DIM)
            if shared:
                change = (calibration - image.calibration)[:MOUNT_DIM]
            view = ImageView(
                *image.smoothed(), image.axes, image.cell_m, clone.rotation,
                change[MOUNT_ROTATION], change[MOUNT_TRANSLATION],
            )  # fmt: skip
            part = photometry(
                returns, values, view, Frame.of(move), self._lever, float(sigmas[slot])
            )
            if part.used:
                sigmas[slot] = max(part.spread, _MIN_SIGMA)
            clear = 1.0 - part.noise_fraction
            unlike = part.spread > _MAX_SIGMA
            if part.used < _MIN_USED or clear < _MIN_CLEAR or unlike:
                continue
            start = POSE_DIM + shared + CLONE_DIM * slot
            where = np.r_[0:POSE_DIM, start : start + CLONE_DIM]
            own = np.r_[0:POSE_DIM, CLONE_AT:ANCHORED_DIM]
            if shared:
                where = np.r_[where, POSE_DIM : POSE_DIM + MOUNT_DIM]
                own = np.r_[own, MOUNT_AT:CLONE_AT]
            # the noise of the gradients adds to the squares, not to the vector
            information[np.ix_(where, where)] += clear * part.information[np.ix_(own, own)]
            vector[where] += part.vector[own]
            used += part.used
            images += 1
        return information, vector, used, images


def _figures(
    used: int = 0, images: int = 0, sigma: float = 0.0, aside_m: float = 0.0
) -> dict[str, float]:
    """Figures of an update, by the name of their plot; ``aside_m``: standard deviation of the
    weaker horizontal direction by this scan alone."""
    return {
        "intensity_used": float(used), "intensity_images": float(images),
        "intensity_sigma": sigma, "intensity_aside_m": aside_m,
    }  # fmt: skip
