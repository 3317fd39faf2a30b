"""The table over finished runs, and the report over a campaign."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.results import load_runs
from touchdown.experiments.reporting import report as document
from touchdown.experiments.reporting.flights import check_revisions, frame_of, load_flights
from touchdown.experiments.reporting.report_tables import run_table, summary
from touchdown.experiments.reporting.tables import Table
from touchdown.experiments.reporting.trajectories import path_deviation

from support.command import Says
from support.report_support import LANDING, write_run


def test_mistakes_are_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no directory"):
        load_runs(tmp_path / "none")
    with pytest.raises(UsageError, match="no finished run"):
        load_runs(tmp_path)
    (tmp_path / "result.json").write_text("{}")
    with pytest.raises(UsageError, match="outcome: Field required"):
        load_runs(tmp_path)


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes, three methods, three seeds; one lost flight, three landings."""
    directory = tmp_path_factory.mktemp("made_up")
    levels = {"livo": 0.05, "zou2024": 0.10, "gps": 1.0}
    for scene, scale in (("crossroad", 1.0), ("lake", 2.0)):
        for method, level in levels.items():
            for seed in range(3):
                error = level * scale * (1.0 + 0.1 * seed)
                changes: dict[str, object] = {"trajectory_error_m": error}
                if (scene, method, seed) == ("lake", "gps", 2):
                    changes |= {"outcome": "DIVERGED", "reason": "the estimate is 20.1 m off"}
                write_run(directory, scene, method, seed, **changes)
    for seed in (10, 11, 12):
        landing = LANDING | {"safe_geometry": seed != 12}
        write_run(
            directory, "lake", "livo", seed, outcome="LANDED", landing=landing,
            trajectory_error_m=0.1,
        )  # fmt: skip
    return directory


@pytest.fixture(scope="module")
def rows(campaign: Path) -> list[dict[str, Any]]:
    return load_flights(campaign)


def table(report: document.Report, key: str) -> Table:
    return next(t for section in report.sections for t in section.tables if t.key == key)


@pytest.fixture(scope="module")
def report(rows: list[dict[str, Any]]) -> document.Report:
    return document.make_report(
        rows, title="Touchdown: made <up>", configuration='name = "x"', paper=True
    )


def test_deviation_of_the_flown_path_by_hand(campaign: Path) -> None:
    """Off by (0.3, -0.4, 0) m and 2 degrees, from lift-off on."""
    found = path_deviation(campaign / "lake-gps-s0")
    assert found == pytest.approx({"x": 0.3, "y": 0.4, "z": 0.0, "yaw_deg": 2.0}, abs=1e-6)
    assert path_deviation(campaign / "nothing") == {}


def lines_of(found: Table) -> dict[tuple[str, str], list[str]]:
    """The figures of each line by the method and the scene that name it."""
    return {(row[0].text, row[1].text): [cell.text for cell in row[2:]] for row in found.rows}


def test_table_2_has_the_published_figures_beside_crossroad(report: document.Report) -> None:
    found = table(report, "table2")
    assert found.header[:6] == [
        "method", "scene", "E_tra (m)", "paper prints", "σ²_tra (m²)", "paper prints",
    ]  # fmt: skip
    lines = lines_of(found)
    assert lines["`zou2024`", "`crossroad`"][:2] == ["0.110", "0.3671"]
    assert lines["`zou2024`", "`crossroad`"][3] == "0.1568"
    assert lines["`zou2024`", "`lake`"][:2] == ["0.220", "–"]
    assert lines["`gps`", "`crossroad`"][:2] == ["1.10", "–"], "set, so not compared"
    assert lines["`gps`", "all scenes"][0] == "1.65"
    gps = next(row for row in found.rows if row[0].text == "`gps`")
    assert gps[2].detail == "[1.00, 1.20] (set)" and gps[2].kind == ""
    assert found.notes[-1] == (
        "(set): the error of `gps` is set by `gps.preset`, not measured (the error is the "
        "receiver's, whose preset was fitted to the paper's Table 2), and is not compared with the "
        "paper."
    )
    livo = found.rows[0]
    assert (livo[2].text, livo[2].detail, livo[2].kind) == ("0.055", "[0.050, 0.060]", "best")


def test_a_method_without_figures_does_not_compete(rows: list[dict[str, Any]]) -> None:
    nothing = {"trajectory_error_m": None, "position_error_m.mean": None, "outcome": "GROUNDED"}
    grounded = [row | nothing if row["estimator"] == "livo" else row for row in rows]
    flow = [r | {"estimator": "stereo"} if r["estimator"] == "gps" else r for r in grounded]
    found = table(document.make_report(flow, title="x", paper=True), "table2").rows
    best = {row[0].text for row in found if row[2].kind == "best"}
    assert best == {"`zou2024`"} and {row[2].text for row in found[:3]} == {"–"}


def test_the_summary_names_what_was_lost(report: document.Report) -> None:
    words = report.sections[1].words
    assert words[0].startswith("2 of 21 flights were not successful. Their errors up to")
    assert "lake, `gps`, seed 2: DIVERGED (the estimate is 20.1 m off)" in words
    flights = table(report, "flights")
    assert flights.numbers["gps"]["lake"]["outcomes"] == "COMPLETED 2, DIVERGED 1"
    lost = lines_of(table(report, "table2"))["`gps`", "`lake`"]
    assert lost[0] == "2.20", "the lost flight is in the mean"


def test_a_report_begins_with_the_parts_and_says_that_all_was_well(
    rows: list[dict[str, Any]],
) -> None:
    flown = [
        row | {"parts.selector": "lab:build"}
        for row in rows
        if row["estimator"] == "livo" and row["seed"] != 12
    ]
    first, second, *rest = document.make_report(flown, title="x").sections
    assert "Selector: `lab:build`." in first.words and second.title == "Outcomes"
    assert second.words[-1] == f"All {len(flown)} flights were successful."
    assert not any("lab:build" in " ".join(section.words) for section in rest)


def test_a_path_that_never_left_the_ground_has_no_deviation(tmp_path: Path) -> None:
    run = write_run(tmp_path, "flat", "gps", 0)
    truth = np.loadtxt(run / "truth.tum")
    truth[:, 1:4] = (0.0, 0.0, 0.05)
    np.savetxt(run / "truth.tum", truth)
    assert path_deviation(run) == {}


def test_a_missing_revision_is_stated_with_its_remedy(
    rows: list[dict[str, Any]], tmp_path: Path
) -> None:
    without = [row | {"git_revision": None} for row in rows[:2]] + rows[2:]
    words = "\n".join(document.condition_words(without))
    assert (
        "Git revision: `0123abc`.\nGit revision of 2 flights not recorded: Touchdown was" in words
    )
    check_revisions(rows, tmp_path)
    with pytest.raises(UsageError, match=r"2 results have no git revision, .* a git checkout"):
        check_revisions(without, tmp_path)


def test_one_file_that_loads_nothing(report: document.Report) -> None:
    text = document.page(report)
    assert "Touchdown: made &lt;up&gt;" in text and "<up>" not in text
    assert not re.search(
        r"""(src|href)\s*=\s*["'](?!#|data:)""", text.replace("xlink:href", "href")
    )
    assert not re.search(r"url\((?!#)|@import|<script|<link (?!rel=.icon)", text)
    assert "prefers-color-scheme: dark" in text and "var(--ink)" in text
    ids = re.findall(r'\bid="([^"]+)"', re.sub(r"<g id=[^>]*>", "", text))
    clips = [name for name in ids if re.fullmatch(r"[mp][0-9a-f]{10}", name)]
    assert len(clips) == len(set(clips)), "figures do not share clip paths"
    for section in report.sections:
        assert f'href="#{section.key}"' in text and f'<section id="{section.key}">' in text


def test_command_writes_everything(campaign: Path, tmp_path: Path, says: Says) -> None:
    out = tmp_path / "deep" / "report"
    tree = json.loads(says(0, "report", campaign, "--out", out, "--json").out)
    assert tree["tables"]["table2"]["zou2024"]["lake"]["trajectory_error_m"][
        "value"
    ] == pytest.approx(0.22)
    assert sorted(tree["files"]) == ["html", "json", "markdown"]
    text = (out / "report.md").read_text()
    for target in re.findall(r"!\[[^]]*\]\(([^)]+)\)", text):
        assert (out / target).is_file()
    assert text.count("| `livo` |") > 5
    assert "cannot be written" in says(2, "report", campaign, "--out", out / "report.md").err


def test_files_of_others_are_no_report_to_be_replaced(
    report: document.Report, tmp_path: Path
) -> None:
    mine = tmp_path / "report.md"
    mine.write_text("mine")
    for text in ("{}", '{"title": "mine"}', "no JSON"):
        (tmp_path / "report.json").write_text(text)
        with pytest.raises(UsageError, match=r"holds 'report\.md', which is of no report"):
            document.write_report(report, [], tmp_path)
    assert mine.read_text() == "mine"
    (tmp_path / "report.json").unlink()
    mine.unlink()
    for _ in range(2):
        written = document.write_report(report, [], tmp_path)
    assert written["markdown"] == mine and mine.read_text() != "mine"


def test_runs_are_found_sorted_and_summed_up(campaign: Path) -> None:
    frame = frame_of(load_flights(campaign))
    totals = summary(frame)
    assert totals["outcomes"] == {"COMPLETED": 17, "LANDED": 3, "DIVERGED": 1}
    assert totals["unsafe_touchdowns"] == 1
    assert totals["means"]["zou2024"]["trajectory_error_m"] == pytest.approx(0.165)
    lines = run_table(frame).lines
    assert len(lines) == 2 + 21 and lines[2].startswith(
        "| crossroad-gps-s0 | crossroad | gps | 0 |"
    )
    assert "0.100 (set)" in lines[2] and "| 0.100 | 0.200 |" in lines[5]
    assert "bounce" not in lines[0], "nobody has it"


def test_a_plain_directory_prints_its_table(campaign: Path, says: Says) -> None:
    lines = says(0, "report", campaign).out.splitlines()
    assert lines[0].startswith("| run | scene | estimator | seed | outcome |")
    assert lines[2].startswith("| crossroad-gps-s0 | crossroad | gps | 0 |")
    assert lines[-2:] == ["", "21 runs: COMPLETED 17, DIVERGED 1, LANDED 3; 1 unsafe touchdown"]
    (run,) = json.loads(says(0, "report", campaign / "lake-livo-s1", "--json").out)["runs"]
    assert run["run"] == "lake-livo-s1"
    assert not (campaign / "report").exists()


def test_flights_without_a_map_are_not_in_the_tables_of_maps(tmp_path: Path) -> None:
    write_run(tmp_path, "lake", "livo", 0)
    nothing = {"duration_s": 18.0, "density_per_m2": 0.0,
               "levelness_error_deg": {"mean": None, "max": None, "places": 0}}  # fmt: skip
    write_run(tmp_path, "lake", "gps", 0, map=nothing)
    report = document.make_report(load_flights(tmp_path), title="x")
    assert set(table(report, "table1").numbers) == {"livo"}
