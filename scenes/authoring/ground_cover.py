"""What the materials of a ground look like to a LIDAR beyond their reflectivity: spread within the
material, plants that stand on it, dust. Sources are in docs/sensors.md."""

from __future__ import annotations

from typing import NamedTuple


class Cover(NamedTuple):
    """As the fields of `scenes.api.Surface`."""

    spread: float = 0.1
    canopy_m: float = 0.0
    leaf_area: float = 0.0
    dust: float = 0.0


_GRASS, _CROP = 1.7, 3.6
"""leaf area index of grassland and of crops, global means (Asner, Scurlock and Hicke 2003)"""

COVERS: dict[str, Cover] = {
    "LAWN": Cover(0.08, 0.045, _GRASS),
    "MEADOW": Cover(0.12, 0.25, _GRASS),
    "SOIL": Cover(0.14, dust=1.0),
    "PAVEMENT": Cover(0.08),
    "SIDE_PAVEMENT": Cover(0.08),
    "ASPHALT": Cover(0.15),
    "NEW_ASPHALT": Cover(0.10),
    "GRAVEL": Cover(0.15, dust=0.2),
    "PAVERS": Cover(0.10),
    "MULCH": Cover(0.20),
    "CAR_PARK": Cover(0.15),
    "WORN": Cover(0.15, 0.02, 0.7, dust=0.2),
    "LITTER": Cover(0.20),
    "FERN": Cover(0.20, 0.35, _CROP),
    "SAND": Cover(0.06, dust=0.6),
    "FAIRWAY": Cover(0.07, 0.015, _GRASS),
    "GREEN": Cover(0.05),
    "ROUGH": Cover(0.12, 0.10, _GRASS),
    "PUDDLE": Cover(0.0),
    "DECK": Cover(0.06),
    "PLANKS": Cover(0.12),
    "PITCH": Cover(0.08, 0.03, _GRASS),
    "CLAY": Cover(0.10, dust=0.8),
    "LANE": Cover(0.15, dust=0.4),
    "COBBLES": Cover(0.12),
    "RUBBER": Cover(0.08),
    "CROPS": Cover(0.16, 0.30, _CROP),
    "BEACH": Cover(0.06, dust=0.4),
    "MUD": Cover(0.14),
    "ROOF_DECK": Cover(0.15),
    "SNOW": Cover(0.04),
    "PACKED_SNOW": Cover(0.06),
    "ICE": Cover(0.0),
    "DUNE": Cover(0.06, dust=1.0),
    "SAND_FLAT": Cover(0.06, dust=1.0),
    "RUTTED_SAND": Cover(0.06, dust=1.0),
    "DRY_GRASS": Cover(0.12, 0.20, 0.8, dust=0.2),
    "BEDROCK": Cover(0.15),
}
PAINT = Cover(0.15)
"""marking paint and its wear"""


def cover_of(material: str) -> Cover:
    """Returns the cover of a material by its name; a material that is not listed is bare."""
    return COVERS.get(material, Cover())
