"""Names of the parts of a flight, as a part of its result."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class PartNames(BaseModel):
    """A text for each part of a flight beside the estimator."""

    model_config = ConfigDict(extra="allow", frozen=True, strict=True)

    selector: str | None = None
    lander: str | None = None
    controller: str | None = None
    mapper: str | None = None
    classifier: str | None = None
