"""Loop closures: revisits correct the map, and the odometry frame follows at a bounded rate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.zou2024.dictionary import InvertedIndex, Vocabulary
from touchdown.estimator.zou2024.landmarks import BRISK, SIFT, Features
from touchdown.estimator.zou2024.pose_graph import Edge, PoseGraph
from touchdown.estimator.zou2024.visual_map import MapKeyframe
from touchdown.sim.frames import Pose, rotation_from_yaw, so3_log

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_WORDS = 3000
"""capacity of each vocabulary"""
_LEAST_LIKENESS = 0.02
_ANCHOR_SIGMAS = np.array([1e-4, 1e-4, 1e-4, 1e-3, 1e-3, 1e-3])
_LEVEL_SIGMAS = np.array([np.radians(0.05), np.radians(0.05), np.inf, np.inf, np.inf, 0.03])
_HOP_SIGMAS = np.array([2e-4, 2e-4, 2e-4, 0.006, 0.006, 0.006])
"""rad and m, from one keyframe to the next"""


class Closures:
    """Dictionary, inverted index, pose graph, and the pose of the odometry frame in the world."""

    def __init__(self, speed_mps: float, rate_radps: float) -> None:
        self._speed, self._rate = speed_mps, rate_radps
        self._vocabularies = (Vocabulary(SIFT, _WORDS), Vocabulary(BRISK, _WORDS))
        self._index = InvertedIndex()
        self._graph = PoseGraph(_ANCHOR_SIGMAS, _LEVEL_SIGMAS)
        self._target = self.world_from_odom = Pose.identity()
        self.drift_covariance: Array = np.zeros((3, 3))
        self.closed = 0

    # ------------------------------------------------------------------------ dictionary

    def words(self, features: tuple[Features, Features]) -> Indices:
        """The dictionary's words (N,) of an image's features; those of the two kinds differ."""
        sift, brisk = (
            vocabulary.assign(found.descriptors)
            for vocabulary, found in zip(self._vocabularies, features, strict=True)
        )
        return np.concatenate([2 * sift, 2 * brisk + 1])

    def candidates(self, words: Indices, among: set[int], most: int) -> list[int]:
        """Returns the keyframes of ``among`` that share most words with an image of these words."""
        scores = self._index.scores(words)
        old = [(s, -k) for k, s in scores.items() if k in among and s >= _LEAST_LIKENESS]
        return [-k for _, k in sorted(old, reverse=True)[:most]]

    # ------------------------------------------------------------------------ graph

    def add(self, keyframe: MapKeyframe, words: Indices, before: int | None) -> None:
        """Adds a new keyframe, connected by odometry to keyframe ``before``."""
        self._index.add(keyframe.number, words)
        self._graph.add_node(keyframe.number, keyframe.map_from_imu, keyframe.odom_from_imu)
        if before is not None:
            self._graph.add_edge(
                Edge(before, keyframe.number, Pose.identity(), np.diag(_HOP_SIGMAS**-2.0), False)
            )

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
        self.closed += 1

    def remove(self, number: int) -> None:
        """Removes a keyframe."""
        self._index.remove(number)
        self._graph.remove_node(number)

    def refresh_odometry(self, keyframes: dict[int, MapKeyframe]) -> None:
        """Updates the odometry edges of the given keyframes after bundle adjustment."""
        for edge in self._graph.edges:
            if not edge.robust and edge.source in keyframes and edge.target in keyframes:
                source, target = keyframes[edge.source], keyframes[edge.target]
                edge.measured = source.odom_from_imu.inverse() @ target.odom_from_imu

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
