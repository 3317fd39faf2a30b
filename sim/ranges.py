"""Types of configuration values with the ranges that they may take; part of `sim.api`.

The ranges are metadata of annotated-types. The dataclasses do not check them; pydantic does when
`experiments.config.loading` reads a configuration.
"""

from __future__ import annotations

from typing import Annotated

from annotated_types import Ge, Gt, Interval

FORBID_EXTRA = {"extra": "forbid"}
"""Read by pydantic: an unknown configuration key is an error, not a silent default."""

Positive = Annotated[float, Gt(0)]
NotNegative = Annotated[float, Ge(0)]
Fraction = Annotated[float, Interval(ge=0, le=1)]
Count = Annotated[int, Gt(0)]
CountOrZero = Annotated[int, Ge(0)]
Heading = Annotated[float, Interval(ge=-360, le=360)]
"""degrees"""
