"""Corners on a deck, followed from image to image: where it is, between scans and below them."""

import cv2
import numpy as np

from touchdown.estimator.deck.filters import DeckFilter
from touchdown.estimator.deck.surfaces import CELL_M
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array, Bytes, Mask

_MOST, _FEW = 80, 40
_SPACING_PX = 10
_QUALITY = 0.02
_WINDOW_PX = (21, 21)
_ERROR = 25.0
"""largest mean difference of grey levels of a corner that was found again"""
_APART_M, _APART = 0.06, 0.02
"""largest distance of a corner from where the others place it, and its part with the range"""
_SIGMA_M, _SIGMA = 0.02, 0.01
"""standard deviation of a place by corners, and its part with the range: half a degree of tilt"""
_SETTLE = 0.1
"""part by which places on the deck follow what scans say of the site"""
_LEAST = 6


class DeckFeatures:
    """Corners with places on the deck: horizontal offsets from its site."""

    def __init__(self, camera: CameraIntrinsics, cells_xy: Array) -> None:
        """``cells_xy`` (N, 2): cells of the deck, from its site."""
        self._camera = camera
        half = int(np.ceil(np.abs(cells_xy).max() / CELL_M)) + 2
        grid = np.zeros((2 * half + 1,) * 2, np.uint8)
        grid[tuple((np.rint(cells_xy / CELL_M).astype(int) + half).T)] = 1
        closed = cv2.morphologyEx(grid, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        self._grid, self._half = cv2.erode(closed, np.ones((3, 3), np.uint8)), half
        self._inner: Array = np.asarray(np.argwhere(self._grid) - half, np.float64) * CELL_M
        self._before: Bytes | None = None
        self._pixels = np.zeros((0, 2), np.float32)
        self._offsets = np.zeros((0, 2))

    def update(self, grey: Bytes, camera_in_odom: Pose, deck: DeckFilter, time_s: float) -> int:
        """Follows the corners into an undistorted grey image of ``time_s`` and tells the filter
        where they place the site. Returns the number of those that agree."""
        agreed = 0
        if self._before is not None and len(self._pixels):
            agreed = self._follow(self._before, grey, camera_in_odom, deck, time_s)
        if len(self._pixels) < _FEW:
            self._find(grey, camera_in_odom, deck, time_s)
        self._before = grey
        return agreed

    def _follow(
        self, before: Bytes, grey: Bytes, pose: Pose, deck: DeckFilter, time_s: float
    ) -> int:
        site, slopes = deck.surface(time_s)
        expected, _ = self._project(self._offsets, pose, site, slopes)
        guess = np.ascontiguousarray(expected, np.float32)
        found, status, error = cv2.calcOpticalFlowPyrLK(
            before, grey, self._pixels, guess, winSize=_WINDOW_PX, maxLevel=3,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )  # fmt: skip
        inside = (found > 2.0).all(1) & (found < np.array(grey.shape[::-1]) - 3.0).all(1)
        good = (status.ravel() == 1) & (error.ravel() < _ERROR) & inside
        pixels, offsets = found[good], self._offsets[good]
        places, meets = self._meet(pixels, pose, site, slopes)
        pixels, offsets, places = pixels[meets], offsets[meets], places[meets]
        self._pixels, self._offsets = pixels, offsets
        if len(places) < _LEAST:
            return 0
        away = float(np.linalg.norm(site - pose.translation))
        told = places[:, :2] - offsets
        middle = np.median(told, axis=0)
        agree = np.linalg.norm(told - middle, axis=1) < _APART_M + _APART * away
        self._pixels, self._offsets = pixels[agree], offsets[agree]
        if agree.sum() < _LEAST:
            return 0
        deck.see_place(time_s, told[agree].mean(axis=0), _SIGMA_M + _SIGMA * away)
        site, _ = deck.surface(time_s)
        self._offsets += _SETTLE * (told[agree].mean(axis=0) - site[:2])
        return int(agree.sum())

    def _find(self, grey: Bytes, pose: Pose, deck: DeckFilter, time_s: float) -> None:
        site, slopes = deck.surface(time_s)
        corners, ahead = self._project(self._inner, pose, site, slopes)
        if ahead.sum() < 3:
            return
        mask = np.zeros_like(grey)
        bounded = np.clip(corners[ahead], -4000.0, 4000.0)
        cv2.fillConvexPoly(mask, cv2.convexHull(bounded.astype(np.int32)), 255)
        for x, y in self._pixels:
            cv2.circle(mask, (int(x), int(y)), _SPACING_PX, 0, -1)
        found = cv2.goodFeaturesToTrack(
            grey, _MOST - len(self._pixels), _QUALITY, _SPACING_PX, mask=mask
        )
        if found is None:
            return
        pixels = np.asarray(found.reshape(-1, 2), np.float64)
        places, meets = self._meet(pixels, pose, site, slopes)
        offsets = places[:, :2] - site[:2]
        kept = meets & self._on_deck(offsets)
        self._pixels = np.concatenate([self._pixels, pixels[kept]]).astype(np.float32)
        self._offsets = np.concatenate([self._offsets, offsets[kept]])

    def _on_deck(self, offsets: Array) -> Mask:
        at = np.rint(offsets / CELL_M).astype(int) + self._half
        within = np.asarray(((at >= 0) & (at < len(self._grid))).all(axis=1))
        at = np.where(within[:, None], at, 0)
        return np.asarray(within & (self._grid[at[:, 0], at[:, 1]] > 0))

    def _project(
        self, offsets: Array, pose: Pose, site: Array, slopes: Array
    ) -> tuple[Array, Mask]:
        """Pixels (N, 2) of places on the deck, and which lie ahead of the camera."""
        points = np.column_stack([site[:2] + offsets, site[2] + offsets @ slopes])
        seen = pose.inverse().apply(points)
        ahead = seen[:, 2] > 0.05
        depth = np.where(ahead, seen[:, 2], 1.0)
        k = self._camera
        return np.column_stack([k.fx * seen[:, 0] / depth + k.cx,
                                k.fy * seen[:, 1] / depth + k.cy]), ahead  # fmt: skip

    def _meet(self, pixels: Array, pose: Pose, site: Array, slopes: Array) -> tuple[Array, Mask]:
        """Points (N, 3) at which the rays of pixels meet the deck's plane, and which do."""
        k = self._camera
        beams = np.column_stack([(pixels[:, 0] - k.cx) / k.fx, (pixels[:, 1] - k.cy) / k.fy,
                                 np.ones(len(pixels))]) @ pose.rotation.T  # fmt: skip
        normal = np.array([-slopes[0], -slopes[1], 1.0])
        across = beams @ normal
        meets = across < -0.05
        way = float(normal @ (site - pose.translation)) / np.where(meets, across, -1.0)
        return pose.translation + way[:, None] * beams, meets & (way > 0.0)
