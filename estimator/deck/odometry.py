"""An estimator that follows a deck, too.

The deck is found as the largest level surface that ends within the field of view, away from the
take-off spot. From then on scans measure its height and tilt, and its middle as long as all of it
is in view; corners in images, and a tag if there is one, measure its place down to the touchdown,
and the rangefinder its height where the LIDAR is too near. Poses of the vehicle enter by their
differences over tenths of a second alone. What moves misleads an odometry that takes it for the
ground: while a deck is followed, the estimator gets the inertial sensors alone.
"""

import dataclasses

import numpy as np

from touchdown.estimator.api import Estimate, Estimator, PoseTrack, spare_sensors
from touchdown.estimator.deck.features import DeckFeatures
from touchdown.estimator.deck.filters import DeckFilter
from touchdown.estimator.deck.surfaces import Surface, fit_plane, surfaces, thinning_part
from touchdown.estimator.deck.tag import TagReader
from touchdown.estimator.filtering.camera_model import Undistorter, at_middle_row
from touchdown.estimator.filtering.deskew import deskewed_points, screen_scan
from touchdown.sim.api import (
    CameraImage,
    LidarScan,
    Observation,
    RangefinderSample,
    SensorNeeds,
    SensorRig,
)
from touchdown.sim.frames import PoseHistory, quat_wxyz_from_matrix
from touchdown.sim.typing import Array, Mask

_CAMERA_HZ = 10
_FROM_START_M = 9.0
"""surfaces nearer to the take-off spot are part of it"""
_AREA_M2 = (5.0, 200.0)
_MAX_SLOPE, _THINNING = 0.3, 0.12
"""steepest deck, and largest density of returns around it, as around a glint on water"""
_CUT_M2, _CUT_NEAR_M = 1.0, 15.0
"""another surface so large and so near that goes on beyond the view may be a part of the same hull,
and the deck yet to come"""
_SEEN_TIMES = 5
"""scans in a row in which a deck is seen before it is followed"""
_STILL_AREA, _SAME_AREA, _SAME_M = 0.08, 0.1, 1.5
"""parts by which its area differs meanwhile, as that of a deck that comes into view would, and
later, and way from scan to scan"""
_EDGE, _EDGE_PULSES = 0.04, 0.005
"""width of the edge of the field of view, as part of it, where pulses are few; the part of them
beyond it"""
_LARGER = 1.3
"""a surface that is so much larger is not the deck"""
_POINTS = 6000
_ABOVE_M, _AROUND_M = 0.5, 3.0
_ASTRAY_M = 1.0
"""distance of the middle of a whole deck from its site at which corners have led astray"""
_FEWEST = 30
_MIDDLE_SIGMA_M = 0.12
_RANGE_M = 4.0
"""range from which on the rangefinder surely points at the deck"""
_LOST_S = 2.0
_TAG_SIGMA_M = 0.03
"""standard deviation of the place of a tag in the plane of its deck"""


class DeckOdometry:
    """``inner`` with `Estimate.deck`. ``tag_m``: side of a tag in its middle; 0: none.
    Deterministic."""

    def __init__(self, inner: Estimator, rig: SensorRig, tag_m: float = 0.0) -> None:
        self._inner, self._rig = inner, rig
        self.needs = inner.needs | SensorNeeds(camera_hz=_CAMERA_HZ, lidar=True, rangefinder=True)
        self.spare_sensors = spare_sensors(inner)
        self._poses = PoseHistory(2 * rig.tick_hz // rig.imu_ticks)
        self._undistort = Undistorter(rig)
        self._start = rig.world_from_body_start.translation
        self._limits: Array | None = None
        self._seen: list[tuple[float, Surface]] = []
        """when, and what may be the deck, in the last scans"""
        self._radius = self._area = 0.0
        self._filter: DeckFilter | None = None
        self._features: DeckFeatures | None = None
        self._corners = 0
        self._tag = TagReader(self._undistort.rig.camera, tag_m) if tag_m else None

    def update(self, obs: Observation) -> Estimate:
        """As `Estimator.update`."""
        told = obs
        if self._filter is not None:
            told = dataclasses.replace(obs, scans=(), images=(), rangefinder=())
        estimate = self._inner.update(told)
        self._poses.add(obs.time_s, estimate.odom_from_body)
        events: list[str] = []
        for scan in obs.scans:
            self._take_scan(scan, estimate, events)
        for image in obs.images:
            self._take_image(at_middle_row(image, self._rig))
        deck = self._filter
        if deck is None:
            return estimate
        for sample in obs.rangefinder:
            self._take_range(deck, sample)
        if obs.time_s - deck.seen_s > _LOST_S:
            self._filter, self._features, self._seen = None, None, []
            return dataclasses.replace(estimate, events=(*estimate.events, "deck lost"))
        return dataclasses.replace(
            estimate,
            deck=deck.track(obs.time_s),
            events=(*estimate.events, *events),
            diagnostics={**estimate.diagnostics, "deck_corners": float(self._corners)},
        )

    def _take_scan(self, scan: LidarScan, estimate: Estimate, events: list[str]) -> None:
        path = self._poses.around(scan.start_time_s, scan.end_time_s)
        pulses = screen_scan(scan, self._rig.lidar)
        if len(path) < 2 or len(pulses) < _FEWEST:
            return
        track = PoseTrack(
            times_s=np.array([one.time_s for one in path]),
            positions_odom=np.array([one.pose.translation for one in path]),
            quats_wxyz=np.array([quat_wxyz_from_matrix(one.pose.rotation) for one in path]),
        )
        points = deskewed_points(scan, pulses, track, self._rig.body_from_lidar)
        left_s = scan.end_time_s - scan.start_time_s - scan.time_offsets[pulses]
        edge = self._at_edge(scan)[pulses]
        if self._filter is None:
            found = [
                one
                for one in surfaces(points, edge)
                if one.area_m2 > _AREA_M2[1] or thinning_part(one, points) < _THINNING
            ]
            self._look_for(found, estimate, scan.end_time_s, events)
        else:
            moved = points + left_s[:, None] * self._filter.velocity
            self._measure(self._filter, moved, edge, scan.end_time_s)

    def _at_edge(self, scan: LidarScan) -> Mask:
        """(N,) pulses at the edge of the field of view."""
        angles = np.arctan2(scan.directions[:, :2], scan.directions[:, 2:])
        if self._limits is None:
            self._limits = np.quantile(angles, [_EDGE_PULSES, 1.0 - _EDGE_PULSES], axis=0)
        low, high = self._limits
        low, high = low + _EDGE * (high - low), high - _EDGE * (high - low)
        return np.asarray(((angles < low) | (angles > high)).any(axis=1))

    def _look_for(
        self, seen: list[Surface], estimate: Estimate, time_s: float, events: list[str]
    ) -> None:
        start = estimate.world_from_odom.inverse().apply(self._start)[:2]
        ground = [one.height_m for one in seen if one.area_m2 > _AREA_M2[1]]
        seen = [one for one in seen if all(abs(one.height_m - low) > _ABOVE_M for low in ground)]
        cut = [one.cells.mean(axis=0) for one in seen if one.clipped and one.area_m2 > _CUT_M2]
        for found in seen:
            middle = found.cells.mean(axis=0)
            apart = np.linalg.norm(found.cells[:, :2] - start, axis=1).min()
            if (
                found.clipped
                or apart < _FROM_START_M
                or not _AREA_M2[0] < found.area_m2 < _AREA_M2[1]
            ):
                continue
            plane = fit_plane(found.cells, middle[:2])
            cut_short = any(np.linalg.norm(one - middle) < _CUT_NEAR_M for one in cut)
            if np.hypot(*plane.slopes) > _MAX_SLOPE or cut_short:
                continue
            areas = [one.area_m2 for _, one in self._seen]
            last = self._seen[-1][1].cells.mean(axis=0) if self._seen else middle
            still = all(abs(found.area_m2 / area - 1.0) < _STILL_AREA for area in areas)
            same = still and np.linalg.norm(middle - last) < _SAME_M
            earlier = self._seen[1 - _SEEN_TIMES :] if same else []
            self._seen = [*earlier, (time_s, found)]
            if len(self._seen) >= _SEEN_TIMES:
                self._follow_seen(np.array([*middle[:2], plane.height]), plane.slopes)
                events.append(f"deck of {found.area_m2:.0f} m2 found")
            return
        self._seen = []

    def _follow_seen(self, site: Array, slopes: Array) -> None:
        """Follows what the last scans have seen."""
        found = self._seen[-1][1]
        cells = found.cells[:, :2] - site[:2]
        self._radius, self._area = float(np.linalg.norm(cells, axis=1).max()), found.area_m2
        times, places = zip(*((t, one.cells.mean(axis=0)) for t, one in self._seen), strict=True)
        course = np.polynomial.polynomial.polyfit(times, np.array(places)[:, :2], 1)[1]
        self._filter = DeckFilter(times[-1], site, slopes, course)
        self._features = DeckFeatures(self._undistort.rig.camera, cells)
        self._seen = []

    def _measure(self, deck: DeckFilter, points: Array, edge: Mask, time_s: float) -> None:
        site, slopes = deck.surface(time_s)
        away = points - site
        near = np.hypot(away[:, 0], away[:, 1]) < self._radius + _AROUND_M
        near &= np.abs(away[:, 2] - away[:, :2] @ slopes) < _ABOVE_M
        if near.sum() < _FEWEST:
            return
        chosen = np.flatnonzero(near)[:: max(1, int(near.sum()) // _POINTS)]
        points, edge = points[chosen], edge[chosen]
        seen = surfaces(points, edge)
        if not seen:
            return
        largest = seen[0]
        if largest.area_m2 > _LARGER * self._area:
            return  # water or ground that it has drifted over
        plane = fit_plane(largest.cells if len(largest.cells) > 60 else points, site[:2])
        deck.see_plane(time_s, plane)
        whole = abs(largest.area_m2 / self._area - 1.0) < _SAME_AREA
        if whole and not largest.clipped:
            middle = largest.cells.mean(axis=0)
            if np.linalg.norm(middle[:2] - site[:2]) < _ASTRAY_M:
                self._seen = []
                deck.see_place(time_s, middle[:2], _MIDDLE_SIGMA_M)
                return
            self._seen = [*self._seen[1 - _SEEN_TIMES :], (time_s, largest)]
            if len(self._seen) >= _SEEN_TIMES:
                self._follow_seen(np.array([*middle[:2], plane.height]), plane.slopes)

    def _take_range(self, deck: DeckFilter, sample: RangefinderSample) -> None:
        pose, sheet = self._poses.at(sample.time_s), self._rig.nav.rangefinder
        if pose is None or not 0.0 < sample.range_m < _RANGE_M:
            return
        spot = pose.apply(np.array(sheet.position_body_m) - [0.0, 0.0, sample.range_m])
        site, slopes = deck.surface(sample.time_s)
        height = float(spot[2] - (spot - site)[:2] @ slopes)
        deck.see_height(sample.time_s, height, sheet.sigma_m)

    def _take_image(self, image: CameraImage) -> None:
        pose, deck = self._poses.at(image.time_s), self._filter
        if pose is None or deck is None or self._features is None:
            return
        camera = pose @ self._rig.body_from_camera
        grey = self._undistort.grey(image.rgb)
        if self._tag is not None and (tag := self._tag.read(grey, camera)) is not None:
            # Its size tells less of the range than scans do.
            site, slopes = deck.surface(image.time_s)
            normal, beam = np.array([-slopes[0], -slopes[1], 1.0]), tag - camera.translation
            way = float(normal @ (site - camera.translation)) / float(normal @ beam)
            deck.see_place(image.time_s, (camera.translation + way * beam)[:2], _TAG_SIGMA_M)
        self._corners = self._features.update(grey, camera, deck, image.time_s)
