"""The results pages: tables by hand, one revision, and nothing that the command did not write."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.benchmarks.limit import survey
from touchdown.experiments.campaign.directory import settle_plan
from touchdown.experiments.campaign.plan import load_plan
from touchdown.experiments.campaign.results_table import ROW_FILE, RUNS, write_table
from touchdown.experiments.errors import UsageError
from touchdown.experiments.reporting.flights import frame_of
from touchdown.experiments.results_tables import edition, tables
from touchdown.experiments.results_tables.edition import (
    FILE,
    ROOT,
    SETS,
    FlightSet,
    chosen,
    merged,
    read_record,
    record_of,
    write_record,
)
from touchdown.experiments.results_tables.pages import BLOCKS, write_pages, written

from support.command import Says

PAGES = sorted({block.page for block in BLOCKS})
LANDINGS = SETS[0]
REVISION = "0123456789abcdef0123456789abcdef01234567"


@pytest.mark.parametrize("page", PAGES)
def test_tables_of_the_pages_are_those_of_the_file_of_results(page: str) -> None:
    """To the letter: a figure edited by hand fails here."""
    text = (ROOT / page).read_text(encoding="utf-8")
    assert written(text, page, read_record(ROOT)) == text, f"{page}: write it with `make results`"


def row(scene: str, seed: int, method: str = "livo", **more: Any) -> dict[str, Any]:
    return {"run_id": f"{scene}-{method}-s{seed}", "scene": scene, "seed": seed,
            "estimator": method, "outcome": "LANDED", "profile": "field",
            "unit": f"{scene}, seed {seed}"} | more  # fmt: skip


def landed() -> list[dict[str, Any]]:
    """Offsets 0.1, 0.3 m on safe ground by the lake, 0.5 m on unsafe ground in the forest."""
    found = []
    for scene, seed, offset, safe in (
        ("lake", 1, 0.1, True),
        ("lake", 2, 0.3, True),
        ("forest", 1, 0.5, False),
    ):
        found.append(row(scene, seed, ground_safe=safe, **{
            "landing.target_offset_m": offset, "landing.vertical_speed_mps": 0.09,
            "landing.vertical_accel_mps2": 0.05, "landing.slope_deg": 1.0,
            "position_error_m.mean": 0.2 * seed, "map.levelness_error_deg.mean": 0.5 * seed,
            "map.levelness_error_deg.max": 2.0 * seed,
        }))  # fmt: skip
    return [*found, row("forest", 2, outcome="COLLIDED", reason="a tree")]


def cells(lines: list[str], *start: str) -> dict[str, str]:
    """The line of a table that begins with ``start``, by the titles of its columns."""
    titles = next(line for line in lines if line.startswith("| "))
    (line,) = (found for found in lines if found.startswith("| " + " | ".join(start) + " |"))
    both = ([cell.strip() for cell in text.strip("|").split("|")] for text in (titles, line))
    return dict(zip(*both, strict=True))


def test_landings_by_scene() -> None:
    lines = tables.landings(frame_of(landed()))
    lake, every = cells(lines, "`lake`"), cells(lines, "all scenes")
    assert lake["flights"] == "2" and lake["unsafe touchdowns"] == "0"
    assert lake["d_L (m)"] == "0.200"  # of two flights there is no interval
    assert lake["v_z (m/s) (set)"] == "0.090"
    assert lake["levelness, mean (°)"] == "0.750"
    assert lake["largest at any place (°)"] == "4.00"
    assert (every["flights"], every["landed"], every["unsafe touchdowns"]) == ("4", "3", "1")
    assert "independent" not in every and every["d_L (m)"].startswith("0.300 [")
    of_one_seed = tables.landings(frame_of([one | {"unit": "a"} for one in landed()]))
    assert cells(of_one_seed, "all scenes")["independent"] == "1"
    assert tables.landings(frame_of(landed()), "ideal") == ["Not flown in `ideal` yet."]
    other = [one | {"profile": "ideal"} for one in landed()[:1]]
    ideal = tables.landings(frame_of([*landed(), *other]), "ideal")
    assert cells(ideal, "`lake`")["flights"] == "1"
    text = "\n".join(lines)
    assert "- `forest`, `livo`, seed 2: COLLIDED (a tree)." in text
    assert "- `forest`, `livo`, seed 1: LANDED, on unsafe ground." in text
    assert "v_z is set by `landing.touchdown_speed_mps`, not measured" in text


def surveys() -> list[dict[str, Any]]:
    levels = {"zou2024": 0.1, "gps": 1.0, "oracle": 0.0}
    return [
        row(scene, seed, method, outcome="COMPLETED", **{
            "position_error_m.mean": level * seed, "trajectory_error_m": 2.0 * level * seed,
            "nees.below_14_2": 0.9, "map.levelness_error_deg.mean": 0.2 + level,
            "map.levelness_error_deg.max": 1.0 + level,
        })
        for method, level in levels.items() for scene in ("lake", "forest") for seed in (1, 3)
    ]  # fmt: skip


def test_positioning_by_method() -> None:
    lines = tables.positioning(frame_of(surveys()), frame_of(landed()))
    assert not any("oracle" in line for line in lines)
    begun = cells(lines, "`livo`")  # the surveys that its landings begin with
    assert begun["flights"] == "4"
    found = cells(lines, "`zou2024`")
    assert found["outcomes"] == "COMPLETED 4" and found["worst flight (m)"] == "0.300"
    assert found["mean error (m)"].startswith("0.200 ") and "(set)" not in found["E_tra (m)"]
    assert found["NEES below 14.2 (%)"].startswith("90.0")
    gps = cells(lines, "`gps`")
    assert gps["flights"] == "4" and gps["E_tra (m)"].endswith("(set)")
    # of the pairs with seed 1 alone: 1.0 and 0.1 over 0.2, the first over the mean of both scenes
    assert gps["times that of `livo`"] == "5.00" and found["times that of `livo`"] == "0.500"
    assert begun["times that of `livo`"] == "–"
    assert any("set by `gps.preset`" in line for line in lines)


def test_levelness_of_surveys_and_landings() -> None:
    lines = tables.levelness(frame_of(surveys()), frame_of(landed()))
    assert cells(lines, "survey, `oracle`")["largest at any place (°)"] == "1.00"
    every = cells(lines, "landing, `livo`")
    assert every["levelness, mean (°)"].startswith("0.667 ")
    assert every["flights"] == "4" and every["largest at any place (°)"] == "4.00"


def test_flights_by_condition() -> None:
    rows = [
        row("lake", 1, outcome=outcome, **{"position_error_m.mean": error}) | {"run_id": name}
        for outcome, error, name in (
            ("LANDED", 0.1, "lake-livo-s1-camera_black.0"),
            ("DIVERGED", 0.9, "lake-livo-s1-lidar_dropout.20"),
        )
    ]
    lines = tables.conditions(frame_of(rows))
    assert cells(lines, "`camera_black.0`")["mean error (m)"] == "0.100"
    assert cells(lines, "`lidar_dropout.20`")["outcomes"] == "DIVERGED 1"


def test_the_papers_figures_stand_beside_ours_unless_ours_are_set() -> None:
    lines = tables.paper_landings(frame_of(landed()))
    speed = next(line for line in lines if line.startswith("| v_z"))
    assert speed.split("|")[1].strip().endswith("(set) (m/s)") and speed.split("|")[2] == " – "
    assert next(line for line in lines if line.startswith("| d_L")).split("|")[2] == " 0.41 "


def test_the_summary_says_first_how_often_it_lands_safely() -> None:
    lines = tables.summary(frame_of(landed()), frame_of(surveys()))
    assert lines[0] == (
        "**2 of 4 flights with `livo` land on safe ground: 50 % [15, 85]; 1 touch unsafe ground.**"
    )
    assert lines[2].startswith(
        "They are 4 independent flights over 2 scenes. They touch down 0.300"
    )
    assert "(largest 0.500 m), where the ground slopes by 1.00 [1.00, 1.00]°" in lines[2]
    start = next(n for n, line in enumerate(lines) if line.startswith("| method"))
    assert cells(lines[start:], "`livo`")["surveys completed"] == "3 of 4"
    assert cells(lines[start:], "`gps`")["surveys completed"] == "4 of 4"
    dependent = tables.summary(frame_of(landed()), frame_of([r | {"unit": "a"} for r in surveys()]))
    assert any("| 4 of 4 (1 independent) |" in line for line in dependent)


def fly(found: FlightSet, out: Path, revision: str = REVISION, left_out: int = 0) -> Path:
    """A campaign below ``out`` as if it were flown at ``revision``."""
    directory = found.directory(out)
    (directory / RUNS).mkdir(parents=True)
    plan = settle_plan(found.plan(), directory, revision)
    for run in plan.runs[left_out:]:
        values = {key: run.values.get(key) for key in ("scene", "estimator", "seed", "profile")}
        (directory / RUNS / run.run_id).mkdir()
        flown = {
            **values, "unit": run.run_id, "run_id": run.run_id, "mode": plan.mode,
            "outcome": "LANDED", "git_revision": revision,
            "started_utc": "2031-02-03T04:05:06Z", "cpu_s": 90.0,
            "position_error_m.mean": 0.123456789, "landing.target_offset_m": 0.1,
            "landing.judged_on": "geometry", "landing.safe_geometry": True,
            "landing.slope_deg": 2.0, "reason": "",
        }  # fmt: skip
        if run is not plan.runs[left_out]:  # it did not touch down
            flown["landing.roughness_m"] = 0.01
        write_table([flown], directory / RUNS / run.run_id / ROW_FILE)
        (directory / RUNS / run.run_id / "result.json").write_text("{}")
    return directory


def pages_in(root: Path) -> Path:
    for page in PAGES:
        (root / page).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / page, root / page)
    return root


def test_the_file_and_the_pages_state_revision_and_plan(tmp_path: Path) -> None:
    root = pages_in(tmp_path / "tree")
    fly(LANDINGS, tmp_path / "out")
    files = write_pages([LANDINGS], tmp_path / "out", root=root)
    picture = "docs/images/chosen_ground.svg"
    assert sorted(str(file.relative_to(root)) for file in files) == sorted([FILE, picture, *PAGES])
    entry = read_record(root)["landing"]
    assert (entry["revision"], entry["date"]) == (REVISION, "2031-02-03")
    assert entry["core_hours"] == 3.5 and len(entry["rows"]) == 140
    assert entry["rows"][0]["position_error_m.mean"] == 0.123457
    assert entry["rows"][0]["ground_safe"] is True
    text = (root / "docs/results/field.md").read_text()
    assert (
        "*Flown at revision `0123456789ab`, 2031-02-03, by `make results`: "
        "`configs/landing.toml`, 3.5 core-hours.*" in text
    )
    assert "| all scenes | 100 | 100 | 0 |" in text and "| all scenes | 40 | 40 | 0 |" in text
    assert "](../images/chosen_ground.svg)" in text and "LANDED ()" not in text
    assert "reason" not in entry["rows"][0]
    assert "Not flown yet: `make results` flies `configs/wind.toml`" in text
    assert written(text, "docs/results/field.md", read_record(root)) == text
    edited = text.replace("| all scenes | 100 | 100 | 0 |", "| all scenes | 100 | 99 | 0 |")
    assert written(edited, "docs/results/field.md", read_record(root)) == text != edited


def test_rows_of_no_or_several_revisions_are_refused(tmp_path: Path) -> None:
    for name, revision, message in (
        ("none", "", "has no git revision"),
        ("dirty", f"{REVISION}-dirty", "changes that were not committed"),
    ):
        fly(LANDINGS, tmp_path / name, revision)
        with pytest.raises(UsageError, match=message):
            record_of(LANDINGS, tmp_path / name)
    directory = fly(LANDINGS, tmp_path)
    run = sorted((directory / RUNS).iterdir())[3]
    (changed,) = [r for r in edition.load_rows(directory) if r["run_id"] == run.name]
    write_table([changed | {"git_revision": "fedcba"}], run / ROW_FILE)
    (directory / "results.parquet").unlink()
    with pytest.raises(UsageError, match=r"2 revisions \(0123456789ab, fedcba\); a page is of one"):
        record_of(LANDINGS, tmp_path)


def test_missing_flights_are_named(tmp_path: Path) -> None:
    fly(LANDINGS, tmp_path, left_out=2)
    with pytest.raises(UsageError, match="2 of 140 flights are missing, such as 'crossroad-livo-s"):
        record_of(LANDINGS, tmp_path)
    with pytest.raises(UsageError, match="140 of 140 flights are missing"):
        record_of(LANDINGS, tmp_path / "nothing")


def test_nothing_is_written_of_missing_flights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, says: Says
) -> None:
    found = {"directory": "d", "runs": 2, "finished": 1, "missing": 1, "crashed": 0, "outcomes": {}}
    monkeypatch.setattr("touchdown.experiments.results_tables.edition.fly", lambda *_: [found])
    monkeypatch.setattr("touchdown.experiments.results_tables.edition.measure", lambda *_: [])
    said = says(1, "results", "--out", tmp_path, "--write", "--quiet")
    assert "nothing is written" in said.err


def test_an_edition_is_of_one_revision_and_kept_to_the_digit(tmp_path: Path) -> None:
    (tmp_path / FILE).parent.mkdir(parents=True)
    head = {"revision": "a", "date": "2031-02-03", "core_hours": 1.5}
    before = {"landing": head | {"rows": landed()}, "short": head | {"rows": landed()[:1]}}
    write_record(before, tmp_path)
    assert read_record(tmp_path) == before
    assert merged(before, {"wind": head | {"rows": []}}).keys() == {*before, "wind"}
    with pytest.raises(UsageError, match=r"\(landing a, wind c, short a\); fly all"):
        merged(before, {"wind": head | {"revision": "c"}})


def test_parts_are_sets_or_the_paper() -> None:
    assert chosen() == list(SETS)
    assert [found.name for found in chosen(["wind", "landing"])] == ["landing", "wind"]
    assert {found.name for found in chosen(["paper"])} == {
        "positioning", "commanded_site", "zou2024_sites", "zou2024",
    }  # fmt: skip
    with pytest.raises(UsageError, match=r"--part zou2024: no part.* short, limit, cost$"):
        chosen(["zou2024"])


def test_the_reproduction_flies_its_sets_where_their_rows_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flown = []
    monkeypatch.setattr(edition, "git_revision", lambda: REVISION)
    monkeypatch.setattr(edition, "reproduce", lambda out, **_: flown.append(out))
    monkeypatch.setattr(edition, "fly_campaign", lambda plan, out, *_, **__: flown.append(out))
    edition.fly(chosen(["wind"]), tmp_path, 1, edition.Watcher)
    assert flown == [tmp_path / "wind"]
    edition.fly(chosen(["paper"]), tmp_path, 1, edition.Watcher)
    assert flown[1:3] == [tmp_path / "paper", tmp_path / "paper" / "positioning" / "flights"]


def test_what_is_measured_is_kept_with_its_revision(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, calls = pages_in(tmp_path / "tree"), []
    figures = {"a landing": {"unit": "s", "value": 12.345}, "memory": {"unit": "", "value": None}}
    monkeypatch.setattr(edition, "MEASURED", {"cost": lambda out: calls.append(out) or figures})
    for revision, times in ((REVISION, 1), (REVISION, 1), ("fedcba", 2)):
        monkeypatch.setattr(edition, "git_revision", lambda now=revision: now)
        (file,) = edition.measure((), tmp_path)
        assert len(calls) == times
    assert edition.measure(["landing"], tmp_path) == []
    monkeypatch.setattr(edition, "git_revision", lambda: f"{REVISION}-dirty")
    with pytest.raises(UsageError, match="changes that were not committed"):
        edition.measure((), tmp_path / "new")
    assert write_pages([], tmp_path, [file], root)[1] == root / "docs/results/cost.json"
    text = (root / "docs/results/field.md").read_text()
    assert "| a landing (s) | 12.3 |\n| memory | – |\n\n*Measured at revision `fedcba`" in text
    other = (root / "docs/results/estimators.md").read_text()
    assert "Not measured yet: `touchdown results --part limit` does." in other


def test_the_report_on_the_paper_is_copied_without_its_renderings(tmp_path: Path) -> None:
    report, root = tmp_path / "out" / "paper" / "report", pages_in(tmp_path / "tree")
    (report / "figures").mkdir(parents=True)
    (report / "figures" / "fig7.svg").write_text('<svg><image href="data:image/jpeg;..."/></svg>')
    (report / "figures" / "fig9.svg").write_text("<svg/>")
    shown = "![Fig. {0}](figures/fig{0}.svg)\n\n*Fig. {0}.* As drawn.\n\n"
    (report / "report.md").write_text("# Paper\n\n" + shown.format(7) + shown.format(9))
    for found in chosen(["paper"]):
        fly(found, tmp_path / "out")
    write_pages(chosen(["paper"]), tmp_path / "out", root=root)
    copied = root / "docs/results/reproduction"
    assert (copied / "report.md").read_text() == "# Paper\n\n" + shown.format(9)
    assert [file.name for file in (copied / "figures").iterdir()] == ["fig9.svg"]


def test_tunings_are_compared_on_logs_of_their_own() -> None:
    one = {
        "estimator": "gps", "trials": 40, "best_settings": {"a": 1, "b": 2}, "logs": [{}, {}, {}],
        "default_error_m": 1.0, "best_error_m": 0.5,
        "check": [{"default_error_m": 1.0, "best_error_m": 0.9},
                  {"default_error_m": 4.0, "best_error_m": 0.4}],
    }  # fmt: skip
    lost = one | {"estimator": "livo", "best_error_m": 0.2, "check": []}
    assert tables.tunings([one, lost])[2:] == [
        "| `livo` | 40 | 2 | 3 | 1.00 | 0.200 | – | – |",
        "| `gps` | 40 | 2 | 3 | 1.00 | 0.500 | 2.00 | 0.600 |",
    ]


def test_beliefs_are_compared_with_the_world_as_it_is() -> None:
    rows = [
        row("lake", seed, **{"position_error_m.mean": error * seed})
        | {"run_id": f"lake-livo-s{seed}-{name}"}
        for name, error in (("as_is", 0.1), ("mounts", 0.15)) for seed in (1, 2, 3)
    ]  # fmt: skip
    lines = tables.beliefs(frame_of(rows))
    assert cells(lines, "`livo`", "`mounts`")["times that of `as_is`"] == "1.50 [1.50, 1.50]"
    assert cells(lines, "`livo`", "`as_is`")["times that of `as_is`"] == "–"


@pytest.mark.parametrize(("revision", "message"), [
    (None, "a flight has no git revision"),
    ("fedcba", r"2 revisions \(0123456789ab, fedcba\)"),
])  # fmt: skip
def test_nothing_is_flown_that_could_not_be_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, revision: str | None, message: str
) -> None:
    fly(LANDINGS, tmp_path, left_out=1)
    monkeypatch.setattr(edition, "git_revision", lambda: revision)
    monkeypatch.setattr(edition, "fly_campaign", lambda *_, **__: pytest.fail("flown"))
    with pytest.raises(UsageError, match=message):
        edition.fly([LANDINGS], tmp_path, 1, edition.Watcher)


def test_the_cost_is_stated_first(tmp_path: Path, says: Says) -> None:
    fly(LANDINGS, tmp_path, left_out=3)
    asked = ["results", "--out", str(tmp_path), "--dry-run", "--part", "landing"]
    printed = says(0, *asked).out.splitlines()
    assert (
        printed[0] == "landing: 140 flights, 137 of them finished; 25 seeds: verdict of edition 1"
    )
    assert printed[-1].startswith("together: 3 flights, 0.07 core-hours"), "90 s each, as measured"
    tree = json.loads(says(0, *asked, "--json").out)
    assert tree["left"] == 3 and tree["core_hours"] == pytest.approx(3 * 90.0 / 3600.0)
    assert "did you mean 'landing'" in says(2, *asked[:-1], "landings").err


def test_a_page_without_its_markers_is_named() -> None:
    with pytest.raises(UsageError, match=r"README.md: no single part from '<!-- results summary"):
        written("# Results\n", "README.md", {})


def test_short_flights_are_paired_with_whole_ones_of_equal_scene_and_seed() -> None:
    """Ranks agree, errors are halved, d_L is the same in all: no correlation of what is equal."""
    sides = [
        [
            row(scene, seed, **{
                "position_error_m.mean": scale * error, "landing.target_offset_m": 0.1,
            })
            for (scene, seed), error in zip(
                ((("lake", "forest")[n // 3], n) for n in range(6)),
                (0.1, 0.2, 0.4, 0.8, 0.3, 0.6), strict=True,
            )
        ]
        for scale in (0.5, 1.0)
    ]  # fmt: skip
    lines = tables.pairs(frame_of([*sides[0], row("lake", 9)]), frame_of(sides[1][::-1]))
    error, offset = cells(lines, "position error (m)"), cells(lines, "d_L (m)")
    assert (error["pairs"], error["whole, mean"], error["short, mean"]) == ("6", "0.400", "0.200")
    assert error["short over whole"] == "0.500 [0.500, 0.500]"
    assert error["rank correlation"].startswith("1.00 [") and offset["rank correlation"] == "–"
    assert "Landed: 6 of 6 short flights, 6 of 6 whole ones." in "\n".join(lines)


def test_the_bound_names_its_logs_without_the_way_to_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "limit" / "runs" / "lake").mkdir(parents=True)
    monkeypatch.setattr(survey, "measure", lambda run, *_: {"run": str(run), "scene": run.name})
    found = edition.MEASURED["limit"](tmp_path)
    assert found == {"runs": [{"run": "lake", "scene": "lake"}]}


def test_programs_of_others_fly_with_the_best_settings_of_their_trials() -> None:
    best = {}
    for name in ("rko_lio", "dlio"):
        found = json.loads((ROOT / f"docs/results/tuning/{name}.json").read_text())
        best[found["estimator"]] = found["best_settings"]
    runs = load_plan(ROOT / "configs/others.toml").runs
    assert {run.values["estimator"] for run in runs} == best.keys()
    for run in runs:
        settings = best[run.values["estimator"]]
        assert {key: run.values[key] for key in settings} == settings
