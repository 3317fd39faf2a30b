"""Loop closures, verified by PnP in RANSAC, then on all landmarks in view: revisits correct the map
by a pose graph of the keyframes, and the odometry frame follows at a bounded rate.
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import splu

from touchdown.estimator.filtering.error_state import (
    POSE,
    POSE_DIM,
    POSITION,
    ROTATION,
    Frame,
    Pinhole,
    after,
    error_between,
    moved_by,
)
from touchdown.estimator.filtering.reprojection import (
    LandmarkViews,
    PixelNoise,
    calibrated_information,
)
from touchdown.estimator.zou2024.bundle import solve_pnp
from touchdown.estimator.zou2024.place_recognition import LoopFilter, Memory, MemoryLimits
from touchdown.estimator.zou2024.relative_pose import ImageModel
from touchdown.estimator.zou2024.visual_map import (
    BRISK_BYTES,
    SIFT,
    SIFT_BYTES,
    Features,
    MapKeyframe,
    Sightings,
    VisualMap,
    by_host,
)
from touchdown.sim.frames import Pose, rotation_from_yaw, skew, so3_log
from touchdown.sim.typing import Array


@dataclass(slots=True)
class Edge:
    """Measured pose ``source_from_target``; ``information`` (6, 6) of the errors (rotation of the
    target, right perturbation; translation in the source frame)."""

    source: int
    target: int
    measured: Pose
    information: Array
    robust: bool
    """True for closures, which may be false; odometry is not robustified"""


def edge_residual(edge: Edge, source: Pose, target: Pose) -> Array:
    """(6,) ``log(M^T R_s^T R_t)`` and ``R_s^T (p_t - p_s) - m``."""
    rotation = edge.measured.rotation.T @ source.rotation.T @ target.rotation
    translation = source.rotation.T @ (target.translation - source.translation)
    return np.concatenate([so3_log(rotation), translation - edge.measured.translation])


_ROBUST_SCALE = 3.0
"""standard deviations, of the Cauchy weights of closures"""
_TARGET_ROTATION, _TARGET_POSITION = after(POSE_DIM, ROTATION), after(POSE_DIM, POSITION)
"""coordinates of the target among an edge's twelve, the source's six first"""


class PoseGraph:
    """Pose graph; nodes by number, in the order of addition. The first one fixes the map."""

    def __init__(self, anchor_sigmas: Array, level_sigmas: Array) -> None:
        """``anchor_sigmas`` (6,): of the first node; ``level_sigmas`` (6,): how well every node's
        rotation and position are known beforehand (rad, m; infinite where they are not): LIDAR and
        gravity measure height and tilt of each, whatever the path."""
        self.poses: dict[int, Pose] = {}
        self.edges: list[Edge] = []
        self._priors: dict[int, tuple[Pose, Array]] = {}
        self._anchor = 1.0 / anchor_sigmas**2
        self._level = 1.0 / level_sigmas**2

    def add_node(self, number: int, guess: Pose, measured: Pose) -> None:
        """``measured``: pose whose height and tilt count (all six coordinates at the first)."""
        self._priors[number] = (measured, self._level if self.poses else self._anchor)
        self.poses[number] = guess

    def measure_node(self, number: int, measured: Pose) -> None:
        """Replaces the ``measured`` pose of a node."""
        self._priors[number] = (measured, self._priors[number][1])

    def add_edge(self, edge: Edge) -> None:
        """Adds an edge between two nodes."""
        self.edges.append(edge)

    def remove_node(self, number: int) -> None:
        """Removes a node and joins its two odometry edges into one."""
        before = [e for e in self.edges if e.target == number and not e.robust]
        after = [e for e in self.edges if e.source == number and not e.robust]
        self.edges = [e for e in self.edges if number not in (e.source, e.target)]
        del self._priors[number]
        first = next(iter(self.poses)) == number
        del self.poses[number]
        if before and after:
            covariance = np.linalg.inv(before[0].information) + np.linalg.inv(after[0].information)
            self.edges.append(
                Edge(
                    before[0].source, after[0].target, before[0].measured @ after[0].measured,
                    np.linalg.inv(covariance), False,
                )
            )  # fmt: skip
        if first and self.poses:
            successor = next(iter(self.poses))
            self._priors[successor] = (self.poses[successor], self._anchor)

    def optimise(self, iterations: int = 2) -> None:
        """Minimises the weighted sum of squares over the nodes."""
        for _ in range(iterations):
            matrix, vector = self._system()
            steps = splu(matrix).solve(vector).reshape(-1, 6)
            for number, step in zip(list(self.poses), steps, strict=True):
                self.poses[number] = moved_by(self.poses[number], step)

    def position_covariance(self, number: int) -> Array:
        """(3, 3) m^2 of a node's position given everything in the graph."""
        matrix, _ = self._system()
        row = 6 * list(self.poses).index(number)
        units = np.zeros((matrix.shape[0], 3))
        units[row + 3 + np.arange(3), np.arange(3)] = 1.0
        block: Array = splu(matrix).solve(units)[row + 3 : row + 6]
        return 0.5 * (block + block.T)

    def _system(self) -> tuple[csc_matrix, Array]:
        order = {number: i for i, number in enumerate(self.poses)}
        size = 6 * len(order)
        vector = np.zeros(size)
        diagonal = np.zeros(size)
        for number, (pose, weights) in self._priors.items():
            at = 6 * order[number]
            diagonal[at : at + 6] = weights
            vector[at : at + 6] = -weights * error_between(pose, self.poses[number])
        values, rows, cols = diagonal, np.arange(size), np.arange(size)
        if self.edges:
            blocks, vectors = self._edge_blocks()
            ends = np.array([(order[e.source], order[e.target]) for e in self.edges])
            where = (6 * ends[:, :, None] + np.arange(6)).reshape(-1, 12)
            np.add.at(vector, where, vectors)
            values = np.concatenate([blocks.ravel(), values])
            rows = np.concatenate([np.repeat(where, 12, axis=1).ravel(), rows])
            cols = np.concatenate([np.tile(where, (1, 12)).ravel(), cols])
        return coo_matrix((values, (rows, cols)), shape=(size, size)).tocsc(), vector

    def _edge_blocks(self) -> tuple[Array, Array]:
        """Blocks (E, 12, 12) and vectors (E, 12), the source's six coordinates first."""
        poses = self.poses
        residuals = np.array(
            [edge_residual(e, poses[e.source], poses[e.target]) for e in self.edges]
        )
        back = np.array([poses[e.source].rotation.T for e in self.edges])
        target = np.array([poses[e.target].rotation for e in self.edges])
        translations = residuals[:, 3:] + np.array([e.measured.translation for e in self.edges])
        # inverse of the right Jacobian, to first order of the (small) rotation residual
        curl = np.eye(3) + 0.5 * np.array([skew(r) for r in residuals[:, ROTATION]])
        jacobians = np.zeros((len(self.edges), POSE_DIM, 2 * POSE_DIM))
        jacobians[:, ROTATION, ROTATION] = -curl @ (back @ target).transpose(0, 2, 1)
        jacobians[:, ROTATION, _TARGET_ROTATION] = curl
        jacobians[:, POSITION, ROTATION] = [skew(translation) for translation in translations]
        jacobians[:, POSITION, POSITION] = -back
        jacobians[:, POSITION, _TARGET_POSITION] = back
        informations = np.array([e.information for e in self.edges])
        square = np.einsum("ei,eij,ej->e", residuals, informations, residuals)
        robust = np.array([e.robust for e in self.edges])
        weights = np.where(robust, 1.0 / (1.0 + square / _ROBUST_SCALE**2), 1.0)
        weighted = jacobians.transpose(0, 2, 1) @ informations * weights[:, None, None]
        return weighted @ jacobians, -(weighted @ residuals[:, :, None])[:, :, 0]


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
    return scale * ((axes * np.maximum(values, 1.0)) @ axes.T)


_ITERATIONS = 300
"""``Vis/Iterations`` of RTAB-Map"""
_CLEAR_RATIO = 0.8
"""ratio of the distances to the nearest descriptor and to the next; ``Vis/CorNNDR`` of RTAB-Map"""
_RANSAC_PX = 3.0
_GATE_PX = 6.0
_RADIUS_PX = 40.0
"""``Vis/CorGuessWinSize`` of RTAB-Map"""
_GUESS_SIGMAS = np.array([0.003, 0.003, 0.05, 2.0, 2.0, 0.2])
_MIN_SCALE = 0.7
"""a large change of scale magnifies the depth errors of landmarks"""


class Revisit(NamedTuple):
    """The present keyframe as the landmarks of an old one show it."""

    pose: Pose  # map_from_imu
    information: Array  # (6, 6) of rotation (right perturbation) and position in the map


@dataclass(frozen=True, slots=True)
class LoopVerifier:
    """Localises a keyframe by the landmarks of old ones."""

    visual_map: VisualMap
    model: ImageModel
    minimum: int
    """landmarks that agree"""

    def __call__(
        self, features: tuple[Features, Features], hosts: list[MapKeyframe], keyframe: MapKeyframe
    ) -> Revisit | None:
        """None where the landmarks of ``hosts`` do not agree on a pose of ``keyframe``, whose image
        has ``features``."""
        hosts = [
            host for host in hosts
            if _MIN_SCALE < host.depth_m / keyframe.depth_m < 1.0 / _MIN_SCALE
        ]  # fmt: skip
        rough = self.by_descriptors(features, hosts)
        if rough is None:
            return None
        # gravity is known better than the tilt by a few landmarks
        guess = level_transform(keyframe.map_from_imu, rough) @ keyframe.map_from_imu
        frames = {host.number: host.map_from_imu for host in hosts}
        known = {host.number: host for host in hosts}
        sightings, _ = self.visual_map.match(features, hosts, frames, guess, _RADIUS_PX)
        if len(sightings) < self.minimum:
            return None
        solved = solve_pnp(
            sightings.pixels, self.visual_map.positions(sightings, frames, known),
            self.model.sigmas_px[sightings.kinds], guess, np.diag(_GUESS_SIGMAS**-2.0),
            self.model.camera.imu_from_camera, self.model.camera.intrinsics, self.minimum,
        )  # fmt: skip
        if solved is None:
            return None
        inliers = sightings.select(solved.inliers)
        return Revisit(solved.pose, self._information(solved.pose, inliers, known))

    def by_descriptors(
        self, features: tuple[Features, Features], hosts: list[MapKeyframe]
    ) -> Pose | None:
        """map_from_imu of an image by P3P in RANSAC over matches that nothing but their descriptors
        predicts; the same for the same input, as OpenCV's generator has a fixed seed."""
        points, pixels = [np.zeros((0, 3))], [np.zeros((0, 2))]
        for kind, found in enumerate(features):
            sets = [host.landmarks[kind] for host in hosts]
            if len(found) == 0 or sum(len(one.points) for one in sets) == 0:
                continue
            norm = cv2.NORM_L2 if kind == SIFT else cv2.NORM_HAMMING
            known = np.concatenate([one.descriptors for one in sets])
            found_twice = cv2.BFMatcher(norm).knnMatch(found.descriptors, known, k=2)
            pairs = [
                two[0] for two in found_twice
                if len(two) == 2 and two[0].distance < _CLEAR_RATIO * two[1].distance
            ]  # fmt: skip
            placed = [h.map_from_imu.apply(h.landmarks[kind].points) for h in hosts]
            points.append(np.concatenate(placed)[[pair.trainIdx for pair in pairs]])
            pixels.append(found.pixels[[pair.queryIdx for pair in pairs]])
        landmarks, seen = np.concatenate(points), np.concatenate(pixels)
        if len(seen) < self.minimum:
            return None
        # near the origin, where single precision is enough
        middle, matrix = landmarks.mean(axis=0), self.model.camera.intrinsics.matrix()
        done, _, _, chosen = cv2.solvePnPRansac(
            landmarks - middle, seen, matrix, None, iterationsCount=_ITERATIONS,
            reprojectionError=_RANSAC_PX, confidence=0.999, flags=cv2.SOLVEPNP_AP3P,
        )  # fmt: skip
        if not done or chosen is None or len(chosen) < self.minimum:
            return None
        inside = chosen[:, 0]
        done, turn, shift = cv2.solvePnP(
            landmarks[inside] - middle, seen[inside], matrix, None, flags=cv2.SOLVEPNP_SQPNP
        )
        if not done:
            return None
        rotation = np.asarray(cv2.Rodrigues(turn)[0], np.float64).T
        map_from_camera = Pose(rotation, middle - rotation @ shift[:, 0])
        return map_from_camera @ self.model.camera.imu_from_camera.inverse()

    def _information(self, pose: Pose, inliers: Sightings, known: dict[int, MapKeyframe]) -> Array:
        """(6, 6) of ``pose`` from its inliers: their pixels in both images, the depths of the
        landmarks, and the scatter of the residuals where that is larger."""
        mount, lens = self.model.camera.imu_from_camera, self.model.camera.intrinsics
        information, excess = np.zeros((POSE_DIM, POSE_DIM)), 0.0
        for mine, landmarks in by_host(inliers, known):
            points = landmarks.points[inliers.indices[mine]]
            arms = points - mount.translation
            spreads = arms * (self.model.depth_sigma_m / np.linalg.norm(arms, axis=1))[:, None]
            views = LandmarkViews.fixed(inliers.pixels[mine], points, spreads)
            sigma = float(np.sqrt(2.0) * self.model.sigmas_px[inliers.kinds[mine[0]]])
            part = calibrated_information(
                views, Frame.of(pose), Frame.of(known[int(inliers.hosts[mine[0]])].map_from_imu),
                np.zeros((2, POSE_DIM)), Frame.of(mount.inverse()), Pinhole.of(lens),
                PixelNoise(sigma, _GATE_PX),
            )  # fmt: skip
            information += part.information[POSE, POSE]
            excess += part.used * part.rms**2 / (2.0 * sigma**2)
        return information / max(1.0, excess / len(inliers))
