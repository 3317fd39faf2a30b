"""Curves against a dial: planted probabilities are found, within intervals that cover them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.errors import UsageError
from touchdown.experiments.reporting.curves import dials_of
from touchdown.experiments.reporting.logistic import crossing_difference, fit_logistic
from touchdown.experiments.reporting.report import Section, make_report

from support.campaign_flights import make_plan

TEXT = (
    'name = "c"\n[axes]\nscene = ["lake"]\nseeds = "0-24"\n'
    "wind_kmh = { from = 0, to = 50, steps = 6 }\n"
)
WINDS = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0)


def expit(x: float) -> float:
    return float(1.0 / (1.0 + np.exp(-x)))


def landings(method: str, half_at: float, seeds: int = 25, effect: float = 0.25) -> list[Any]:
    """Landings that are safe with a probability that is one half at ``half_at`` km/h."""
    rng = np.random.default_rng(7)
    return [
        {
            "run_id": f"lake-{method}-s{seed}-w{wind:g}", "scene": "lake", "seed": seed,
            "estimator": method, "mode": "land", "git_revision": "0123abc", "run_dir": "",
            "outcome": "LANDED", "wind_kmh": wind, "success": bool(safe), "ground_safe": bool(safe),
            "condition": f"w{wind:g}", "unit": f"lake, seed {seed}",
            "position_error_m.mean": 0.1 + 0.001 * effect * wind,
            "landing.target_offset_m": 0.01 * seed,
        }
        for seed in range(seeds)
        for wind in WINDS
        for safe in [rng.random() < expit(effect * (half_at - wind))]
    ]  # fmt: skip


def section(rows: list[Any], text: str = TEXT, key: str = "curves") -> Section:
    (found,) = (s for s in make_report(rows, title="c", configuration=text).sections
                if s.key == key)  # fmt: skip
    return found


@pytest.mark.parametrize("alike", [1, 4])
def test_intervals_cover_what_is_planted(alike: int) -> None:
    """Flights by themselves, and four of a unit that end alike."""
    rng = np.random.default_rng(11)
    band, crossing, difference = [], [], []
    for _ in range(300):
        both: tuple[list[bool], list[bool]] = ([], [])
        dial: list[float] = []
        names: list[int] = []
        for unit in range(60):
            wind = rng.choice(WINDS)
            dial += alike * [wind]
            names += alike * [unit]
            for hits, half_at in zip(both, (25.0, 15.0), strict=True):
                hits += alike * [rng.random() < expit((half_at - wind) / 6.0)]
        a, b = (fit_logistic(dial, hits, names) for hits in both)
        _, low, high = a.band(np.array([25.0]))
        band.append(low[0] <= 0.5 <= high[0])
        if (found := a.crossing(0.5)) and found.low is not None and found.high is not None:
            crossing.append(found.low <= 25.0 <= found.high)
        apart = crossing_difference(a, b, 0.5)
        assert apart is not None and apart.low is not None and apart.high is not None
        difference.append(apart.low <= -10.0 <= apart.high)
    for covered in (band, crossing, difference):
        assert 0.92 <= np.mean(covered) <= 0.985


def test_pairs_tell_a_difference_through_what_they_share() -> None:
    """Units fail at winds of their own, the second method 5 km/h before the first."""
    limits = np.random.default_rng(3).normal(25.0, 8.0, 40)
    dial, names = np.tile(WINDS, 40), np.repeat(np.arange(40), 6)
    a = fit_logistic(dial, np.repeat(limits, 6) > dial, names)
    b = fit_logistic(dial, np.repeat(limits - 5.0, 6) > dial, names)
    c = fit_logistic(dial, np.repeat(limits - 5.0, 6) > dial, names + 40)
    paired, apart = crossing_difference(a, b, 0.5), crossing_difference(a, c, 0.5)
    assert paired is not None and paired.low is not None and paired.high is not None
    assert apart is not None and apart.low is not None and apart.high is not None
    assert paired.low < -5.0 < paired.high and paired.units == 40
    assert paired.high - paired.low < 0.6 * (apart.high - apart.low)


def test_what_levels_separate_is_finite_and_what_never_fails_is_not_certain() -> None:
    """A fit is less certain than a fraction: the interval of 12 of 12 by Wilson begins at 0.76."""
    fit = fit_logistic([0.0, 1.0] * 12, [True, False] * 12, range(24))
    found = fit.crossing(0.5)
    assert found is not None and found.value == pytest.approx(0.5, abs=1e-3) and fit.changes()
    always = fit_logistic([0.0, 1.0] * 12, [True] * 24, range(24))
    assert always.crossing(0.5) is None and not always.changes()
    assert 0.5 < always.band(np.array([1.0]))[1][0] < 0.9


def test_a_worse_method_is_worse_by_its_interval() -> None:
    found = section(landings("livo", 35.0) + landings("zou2024", 15.0))
    (table,) = found.tables
    assert table.header[:4] == ["method", "flights", "90 % safe", "50 % safe"]
    livo, other = (table.numbers[name]["safe_0.5"] for name in ("livo", "zou2024"))
    assert livo["low"] < 35.0 < livo["high"] and other["low"] < 15.0 < other["high"]
    assert table.rows[0][1].text == "150" and table.rows[0][1].detail == "25 independent"
    (word,) = found.words
    assert word.startswith(
        "`zou2024` falls to 50 % safe earlier than `livo`, by 20 [15.7, 24.3] of"
    )
    (picture,) = found.pictures
    assert "unsafely" in picture.svg and "no site" not in picture.svg, "none was missed"


def test_a_dial_along_which_landings_become_safe_is_read_from_its_other_end() -> None:
    """As the fraction of safe ground is: the planted half lies at 15."""
    rising = [row | {"wind_kmh": 50.0 - row["wind_kmh"]} for row in landings("livo", 35.0)]
    better = [row | {"wind_kmh": 50.0 - row["wind_kmh"]} for row in landings("zou2024", 45.0)]
    found = section(rising + better)
    (livo, _), numbers = found.tables[0].rows, found.tables[0].numbers["livo"]
    assert numbers["safe_0.5"]["low"] < 15.0 < numbers["safe_0.5"]["high"]
    assert livo[3].text.startswith("from 1") and "rises to 50 % safe earlier" in found.words[0]
    never = [row | {"ground_safe": row["seed"] == 0} for row in rising]
    assert section(never).tables[0].rows[0][2].text == "nowhere"


def test_a_dial_that_changes_nothing_is_a_warning() -> None:
    same = [
        row | {"ground_safe": True, "position_error_m.mean": 0.1} for row in landings("livo", 9)
    ]
    assert section(same).words[0].startswith("Warning: `wind.mean_kmh` changed nothing")
    assert section(same).tables[0].rows[0][2].text == "everywhere"
    weak = section([row | {"ground_safe": True} for row in landings("livo", 9)])
    assert weak.words == ["No effect of `wind.mean_kmh` on safe landings is shown."]


def test_a_missed_site_is_none_that_was_not_in_view() -> None:
    rows = landings("livo", 60.0, 4)
    rows += [
        row | {"seed": row["seed"] + 90, "outcome": "NO_SITE", "choice.missed.safe_m2": area}
        for row, area in zip(landings("livo", 60.0, 2), [None, 5.0] * 6, strict=True)
    ]
    levels = section(rows).tables[0].numbers["livo"]["levels"]
    assert [levels[f"{wind:g}"]["missed"]["value"] for wind in WINDS] == [0.0, 1 / 3] * 3


def test_a_curve_is_of_one_set_of_parts() -> None:
    rows = landings("livo", 35.0, 2)
    for row in rows[1::2]:
        row["parts.selector"] = "lab:build"
    names = [row[0].text for row in section(rows).tables[0].rows]
    assert names == ["`livo`", "`livo + lab:build`"]


def test_selectors_are_compared_over_all_values_of_a_dial_and_at_equal_ones() -> None:
    rows = landings("livo", 35.0, 9)
    others = [
        row | {"parts.selector": "lab:build", "condition": f"lab-{row['condition']}",
               "landing.target_offset_m": row["landing.target_offset_m"] + 0.5}
        for row in rows
    ]  # fmt: skip
    found = section(rows + others, key="varies")
    assert found.words[0] == "Varies: method (`livo`, `livo + lab:build`)."
    levels, differences = found.tables
    assert [row[1].text for row in levels.rows] == ["54", "54"]
    offset = differences.numbers["landing.target_offset_m"]
    assert offset["value"] == pytest.approx(0.5) and offset["flights"] == 54


def test_ranges_and_sweeps_become_runs(tmp_path: Path) -> None:
    text = TEXT.replace('seeds = "0-24"', 'seeds = "3"') + (
        '[sweep]\n"survey.height_m" = { from = 20.0, to = 30.0, steps = 3 }\n'
        '"survey.legs" = [1, 2]\n'
    )
    plan = make_plan(tmp_path, text)
    assert len(plan.runs) == 6 * 5 and plan.runs[0].run_id == "lake-livo-s3-w0-height_m20"
    first = [run.values for run in plan.runs[:5]]
    assert [v.get("survey.height_m") for v in first] == [20.0, 25.0, 30.0, None, None]
    assert [v.get("survey.legs") for v in first] == [None, None, None, 1, 2]
    assert [run.values["wind.mean_kmh"] for run in plan.runs[::5]] == [*map(int, WINDS)]
    assert dials_of(text) == ["wind.mean_kmh", "survey.height_m"], "two legs are no curve"
    own = make_plan(tmp_path, "own_seeds = true\n" + text.replace('"3"', '"3-4"'))
    assert [run.values["seed"] for run in own.runs[:5]] == [3, 5, 7, 9, 11]
    assert (
        len({run.values["seed"] for run in own.runs}) == 10
        and own.runs[4].run_id.split("-")[2] == "s11"
    )
    named = '\n[[expect]]\nname = "one"\nwhen = { seed = [3] }\n'
    for wrong, reason in (
        ("own_seeds = true\n" + text + named, "own_seeds changes them"),
        (text.replace("steps = 3", "steps = 1"), "a range is"),
        (text + "wind_kmh = [3]\n", "unknown key 'wind_kmh' in \\[sweep\\]"),
        (text.replace("survey.legs", "survey.leg"), "unknown key 'survey.leg'"),
        (text.replace('"survey.legs"', '"wind.mean_kmh"'), "is an axis already"),
    ):
        with pytest.raises(UsageError, match=reason):
            make_plan(tmp_path, wrong)


def test_swept_dials_are_judged_at_the_usual_value_of_the_others(tmp_path: Path) -> None:
    rows = landings("livo", 35.0, 6)
    for row in rows:
        row["run_dir"] = str(tmp_path / row["run_id"])
        path = Path(row["run_dir"]) / "config.json"
        path.parent.mkdir()
        path.write_text(
            f'{{"wind": {{"mean_kmh": {row["wind_kmh"]}}}, "survey": {{"height_m": 30}}}}'
        )
    low = [r | {"run_id": f"{r['run_id']}-h{h}", "run_dir": str(tmp_path / f"h{h}")}
           for r in rows[:1] for h in (10, 20, 30)]  # fmt: skip
    for row, height in zip(low, (10, 20, 30), strict=True):
        (tmp_path / f"h{height}").mkdir()
        text = f'{{"wind": {{"mean_kmh": 0}}, "survey": {{"height_m": {height}}}}}'
        (Path(row["run_dir"]) / "config.json").write_text(text)
    sweep = TEXT + '[sweep]\n"survey.height_m" = [10, 20, 30]\n'
    winds, heights = (t.rows[0][1].text for t in section(rows + low, sweep).tables)
    assert (winds, heights) == ("37", "9")
    for row in rows:
        (Path(row["run_dir"]) / "config.json").write_text(
            f'{{"wind": {{"mean_kmh": {row["wind_kmh"]}}}}}'
        )
    assert section(rows + low, sweep).tables[0].rows[0][1].text == "36", "at the height unset"
