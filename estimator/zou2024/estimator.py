"""The paper's positioning: LIDAR and camera poses, loosely coupled."""

import dataclasses
from collections import deque
from collections.abc import Sequence
from functools import partial

from touchdown.estimator.api import Estimate, PoseTrack, Zou2024Params
from touchdown.estimator.filtering.camera_model import Undistorter
from touchdown.estimator.filtering.error_state import POSITION
from touchdown.estimator.filtering.inertial_filter import InertialFilter
from touchdown.estimator.filtering.landmark_depth import RecentReturns
from touchdown.estimator.filtering.online_calibration import prior_sigmas
from touchdown.estimator.filtering.synchronizer import MessageSynchronizer
from touchdown.estimator.zou2024.camera_pose import CameraPositioning
from touchdown.estimator.zou2024.depth_field import half_size_energy
from touchdown.estimator.zou2024.lidar_pose import LidarPositioning
from touchdown.estimator.zou2024.structured_edges import edge_detector
from touchdown.sim.api import CameraImage, LidarScan, Observation, SensorNeeds, SensorRig
from touchdown.sim.typing import Float32


def nearest_image(
    images: Sequence[CameraImage], tick: int, max_ticks_apart: int
) -> CameraImage | None:
    """Returns the image nearest in time to a scan's ``tick`` (section 3.2), the earlier of two;
    None if none is within ``max_ticks_apart``."""
    near = [image for image in images if abs(image.tick - tick) <= max_ticks_apart]
    return min(near, key=lambda image: (abs(image.tick - tick), image.tick), default=None)


class Zou2024Estimator:
    """The paper's estimator. Deterministic; nothing is drawn at random."""

    def __init__(self, rig: SensorRig, params: Zou2024Params | None = None) -> None:
        self._undistort = Undistorter(rig)
        self._rig = rig = self._undistort.rig
        self._params = params = params or Zou2024Params()
        self.needs = SensorNeeds(camera_hz=params.camera_hz, lidar=True)
        self._filter = InertialFilter(rig, calibration_sigmas=prior_sigmas(params))
        self._edges = edge_detector(params.edge_model)
        self._recent = RecentReturns(scans=15, per_scan=8000)
        self._lidar = LidarPositioning(rig, params, self._filter, self._recent)
        self._camera = CameraPositioning(rig, params, self._filter, self._recent, self._lidar.maps)
        self._images: deque[CameraImage] = deque(maxlen=3)
        self._energies: list[tuple[CameraImage, Float32]] = []
        self._scan_track: PoseTrack | None = None
        self._skipped = 0
        self._synchronizer = MessageSynchronizer(
            rig, self._filter, params.camera_hz, middle_rows=True
        )

    def update(self, obs: Observation) -> Estimate:
        """Processes the arrived messages and returns the estimate at ``obs.tick``."""
        self._scan_track = None
        arrivals = list(self._synchronizer.push(obs))
        self._images.extend(m for m in arrivals if isinstance(m, CameraImage))
        for message in arrivals:
            if self._synchronizer.advance(message):
                self._take(message)
        self._synchronizer.flush(obs)
        seconds = self._filter.step_s
        world_from_odom, spread = self._camera.world_from_odom(seconds)
        # the reported pose differs from the best estimate by the decaying jump
        jump = self._filter.jump[POSITION]
        spread = spread + jump * jump[:, None]
        spread[2, 2] += self._params.ground_sigma_m**2
        skipped = self._skipped + self._synchronizer.skipped + self._camera.failed
        diagnostics = self._lidar.diagnostics | self._camera.diagnostics
        diagnostics |= {"skipped": float(skipped)}
        events = tuple(self._synchronizer.events)
        return self._filter.estimate(
            obs, world_from_odom, spread, self._scan_track, diagnostics, events
        )

    def _flat(self, image: CameraImage) -> CameraImage:
        """The image without the lens's distortion."""
        return dataclasses.replace(image, rgb=self._undistort(image.rgb), right_rgb=None)

    def _take(self, message: LidarScan | CameraImage) -> None:
        if isinstance(message, LidarScan):
            tick = message.end_tick
            # edge energy is a large cost: that of a keyframe serves the scans until the next
            known, apart = [image for image, _ in self._energies], self._rig.lidar_scan_ticks
            period = round(self._params.keyframe_period_s * self._rig.tick_hz)
            image = nearest_image(known, tick, period) or nearest_image(self._images, tick, apart)
            energy = None
            if image is not None and self._params.use_colour_smoothness:
                energy = self._energy_of(image)
            seen_from = None
            if image is not None and image.tick < tick:
                seen_from = self._filter.trail.pose_at(image.tick)
            done = self._lidar.take(message, energy, seen_from)
            self._skipped += not done
            self._scan_track = self._filter.track_of(message, self._scan_track)
        elif self._camera.due(message.tick):
            flat = self._flat(message)
            self._camera.take(flat, partial(self._energy_of, message, flat))

    def _energy_of(self, image: CameraImage, flat: CameraImage | None = None) -> Float32:
        """Edge energy of an image; ``flat``: the same without distortion, where it is known."""
        if not self._energies or self._energies[0][0].tick != image.tick:
            rgb = (flat or self._flat(image)).rgb
            self._energies = [(image, half_size_energy(rgb, self._edges))]
        return self._energies[0][1]
