"""Wrapper of an external estimator in flight, which reports its errors in one line."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

from touchdown.estimator.api import Estimate, spare_sensors
from touchdown.experiments.errors import UsageError
from touchdown.experiments.external.estimate_checks import (
    call,
    describe_error,
    wrong_estimate,
    wrong_estimator,
)
from touchdown.experiments.external.loading import external_builder, location, wrong_signature
from touchdown.sim.api import Observation, SensorNeeds, SensorRig


class ExternalEstimatorError(UsageError):
    """Error of an external estimator, in one line."""


class ExternalEstimator:
    """Passes observations to the estimator that ``name``, MODULE:FUNCTION, builds from ``params``
    and ``rig``, and checks its estimates.

    Raises ExternalEstimatorError for every exception in building or updating, and for an invalid
    estimate; UsageError if the function does not exist.
    """

    needs: SensorNeeds

    def __init__(self, name: str, params: Mapping[str, Any], rig: SensorRig) -> None:
        build = external_builder(name)
        self._name = name
        reason = wrong_signature(build)
        if reason:
            raise self._error(reason)
        inner, error = call(build, copy.deepcopy(dict(params)), rig)
        if error is not None:
            raise self._error(f"build raised {describe_error(error)}", error) from error
        reason = wrong_estimator(inner, rig)
        if reason:
            raise self._error(reason)
        self.needs, self.spare_sensors = inner.needs, spare_sensors(inner)
        self._update = inner.update

    def update(self, obs: Observation) -> Estimate:
        """Estimate of the external estimator, checked."""
        estimate: Estimate
        estimate, error = call(self._update, obs)
        if error is not None:
            what = f"at {obs.time_s:.3f} s update raised {describe_error(error)}"
            raise self._error(what, error) from error
        reason = wrong_estimate(estimate)
        if reason:
            raise self._error(f"at {obs.time_s:.3f} s update returned {reason}")
        return estimate

    def _error(self, what: str, error: BaseException | None = None) -> ExternalEstimatorError:
        where = "" if error is None else location(error, self._name.partition(":")[0])
        return ExternalEstimatorError(
            f"estimator '{self._name}': {what}{where}; "
            f"`touchdown check-estimator {self._name}` says more"
        )
