"""What the rest of the project may know of experiments: outcomes."""

from __future__ import annotations

from enum import StrEnum


class Outcome(StrEnum):
    LANDED = "LANDED"
    TIPPED = "TIPPED"
    COLLIDED = "COLLIDED"
    TIMEOUT = "TIMEOUT"
    DIVERGED = "DIVERGED"
    NO_SITE = "NO_SITE"
    ABORTED = "ABORTED"
    COMPLETED = "COMPLETED"
    """``fly``: the survey was flown to its end"""
