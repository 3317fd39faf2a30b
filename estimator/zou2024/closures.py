"""Loop closures: revisits correct the map, and the odometry frame follows at a bounded rate."""

from __future__ import annotations

import numpy as np

from touchdown.estimator.typing import Array
from touchdown.estimator.zou2024.landmarks import BRISK_BYTES, SIFT_BYTES, Features
from touchdown.estimator.zou2024.loop_closure.hypotheses import LoopFilter
from touchdown.estimator.zou2024.loop_closure.memory import Memory, MemoryLimits
from touchdown.estimator.zou2024.pose_graph import Edge, PoseGraph
from touchdown.estimator.zou2024.visual_map import MapKeyframe
from touchdown.sim.frames import Pose, rotation_from_yaw, skew, so3_log

KINDS = ((SIFT_BYTES, False), (BRISK_BYTES, True))
"""kinds of descriptors: number of bytes, and whether these are bits"""
_ANCHOR_SIGMAS = np.array([1e-4, 1e-4, 1e-4, 1e-3, 1e-3, 1e-3])
_LEVEL_SIGMAS = np.array([np.radians(0.05), np.radians(0.05), np.inf, np.inf, np.inf, 0.03])
_HOP_FLOOR_SIGMAS = np.repeat([2e-5, 1e-3], 3)
"""rad and m: a hop adds as much where the filter has learnt more than it forgot"""


class Closures:
    """Memory of places, loop hypotheses, pose graph, and the pose of the odometry frame in the
    world."""

    def __init__(self, speed_mps: float, rate_radps: float, limits: MemoryLimits) -> None:
        self._speed, self._rate = speed_mps, rate_radps
        self.memory, self._filter = Memory(limits, KINDS), LoopFilter()
        self._asked = 0
        self._graph = PoseGraph(_ANCHOR_SIGMAS, _LEVEL_SIGMAS)
        self._covariance: Array = np.zeros((6, 6))
        self._target = self.world_from_odom = Pose.identity()
        self.drift_covariance: Array = np.zeros((3, 3))
        self.closed = 0

    # ------------------------------------------------------------------------ places

    def ask(self, number: int, features: tuple[Features, Features], threshold: float) -> int | None:
        """Makes a keyframe a location. Returns the one that it most probably shows again, where it
        is new with a probability of ``1 - threshold`` at most, and not without a second one to
        compare it with."""
        descriptors = features[0].descriptors, features[1].descriptors
        self._asked, words = self.memory.add(number, descriptors)
        places = self.memory.working
        best = self._filter.update(places, self.memory.links(), self.memory.scores(words))
        self.memory.manage(best)
        return best if len(places) > 1 and 1.0 - self._filter.new >= threshold else None

    # ------------------------------------------------------------------------ graph

    def add(self, keyframe: MapKeyframe, covariance: Array, before: MapKeyframe | None) -> None:
        """Adds a new keyframe, connected by odometry to the newest one, ``before``; ``covariance``
        (6, 6): of its pose in the filter."""
        self._graph.add_node(keyframe.number, keyframe.map_from_imu, keyframe.odom_from_imu)
        if before is not None:
            ends = before.odom_from_imu, keyframe.odom_from_imu
            hop = hop_covariance(self._covariance, covariance, *ends)
            measured = ends[0].inverse() @ ends[1]
            information = np.linalg.inv(hop).astype(np.float64)
            self._graph.add_edge(Edge(before.number, keyframe.number, measured, information, False))
        self._covariance = covariance.copy()

    def close(
        self, source: MapKeyframe, target: MapKeyframe, seen: Pose, information: Array
    ) -> None:
        """Adds a closure: ``target``, localised at ``seen`` (map_from_imu) by landmarks around
        ``source``; ``information`` (6, 6) of rotation (right perturbation) and position in the
        map."""
        measured = source.map_from_imu.inverse() @ seen
        to_source = np.eye(6)
        to_source[3:, 3:] = source.map_from_imu.rotation
        self._graph.add_edge(
            Edge(
                source.number, target.number, measured, to_source.T @ information @ to_source, True
            )
        )
        self.memory.connect(source.number, self._asked)
        self.closed += 1

    def remove(self, number: int) -> None:
        """Removes a keyframe."""
        self.memory.remove(number)
        self._graph.remove_node(number)

    def refresh_odometry(self, keyframes: list[MapKeyframe], clones: int) -> None:
        """Updates height and tilt of the keyframes that the filter still corrects, and the odometry
        edges to them. ``keyframes``: all; the newest ``clones`` are in the filter, and the one
        before was until now."""
        for keyframe in keyframes[-clones - 1 :]:
            self._graph.measure_node(keyframe.number, keyframe.odom_from_imu)
        poses = {k.number: k.odom_from_imu for k in keyframes[-clones - 2 :]}
        for edge in self._graph.edges:
            if not edge.robust and edge.source in poses and edge.target in poses:
                edge.measured = poses[edge.source].inverse() @ poses[edge.target]

    def settle(self, keyframes: list[MapKeyframe]) -> None:
        """Solves the graph and updates the poses of the keyframes."""
        for keyframe in keyframes:
            self._graph.poses[keyframe.number] = keyframe.map_from_imu
        self._graph.optimise()
        for keyframe in keyframes:
            keyframe.map_from_imu = self._graph.poses[keyframe.number]
        newest = keyframes[-1]
        self.drift_covariance = self._graph.position_covariance(newest.number)
        self.aim(newest)

    def aim(self, newest: MapKeyframe) -> None:
        """Sets the target of the odometry frame: rotated about the vertical only, because both
        frames are aligned with gravity, and such that the newest keyframe lies where the graph has
        it."""
        self._target = level_transform(newest.odom_from_imu, newest.map_from_imu)

    # ------------------------------------------------------------------------ the odometry frame

    def advance(self, position_odom: Array, seconds: float) -> Pose:
        """Moves the odometry frame towards its target at a bounded speed at the vehicle, and
        returns its pose."""
        now, target = self.world_from_odom, self._target
        if now is target:
            return now
        yaw_error = float(so3_log(now.rotation.T @ target.rotation)[2])
        limit = self._rate * seconds
        yaw = float(np.arctan2(now.rotation[1, 0], now.rotation[0, 0]))
        rotation = rotation_from_yaw(yaw + float(np.clip(yaw_error, -limit, limit)))
        here = now.apply(position_odom)
        gap = target.apply(position_odom) - here
        length = float(np.sqrt(gap @ gap))
        here = here + gap * min(1.0, self._speed * seconds / max(length, 1e-12))
        arrived = length <= self._speed * seconds and abs(yaw_error) <= limit
        self.world_from_odom = (
            target if arrived else Pose(rotation, here - rotation @ position_odom)
        )
        return self.world_from_odom


def level_transform(odom: Pose, world: Pose) -> Pose:
    """Returns world_from_odom, a rotation about the vertical and a translation, that maps the
    position of ``odom`` to that of ``world`` and matches the heading best."""
    relative = world.rotation @ odom.rotation.T
    yaw = float(np.arctan2(relative[1, 0] - relative[0, 1], relative[0, 0] + relative[1, 1]))
    rotation = rotation_from_yaw(yaw)
    return Pose(rotation, world.translation - rotation @ odom.translation)


def hop_covariance(before: Array, now: Array, source: Pose, target: Pose) -> Array:
    """Returns the covariance (6, 6) of an odometry edge from the filter's of both poses, ``before``
    and ``now`` (6, 6): what the errors have grown by beyond those that the source hands on. Over
    many hops the pose graph is then as uncertain as the filter."""
    back = source.rotation.T
    handed_on = np.eye(6)
    handed_on[:3, :3] = target.rotation.T @ source.rotation
    handed_on[3:, :3] = -source.rotation @ skew(back @ (target.translation - source.translation))
    grown = now - handed_on @ before @ handed_on.T
    grown[3:] = back @ grown[3:]
    grown[:, 3:] = grown[:, 3:] @ source.rotation
    scale = np.outer(_HOP_FLOOR_SIGMAS, _HOP_FLOOR_SIGMAS)
    values, axes = np.linalg.eigh(0.5 * (grown + grown.T) / scale)
    covariance: Array = scale * ((axes * np.maximum(values, 1.0)) @ axes.T)
    return covariance
