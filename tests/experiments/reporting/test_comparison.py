"""What a report says of a factor: levels, paired differences, and what they show in words."""

from typing import Any

import numpy as np

from touchdown.experiments.io.result_parts import Choice, EarlierDecision
from touchdown.experiments.reporting import comparison
from touchdown.experiments.reporting.flights import frame_of
from touchdown.experiments.reporting.report import make_report
from touchdown.experiments.reporting.tables import MAX_COLUMNS, Table

Rows = list[dict[str, Any]]


def flights(selector: str, slope: float, seeds: int = 8, **more: Any) -> Rows:
    """Landings in two scenes; the slope grows with the seed, by noise that all selectors share."""
    return [
        {
            "run_id": f"{scene}-livo-s{seed}-{selector}", "scene": scene, "seed": seed,
            "estimator": "livo", "mode": "land", "outcome": "LANDED", "success": True,
            "ground_safe": True, "condition": selector, "unit": f"{scene}, seed {seed}",
            "landing.slope_deg": seed + slope, "landing.obstacle_distance_m": 4.0,
            "landing.target_offset_m": 0.05 * (seed + 1), "position_error_m.mean": 0.1,
            "go_arounds": float(seed % 2), "git_revision": "0123abc", "run_dir": "",
        } | more
        for scene in ("lake", "forest")
        for seed in range(seeds)
    ]  # fmt: skip


def compared(rows: Rows) -> tuple[dict[str, list[str]], list[str], Table]:
    """The cells of the one table of differences by measure, the words, the table."""
    (table,), words = comparison.difference_tables(frame_of(rows))
    return {row[0].text: [cell.text for cell in row[1:]] for row in table.rows}, words, table


def test_a_paired_difference_is_seen_through_the_spread_of_places() -> None:
    found, words, table = compared(flights("risk", 0.0) + flights("mine", 0.5))
    assert found == {"slope (°)": ["3.50", "4.00", "0.500", "16", "larger"]}
    assert table.header == ["measure", "risk", "mine", "difference", "pairs", "shown"]
    assert words == ["`mine` against `risk`: slope larger by 0.500 °."]
    assert table.notes == [
        "The same in every pair: safe landings, obstacle distance, offset from the site, "
        "go-arounds, position error."
    ]


def test_pairs_are_of_equal_scene_and_seed_and_units_are_counted() -> None:
    other = [r | {"seed": r["seed"] + 4} for r in flights("mine", -0.5)]  # four seeds are shared
    one_place = [row | {"unit": f"layout {row['seed'] % 2}"} for row in flights("risk", 0.0)]
    found, words, table = compared(one_place + other)
    assert found["slope (°)"][2:] == ["-4.50", "8", "n = 2 says nothing"]
    assert "n = 2 says nothing" in words[0] and f"by {comparison.NEEDED} independent" in words[0]
    assert table.rows[-1][4].detail == "2 independent"


def test_few_pairs_say_nothing_and_noise_shows_nothing() -> None:
    assert comparison.NEEDED == 6, "2 / 2**6 < 0.05 <= 2 / 2**5"
    few = flights("risk", 0.0, 2) + flights("mine", 3.0, 2)
    assert compared(few)[0]["slope (°)"][-1] == "n = 4 says nothing"
    noise = np.random.default_rng(1).normal(0.0, 1.0, 16)
    noisy = [
        row | {"landing.slope_deg": row["landing.slope_deg"] + shift - noise.mean()}
        for row, shift in zip(flights("mine", 0.0), noise, strict=True)
    ]
    found, words, _ = compared(flights("risk", 0.0) + noisy)
    assert found["slope (°)"][-1] == "no difference shown"
    assert words == ["`mine` against `risk`: no difference is shown by 16 independent pairs."]
    unsafe = flights("mine", 0.0, ground_safe=False)
    assert compared(flights("risk", 0.0) + unsafe)[0]["safe landings (%)"] == [
        "100", "0", "-100", "16", "smaller"
    ]  # fmt: skip


def test_a_method_is_compared_within_each_condition() -> None:
    rows = [
        row | {"estimator": method, "position_error_m.mean": error * (1 + row["seed"])}
        for method, error in (("livo", 0.1), ("gps", 1.0))
        for wind in ("calm", "storm")
        for row in flights(wind, 0.0)
    ]
    tables, words = comparison.difference_tables(frame_of(rows))
    by_title = {table.title.partition(",")[0]: table for table in tables}
    assert set(by_title) == {"`gps` against `livo`", "`storm` against `calm`"}
    assert by_title["`gps` against `livo`"].rows[-1][4].text == "32"
    assert "`gps` against `livo`: position error larger by 4.05 m." in words
    levels = comparison.level_table(frame_of(rows))
    assert levels.header[:3] == ["condition", "method", "flights"]
    assert len(levels.header) <= MAX_COLUMNS


def test_a_report_leads_with_what_varies_in_narrow_tables_without_the_papers_figures() -> None:
    text = '[axes]\nscene = ["lake"]\nseeds = "0-7"\nlanding.selector = ["risk", "mine"]\n'
    rows = flights("risk", 0.0) + flights("mine", 0.5)
    report = make_report(rows, title="selectors", configuration=text, first="risk")
    lead = report.sections[0]
    assert (lead.title, lead.tables[0].key) == ("What varies", "levels")
    assert lead.words[0] == "Varies: landing.selector (`risk`, `mine`)."
    tables = [table for section in report.sections for table in section.tables]
    assert all(len(table.header) <= MAX_COLUMNS for table in tables)
    assert not any("paper" in note for table in tables for note in table.notes)
    assert not any("Table" in table.title for table in tables)
    assert comparison.condition_names("[axes") == "condition"


def test_sites_given_up_from_closer_are_counted() -> None:
    before = [
        EarlierDecision(time_s=at, candidates=3, given_up=why)
        for at, why in ((1, "rough"), (2, ""))
    ]
    given_up = Choice(time_s=3.0, selector="risk", why="", given_up="a car", earlier=before)
    assert (given_up.go_arounds, Choice(time_s=3.0, selector="risk", why="").go_arounds) == (2, 0)


def test_ten_safe_landings_of_ten_are_not_certain() -> None:
    """Wilson's interval of ten flights, not the spread of ten equal numbers."""
    rows = [row | {"scene": "lake"} for row in flights("risk", 0.0, 10)[:10]]
    table = comparison.level_table(frame_of(rows))
    column = table.header.index("safe landings (%)")
    assert table.rows[0][column].detail == "[72.2, 100]"
