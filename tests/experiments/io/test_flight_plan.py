"""Paths of files: plans of QGroundControl and GeoJSON."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.flight_plan import FlightPlan, covering, plan_of, read_path

HOME = [47.397742, 8.545594, 488.0]
DEGREE_M = 111_180.0
"""of latitude at home, on WGS 84"""


def _item(command: int, *place: float, frame: int = 3) -> dict[str, Any]:
    return {"type": "SimpleItem", "command": command, "frame": frame,
            "params": [0, 0, 0, None, *place]}  # fmt: skip


def _read(tmp_path: Path, tree: Any, **options: Any) -> FlightPlan:
    file = tmp_path / "path.json"
    file.write_text(json.dumps(tree))
    values: dict[str, Any] = {"height_m": 30.0, "spacing_m": 20.0, "home_wgs84": None} | options
    return read_path(file, **values)


def _mission(*items: Any, home: Any = HOME) -> dict[str, Any]:
    return {"fileType": "Plan", "mission": {"plannedHomePosition": home, "items": list(items)}}


NORTH = HOME[0] + 50.0 / DEGREE_M


def test_a_plan_of_take_off_waypoints_and_landing(tmp_path: Path) -> None:
    """Heights above home and above the sea, a survey's own items, commands that go nowhere."""
    survey = {"type": "ComplexItem", "complexItemType": "survey",
              "TransectStyleComplexItem": {"Items": [_item(16, NORTH, HOME[1], 520.0, frame=0),
                                                     _item(206, 10, 0, 0)]}}  # fmt: skip
    plan = _read(tmp_path, _mission(
        _item(22, *HOME[:2], 25.0), _item(16, NORTH, HOME[1], 25.0), survey, _item(178, 0, 0, 0),
        _item(21, *HOME[:2], 0.0),
    ))  # fmt: skip
    np.testing.assert_allclose(plan.waypoints_m, [[0, 50, 25], [0, 50, 32]], atol=0.01)
    assert plan.land_m == (0.0, 0.0) and not plan.returns
    assert plan.home_wgs84 == tuple(HOME)
    assert _read(tmp_path, _mission(_item(16, NORTH, HOME[1], 25.0), _item(20, 0, 0, 0))).returns


def test_a_plan_is_written_back_equal(tmp_path: Path) -> None:
    """To a hundredth of a millimetre, over a kilometre."""
    ways = ((812.5, -640.25, 25.0), (12.5, 91.0, 41.5))
    for ends in ({"land_m": (-30.0, 4.0)}, {"returns": True}, {}):
        plan = FlightPlan(home_wgs84=(-33.9, 151.2, 12.0), waypoints_m=ways, **ends)
        text = plan_of(plan)
        read = _read(tmp_path, json.loads(text))
        np.testing.assert_allclose(read.waypoints_m, ways, atol=2e-4)
        assert (read.home_wgs84, read.returns) == (plan.home_wgs84, plan.returns)
        assert plan_of(read) == text


POLYGON = [[0.0, 0.0], [60.0, 0.0], [60.0, 40.0], [0.0, 40.0]]


def _geo(kind: str, coordinates: Any) -> dict[str, Any]:
    return {
        "type": "Feature",
        "properties": {},
        "geometry": {"type": kind, "coordinates": coordinates},
    }


def test_a_polygon_is_covered_and_a_line_is_followed(tmp_path: Path) -> None:
    side = 40.0 / DEGREE_M
    ring = [[HOME[1], HOME[0]], [HOME[1], HOME[0] + side], [HOME[1] + side, HOME[0] + side],
            [HOME[1] + side, HOME[0]], [HOME[1], HOME[0]]]  # fmt: skip
    tree = {"type": "FeatureCollection",
            "features": [_geo("Point", [HOME[1], HOME[0]]), _geo("Polygon", [ring])]}  # fmt: skip
    plan = _read(tmp_path, tree)
    ways = np.array(plan.waypoints_m)
    assert (ways[:, 2] == 30.0).all() and plan.home_wgs84 == (HOME[0], HOME[1], 0.0)
    assert ways[:, :2].min() > -0.1 and ways[:, 1].max() < 40.1
    line = _read(tmp_path, _geo("LineString", ring[:2]), home_wgs84=tuple(HOME))
    np.testing.assert_allclose(line.waypoints_m, [[0, 0, 30], [0, 40, 30]], atol=0.01)


def test_legs_lie_along_the_longest_side_half_a_spacing_from_the_others() -> None:
    legs = covering(np.array(POLYGON), 20.0)
    np.testing.assert_allclose(legs, [[0, 10], [60, 10], [60, 30], [0, 30]], atol=1e-9)
    turned = np.array(POLYGON) @ np.array([[0.8, 0.6], [-0.6, 0.8]])
    np.testing.assert_allclose(
        covering(turned, 20.0) @ np.array([[0.8, -0.6], [0.6, 0.8]]), legs, atol=1e-9
    )
    far = covering(np.array(POLYGON) - [60.0, 40.0], 20.0)  # begins at the corner nearest by
    np.testing.assert_allclose(far[0], [0.0, -10.0], atol=1e-9)
    notched = covering(np.array([[0, 0], [60, 0], [60, 40], [30, 12], [0, 40]], float), 20.0)
    assert len(notched) == 6  # one leg below the notch, two beside it


LEVEL = _item(16, NORTH, HOME[1], 25.0)


@pytest.mark.parametrize(("tree", "word"), [
    ([], "no object"), ({"type": "Circle"}, "neither a plan"), (_mission(), "0 waypoints"),
    ({"fileType": "Plan"}, "no mission"), (_mission({"command": 16}), "no command"),
    (_mission(_item(16, 91.0, 0.0, 10.0)), "nowhere on the globe"),
    (_mission(_item(16, NORTH, HOME[1], 25.0, frame=10)), "frame 10"),
    (_mission(_item(16, NORTH, HOME[1], -1.0)), "not above"),
    (_mission(_item(19, NORTH, HOME[1], 25.0)), "MAV_CMD 19"),
    (_mission(LEVEL, _item(20, 0, 0, 0), LEVEL), "after the landing"),
    (_mission(LEVEL, home=[1.0, "x", 2.0]), "plannedHomePosition"),
    (_mission(LEVEL, home=[91.0, 0.0, 2.0]), "nowhere on the globe"),
    (_mission(_item(16, NORTH, None, 25.0)), "the place of item 1"),
    (_geo("LineString", [[0.0, 0.0], [1.0, 1.0]]), "take-off spot"),
    (_geo("Point", [0.0, 0.0]), "one Polygon"),
    (_mission(_item(16, 10**400, HOME[1], 25.0)), "too large"),
    ({"type": "FeatureCollection", "features": [_geo("Point", [0, 0]), _geo("Polygon", [5])]},
     "not one ring"),
])  # fmt: skip
def test_what_is_no_path_is_one_line(tmp_path: Path, tree: Any, word: str) -> None:
    with pytest.raises(UsageError, match=word) as caught:
        _read(tmp_path, tree)
    assert "\n" not in str(caught.value)


def test_polygons_that_cannot_be_covered(tmp_path: Path) -> None:
    for ring, word in (
        ([[0.0, 0.0], [1e-3, 0.0], [0.0, 0.0]], "three corners"),
        ([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 0.0]], "legs; raise"),
    ):
        with pytest.raises(UsageError, match=word):
            _read(tmp_path, _geo("Polygon", [ring]), home_wgs84=(0.0, 0.0, 0.0), spacing_m=10.0)
    holes = [[[0, 0], [1, 0], [1, 1], [0, 0]]] * 2
    with pytest.raises(UsageError, match="holes"):
        _read(tmp_path, _geo("Polygon", holes), home_wgs84=(0.0, 0.0, 0.0))
    with pytest.raises(UsageError, match="neither serpentine nor spiral"):
        read_path(tmp_path / "spirall", 30.0, 20.0, None)
