"""Error-state iterated Kalman filter on the manifold, with keyframe poses cloned into its state.

Measurements enter in information form over the few error coordinates that they touch: with
``A = sum h^T h / var`` and ``b = sum h^T r / var`` the posterior of ``n`` coordinates costs one
solve of the touched size, whatever the number of residuals. This is the measurement-compressed
iterated update of FAST-LIO (Xu and Zhang 2021, Eqs. 18-20) in its information form; clones follow
Roumeliotis and Burdick 2002 ("Stochastic cloning"). Degenerate directions of a scan, such as
lateral motion over level ground, are found and removed in that form.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dpstrf

from touchdown.estimator.filtering.error_state import (
    ACCEL_BIAS,
    CLOCK,
    CLONE_DIM,
    GYRO_BIAS,
    IMU_DIM,
    NAVIGATION,
    POSE,
    POSE_DIM,
    POSITION,
    ROTATION,
    STATE_DIM,
    VELOCITY,
    Frames,
)
from touchdown.estimator.filtering.imu_propagation import (
    ImuBuffer,
    NavState,
    Passage,
    exp_so3_each,
    propagate_nominal,
    transition,
)
from touchdown.sim.frames import Pose, so3_exp
from touchdown.sim.typing import Array, Indices


class NormalEquations(NamedTuple):
    """Weighted least squares over D error coordinates. Kernels return it, too."""

    information: Array  # (D, D) ``sum h^T h / var``
    vector: Array  # (D,) ``sum h^T r / var``
    used: int  # residuals within the gate
    rms: float  # of these residuals, m or pixels


def limit_information(information: Array, errors: Array) -> Array:
    """Applies an information floor: returns the ``information`` A (D, D) of a measurement with
    independent ``errors`` of covariance F (D, D) added, which do not average out over its
    residuals. ``(A^-1 + F)^-1 = (I + A F)^-1 A`` holds for a singular A as well."""
    limited = np.linalg.solve(np.eye(len(errors)) + information @ errors, information)
    return 0.5 * (limited + limited.T)


def square_root(matrix: Array) -> Array:
    """Returns R (D, r) with ``R R^T = matrix`` (D, D), positive semi-definite of rank r: Cholesky
    factors with pivots, which end where what is left is rounding."""
    factors, order, rank, _ = dpstrf(0.5 * (matrix + matrix.T), lower=1)
    root = np.zeros((len(matrix), rank))
    root[order - 1] = np.tril(factors[:, :rank])
    return root


def weak_directions(
    information: Array, noise: Array, sigma_rad: float, sigma_m: float
) -> tuple[Array, Array]:
    """Returns the degenerate axes of rotation (3, r) and directions of translation (3, t) as unit
    columns: those whose standard deviation under ``information`` (6, 6), less twice its part of
    ``noise`` (6, 6), exceeds the limits.

    Rotation and translation are treated separately, each after marginalisation of the other (Schur
    complement), so that metres are never weighed against radians. Leaving out such directions
    follows Zhang, Kaess and Singh 2016 ("On degeneracy of optimization-based state estimation
    problems"), here with thresholds in the units of the state.
    """
    return (
        _weak_axes(information, noise, ROTATION, POSITION, sigma_rad),
        _weak_axes(information, noise, POSITION, ROTATION, sigma_m),
    )


def weak_columns(information: Array, noise: Array, sigmas: tuple[float, float]) -> Array:
    """The same as orthonormal columns (6, r + t) over a pose. ``sigmas``: rad and m."""
    axes, directions = weak_directions(information, noise, *sigmas)
    columns = np.zeros((POSE_DIM, axes.shape[1] + directions.shape[1]))
    columns[ROTATION, : axes.shape[1]] = axes
    columns[POSITION, axes.shape[1] :] = directions
    return columns


def rotations_among(weak: Array) -> int:
    """Number of axes of rotation among the columns of ``weak_columns``."""
    return int(weak[ROTATION].any(axis=0).sum())


def _weak_axes(information: Array, noise: Array, own: slice, other: slice, sigma: float) -> Array:
    """The degenerate directions of the three coordinates ``own``, the three others marginalised."""
    following = np.zeros((POSE_DIM, 3))
    following[own] = np.eye(3)
    # the pseudo-inverse ignores unobserved directions of the other block
    inverse = np.linalg.pinv(information[other, other], rcond=1e-9, hermitian=True)
    following[other] = -inverse @ information[other, own]
    values, vectors = np.linalg.eigh(following.T @ information @ following)
    noisy = np.diag((following @ vectors).T @ noise @ following @ vectors)
    return vectors[:, values - 2.0 * noisy < 1.0 / sigma**2]


def without_directions(information: Array, vector: Array, weak: Array) -> tuple[Array, Array]:
    """Returns the measurement (D, D), (D,) with the orthonormal columns ``weak`` (6, k), D >= 6,
    marginalised as unknown, so that the remaining information holds for any value of them."""
    if weak.shape[1] == 0:
        return information, vector
    if len(weak) < len(vector):
        weak = np.concatenate([weak, np.zeros((len(vector) - len(weak), weak.shape[1]))])
    across = information @ weak
    explained = across @ np.linalg.pinv(weak.T @ across, rcond=1e-9, hermitian=True)
    keep = np.eye(len(vector)) - weak @ weak.T
    left = keep @ (information - explained @ across.T) @ keep
    return 0.5 * (left + left.T), keep @ (vector - explained @ (weak.T @ vector))


_RATE_SAMPLES = 3
"""number of IMU samples over which the angular rate is a mean: one alone is mostly vibration"""


_CONVERGED = np.repeat([2e-5, 5e-4], 3)
"""rad and m: a step by less than these is the last one that is worth its time"""


class Prior(NamedTuple):
    """Covariance before a measurement of D error coordinates."""

    rows: Array  # (D, B + 6K) with all
    spread: Array  # (D, D) of them, and what the measurement errs by as a whole


class Eskf:
    """Error-state filter with cloned poses, as in the MSCKF.

    ``state`` and ``clones`` are the mean, ``covariance`` (B + 6K, B + 6K) that of the errors. The
    first B = 15 + C error coordinates are those of the navigation state and of its C constant
    calibration parameters; the error of clone k is (rotation right perturbation, position) at rows
    B + 6k. ``variances`` (B,) are the initial ones.
    """

    def __init__(self, state: NavState, variances: Array) -> None:
        self.state = state
        self.base = len(variances)
        self.rate = np.zeros(3)
        """(3,) rad/s, angular rate in the IMU's frame over the last hundredth of a second"""
        self.shared = max(0, len(state.calibration) - IMU_DIM)
        """number of calibration parameters that measurements depend on directly: all but the
        errors of the IMU, which act through the propagation"""
        self.loosely_coupled = False
        """loose coupling: measurements are taken as measurements of the present pose alone; clones
        and calibration count as exact"""
        self.covariance: Array = np.diag(np.asarray(variances, dtype=np.float64))
        self.clones: list[Pose] = []

    # ------------------------------------------------------------------------ propagation

    def propagate(self, buffer: ImuBuffer, count: int) -> tuple[Array, Array, Array]:
        """Propagates over the buffer's oldest ``count`` samples, which stay in the buffer.

        Returns the ticks (N + 1,), rotations (N + 1, 3, 3) and positions (N + 1, 3) passed.
        """
        ticks = np.concatenate(([self.state.tick], buffer.samples(count)[0]))
        passed, linear = self._passed(buffer, count)
        self.state = passed.end
        self._propagate_covariance(*linear)
        if count:
            self.rate = passed.gyro[-_RATE_SAMPLES:].mean(axis=0)
        return ticks, passed.rotations, passed.positions

    def predicted(self, buffer: ImuBuffer) -> tuple[NavState, Array]:
        """State and covariance (15, 15) after all samples of the buffer; the filter stays."""
        passed, (total, noise, _) = self._passed(buffer, buffer.count)
        return passed.end, total @ self.covariance[NAVIGATION, NAVIGATION] @ total.T + noise

    def _passed(self, buffer: ImuBuffer, count: int) -> tuple[Passage, tuple[Array, Array, Array]]:
        """The way over ``count`` samples, and what ``transition`` gives."""
        passed = propagate_nominal(self.state, *buffer.samples(count)[:3], buffer.step_s)
        return passed, transition(
            passed.rotations, passed.gyro, passed.force, buffer.step_s, buffer.densities
        )

    def _propagate_covariance(self, total: Array, noise: Array, by_errors: Array) -> None:
        cov, nav = self.covariance, slice(0, STATE_DIM)
        moved = total @ cov[nav]
        if self.shared:
            moved += by_errors @ cov[self.base - IMU_DIM : self.base]
        own = moved[:, nav] @ total.T + noise
        if self.shared:
            own += moved[:, self.base - IMU_DIM : self.base] @ by_errors.T
        cov[nav] = moved
        cov[STATE_DIM:, nav] = moved[:, STATE_DIM:].T
        cov[nav, nav] = 0.5 * (own + own.T)

    @property
    def twist(self) -> Array:
        """(6,) angular rate in the IMU's frame, rad/s, and velocity in the odometry frame, m/s."""
        return np.concatenate([self.rate, self.state.velocity])

    # ------------------------------------------------------------------------ clones

    def clone_indices(self, k: int) -> Indices:
        """The six error coordinates of clone ``k``."""
        start = self.base + CLONE_DIM * k
        return np.arange(start, start + CLONE_DIM)

    def add_clone(self, own_variances: Array | None = None) -> None:
        """Clones the present pose, fully correlated with the state.

        ``own_variances`` (6,) or their covariance (6, 6), rad^2 and m^2: independent errors shared
        by all that is stored with this clone.
        """
        size = len(self.covariance)
        grown = np.empty((size + CLONE_DIM, size + CLONE_DIM))
        grown[:size, :size] = self.covariance
        grown[size:, :size] = self.covariance[POSE]
        grown[:size, size:] = self.covariance[:, POSE]
        grown[size:, size:] = self.covariance[POSE, POSE]
        if own_variances is not None:
            spread = np.diag(own_variances) if own_variances.ndim == 1 else own_variances
            grown[size:, size:] += spread
        self.covariance = grown
        self.clones.append(self.state.pose)

    def remove_clone(self, k: int) -> None:
        """Marginalises clone ``k``: removes its rows and columns."""
        gone = self.clone_indices(k)
        self.covariance = np.delete(np.delete(self.covariance, gone, axis=0), gone, axis=1)
        del self.clones[k]

    # ------------------------------------------------------------------------ update

    def coupled(self, information: Array, vector: Array) -> tuple[Array, Array]:
        """Returns a measurement of ``touched`` coordinates under the filter's coupling: with loose
        coupling, its part about the present pose."""
        if not self.loosely_coupled:
            return information, vector
        information, vector = information.copy(), vector.copy()
        information[POSE_DIM:], information[:, POSE_DIM:], vector[POSE_DIM:] = 0.0, 0.0, 0.0
        return information, vector

    def gains(self, fraction: float) -> Array:
        """(C,) fraction of a measurement's correction that each calibration parameter takes, if
        mounts and lens take ``fraction``; with 0 they are "consider" parameters (Schmidt): their
        covariance counts, their estimate stays. The camera's clock, which no other error
        resembles, and the errors of the IMU take all."""
        gains = np.ones(self.base - STATE_DIM)
        gains[: self.shared] = fraction
        gains[CLOCK : CLOCK + 1] = 1.0
        return gains

    def prior(self, touched: Indices, floor_sigmas: Array | None = None) -> Prior:
        """The part of the covariance that a measurement of ``touched`` (D,) corrects.
        ``floor_sigmas`` (D,): of independent errors of the measurement as a whole."""
        rows = self.covariance[touched]
        spread = rows[:, touched]
        if floor_sigmas is not None:
            spread[np.diag_indices(len(touched))] += floor_sigmas**2
        return Prior(rows, spread)

    def correction(
        self, touched: Indices, information: Array, vector: Array, gains: Array | None = None,
        prior: Prior | None = None,
    ) -> Array:  # fmt: skip
        """Returns the error-state correction (B + 6K,) of the prior mean by ``A``, ``b`` on
        ``touched``; ``gains`` (C,): see there; ``prior``: that of ``touched``, if known."""
        rows, spread = prior or self.prior(touched)
        solved = np.linalg.solve(np.eye(len(touched)) + information @ spread, vector)
        delta: Array = solved @ rows
        if gains is not None:
            delta[STATE_DIM : self.base] *= gains
        return delta

    def update_covariance(
        self, touched: Indices, information: Array, gains: Array | None = None,
        prior: Prior | None = None,
    ) -> None:  # fmt: skip
        """Updates the covariance: ``P - P_t (I + A P_tt)^-1 A P_t^T``; parameters of the
        calibration lose what belongs to their part. ``prior``: that of ``touched``, if
        known."""
        rows, spread = prior or self.prior(touched)
        middle = np.linalg.solve(np.eye(len(touched)) + information @ spread, information)
        # a square keeps the matrix symmetric
        root = square_root(np.asarray(middle, np.float64)).T @ rows
        lost = root.T @ root
        if gains is not None:
            held = slice(STATE_DIM, self.base)
            lost[held, held] *= 1.0 - np.outer(1.0 - gains, 1.0 - gains)
        self.covariance = self.covariance - lost

    def apply(
        self, touched: Indices, information: Array, vector: Array, gains: Array | None = None
    ) -> None:
        """Updates mean and covariance by ``A``, ``b`` on ``touched``."""
        delta = self.correction(touched, information, vector, gains)
        self.state, self.clones = self.boxplus(self.state, self.clones, delta)
        self.update_covariance(touched, information, gains)

    def boxplus(
        self, state: NavState, clones: list[Pose], delta: Array, only: list[int] | None = None
    ) -> tuple[NavState, list[Pose]]:
        """Returns the mean ``(state, clones)`` moved by an error-state vector; of the clones
        ``only`` these, if given."""
        moved = replace(
            state, rotation=state.rotation @ so3_exp(delta[ROTATION]),
            position=state.position + delta[POSITION], velocity=state.velocity + delta[VELOCITY],
            gyro_bias=state.gyro_bias + delta[GYRO_BIAS],
            accel_bias=state.accel_bias + delta[ACCEL_BIAS],
            calibration=state.calibration + delta[STATE_DIM : self.base],
        )  # fmt: skip
        which = list(range(len(clones))) if only is None else only
        parts = delta[self.base :].reshape(-1, CLONE_DIM)[which]
        rotations, translations = Frames.of([clones[k] for k in which])
        turns = exp_so3_each(np.ascontiguousarray(parts[:, ROTATION]))
        new_clones = list(clones)
        ends = Frames(rotations @ turns, translations + parts[:, POSITION]).poses()
        for k, pose in zip(which, ends, strict=True):
            new_clones[k] = pose
        return moved, new_clones

    def touched(self, clones: list[int]) -> Indices:
        """Error coordinates of pose, shared calibration and the given clones, (6 + S + 6m,)."""
        shared = np.arange(STATE_DIM, STATE_DIM + self.shared)
        own = [self.clone_indices(k) for k in clones]
        return np.concatenate([np.arange(POSE_DIM), shared, *own])


class IteratedUpdate:
    """An update by one measurement whose normal equations are linearised anew after each step."""

    def __init__(self, eskf: Eskf, fraction: float = 1.0) -> None:
        """``fraction``: that mounts and lens take, see ``Eskf.gains``."""
        self._eskf, self._gains = eskf, eskf.gains(fraction)
        self._mean, self._clones = eskf.state, eskf.clones
        self._touched, self._prior = np.zeros(0, np.int64), eskf.prior(np.zeros(0, np.int64))
        self._information, self._delta = np.zeros((0, 0)), np.zeros(len(eskf.covariance))
        self._moved = self._delta
        """of ``_delta``, what the present mean has moved by: that of the clones linearised about"""

    def step(
        self, clones: list[int], information: Array, vector: Array, floors: Array | None = None
    ) -> bool:
        """Moves the mean by the measurement (D, D), (D,) of pose, shared calibration and the given
        clones, linearised at the present mean; other clones follow in the end. ``floors`` (D,):
        standard deviations of errors that do not average out over the residuals, see
        ``limit_information``, in the same equation as the prior. True if the pose hardly moves."""
        eskf = self._eskf
        information, vector = eskf.coupled(information, vector)
        coordinates = eskf.touched(clones)
        vector = vector + information @ self._moved[coordinates]
        # what the measurement says nothing about only follows
        known = np.flatnonzero(information.any(axis=0))
        touched = coordinates[known]
        if not np.array_equal(touched, self._touched):
            floors = None if floors is None else floors[known]
            self._touched, self._prior = touched, eskf.prior(touched, floors)
        self._information = information[np.ix_(known, known)]
        self._delta = eskf.correction(
            touched, self._information, vector[known], self._gains, self._prior
        )
        eskf.state, eskf.clones = eskf.boxplus(self._mean, self._clones, self._delta, clones)
        before, self._moved = self._moved, np.zeros(len(self._delta))
        self._moved[coordinates] = self._delta[coordinates]
        return bool((np.abs(self._moved - before)[POSE] < _CONVERGED).all())

    def abandon(self) -> None:
        """Returns to the mean before the first step."""
        self._eskf.state, self._eskf.clones = self._mean, self._clones

    def finish(self) -> None:
        """Moves all clones by the newest step and updates the covariance by its linearisation."""
        eskf = self._eskf
        eskf.state, eskf.clones = eskf.boxplus(self._mean, self._clones, self._delta)
        eskf.update_covariance(self._touched, self._information, self._gains, self._prior)
