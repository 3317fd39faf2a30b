"""Errors of a flight that PX4 controls."""

from __future__ import annotations

from touchdown.experiments.errors import UsageError


class Px4Error(UsageError):
    """PX4 is missing, or broke the protocol in the middle of a flight; one line."""
