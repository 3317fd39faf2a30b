"""Published figures of Zou, Sun and Kong (2024), doi:10.3390/app14146079, with their tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

SOURCE = (
    "C. Zou, Y. Sun, L. Kong: Unmanned Aerial Vehicle Landing on Rugged Terrain by On-Board "
    "LIDAR–Camera Positioning System. Applied Sciences 2024, 14(14), 6079, "
    "doi:10.3390/app14146079"
)

ANALYSED_SCENE = "crossroad"
"""the only scene that the paper analyses method by method (its section 5.1)"""

METHOD_NAMES: Mapping[str, str] = {
    "gps": "GPS",
    "optical_flow": "Optical Flow",
    "hybrid_flow": "Hybrid Optical Flow",
    "zou2024": "Ours",
}
"""Estimators of this project and the name that the paper's tables give to the same method."""


@dataclass(frozen=True, slots=True)
class Published:
    """``value`` as printed; ``where`` names the table."""

    value: float
    where: str


def _table(where: str, **values: float) -> Mapping[str, Published]:
    return {method: Published(value, where) for method, value in values.items()}


TRAJECTORY_ERROR_M = _table(
    "Table 2", gps=1.0112, optical_flow=2.0538, hybrid_flow=0.5193, zou2024=0.3671
)
"""E_tra: mean deviation of the flown path from the expected one."""

TRAJECTORY_VARIANCE_M2 = _table(
    "Table 2", gps=0.5083, optical_flow=1.5819, hybrid_flow=0.1828, zou2024=0.1568
)

SCAN_TIME_AND_DENSITY = "36.11111"
"""Table 1, T_total (s) and rho_map (points per square metre): the text runs the two numbers
together, and the position of the boundary is unknown."""

LEVELNESS_DEG: tuple[float, ...] = (1.19, 0.89, 0.96, 1.19)
"""Table 1, "±" in its scenes 1 to 4, which the text does not name."""

LEVELNESS_BOUND_DEG = 1.5
"""section 5.1: the bound that the paper states over all its scenes"""

LANDING_OFFSET_M = _table("Table 5", gps=1.41, optical_flow=1.31, hybrid_flow=0.54, zou2024=0.41)
LANDING_SPEED_MPS = _table("Table 5", gps=0.32, optical_flow=0.29, hybrid_flow=0.17, zou2024=0.10)
LANDING_ACCEL_MPS2 = _table("Table 5", gps=0.21, optical_flow=0.18, hybrid_flow=0.15, zou2024=0.04)
LANDING_SLOPE_DEG = _table("Table 5", gps=3.11, optical_flow=2.36, hybrid_flow=1.83, zou2024=1.99)


@dataclass(frozen=True, slots=True)
class PublishedSite:
    """A column of Table 6."""

    name: str
    obstacle_distance_m: float
    level_deg: float
    """the average level of site selection of the paper"""
    speed_mps: float
    site_type: str


SITES: Mapping[str, PublishedSite] = {
    "turf": PublishedSite("Turf", 4.52, 3.52, 0.13, "Lawn (safe)"),
    "rooftop_parking": PublishedSite("Rooftop Parking Lots", 2.12, 2.32, 0.12, "Path (safe)"),
    "cottage": PublishedSite("Cottage Area", 1.58, 4.11, 0.15, "Road (safe)"),
    "footbridge": PublishedSite("Footbridge", 1.86, 2.45, 0.13, "Road (risky)"),
    "pools": PublishedSite("Swimming Pools", 4.33, 3.18, 0.10, "Field (safe)"),
}
"""Table 6, five landings each, by the scene of this project that is of the same kind."""

ORDER: tuple[str, ...] = tuple(
    sorted(TRAJECTORY_ERROR_M, key=lambda method: TRAJECTORY_ERROR_M[method].value)
)
"""The paper's methods by E_tra, best first."""
