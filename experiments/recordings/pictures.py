"""Images of a recording: decoded within limits, and undistorted or rectified where an estimator's
camera model does not reach."""

import dataclasses
import io
import zlib
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.recordings.contract import Lens
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.files.opening import check_file
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Bytes

_MAX_PIXELS = 1 << 26
_MAX_BYTES = 1 << 28
_SAME = 1e-6


def decoded(data: bytes) -> Bytes:
    """(H, W, 3) RGB of the bytes of a PNG or a JPEG. Raises ValueError for anything else."""
    from PIL.JpegImagePlugin import JpegImageFile
    from PIL.PngImagePlugin import PngImageFile

    kind = PngImageFile if data[:4] == b"\x89PNG" else JpegImageFile
    try:
        with kind(io.BytesIO(data)) as image:
            if image.width * image.height > _MAX_PIXELS:
                raise ValueError(f"more than {_MAX_PIXELS} pixels")
            return np.array(image.convert("RGB"))
    except (OSError, SyntaxError, ValueError, zlib.error) as error:
        raise ValueError(f"an image cannot be decoded ({error})") from None


def read_image(path: Path) -> Bytes:
    """(H, W, 3) RGB of a PNG or JPEG file. Raises ValueError, one line."""
    try:
        check_file(path, "image", _MAX_BYTES)
        return decoded(path.read_bytes())
    except (OSError, ValueError) as error:
        raise ValueError(f"'{path}': {error}") from None


Maps = tuple[NDArray[np.int16], NDArray[np.uint16]]


class Optics(NamedTuple):
    """One camera or an ideal pair as estimators take it, and how images become its images."""

    camera: CameraIntrinsics
    body_from_camera: Pose
    body_from_right: Pose
    maps: tuple[Maps | None, Maps | None]
    """of the left and the right image; None: as they are"""

    def apply(self, rgb: Bytes, right: bool) -> Bytes:
        """The image (H, W, 3) of the camera as estimators take it."""
        maps = self.maps[right]
        if maps is None:
            return rgb
        return np.asarray(cv2.remap(rgb, *maps, cv2.INTER_LINEAR), np.uint8)


def optics_of(left: Lens, right: Lens | None) -> Optics:
    """The optics of one lens, or of a pair, which is rectified unless it is so already. Raises
    ValueError."""
    if right is None:
        mount = left.body_from_camera
        return Optics(left.intrinsics, mount, mount, (None, None))
    one, two = left.intrinsics, right.intrinsics
    if (one.width, one.height) != (two.width, two.height):
        raise ValueError("the two cameras have images of different sizes")
    right_from_left = right.body_from_camera.inverse() @ left.body_from_camera
    shift = right_from_left.translation
    if abs(shift[0]) < abs(shift[1]) or shift[0] >= 0.0:
        raise ValueError("the right camera is not right of the left one")
    turned = float(np.abs(right_from_left.rotation - np.eye(3)).max())
    if turned < _SAME and np.abs(shift[1:]).max() < _SAME and _same_lens(left, right):
        return Optics(one, left.body_from_camera, right.body_from_camera, (None, None))
    turns = cv2.stereoRectify(
        one.matrix(), np.zeros(5), two.matrix(), np.zeros(5), (one.width, one.height),
        right_from_left.rotation, shift.reshape(3, 1), flags=cv2.CALIB_ZERO_DISPARITY, alpha=0,
    )  # fmt: skip
    new_left, new_right, matrix = (np.asarray(turn, np.float64)[:, :3] for turn in turns[:3])
    camera = _ideal(one, matrix)
    body_from_left = Pose(
        left.body_from_camera.rotation @ new_left.T, left.body_from_camera.translation
    )
    baseline = Pose(np.eye(3), np.array([float(np.linalg.norm(shift)), 0.0, 0.0]))
    both = _maps(left, new_left, matrix), _maps(right, new_right, matrix)
    return Optics(camera, body_from_left, body_from_left @ baseline, both)


def _ideal(camera: CameraIntrinsics, matrix: NDArray[np.float64]) -> CameraIntrinsics:
    return dataclasses.replace(
        camera, fx=float(matrix[0, 0]), fy=float(matrix[1, 1]), cx=float(matrix[0, 2]),
        cy=float(matrix[1, 2]), distortion=np.zeros(5), lens="pinhole",
    )  # fmt: skip


def _same_lens(left: Lens, right: Lens) -> bool:
    one, two = left.intrinsics, right.intrinsics
    same = np.allclose(one.matrix(), two.matrix(), atol=_SAME, rtol=0.0)
    return same and one.lens == two.lens and np.array_equal(one.distortion, two.distortion)


def _maps(lens: Lens, turn: NDArray[np.float64], matrix: NDArray[np.float64]) -> Maps:
    camera, size = lens.intrinsics, (lens.intrinsics.width, lens.intrinsics.height)
    if camera.lens == "fisheye":
        found = cv2.fisheye.initUndistortRectifyMap(
            camera.matrix(), camera.distortion[:4], turn, matrix, size, cv2.CV_16SC2
        )
    else:
        found = cv2.initUndistortRectifyMap(
            camera.matrix(), camera.distortion, turn, matrix, size, cv2.CV_16SC2
        )
    return np.asarray(found[0], np.int16), np.asarray(found[1], np.uint16)
