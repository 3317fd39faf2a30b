"""The standard watch: is it safe to go on with the descent?"""

import math
from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from touchdown.estimator.api import GridMap
from touchdown.landing.api import Finding, Verdict, WatchInput, WatchReport, WatchRig
from touchdown.landing.watch.footing import footing, nearest_safe, water_fraction
from touchdown.landing.watch.people import SHIPPED, PeopleDetector
from touchdown.landing.watch.sightings import Sighting, Sightings
from touchdown.landing.watch.surface import CELL_M, Layers, Surface
from touchdown.landing.watch.tracks import MIN_NEW_M, Memory, Track, Tracks, things_in
from touchdown.sim.api import LidarScan, SensorNeeds
from touchdown.sim.frames import PoseHistory
from touchdown.sim.typing import Array, Indices

_POSES = 256
_BREAK_S = 1.0
"""time without a call after which all is forgotten"""
_NEAR_M = 2.0
"""distance to the site within which nothing may be that was not there when it was chosen"""
_PERSON_M, _PERSON_S, _TALL_M = 3.5, 2.0, 1.7
"""distance to the site within which nobody may be, 3 m and what a place in an image is off by, and
until when; height that somebody is shown with"""
_MOVER_M = 3.0
"""distance to the site within which nothing that moves may be at the touchdown"""
_SOON_S = 2.0
"""time in which what moves may be at the site that is believed at once: two scans in a row have to
say that others move"""
_LEGS_M = 0.6
"""radius of what the vehicle touches the ground with"""
_REACT_S, _BRAKE_MPS2 = 0.3, 2.0
_AROUND_S, _AHEAD_S = 2.0, 8.0
"""uncertainty of the time of the touchdown, and how far ahead a track is continued"""
_SCANS = 2
"""number of scans that have to agree"""
_CLEAR_S = 1.0
"""time for which nothing may be in the way before the descent goes on"""
_ASIDE_AFTER_S = 2.0
"""time in the way after which it is given up that something still leaves by itself"""
_STEEP_DEG, _STEP_M, _WATER = 12.0, 0.3, 0.5
"""ground that is refused from close even where there is no other: slope, step, fraction of pulses
without return"""
_SPARE_M = 0.5
"""distance by which another place is farther away than what is in the way"""
_REACH_M = 3.5
"""height of the body below which it climbs at once where somebody is in the way: nobody reaches
higher"""
_CLOSE_M = 1.2
"""height of the body below which people and what moves alone interrupt a descent, and images are
not looked at: they show little but the vehicle's own shadow"""
_LOOK_AFTER_S = 3.0
"""time in the way after which it climbs to see more, from below ``landing.look_height_m``"""
_SAME_M = 0.6
"""horizontal distance up to which something is what the map has: its error and what crowns sway"""
_HIGHER_M = 0.25
"""height above the map from which something is new"""
_BLIND_S = 1.0


class StandardWatch:
    """Looks at each scan for what stands, has appeared or moves near the landing place.

    Implements ``landing.api.Watch``. All positions are relative to the vehicle over the last
    seconds; the map as it was when the site was chosen tells what stood there before."""

    needs = SensorNeeds(lidar=True)

    def __init__(self, rig: WatchRig) -> None:
        self._rig = rig
        self._surface = Surface(rig.sensors.body_from_lidar)
        self._memory, self._tracks = Memory(), Tracks()
        self._poses = PoseHistory(_POSES)
        self._called_s = self._seen_s = self._first_s = -np.inf
        self._blocked_s = self._since_s = -np.inf
        self._bad_ground: set[str] = set()
        """what was wrong with the ground in the last scan"""
        self._report = WatchReport()
        self._sightings: Sightings | None = None
        """None where images are not looked at"""
        if rig.landing.people_network:
            name = rig.landing.people_network
            detector = PeopleDetector(SHIPPED if name == "shipped" else Path(name))
            self._sightings = Sightings(rig.sensors, detector)
            self.needs = SensorNeeds(camera_hz=5, lidar=True)
        self._ground_z = np.nan
        """height of the ground below in the last scan, odom frame"""

    def look(self, seen: WatchInput) -> WatchReport:
        """Returns the verdict; it changes with scans, and to waiting with images, too."""
        now = seen.obs.time_s
        if now - self._called_s > _BREAK_S:
            self._begin(now)
        self._called_s = now
        self._poses.add(now, seen.estimate.odom_from_body)
        for image in seen.obs.images if self._sightings is not None else ():
            pose = self._poses.at(image.time_s)
            if self._sightings is None or pose is None:
                continue
            if pose.translation[2] - self._ground_z > _CLOSE_M:
                self._sightings.add(image, pose, self._ground_z)
                self._hold_for(self._sightings, seen, now)
        for scan in seen.obs.scans:
            self._look_at(scan, seen)
        if now - max(self._seen_s, self._first_s) > _BLIND_S:
            self._report = WatchReport(reason="no scan shows the ground: it is not watched")
        return self._report

    def _begin(self, now: float) -> None:
        self._surface.clear()
        self._memory.clear()
        self._tracks.clear()
        self._poses = PoseHistory(_POSES)
        self._first_s = now
        self._seen_s = self._blocked_s = self._since_s = -np.inf
        self._bad_ground = set()
        if self._sightings is not None:
            self._sightings.clear()
        self._ground_z = np.nan
        self._report = WatchReport()

    def _look_at(self, scan: LidarScan, seen: WatchInput) -> None:
        layers = self._surface.add(scan, self._poses)
        if layers is None:
            return
        now, corner = scan.end_time_s, self._surface.corner
        self._memory.move(self._surface.shift)
        body = seen.estimate.odom_from_body.translation
        if not np.isfinite(below := _ground_at(layers, corner, body)):
            return
        self._ground_z = below
        self._seen_s = seen.obs.time_s
        memory = self._memory
        things = things_in(layers, corner, memory.was_free(now), memory.higher(now, layers))
        memory.add(now, layers)
        tops = None if seen.known is None else _known_tops(seen.known, layers, corner)
        for track in self._tracks.update(things, now, layers, corner):
            track.new += track.thing.sure and _is_new(track, tops, seen.known)
        findings = [self._finding(track, seen, now) for track in self._tracks.tracks]
        if self._sightings is not None:
            findings += [_person(one, seen, below) for one in self._people(self._sightings, now)]
        findings.sort(key=lambda finding: finding.distance_m)
        ground = self._ground(layers, seen)
        findings += [finding for finding in ground if finding.kind in self._bad_ground]
        self._bad_ground = {finding.kind for finding in ground}
        self._judge(findings, layers, seen, now)

    def _hold_for(self, sightings: Sightings, seen: WatchInput, now: float) -> None:
        """Holds the descent for who is near the site in an image; the next scan judges again."""
        if self._report.verdict is not Verdict.GO:
            return
        found = (_person(one, seen, self._ground_z) for one in self._people(sightings, now))
        near = [(reason, one) for one in found if (reason := _reason(one, seen, _NEAR_M))]
        if near:
            self._blocked_s = self._since_s = now
            self._report = replace(
                self._report, verdict=Verdict.WAIT, reason=near[0][0],
                findings=(*(one for _, one in near), *self._report.findings),
            )  # fmt: skip

    def _people(self, sightings: Sightings, now: float) -> list[Sighting]:
        """Who is found in images, but where scans show nothing as high as a person."""
        corner = self._surface.corner
        return [
            one for one in sightings.present()
            if not self._memory.is_low(now, _cell(one.xy_odom, corner))
        ]  # fmt: skip

    def _finding(self, track: Track, seen: WatchInput, now: float) -> Finding:
        thing, at = track.thing, track.at(now)
        cells = thing.cells + (at - thing.middle)
        distance = float(np.linalg.norm(cells - seen.site_odom[:2], axis=1).min()) - 0.5 * CELL_M
        kind: Literal["moving", "new", "object", "known"] = "known"
        if track.seen >= _SCANS:
            soon = distance < _SOON_S * float(np.hypot(*track.velocity))
            if track.moving >= (1 if soon else _SCANS):
                kind = "moving"
            elif max(track.appeared, track.new) >= _SCANS:
                kind = "new"
            elif distance < _LEGS_M and thing.sure and thing.height_m >= MIN_NEW_M:
                kind = "object"
        return Finding(
            kind=kind, position_odom=np.array([*at, thing.top]), velocity_odom=track.velocity,
            height_m=thing.height_m, width_m=float(np.ptp(thing.cells, axis=0).max()) + CELL_M,
            distance_m=max(distance, 0.0),
        )  # fmt: skip

    def _judge(self, findings: list[Finding], layers: Layers, seen: WatchInput, now: float) -> None:
        speed = float(np.linalg.norm(seen.estimate.velocity_odom[:2]))
        near = _NEAR_M + min(speed * _REACT_S + 0.5 * speed**2 / _BRAKE_MPS2, _NEAR_M)
        height = self._height(layers, seen)
        goes_on = height < _CLOSE_M and self._report.verdict is Verdict.GO
        counts = [one for one in findings if not goes_on or one.kind in ("moving", "person")]
        blocking = [one for one in counts if _reason(one, seen, near)]
        reason = _reason(blocking[0], seen, near) if blocking else ""
        if reason:
            if now - self._blocked_s > _CLEAR_S:
                self._since_s = now
            self._blocked_s = now
        elif now - self._blocked_s < _CLEAR_S:
            reason = self._report.reason
        verdict, aside = Verdict.WAIT if reason else Verdict.GO, None
        alive = [one for one in blocking if one.kind in ("moving", "new", "person")]
        if alive and height < _REACH_M:
            verdict = Verdict.CLIMB
        elif blocking and now - self._since_s > _ASIDE_AFTER_S:
            if all(one.kind != "moving" for one in blocking):
                aside = self._aside(findings, layers, seen, near)
            if aside is not None:
                verdict = Verdict.MOVE
            elif now - self._since_s > _LOOK_AFTER_S and height < self._rig.landing.look_height_m:
                verdict = Verdict.CLIMB
        self._report = WatchReport(
            verdict=verdict, reason=reason, findings=tuple(findings), aside_odom=aside,
            height_m=height,
        )  # fmt: skip

    def _height(self, layers: Layers, seen: WatchInput) -> float:
        body = seen.estimate.odom_from_body.translation
        return float(body[2]) - _ground_at(layers, self._surface.corner, body)

    def _aside(
        self, findings: list[Finding], layers: Layers, seen: WatchInput, near: float
    ) -> Array | None:
        """(2,) the nearest place that is level, free, and away from all that is found."""
        away = []
        for finding in findings:
            if finding.kind in ("person", "moving", "new", "object", "known"):
                keep = near + _SPARE_M if finding.kind in ("moving", "new") else _LEGS_M
                keep = _PERSON_M if finding.kind == "person" else keep
                for ahead_s in (
                    np.linspace(0.0, _AHEAD_S, 5) if finding.kind == "moving" else (0.0,)
                ):
                    at = finding.position_odom[:2] + ahead_s * finding.velocity_odom
                    away.append((at, keep + 0.5 * finding.width_m))
        return nearest_safe(
            layers, self._surface.corner, self._memory.free(), seen.site_odom[:2], away
        )

    def _ground(self, layers: Layers, seen: WatchInput) -> list[Finding]:
        """What is wrong with the ground under the legs."""
        found, site = footing(layers, self._surface.corner, seen.site_odom[:2]), seen.site_odom
        kinds: list[tuple[Literal["slope", "step", "water"], bool, float]] = [
            ("step", found.step_m > _STEP_M, found.step_m),
            ("slope", found.slope_deg > _STEEP_DEG, math.tan(math.radians(found.slope_deg))),
            ("water", water_fraction(seen.map_view.coarse, site[:2]) > _WATER, 0.0),
        ]
        return [
            Finding(
                kind=kind, position_odom=site.copy(), velocity_odom=np.zeros(2), height_m=height,
                width_m=2.0 * _LEGS_M, distance_m=0.0,
            )
            for kind, wrong, height in kinds
            if wrong
        ]  # fmt: skip


def _reason(finding: Finding, seen: WatchInput, near_m: float) -> str:
    """Returns in words why a finding is in the way; empty where it is not."""
    away, what = finding.distance_m, f"{finding.height_m:.1f} m high"
    if finding.kind == "person":
        at = finding.position_odom[:2] - seen.site_odom[:2]
        way = at + np.linspace(0.0, _PERSON_S, 5)[:, None] * finding.velocity_odom
        near = float(np.linalg.norm(way, axis=1).min()) < _PERSON_M
        return f"somebody {away:.1f} m from the site" if near else ""
    if finding.kind == "object":
        return f"something {what} under the legs"
    if finding.kind == "slope":
        return f"the ground slopes by {math.degrees(math.atan(finding.height_m)):.0f} degrees"
    if finding.kind == "step":
        return f"a step of {finding.height_m:.1f} m under the legs"
    if finding.kind == "water":
        return "water under the legs"
    if finding.kind == "known":
        return ""
    if finding.kind == "new" or away < near_m:
        text = "moves" if finding.kind == "moving" else f"new, {what},"
        return f"something {text} {away:.1f} m from the site" if away < near_m else ""
    if (left := seen.touchdown_s) > _AHEAD_S:
        return ""
    times = np.linspace(max(left - _AROUND_S, 0.0), left + _AROUND_S, 9)
    ways = (finding.position_odom[:2] - seen.site_odom[:2]) + times[:, None] * finding.velocity_odom
    closest = float(np.linalg.norm(ways, axis=1).min()) - 0.5 * finding.width_m
    if closest >= _MOVER_M:
        return ""
    return f"something that moves {away:.1f} m away will be {max(closest, 0.0):.1f} m from the site"


def _person(one: Sighting, seen: WatchInput, ground_z: float) -> Finding:
    return Finding(
        kind="person", position_odom=np.array([*one.xy_odom, ground_z + _TALL_M]),
        height_m=_TALL_M, velocity_odom=one.velocity_odom, width_m=0.0,
        distance_m=float(np.linalg.norm(one.xy_odom - seen.site_odom[:2])),
    )  # fmt: skip


def _cell(at: Array, corner: Array) -> Indices:
    """(2,) column and row of a place."""
    return np.floor((at - corner) / CELL_M).astype(np.int64)


def _ground_at(layers: Layers, corner: Array, at: Array) -> float:
    """Median height of the ground within a metre; NaN where it is not known."""
    col, row = _cell(at[:2], corner)
    reach, size = int(1.0 / CELL_M), len(layers.ground)
    if not (reach <= row < size - reach and reach <= col < size - reach):
        return float("nan")
    patch = layers.ground[row - reach : row + reach + 1, col - reach : col + reach + 1]
    known = patch[np.isfinite(patch)]
    return float(np.median(known)) if known.size else float("nan")


def _known_tops(known: GridMap, layers: Layers, corner: Array) -> Array | None:
    """Returns the upper side of a map, (rows, cols) of its cells, each the highest around, at the
    height at which the scan shows the ground; -inf where nothing was mapped."""
    rows, cols = known.height_m.shape
    x = known.origin_xy_m[0] + (np.arange(cols) + 0.5) * known.cell_m
    y = known.origin_xy_m[1] + (np.arange(rows) + 0.5) * known.cell_m
    col = np.floor((x - corner[0]) / CELL_M).astype(int)
    row = np.floor((y - corner[1]) / CELL_M).astype(int)
    ok_c, ok_r = ((at >= 0) & (at < len(layers.ground)) for at in (col, row))
    now = np.full((rows, cols), np.nan)
    now[np.ix_(ok_r, ok_c)] = layers.ground[np.ix_(row[ok_r], col[ok_c])]
    low = (known.max_height_m - known.min_height_m) < _HIGHER_M
    both = np.isfinite(now) & np.isfinite(known.height_m) & low
    lift = float(np.median(now[both] - known.height_m[both])) if both.sum() > 20 else 0.0
    reach = round(_SAME_M / known.cell_m)
    tops = np.nan_to_num(known.max_height_m, nan=-np.inf).astype(np.float32)
    window = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    widened = cv2.dilate(tops, window, borderType=cv2.BORDER_CONSTANT, borderValue=-np.inf)
    return np.asarray(widened + lift, np.float64)


def _is_new(track: Track, tops: Array | None, known: GridMap | None) -> bool:
    """Whether most of a thing stands higher than what the map has there; what lies where nothing
    was mapped is not called new."""
    if tops is None or known is None:
        return False
    thing = track.thing
    cols, rows = np.floor((thing.cells - known.origin_xy_m) / known.cell_m).astype(int).T
    inside = (cols >= 0) & (rows >= 0) & (cols < tops.shape[1]) & (rows < tops.shape[0])
    before = tops[rows[inside], cols[inside]]
    higher = np.isfinite(before) & (thing.tops[inside] > before + _HIGHER_M)
    return bool(higher.sum() > 0.5 * len(thing.cells))
