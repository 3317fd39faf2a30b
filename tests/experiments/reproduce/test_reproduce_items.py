"""What a reproduction has of each item of the paper, each with a reason where it is not whole."""

from typing import Any

from touchdown.experiments.reproduce.items import ITEMS, item_table, measured
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


def test_what_is_measured_follows_the_state_of_the_part() -> None:
    item = BY_NAME["Fig. 12"]
    assert measured(item, state("commanded_site")) == "yes"
    assert measured(item, None) == "no: its part was left out"
    assert measured(item, state("x", error="no disk")).endswith("with an error, no disk")
    assert measured(item, state("x", edition="quick")).startswith("in part: quick edition")
    assert measured(item, state("x", why="2 unsafe")) == "in part: 2 unsafe"
    found = measured(BY_NAME["Table 2"], state("x"))
    assert found.startswith("in part") and "set by `gps.preset`" in found


def test_everything_that_is_not_whole_has_a_reason() -> None:
    table = item_table(WHOLE)
    assert len(table.rows) == 17
    for row in table.rows:
        for cell in row[-2:]:
            assert cell.text == "yes" or ": " in cell.text, row[0].text
    left_out = item_table({})
    assert {row[-1].text for row in left_out.rows if row[0].text == "Table 5"} == {
        "no: not measured"
    }
