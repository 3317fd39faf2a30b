"""Configurations of tests whose known answers are those of the ideal world."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from touchdown.experiments.config import loading
from touchdown.experiments.config.schema import Config

IDEAL = "profile=ideal"
"""An override after ``--set``."""


def load_ideal_config(
    file: Path | None = None, overrides: Sequence[str] = (), **options: Any
) -> Config:
    """As `touchdown.experiments.config.loading.load_config`, in profile ``ideal`` where nothing
    names another."""
    return loading.load_config(file, tuple(overrides), profile_default="ideal", **options)
