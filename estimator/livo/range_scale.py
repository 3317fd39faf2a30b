"""Scale of the images while the LIDAR is silent: the rangefinder's range against landmarks around.

Images show depths in units of the way since a keyframe: a landmark whose depth is assumed lies
where parallax puts it, and so further off by a tenth if that way is taken for a tenth too long. The
rangefinder measures one depth in metres. Its ratio to the depth of the landmarks around the spot
that the beam meets is therefore a measurement of the length of the way: of the pose now against
that of the keyframe. Relief does not matter, as both see the same roof or crown.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from touchdown.estimator.api import LivoParams
from touchdown.estimator.filtering.error_state import CLONE_DIM, POSITION
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.typing import Array

_MIN_DEPTH_M = 0.5
_MAD = 1.4826
"""standard deviation of normal noise in its median absolute deviation"""


class SeenGround(NamedTuple):
    """Landmarks of assumed depth that the present image shows."""

    keyframe: int
    way: Array  # (3,) m, odometry frame, from the keyframe to the present
    points: Array  # (N, 3) in the present camera frame


def measure_way(eskf: Eskf, seen: list[SeenGround], spot: Array, params: LivoParams) -> bool:
    """Corrects pose and clone of the keyframe with the longest way by the depth of the ``spot``
    (3,), camera frame; False if nothing is near enough or it does not fit (``range_scale_*``)."""
    if spot[2] < _MIN_DEPTH_M:
        return False
    known = [
        (ground, ratios) for ground in seen if len(ratios := _ratios(ground, spot, params)) > 0
    ]
    if not known:
        return False
    (keyframe, way, _), ratios = max(known, key=lambda pair: float(np.linalg.norm(pair[0].way)))
    ratio = float(np.median(ratios))
    scatter = _MAD * float(np.median(np.abs(ratios - ratio)))
    variance = params.range_scale_sigma**2 + scatter * scatter
    touched = eskf.touched([keyframe])
    row = np.zeros(len(touched))
    row[POSITION] = way / (way @ way)
    row[len(row) - CLONE_DIM :][POSITION] = -row[POSITION]
    expected = row @ eskf.prior(touched).spread @ row + variance
    if ratio * ratio > params.range_scale_gate**2 * expected:
        return False
    information = np.outer(row, row) / variance
    eskf.apply(touched, information, row * (ratio / variance), eskf.gains(0.0))
    return True


def _ratios(ground: SeenGround, spot: Array, params: LivoParams) -> Array:
    """Logarithms (N,) of the depth of the spot in that of the landmarks around it; none where they
    are few or the way is short."""
    points = ground.points[ground.points[:, 2] > _MIN_DEPTH_M]
    aside = points[:, :2] / points[:, 2:] - spot[:2] / spot[2]
    near = points[np.hypot(aside[:, 0], aside[:, 1]) < params.range_scale_radius]
    least_m = params.range_scale_way * float(spot[2])
    if len(near) < params.range_scale_landmarks or float(np.linalg.norm(ground.way)) < least_m:
        return np.zeros(0)
    ratios: Array = np.log(spot[2] / near[:, 2])
    return ratios
