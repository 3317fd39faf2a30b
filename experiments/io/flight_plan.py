"""Paths of a survey in files: polygons and lines in GeoJSON, and plans of QGroundControl.

A plan is read as far as a survey needs it: its home, waypoints, also those of a survey that
QGroundControl has laid out, and how it ends, by a landing or a return. Commands that move a gimbal,
a camera or a servo are left out.
"""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.experiments.errors import UsageError, reason_of
from touchdown.experiments.io.untrusted import read_object, shown
from touchdown.sim.typing import Array

WAYPOINT, RETURN, LAND, TAKEOFF, SPLINE = 16, 20, 21, 22, 82
"""MAVLink's commands (MAV_CMD)"""
_FIRST_DO = 112
"""commands from this one on set something and go nowhere"""
_ABSOLUTE, _RELATIVE = 0, 3
"""MAVLink's frames of a height: above the sea, above home"""
_MULTICOPTER, _PX4 = 2, 12
"""types of vehicle and firmware in a plan"""
_MOST = 5000
"""waypoints"""


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class FlightPlan:
    """A path over a place on WGS 84."""

    home_wgs84: tuple[float, float, float]
    """latitude, longitude (degrees) and height (m) of the take-off spot"""
    waypoints_m: tuple[tuple[float, float, float], ...]
    """metres east and north of it, and height above it"""
    land_m: tuple[float, float] | None = None
    """metres east and north of where the plan lands; None where it does not say"""
    returns: bool = False
    """True where the plan ends with a return to the take-off spot"""


def read_path(
    file: Path, height_m: float, spacing_m: float, home_wgs84: tuple[float, float, float] | None
) -> FlightPlan:
    """Reads a plan or GeoJSON. ``height_m`` and ``spacing_m`` are those of the legs in a polygon,
    ``home_wgs84`` the take-off spot, without which the file has to name it. Raises UsageError, one
    line."""
    try:
        tree = read_object(file)
        if tree.get("fileType") == "Plan":
            return _plan(tree, home_wgs84)
        return _geojson(tree, height_m, spacing_m, home_wgs84)
    except FileNotFoundError:
        raise UsageError(
            f"survey.path: '{file}' is neither serpentine nor spiral nor a file"
        ) from None
    except (ValueError, OverflowError, OSError) as error:
        raise UsageError(f"survey.path: '{file}': {reason_of(error)}") from error


def plan_of(plan: FlightPlan) -> str:
    """The plan as QGroundControl writes it."""
    latitude, longitude, height = plan.home_wgs84

    def item(command: int, place: Array | None) -> dict[str, Any]:
        where = [0.0, 0.0, 0.0]
        if place is not None:
            degrees = geodetic(plan.home_wgs84, place[:2])
            where = [round(degrees[0], 9), round(degrees[1], 9), round(float(place[2]), 3)]
        return {
            "AMSLAltAboveTerrain": None, "Altitude": where[2], "AltitudeMode": 1,
            "autoContinue": True, "command": command, "doJumpId": 0, "frame": _RELATIVE,
            "params": [0, 0, 0, None, *where], "type": "SimpleItem",
        }  # fmt: skip

    first = np.array([0.0, 0.0, plan.waypoints_m[0][2]])
    items = [item(TAKEOFF, first)]
    items += [item(WAYPOINT, np.array(place)) for place in plan.waypoints_m]
    if plan.land_m is not None:
        items.append(item(LAND, np.array([*plan.land_m, 0.0])))
    elif plan.returns:
        items.append(item(RETURN, None) | {"frame": 2})
    for number, one in enumerate(items, start=1):
        one["doJumpId"] = number
    tree = {
        "fileType": "Plan", "version": 1, "groundStation": "QGroundControl",
        "geoFence": {"circles": [], "polygons": [], "version": 2},
        "rallyPoints": {"points": [], "version": 2},
        "mission": {
            "version": 2, "firmwareType": _PX4, "vehicleType": _MULTICOPTER,
            "cruiseSpeed": 15, "hoverSpeed": 5, "globalPlanAltitudeMode": 1,
            "plannedHomePosition": [latitude, longitude, height], "items": items,
        },
    }  # fmt: skip
    return json.dumps(tree, indent=4) + "\n"


def _plan(tree: dict[str, Any], home_wgs84: tuple[float, float, float] | None) -> FlightPlan:
    mission = tree.get("mission")
    items = mission.get("items") if isinstance(mission, dict) else None
    if not isinstance(mission, dict) or not isinstance(items, list):
        raise ValueError("it has no mission with items")
    home = home_wgs84 or _numbers(mission.get("plannedHomePosition"), 3, "plannedHomePosition")
    ways, land, returns = [], None, False
    for number, item in enumerate(_simple(items), start=1):
        what = f"item {number}"
        command = item.get("command")
        if not isinstance(command, int) or not isinstance(item.get("params"), list):
            raise ValueError(f"{what} has no command with parameters")
        if command >= _FIRST_DO or command == TAKEOFF:
            continue
        if land is not None or returns:
            raise ValueError(f"{what} comes after the landing; a flight has one")
        if command == RETURN:
            returns = True
            continue
        if command not in (WAYPOINT, SPLINE, LAND):
            raise ValueError(
                f"{what} is MAV_CMD {command}; take-off, waypoints, land and return fly"
            )
        place = _numbers(item["params"][4:7], 3, f"the place of {what}")
        frame = item.get("frame")
        if frame not in (_ABSOLUTE, _RELATIVE):
            raise ValueError(f"the height of {what} counts from frame {shown(frame)}; take 0 or 3")
        east, north = _metres(home, place)
        if command == LAND:
            land = (east, north)
        else:
            up = place[2] - (home[2] if frame == _ABSOLUTE else 0.0)
            ways.append((east, north, up))
    return _checked(
        FlightPlan(home_wgs84=home, waypoints_m=tuple(ways), land_m=land, returns=returns)
    )


def _simple(items: list[Any]) -> list[dict[str, Any]]:
    """The items of a mission, those of its surveys among them."""
    found: list[dict[str, Any]] = []
    for item in items:
        if not isinstance(item, dict):
            raise ValueError(f"{shown(item)} is no item of a mission")
        inner = item.get("TransectStyleComplexItem")
        inner = inner.get("Items") if isinstance(inner, dict) else None
        found += _simple(inner) if isinstance(inner, list) else [item]
    return found


def _geojson(
    tree: dict[str, Any], height_m: float, spacing_m: float,
    home_wgs84: tuple[float, float, float] | None,
) -> FlightPlan:  # fmt: skip
    shapes = {"Point": None, "LineString": None, "Polygon": None} | dict(_geometries(tree, 0))
    if home_wgs84 is None:
        if shapes["Point"] is None:
            raise ValueError(
                "it does not say where the take-off spot is; add a Point, or set survey.home_wgs84"
            )
        longitude, latitude = _numbers(shapes["Point"][:2], 2, "its Point")
        home_wgs84 = (latitude, longitude, 0.0)
    line, polygon = shapes["LineString"], shapes["Polygon"]
    if (line is None) == (polygon is None):
        raise ValueError("it needs one Polygon to cover or one LineString to follow")
    if polygon is not None and not (len(polygon) == 1 and isinstance(polygon[0], list)):
        raise ValueError("its Polygon is not one ring of corners without holes")
    corners = []
    for corner in line if polygon is None else polygon[0]:
        longitude, latitude = _numbers(corner[:2] if isinstance(corner, list) else 0, 2, "a corner")
        corners.append(_metres(home_wgs84, (latitude, longitude)))
    places = np.array(corners) if polygon is None else covering(np.array(corners[:-1]), spacing_m)
    ways = tuple((float(x), float(y), height_m) for x, y in places)
    return _checked(FlightPlan(home_wgs84=home_wgs84, waypoints_m=ways))


def _geometries(tree: Any, depth: int) -> list[tuple[str, Any]]:
    """Type and coordinates of every geometry."""
    if not isinstance(tree, dict) or depth > 4:
        raise ValueError("it is neither a plan of QGroundControl nor GeoJSON")
    kind = tree.get("type")
    if kind == "FeatureCollection" and isinstance(tree.get("features"), list):
        return [found for one in tree["features"] for found in _geometries(one, depth + 1)]
    if kind == "Feature":
        return _geometries(tree.get("geometry"), depth + 1)
    coordinates = tree.get("coordinates")
    if kind not in ("Point", "LineString", "Polygon") or not isinstance(coordinates, list):
        raise ValueError(f"{shown(kind)} is neither a plan of QGroundControl nor GeoJSON's Point, "
                         "LineString or Polygon")  # fmt: skip
    return [(kind, coordinates)]


def covering(corners: Array, spacing_m: float) -> Array:
    """(M, 2) ends of parallel legs that cover a polygon of ``corners`` (N, 2), ``spacing_m`` apart
    and half of that from its sides, along its longest side; of the four ways to begin, the one
    nearest to the origin. Raises ValueError for a polygon that is too narrow."""
    if len(corners) < 3:
        raise ValueError("its Polygon has less than three corners")
    sides = np.roll(corners, -1, axis=0) - corners
    along = sides[np.argmax(np.linalg.norm(sides, axis=1))]
    turn = math.atan2(along[1], along[0])
    cos, sin = math.cos(turn), math.sin(turn)
    rotation = np.array([[cos, -sin], [sin, cos]])
    x, y = (corners @ rotation).T
    x2, y2 = np.roll(x, -1), np.roll(y, -1)
    count = max(int((y.max() - y.min()) / spacing_m + 0.5), 1)
    if count * 2 > _MOST:
        raise ValueError(f"its Polygon takes {count} legs; raise survey.leg_spacing_m")
    first = 0.5 * (y.min() + y.max()) - 0.5 * (count - 1) * spacing_m
    legs = []
    for level in first + spacing_m * np.arange(count):
        crossed = (y <= level) != (y2 <= level)
        t = (level - y[crossed]) / (y2[crossed] - y[crossed])
        ends = np.sort(x[crossed] + t * (x2[crossed] - x[crossed]))
        legs += [
            np.array([[a, level], [b, level]]) for a, b in zip(ends[::2], ends[1::2], strict=True)
        ]
    if not legs:
        raise ValueError("its Polygon has no inside")
    ways = []
    for order in (legs, legs[::-1]):
        for odd in (0, 1):
            ways.append(
                np.vstack([leg[:: -1 if k % 2 == odd else 1] for k, leg in enumerate(order)])
            )
    nearest = min(ways, key=lambda way: float(np.linalg.norm(way[0])))
    return np.asarray(nearest @ rotation.T)


def _checked(plan: FlightPlan) -> FlightPlan:
    latitude, longitude, _ = plan.home_wgs84
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
        raise ValueError(
            f"its take-off spot at {latitude:g}, {longitude:g} is nowhere on the globe"
        )
    if not 1 <= len(plan.waypoints_m) <= _MOST:
        raise ValueError(f"it has {len(plan.waypoints_m)} waypoints; 1 to {_MOST} can be flown")
    if min(up for *_, up in plan.waypoints_m) <= 0.0:
        raise ValueError("a waypoint is not above its take-off spot")
    return plan


def _numbers(value: Any, count: int, what: str) -> Any:
    numbers = isinstance(value, list) and all(
        isinstance(one, int | float) and math.isfinite(one) for one in value
    )
    if not numbers or len(value) != count:
        raise ValueError(f"{what} is not {count} numbers")
    return tuple(map(float, value))


def _metres(home: tuple[float, ...], place: tuple[float, ...]) -> tuple[float, float]:
    """Metres east and north of ``home``, both in degrees."""
    import pymap3d

    if not (abs(place[0]) <= 90.0 and abs(place[1]) <= 180.0):
        raise ValueError(f"{place[0]:g}, {place[1]:g} is nowhere on the globe")
    east, north, _ = pymap3d.geodetic2enu(place[0], place[1], 0.0, home[0], home[1], 0.0)
    return float(east), float(north)


def geodetic(home: tuple[float, ...], place: Array) -> tuple[float, float]:
    """Latitude and longitude (degrees) of ``place`` (2,), metres east and north of ``home``, whose
    first two numbers are its own."""
    import pymap3d

    latitude, longitude, _ = pymap3d.enu2geodetic(*place.tolist(), 0.0, *home[:2], 0.0)
    return float(latitude), float(longitude)
