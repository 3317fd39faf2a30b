"""Margins around maps: ticks in metres, take-off point, survey area and colour keys.

Drawn by OpenCV, not by matplotlib: a cell stays a whole number of pixels, and a flight need not
load matplotlib. Pixels of the map itself change only under the requested marks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.landing.api import SurveyParams

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
"""(H, W, 3) RGB"""

INK, PAPER = (235, 235, 235), 24
_MARK_RGB, _RIM_RGB = (255, 255, 255), (20, 20, 20)
_TICKS = 17
"""Greatest number of ticks on the longer edge."""
_DASH_PIXELS = 9


@dataclass(frozen=True, kw_only=True, slots=True)
class Marks:
    """Take-off and survey of a flight on a map, world frame."""

    takeoff_xy_m: Array
    """(2,)"""
    yaw: float
    """heading of the take-off, rad"""
    corners_xy_m: Array
    """(4, 2) of the rectangle of the survey's legs"""


def survey_marks(takeoff_xy_m: Array, yaw: float, survey: SurveyParams) -> Marks:
    """Marks of a survey whose legs run along the heading from the take-off point, each next leg to
    the left."""
    length, width = survey.leg_length_m, (survey.legs - 1) * survey.leg_spacing_m
    local = np.array([[0.0, 0.0], [length, 0.0], [length, width], [0.0, width]])
    c, s = np.cos(yaw), np.sin(yaw)
    corners = local @ np.array([[c, s], [-s, c]]) + takeoff_xy_m
    return Marks(takeoff_xy_m=takeoff_xy_m, yaw=yaw, corners_xy_m=corners)


@dataclass(frozen=True, kw_only=True, slots=True)
class MapFrame:
    """Position and scale of the pixels of a map with north up."""

    west_m: float
    south_m: float
    pixels_per_m: float
    scale: float = 1.0
    """factor of letters and lines"""

    def draw_marks(self, image: Image, marks: Marks) -> None:
        """Writes take-off point, heading and the survey's rectangle into ``image``."""
        corners = [self._pixel(image, corner) for corner in marks.corners_xy_m]
        for start, end in zip(corners, [*corners[1:], corners[0]], strict=True):
            self._dashed(image, start, end)
        ahead = np.array([np.cos(marks.yaw), -np.sin(marks.yaw)])
        centre = self._pixel(image, marks.takeoff_xy_m)
        radius, width = round(7 * self.scale), max(1, round(self.scale))
        tip = centre + 2.4 * radius * ahead
        for colour, line in ((_RIM_RGB, width + 2), (_MARK_RGB, width)):
            cv2.line(image, _whole(centre), _whole(tip), colour, line, cv2.LINE_AA)
            cv2.circle(image, _whole(centre), radius, colour, line, cv2.LINE_AA)

    def around(self, panels: Sequence[Image], text: str) -> Image:
        """Returns maps of the same ground side by side, with ticks on the left and below, and
        ``text`` under these."""
        height, gap = panels[0].shape[0], round(14 * self.scale)
        spacer = np.full((height, gap, 3), PAPER, np.uint8)
        row = [self._left_edge(height)]
        for panel in panels:
            row += [panel, spacer]
        top = np.hstack(row)
        below = np.full((round(58 * self.scale), top.shape[1], 3), PAPER, np.uint8)
        left = row[0].shape[1]
        for panel in panels:
            self._lower_edge(below, left, panel.shape[1])
            left += panel.shape[1] + gap
        self.write(below, text, row[0].shape[1], round(48 * self.scale))
        above = np.full((gap, top.shape[1], 3), PAPER, np.uint8)
        return np.vstack([above, top, below])

    def below(self, framed: Image, strip: Image) -> Image:
        """Adds a key of the map's width under a framed map."""
        left = self._margin
        wide = np.full((strip.shape[0], framed.shape[1], 3), PAPER, np.uint8)
        wide[:, left : left + strip.shape[1]] = strip[:, : wide.shape[1] - left]
        return np.vstack([framed, wide])

    def write(self, image: Image, text: str, left: int, base: int) -> int:
        """Writes into the image and returns the column at the end of the text."""
        return write_text(image, text, left, base, 0.5 * self.scale)

    @property
    def _margin(self) -> int:
        return round(54 * self.scale)

    def _pixel(self, image: Image, xy_m: Array) -> Array:
        across, up = (xy_m - [self.west_m, self.south_m]) * self.pixels_per_m
        return np.array([across, image.shape[0] - up])

    def _dashed(self, image: Image, start: Array, end: Array) -> None:
        dash = _DASH_PIXELS * self.scale
        length = float(np.linalg.norm(end - start))
        width = max(1, round(self.scale))
        for at in np.arange(0.0, length, 1.8 * dash):
            a, b = (start + (end - start) * min(t / length, 1.0) for t in (at, at + dash))
            for colour, line in ((_RIM_RGB, width + 2), (_MARK_RGB, width)):
                cv2.line(image, _whole(a), _whole(b), colour, line, cv2.LINE_AA)

    def _ticks(self, start_m: float, pixels: int) -> list[tuple[float, int]]:
        """(metres, pixels from the start) along an edge."""
        step = tick_step(pixels / self.pixels_per_m)
        first = np.ceil(start_m / step - 1e-9) * step
        metres = np.arange(first, start_m + pixels / self.pixels_per_m + 1e-9, step)
        return [(float(m), round((m - start_m) * self.pixels_per_m)) for m in metres]

    def _left_edge(self, height: int) -> Image:
        edge = np.full((height, self._margin, 3), PAPER, np.uint8)
        line, font = max(1, round(self.scale)), 0.45 * self.scale
        for metres, up in self._ticks(self.south_m, height):
            row = min(height - 1, height - up)
            edge[max(row - line + 1, 0) : row + 1, -round(6 * self.scale) :] = INK
            label = f"{metres + 0.0:g}"
            (wide, tall), _ = cv2.getTextSize(label, cv2.FONT_HERSHEY_SIMPLEX, font, line)
            base = min(max(row + tall // 2, tall), height - 1)
            write_text(edge, label, self._margin - round(10 * self.scale) - wide, base, font)
        return edge

    def _lower_edge(self, strip: Image, left: int, width: int) -> None:
        line, font = max(1, round(self.scale)), 0.45 * self.scale
        for metres, across in self._ticks(self.west_m, width):
            col = left + min(across, width - 1)
            strip[: round(6 * self.scale), max(col - line + 1, 0) : col + 1] = INK
            label = f"{metres + 0.0:g}"
            (wide, tall), _ = cv2.getTextSize(label, cv2.FONT_HERSHEY_SIMPLEX, font, line)
            write_text(strip, label, col - wide // 2, round(10 * self.scale) + tall, font)


def tick_step(span_m: float) -> float:
    """Returns the tick distance: 1, 2 or 5 times a power of ten, for few ticks in ``span_m``."""
    least = span_m / _TICKS
    decade = 10.0 ** np.floor(np.log10(least))
    return float(next(f * decade for f in (1.0, 2.0, 5.0, 10.0) if f * decade >= least - 1e-9))


def write_text(image: Image, text: str, left: int, base: int, font: float) -> int:
    """Writes into the image and returns the column at the end of the text."""
    line = max(1, round(font * 2.0))
    cv2.putText(image, text, (left, base), cv2.FONT_HERSHEY_SIMPLEX, font, INK, line, cv2.LINE_AA)
    return left + int(cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, font, line)[0][0])


def _whole(pixel: Array) -> tuple[int, int]:
    return round(float(pixel[0])), round(float(pixel[1]))
