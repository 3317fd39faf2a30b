"""Things that stand on the ground: found in one scan, followed over the next."""

import itertools
from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np

from touchdown.landing.watch.surface import CELL_M, Layers, Mask, shifted
from touchdown.sim.typing import Array, Float32, Indices

_MIN_CELLS, _MIN_RETURNS = 2, 6
_MIN_HEIGHT_M, _MAX_HEIGHT_M = 0.3, 2.5
"""what may walk or be put on a site: higher things are trees and houses"""
_MAX_WIDTH_M = 6.0
MIN_NEW_M = 0.35
"""height from which it may have appeared: crops and meadows are up to 0.3 m high, and noise"""
_APPEARED = 0.3
"""fraction of its cells"""
_AGO_S, _LONGEST_S = 0.55, 2.0
"""age of scans that show what has stood somewhere before"""
_RISE_M, _LEAST_M, _MOST_M = 0.15, 0.2, 1.0
"""by how much it is higher than what was there: from low down plants are somewhat higher than from
above; and height of a dog, of which few pulses are higher than plants"""
_FREE_SCANS = 3
"""number of those that have to show free ground"""
_KEPT = 20
_BESIDE = np.ones((3, 3), np.uint8)
_LATELY_S, _AROUND_M, _SEEN, _LOW_M = 0.6, 1.0, 0.5, 0.45
"""age of scans, distance to a place, fraction of the cells there, and height below which all has to
be where neither a person nor a dog is"""
_GATE_M, _FASTEST_MPS = 0.5, 6.0
"""distance to where a thing was expected, and speed of one seen for the first time"""
_FORGET_S, _LOST_S = 4.0, 0.35
"""time for which something is kept that is out of sight, and that should be seen"""
_FIT_S, _FIT_SPAN_S, _FIT_SCANS = 1.2, 0.35, 4
_MOVES_MPS, _MOVED_M = 0.35, 0.25
_LOOSE_M, _BENT, _STRAIGHT = 0.2, 0.2, 0.1
"""root mean square of the distances from one straight motion up to which it is one thing, the same
as a fraction of its way, and the fraction up to which it moves"""
_FREE_LATELY = 4
"""number of the last five scans by which it stands where the ground was free, as who walks does"""
_RUNS_MPS, _RAN_M, _OFF_M = 2.0, 2.0, 0.08
"""speed and way of what is fast, and its distance from a straight motion"""
_GOES_SCANS, _WENT_M, _CAME = 8, 1.2, 1 / 3
"""scans and way of what goes on, and fraction of the scans in which it has come: plants hide who
passes behind them in some"""


class Thing(NamedTuple):
    """What stands on the ground in one scan."""

    middle: Array
    """(2,) odom frame"""
    cells: Array
    """(n, 2) middles of its cells, odom frame"""
    top: float
    """z, odom frame"""
    tops: Array
    """(n,) the same of its cells"""
    height_m: float
    appeared: float
    """fraction of its cells where the ground was free half a second and more before"""
    came: float
    """the same where nothing was nearly as high: among plants no ground is free"""
    sure: bool
    """one scan shows it, rather than two, or only as it is higher than what was there before"""


class Memory:
    """What stood where in the scans before, on the grid of the last one."""

    def __init__(self) -> None:
        self._scans: deque[tuple[float, Mask, Mask, Float32]] = deque(maxlen=_KEPT)
        """when, where something rises, where the ground is free, height of what is highest"""

    def clear(self) -> None:
        """Forgets all."""
        self._scans.clear()

    def move(self, by: tuple[int, int]) -> None:
        """Follows the grid, by rows and columns."""
        if by != (0, 0):
            moved = [
                (t, shifted(a, by, False), shifted(b, by, False), shifted(h, by, np.nan))
                for t, a, b, h in self._scans
            ]
            self._scans.clear()
            self._scans.extend(moved)

    def add(self, time_s: float, layers: Layers) -> None:
        """Adds what a scan shows. Plants at the limit of what is tall are so in one scan and not in
        the next; free ground they are in none."""
        rises = (layers.returns > 0.0) & ~layers.free
        height = np.where(layers.returns > 0.0, layers.high - layers.ground, np.float32(np.nan))
        self._scans.append((time_s, rises, layers.free, height))

    def free(self) -> Mask:
        """Where one of the scans has seen free ground and none something on it."""
        rises = np.logical_or.reduce([rises for _, rises, _, _ in self._scans])
        seen: Mask = np.logical_or.reduce([free for _, _, free, _ in self._scans])
        return seen & ~rises

    def is_low(self, time_s: float, cell: Indices) -> bool:
        """Whether the last scans show what is around a ``cell`` (2,), column and row, and nothing
        there as high as a dog."""
        reach = round(_AROUND_M / CELL_M)
        col, row = cell.tolist()
        lately = [height for at, _, _, height in self._scans if time_s - at <= _LATELY_S]
        if not lately or not reach <= min(row, col) <= max(row, col) < len(lately[0]) - reach:
            return False
        around = np.s_[row - reach : row + reach + 1, col - reach : col + reach + 1]
        high = np.fmax.reduce([height[around] for height in lately])
        return bool(np.isfinite(high).mean() >= _SEEN and np.nanmax(high) < _LOW_M)

    def was_free(self, time_s: float) -> Mask | None:
        """Where the ground was free and nothing stood beside; None without a scan that old."""
        old = self._old(time_s)
        if not old:
            return None
        risen = np.logical_or.reduce([rises for _, rises, _, _ in old]).astype(np.uint8)
        often: Mask = np.add.reduce([free for _, _, free, _ in old], dtype=np.uint8) >= _FREE_SCANS
        return often & (cv2.dilate(risen, _BESIDE) == 0)

    def higher(self, time_s: float, layers: Layers) -> Mask:
        """Where something stands above all that was there, and beside, before."""
        old = [height for *_, height in self._old(time_s)]
        if not old:
            return np.zeros_like(layers.tall)
        often = np.add.reduce([np.isfinite(one) for one in old], dtype=np.uint8) >= _FREE_SCANS
        before = cv2.dilate(np.nan_to_num(np.fmax.reduce(old), nan=0.0), _BESIDE)
        above: Mask = layers.high - layers.ground > before + _RISE_M
        return often & above

    def _old(self, time_s: float) -> list[tuple[float, Mask, Mask, Float32]]:
        return [one for one in self._scans if _AGO_S <= time_s - one[0] <= _LONGEST_S]


def things_in(layers: Layers, corner: Array, was_free: Mask | None, higher: Mask) -> list[Thing]:
    """Returns what stands on the ground. ``corner`` (2,): of the grid, odom frame."""
    up = layers.high - layers.ground
    stands = layers.tall | (layers.steep & higher & (up > _LEAST_M) & (up < _MOST_M))
    count, labels = cv2.connectedComponents(stands.astype(np.uint8), connectivity=8)
    rows, cols = np.nonzero(stands)
    owner = labels[rows, cols]
    order = np.argsort(owner, kind="stable")
    rows, cols, owner = rows[order], cols[order], owner[order]
    bounds = np.searchsorted(owner, np.arange(1, count + 1))
    found = []
    for first, last in itertools.pairwise(bounds):
        at = rows[first:last], cols[first:last]
        returns = layers.returns[at]
        height = float(up[at].max())
        few = last - first < _MIN_CELLS or returns.sum() < _MIN_RETURNS
        if few or not layers.newest[at].any():
            continue
        cells = corner + CELL_M * (np.column_stack([at[1], at[0]]) + 0.5)
        if not _MIN_HEIGHT_M <= height <= _MAX_HEIGHT_M or np.ptp(cells, 0).max() > _MAX_WIDTH_M:
            continue
        found.append(Thing(
            middle=np.average(cells, axis=0, weights=returns), cells=cells,
            top=float(layers.high[at].max()), tops=layers.high[at].astype(np.float64),
            height_m=height, appeared=0.0 if was_free is None else float(was_free[at].mean()),
            came=float(higher[at].mean()),
            sure=bool(
                layers.alone[at].sum() >= _MIN_CELLS
                and (layers.fresh * layers.alone)[at].sum() >= _MIN_RETURNS
            ),
        ))  # fmt: skip
    return found


@dataclass(slots=True, eq=False)
class Track:
    """One thing over time."""

    thing: Thing
    """as last seen"""
    seen_s: float
    seen: int = 1
    """number of scans"""
    appeared: int = 0
    """number of scans in which it stood where nothing had stood"""
    lately: deque[bool] = field(default_factory=lambda: deque(maxlen=5))
    """whether it has come to where it stands, of the last scans"""
    new: int = 0
    """number of scans in which the map did not have it"""
    velocity: Array = field(default_factory=lambda: np.zeros(2))
    """(2,) m/s; 0 where it is not known to move"""
    moving: int = 0
    """number of scans in a row in which it moved"""
    drift: Array = field(default_factory=lambda: np.zeros(2))
    """(2,) m/s, by which it is looked for in the next scan: of who walks before that is sure"""
    path: deque[tuple[float, Array, bool]] = field(default_factory=lambda: deque(maxlen=_KEPT))
    """when, where, and whether it had come"""

    def at(self, time_s: float) -> Array:
        """(2,) where its middle is expected."""
        return self.thing.middle + (time_s - self.seen_s) * self.velocity

    @property
    def moves(self) -> bool:
        """True for what walks, drives or rolls."""
        return self.moving > 0

    def see(self, thing: Thing, time_s: float) -> None:
        """Takes over where it is now."""
        self.thing, self.seen_s = thing, time_s
        self.seen += 1
        self._follow()

    def _follow(self) -> None:
        high = self.thing.height_m >= MIN_NEW_M
        sure = high and self.thing.sure
        self.appeared += sure and self.thing.appeared >= _APPEARED
        came = self.thing.came >= _APPEARED
        self.lately.append(sure and came)
        self.path.append((self.seen_s, self.thing.middle, came))
        near = [one for one in self.path if self.seen_s - one[0] <= _FIT_S]
        times = np.array([t for t, *_ in near]) - self.seen_s
        if len(near) < _FIT_SCANS or -times[0] < _FIT_SPAN_S:
            return
        places = np.array([xy for _, xy, _ in near])
        line = np.polynomial.polynomial.polyfit(times, places, 1)
        slope, off = line[1], places - np.polynomial.polynomial.polyval(times, line).T
        spread = np.sqrt((off**2).sum(axis=1).mean())
        half = len(near) // 2
        moved = np.linalg.norm(places[half:].mean(axis=0) - places[:half].mean(axis=0))
        speed = np.hypot(*slope)
        way = speed * -times[0]
        one = spread < min(_LOOSE_M, _BENT * way)
        straight = one and spread < _STRAIGHT * way
        # What comes into view seems to move too; but it has not been seen free before.
        free = sum(self.lately) >= _FREE_LATELY
        moves = speed > _MOVES_MPS and 2.0 * moved > _MOVED_M and free
        # Far away too few pulses tell whether the ground was free before. Bushes that are taken for
        # one thing do not lie on a line in equal steps.
        runs = speed > _RUNS_MPS and way > _RAN_M and spread < _OFF_M
        # From low down little tells what was free; few bushes lie on a line for so many scans.
        often = np.mean([came for *_, came in near]) > _CAME
        goes = len(near) >= _GOES_SCANS and way > _WENT_M and often
        self.velocity = slope if runs or (straight and (moves or goes)) else np.zeros(2)
        self.moving = self.moving + 1 if self.velocity.any() else 0
        self.drift = slope if one else np.zeros(2)


class Tracks:
    """All things in view, and what has moved out of it."""

    def __init__(self) -> None:
        self.tracks: list[Track] = []

    def clear(self) -> None:
        """Forgets all."""
        self.tracks = []

    def update(
        self, things: list[Thing], time_s: float, layers: Layers, corner: Array
    ) -> list[Track]:
        """Follows the things of a scan; returns those that it shows. What it does not show is kept
        for a while, unless the ground is free there."""
        left, shown = list(self.tracks), []
        for thing in sorted(things, key=lambda thing: -len(thing.cells)):
            track = min(left, key=lambda one: _apart(one, thing, time_s), default=None)
            if track is None or _apart(track, thing, time_s) == np.inf:
                track = Track(thing, time_s, seen=0)
                self.tracks.append(track)
            else:
                left.remove(track)
            track.see(thing, time_s)
            shown.append(track)
        self.tracks = [
            track
            for track in self.tracks
            if time_s - track.seen_s
            < (_LOST_S if _gone(track, time_s, layers, corner) else _FORGET_S)
        ]
        return shown


def _gone(track: Track, time_s: float, layers: Layers, corner: Array) -> bool:
    """Whether the ground is free where a track is expected."""
    cells = track.thing.cells + (track.at(time_s) - track.thing.middle)
    cols, rows = np.floor((cells - corner) / CELL_M).astype(int).T
    size = len(layers.free)
    inside = (cols >= 0) & (rows >= 0) & (cols < size) & (rows < size)
    return bool(layers.free[rows[inside], cols[inside]].sum() >= 0.5 * len(cells))


def _apart(track: Track, thing: Thing, time_s: float) -> float:
    """Distance of a thing to where a track is expected, m; infinite beyond its reach."""
    since = time_s - track.seen_s
    reach = _GATE_M + (0.5 if track.moves or track.seen > 3 else _FASTEST_MPS) * since
    apart = float(np.linalg.norm(thing.middle - track.thing.middle - since * track.drift))
    return apart if apart <= reach else np.inf
