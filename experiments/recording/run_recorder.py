"""Recorder of the files of a flight: trajectories, the Rerun recording, the map, the costmap."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from touchdown.estimator.api import Estimate, MapView
from touchdown.experiments.config.schema import Config
from touchdown.experiments.drawing.map_images import survey_marks
from touchdown.experiments.io.tum import TumWriter
from touchdown.experiments.recording.recorder import NullRecorder, Recorder, StepRecord
from touchdown.landing.api import LanderView
from touchdown.scenes.api import Scene
from touchdown.sim.api import SensorRig
from touchdown.sim.frames import Pose, rotation_from_yaw

if TYPE_CHECKING:
    from touchdown.experiments.io.sensor_log import SensorLog


class RunRecorder:
    """Fills a run directory: ``truth.tum``, ``estimate.tum``, ``reference.tum``, ``map.ply``,
    ``costmap.png``, ``classes.png`` and, with ``config.record``, ``flight.rrd``; with ``sensors``,
    also the sensor log and ``odometry.tum``. ``live``: see `RerunLog`.

    ``out_dir`` must exist. Files are complete after ``close``; memory does not grow with the
    flight.
    """

    def __init__(
        self,
        out_dir: Path,
        scene: Scene,
        rig: SensorRig,
        config: Config,
        sensors: SensorLog | None = None,
        live: str | None = None,
    ) -> None:
        self._out_dir = out_dir
        self._sensors = sensors
        self._truth = TumWriter(out_dir / "truth.tum")
        self._estimate = TumWriter(out_dir / "estimate.tum")
        self._reference = TumWriter(out_dir / "reference.tum")
        self._odometry = TumWriter(out_dir / "odometry.tum") if sensors is not None else None
        self._row_ticks = max(1, round(rig.tick_hz / config.log.trajectory_hz))
        self._next_row_tick = 0
        self._last: tuple[Estimate, MapView] | None = None
        self._selection: tuple[LanderView, Pose] | None = None
        self._costmap_id = 0
        self._marks = survey_marks(scene.takeoff_xy_m, scene.takeoff_yaw, config.survey)
        self._recording: Recorder = NullRecorder()
        if config.record or live is not None:
            from touchdown.experiments.recording.rerun_recorder import RerunLog

            path = out_dir / "flight.rrd" if config.record else None
            self._recording = RerunLog(path, scene, rig, config, live)

    def tick(self, step: StepRecord) -> None:
        estimate, lander_view = step.estimate, step.lander_view
        if step.truth.tick >= self._next_row_tick:
            self._next_row_tick = step.truth.tick + self._row_ticks
            self._write_rows(step)
        self._last = (estimate, step.map_view)
        if self._sensors is not None:
            self._sensors.add(step.obs)
        if lander_view.costmap is not None and lander_view.site_world is not None:
            self._keep_selection(lander_view, estimate)
        elif lander_view.costmap is not None and self._selection is None:
            self._selection = (lander_view, estimate.world_from_odom)
        self._recording.tick(step)

    def close(self) -> None:
        for writer in (self._truth, self._estimate, self._reference, self._odometry):
            if writer is not None:
                writer.close()
        if self._sensors is not None:
            self._sensors.close()
        self._recording.close()
        self._write_map()
        self._write_costmap()

    def _write_rows(self, step: StepRecord) -> None:
        truth, estimate = step.truth, step.estimate
        self._truth.add(truth.time_s, truth.world_from_body)
        self._estimate.add(estimate.time_s, estimate.world_from_body)
        if self._odometry is not None:
            self._odometry.add(estimate.time_s, estimate.odom_from_body)
        heading = estimate.world_from_odom.rotation @ rotation_from_yaw(step.setpoint.yaw_odom)
        self._reference.add(truth.time_s, Pose(heading, step.lander_view.reference_world))

    def _keep_selection(self, lander_view: LanderView, estimate: Estimate) -> None:
        """Keeps each new costmap together with the map's frame of that moment."""
        if id(lander_view.costmap) != self._costmap_id:
            self._costmap_id = id(lander_view.costmap)
            self._selection = (lander_view, estimate.world_from_odom)

    def _write_map(self) -> None:
        if self._last is None:
            return
        from touchdown.experiments.drawing.map_images import map_points, transform_points, write_ply

        estimate, map_view = self._last
        points, colours = map_points(map_view.coarse)
        write_ply(
            self._out_dir / "map.ply", transform_points(estimate.world_from_odom, points), colours
        )

    def _write_costmap(self) -> None:
        if self._selection is None:
            return
        from touchdown.experiments.drawing.costmap_image import write_costmap

        view, world_from_odom = self._selection
        site = view.site_world
        site_odom = None if site is None else world_from_odom.inverse().apply(np.asarray(site))
        write_costmap(self._out_dir / "costmap.png", view, site_odom, world_from_odom, self._marks)
        if view.costmap is not None and view.costmap.semantics is not None:
            from touchdown.experiments.drawing.class_image import write_classes

            write_classes(self._out_dir / "classes.png", view.costmap, world_from_odom, self._marks)
