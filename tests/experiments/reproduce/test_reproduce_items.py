"""Grades of the paper's items: implemented, measured, comparable, each with a reason."""

from typing import Any

from touchdown.experiments.reproduce.items import (
    ITEMS,
    NO,
    YES,
    Grade,
    comparable,
    item_table,
    measured,
)
from touchdown.experiments.reproduce.state import PartState
from touchdown.experiments.reproduce.steps import PARTS


def state(part: str, **changes: Any) -> PartState:
    given: dict[str, Any] = {
        "part": part, "edition": "whole", "settings": {}, "figures": {}, "why": "", "error": "",
        "wall_s": 1.0, "finished_utc": "", "git_revision": "0123abc",
    }  # fmt: skip
    return PartState(**given | changes)


BY_NAME = {item.name: item for item in ITEMS}
WHOLE = {part.name: state(part.name) for part in PARTS}


def test_grades_follow_the_state_of_the_part() -> None:
    item = BY_NAME["Fig. 12"]
    assert measured(item, state("commanded_site")) == Grade(YES)
    assert measured(item, None) == Grade(NO, "its part was left out")
    assert measured(item, state("x", error="no disk")).why.endswith("with an error, no disk")
    assert measured(item, state("x", edition="quick")).text.startswith("in part: quick edition")
    assert measured(item, state("x", why="2 unsafe")).text == "in part: 2 unsafe"
    assert comparable(BY_NAME["Table 5"], Grade(NO, "its part was left out")).why == "not measured"


def test_figures_that_are_set_are_not_graded_as_measured() -> None:
    for name, key in (
        ("Table 1", "survey.duration_s"),
        ("Table 2", "gps.preset"),
        ("Table 5", "landing.touchdown_speed_mps"),
    ):
        found = measured(BY_NAME[name], state("x"))
        assert found.word == "in part" and f"set by `{key}`" in found.why


def test_every_grade_that_is_not_whole_has_a_reason() -> None:
    table = item_table(WHOLE)
    assert table.header[-3:] == ["implemented", "measured", "comparable with the paper"]
    assert len(table.rows) == 17
    for row in table.rows:
        for cell in row[-3:]:
            assert cell.text == YES or ": " in cell.text, row[0].text
    assert "done" not in " ".join(cell.text for row in table.rows for cell in row)
