"""Camera images of the survey, and ground patches extracted from them.

The classifier is trained on patches of camera images and gets the same in flight, not the coloured
map, whose cells are far coarser. A patch is a level square through the ground at a site, along the
axes of the image: this removes tilt and lens distortion and keeps the resolution. Haze that the
images so far show is removed as well. Images at night show nothing but noise, or dim ground under
the vehicle's lamp: the former are not used, the latter are smoothed and brightened to the level of
daylight, which is what the classifier knows.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import Estimate, image_defect, some_pixels
from touchdown.landing.classification.haze import Haze, darkest_light, estimate_haze
from touchdown.sim.api import CameraImage, Observation, SensorRig
from touchdown.sim.frames import Pose, PoseHistory
from touchdown.sim.geometry.lens import project
from touchdown.sim.typing import Array, Image

_TRACK = 128
"""number of kept poses, for the pose of an exposure: at 200 Hz longer than the delay of an image"""
_SPACING = 0.2
"""distance between kept images, relative to their height"""
_SPACING_GROWTH = 1.25
"""growth of the spacing where there are too many images"""
_LOWEST_M = 3.0
_MAX_PX = 480
_SIDE_FACTORS = (1.0, 0.7, 0.5)
"""sides of the patch, relative to the wanted one, that are tried in this order"""
_DIM = 60.0
"""grey level that at most a twentieth of a dim image's pixels exceed"""
_BLOCK_PX = 16
_MIN_STRUCTURE = 2.0
"""scatter of the means of blocks of a dim image, over what independent noise of its pixels gives,
up to which it shows nothing"""
_DAYLIGHT = (110.0 / 255.0) ** 2.2
"""mean linear light of a patch by day"""
_SMOOTHING_PX = 1.0
"""of a dim patch"""
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 100, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111)
"""of kept images: half the memory, with an error of half a level"""
_BLURRED, _SHARP = 0.2, 0.5
"""contrast of the finest structures over that of the next ones: of a picture enlarged more than
four times, and what 98 % of sharp pictures of ground exceed"""
_HEIGHT_WEIGHT = 0.01
"""weight of a metre of height relative to the tangent of the viewing angle"""


@dataclass(frozen=True, slots=True)
class PosedImage:
    """An image with its pose at exposure."""

    rgb: Image
    """pixels, or the bytes of a JPEG file of one dimension"""
    time_s: float
    odom_from_camera: Pose
    height_m: float
    """above the ground of the take-off"""
    pixel_rad: float
    dim: bool = False
    """taken in too little light for the camera"""
    darkest: float = 0.0
    """``landing.classification.haze.darkest_light``; 0 for images that are not kept"""

    @property
    def position(self) -> Array:
        """(3,) of the camera, odom frame."""
        return self.odom_from_camera.translation

    @property
    def ground_odom_m(self) -> float:
        """Height of the ground of the take-off, odom frame."""
        return float(self.position[2]) - self.height_m

    def pixels(self) -> Image:
        """(H, W, 3)"""
        return (
            self.rgb
            if self.rgb.ndim == 3
            else np.asarray(cv2.imdecode(self.rgb, cv2.IMREAD_COLOR), np.uint8)
        )


class SurveyImages:
    """At most ``limit`` images, at least a fifth of their height apart, and the newest image."""

    def __init__(self, rig: SensorRig, limit: int) -> None:
        self._rig = rig
        self._limit = max(limit, 1)
        self._spacing = _SPACING
        start = rig.world_from_body_start.translation[2]
        self._ground_world = float(start) - rig.vehicle.leg_height_m
        self._history = PoseHistory(_TRACK)
        self._kept: list[PosedImage] = []
        self._newest: PosedImage | None = None
        self._newest_s = -np.inf
        """time stamp of the newest usable image"""
        self._pixels: Image = np.zeros(0, np.uint8)
        """sample of its pixels"""
        self.dark = False
        """True where the newest image shows nothing for want of light"""
        self._haze: Haze | None = None
        """of the kept images; None: to be estimated"""

    def __len__(self) -> int:
        return len(self._kept)

    def update(self, obs: Observation, estimate: Estimate) -> None:
        """Takes over the images of a control step; called once a step."""
        self._history.add(estimate.time_s, estimate.odom_from_body)
        if not estimate.healthy:
            return
        for image, dim in self._usable(obs.images):
            pose = self._history.at(image.time_s)
            if pose is None:
                continue
            camera = pose @ self._rig.body_from_camera
            height = float(estimate.world_from_odom.apply(camera.translation)[2])
            kept = PosedImage(
                image.rgb, image.time_s, camera, height - self._ground_world,
                1.0 / self._rig.camera.fx, dim,
            )  # fmt: skip
            self._newest = kept
            low = kept.height_m < _LOWEST_M
            if not low and (not self._kept or self._far_enough(self._kept[-1], kept)):
                self._keep(kept)

    def _usable(self, images: tuple[CameraImage, ...]) -> list[tuple[CameraImage, bool]]:
        """Returns the images without a defect and whether they are dim, none where they are out of
        order: dark and frozen images show no ground, and the pose of swapped ones is unknown."""
        times = [image.time_s for image in images]
        if times != sorted(times):
            return []
        found = []
        for image in images:
            pixels = some_pixels(image.rgb)
            if image.time_s <= self._newest_s or image_defect(pixels, self._pixels):
                continue
            self._newest_s, self._pixels = image.time_s, pixels
            dim = is_dim(pixels)
            self.dark = dim and not shows_structure(image.rgb)
            if not self.dark:
                found.append((image, dim))
        return found

    def _far_enough(self, before: PosedImage, image: PosedImage) -> bool:
        away = image.odom_from_camera.translation - before.odom_from_camera.translation
        return float(np.linalg.norm(away)) >= self._spacing * image.height_m

    def _keep(self, image: PosedImage) -> None:
        """Keeps a compressed copy; above the limit the spacing grows."""
        coded = np.asarray(cv2.imencode(".jpg", image.rgb, _JPEG)[1], np.uint8)
        self._kept.append(replace(image, rgb=coded, darkest=darkest_light(image.rgb)))
        self._haze = None
        while len(self._kept) > self._limit:
            self._spacing *= _SPACING_GROWTH
            kept = self._kept[:1]
            for other in self._kept[1:]:
                if self._far_enough(kept[-1], other):
                    kept.append(other)
            self._kept = kept

    @property
    def haze(self) -> Haze:
        """Haze by the images kept so far."""
        if self._haze is None:
            heights = np.array([kept.height_m for kept in self._kept])
            self._haze = estimate_haze(heights, np.array([kept.darkest for kept in self._kept]))
        return self._haze

    def newest_view(self) -> PosedImage | None:
        """Returns the newest image where it is high enough to show a square of ground."""
        newest = self._newest
        return None if newest is None or newest.height_m < _LOWEST_M else newest

    def shows(self, image: PosedImage, sites_odom: Array, side_m: float) -> NDArray[np.bool_]:
        """Returns the mask of ``sites_odom`` (N, 3) of which the image shows all of the square."""
        corners = _ground_points(image.odom_from_camera, np.zeros(3), side_m, np.array([-0.5, 0.5]))
        points = (sites_odom[:, None, :] + corners.reshape(4, 3)).reshape(-1, 3)
        camera = self._rig.camera
        pixels, ahead = project(camera, image.odom_from_camera.inverse().apply(points))
        limit = np.array([camera.width - 1, camera.height - 1])
        inside = ahead & (pixels >= 0.0).all(axis=-1) & (pixels <= limit).all(axis=-1)
        shown = inside.reshape(-1, 4).all(axis=1)
        return np.asarray(shown & (image.position[2] > sites_odom[:, 2]))

    def patch(
        self, site_odom: Array, side_m: float, pixels: int, since_s: float = -np.inf
    ) -> Image | None:
        """Returns (pixels, pixels, 3) RGB of the level square of ``side_m`` around ``site_odom``
        (3,).

        It is taken from the image since ``since_s`` with the steepest and nearest view. Where no
        image shows all of the square, a smaller one is tried, down to half the side; None where no
        image shows that.
        """
        images = [*self._kept, *([] if self._newest is None else [self._newest])]
        recent = [kept for kept in images if kept.time_s >= since_s]
        for factor in _SIDE_FACTORS:
            best: tuple[float, PosedImage] | None = None
            for kept in recent:
                rank = self._rank(kept, site_odom, factor * side_m)
                if rank is not None and (best is None or rank < best[0]):
                    best = rank, kept
            if best is not None:
                return self.extract(best[1], site_odom, factor * side_m, pixels)
        return None

    def _rank(self, kept: PosedImage, site: Array, side_m: float) -> float | None:
        """Returns the rank of an image, lower is better; None where it does not show all of the
        square."""
        offset = kept.position - site
        if offset[2] < _LOWEST_M or not self.shows(kept, site[None], side_m)[0]:
            return None
        return float(np.hypot(offset[0], offset[1]) / offset[2] + _HEIGHT_WEIGHT * offset[2])

    def extract(self, kept: PosedImage, site: Array, side_m: float, pixels: int) -> Image:
        """Returns (pixels, pixels, 3) RGB of the square around ``site`` (3,) in the image, sampled
        at its own resolution and averaged down."""
        depth = float(kept.odom_from_camera.translation[2] - site[2])
        native = round(side_m * self._rig.camera.fx / depth)
        count = int(np.clip(native, pixels, max(_MAX_PX, pixels)))
        steps = (np.arange(count) + 0.5) / count - 0.5
        points = _ground_points(kept.odom_from_camera, site, side_m, steps)
        where, _ = project(self._rig.camera, kept.odom_from_camera.inverse().apply(points))
        x, y = (np.ascontiguousarray(where[..., axis], np.float32) for axis in (0, 1))
        found = cv2.remap(kept.pixels(), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        if self.haze.extinction > 0.0:
            away = np.linalg.norm(points - kept.odom_from_camera.translation, axis=-1)
            found = self.haze.removed(np.asarray(found, np.uint8), away)
        if count != pixels:
            found = cv2.resize(found, (pixels, pixels), interpolation=cv2.INTER_AREA)
        return brightened(np.asarray(found, np.uint8)) if kept.dim else np.asarray(found, np.uint8)


def sharpness(patch: Image) -> float:
    """Fraction of the fine detail of a sharp picture that a patch (H, W, 3) has, 0 to 1: by the
    contrast below two pixels over that of up to eight. Photographs of ground mostly have all of it;
    enlarged twice, half of them have less than 0.7, four times less than 0.3."""
    grey = patch.mean(axis=2, dtype=np.float32)
    fine, coarse = (cv2.GaussianBlur(grey, (0, 0), sigma) for sigma in (1.0, 4.0))
    ratio = float((grey - fine).std()) / max(float((fine - coarse).std()), 1.0)
    return float(np.clip((ratio - _BLURRED) / (_SHARP - _BLURRED), 0.0, 1.0))


def is_dim(rgb: Image) -> bool:
    """True for an image (H, W, 3), or a sample of its pixels, taken in too little light."""
    return bool(np.count_nonzero(rgb >= _DIM) < 0.05 * rgb.size)


def shows_structure(rgb: Image) -> bool:
    """True where the means of blocks of an image (H, W, 3) scatter more than noise makes them."""
    grey = rgb.mean(axis=2, dtype=np.float32)
    size = (max(grey.shape[1] // _BLOCK_PX, 1), max(grey.shape[0] // _BLOCK_PX, 1))
    blocks = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return float(blocks.std()) * _BLOCK_PX > _MIN_STRUCTURE * float(grey.std())


def brightened(patch: Image) -> Image:
    """Returns a dim patch (H, W, 3), smoothed, at the mean light of a patch by day."""
    smooth = cv2.GaussianBlur(patch, (0, 0), _SMOOTHING_PX)
    linear = (smooth.astype(np.float32) / 255.0) ** 2.2
    linear *= np.float32(_DAYLIGHT / max(float(linear.mean()), 1e-5))
    return np.asarray(np.rint(255.0 * np.minimum(linear, 1.0) ** (1.0 / 2.2)), np.uint8)


def _ground_points(odom_from_camera: Pose, site: Array, side_m: float, steps: Array) -> Array:
    """Returns points (N, N, 3) of the level square around ``site``, rows down and columns to the
    right in the image, at ``steps`` (N,) in [-0.5, 0.5] of its side."""
    right, down = odom_from_camera.rotation[:2, 0], odom_from_camera.rotation[:2, 1]
    right = right / np.linalg.norm(right)
    across = np.array([-right[1], right[0]])
    across = across * np.sign(across @ down)
    col, row = np.meshgrid(side_m * steps, side_m * steps)
    points = np.empty((*col.shape, 3))
    points[..., :2] = site[:2] + col[..., None] * right + row[..., None] * across
    points[..., 2] = site[2]
    return points
