"""Configurations of tests whose known answers are those of the ideal world."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from touchdown.experiments.config import loading
from touchdown.experiments.config.schema import Config
from touchdown.sim.api import ImuParams, WindParams

NO_NOISE = ImuParams(
    gyro_density=0.0, accel_density=0.0, gyro_bias_walk=0.0, accel_bias_walk=0.0,
    gyro_bias_sigma=0.0, accel_bias_sigma=0.0,
)  # fmt: skip
STILL_AIR = WindParams(mean_kmh=0.0, turbulence=False)


def load_ideal_config(
    file: Path | None = None, overrides: Sequence[str] = (), **options: Any
) -> Config:
    """As `touchdown.experiments.config.loading.load_config`, in profile ``ideal`` where nothing
    names another."""
    return loading.load_config(file, tuple(overrides), profile_default="ideal", **options)
