"""Reproduction: parts, resuming, failures and the report, with parts that take no time."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from touchdown.experiments.cli import main as cli
from touchdown.experiments.errors import UsageError
from touchdown.experiments.reproduce import parts
from touchdown.experiments.reproduce import run as reproduce
from touchdown.experiments.reproduce.networks import PICTURES, _trainings, train_and_score
from touchdown.experiments.reproduce.parts import PARTS, PartResult, Reproduction, part_named
from touchdown.experiments.reproduce.report import ITEMS, item_table, measured
from touchdown.experiments.reproduce.tables import claim_table
from touchdown.landing.classification.networks.registry import check_network

from support.command import Says

if TYPE_CHECKING:
    from support.reproduce_world import World

pytest_plugins = ("support.reproduce_world",)
CAMPAIGNS = ("positioning", "commanded_site", "zou2024_sites", "zou2024")
USUAL = tuple(part.name for part in PARTS if not part.needs_photographs)


def run_quick(out: Path, **options: Any) -> Reproduction:
    return reproduce.reproduce(out, quick=True, jobs=1, **options)


def run_photographs(out: Path, *photographs: str) -> Reproduction:
    """The whole edition of the part of photographs and of that of the speed."""
    skip = [name for name in USUAL if name != "speed"]
    return reproduce.reproduce(out, quick=False, jobs=1, skip=skip, photographs=list(photographs))


def test_every_item_of_the_paper_has_one_part() -> None:
    shown = [item for part in PARTS for item in part.shows]
    assert sorted(shown) == sorted(item.name for item in ITEMS)
    tables = {f"Table {number}" for number in range(1, 8)}
    figures = {f"Fig. {number}" for number in (2, 4, 5, 7, 8, 9, 10, 11, 12)}
    assert {re.sub(r" [ab]$", "", item) for item in shown} == tables | figures


def test_one_command_gives_every_table_and_figure(world: World, tmp_path: Path, says: Says) -> None:
    out = tmp_path / "deep" / "out"
    output = says(0, "reproduce", "--out", out, "--quick", "--jobs", "1", "--json")
    tree = json.loads(output.out)
    assert [part["part"] for part in tree["parts"]] == list(USUAL)
    assert tree["good"] and all(part["good"] for part in tree["parts"])
    assert f"[1/{len(USUAL)}] calibration" in output.err
    text = Path(tree["files"]["md"]).read_text(encoding="utf-8")
    for number in range(1, 8):
        assert re.search(rf"^\*\*Table {number}:", text, re.MULTILINE), f"Table {number}"
    for figure in ("2", "4", "5", "7", "8", "9 a", "9 b", "10 a", "10 b", "11", "12"):
        assert re.search(rf"^!\[Fig\. {figure}\b", text, re.MULTILINE), f"Fig. {figure}"
    for target in re.findall(r"!\[[^]]*\]\(([^)]+)\)", text):
        assert (out / "report" / target).is_file()
    assert "2.0538" in text and "4141.12 ± 73.24" in text and "0.769" in text
    assert "Quick edition" in text and "does not measure attainable scores" in text
    page = Path(tree["files"]["html"]).read_text(encoding="utf-8")
    assert not re.search(r"""(src|href)\s*=\s*["'](?!#|data:)""", page)
    numbers = json.loads(Path(tree["files"]["json"]).read_text(encoding="utf-8"))
    assert numbers["flights"] == 15
    assert "positioning_table2" in numbers["tables"] and "table4" in numbers["tables"]


@pytest.mark.usefixtures("no_report")
def test_an_interrupted_reproduction_resumes(world: World, tmp_path: Path) -> None:
    world.interrupted = "crossroad-hybrid_flow-s20000"
    with pytest.raises(KeyboardInterrupt):
        run_quick(tmp_path)
    assert not (tmp_path / "report").exists()
    world.interrupted = ""
    of_one_killed = tmp_path / "speed" / ".pictures.partial-1"
    of_one_killed.mkdir(parents=True)
    assert run_quick(tmp_path).successful and not of_one_killed.exists()
    before = list(world.calls)
    assert run_quick(tmp_path).successful and world.calls == before, "nothing is repeated"
    assert world.count("calibration") == world.count("pictures") == 1
    # The one that was interrupted once more.
    flown = ("crossroad-hybrid_flow-s20000", "crossroad-gps-s20000", "crossroad-gps-s20120")
    assert [world.count(name) for name in flown] == [2, 1, 1]


@pytest.mark.usefixtures("no_report")
def test_quick_becomes_whole_and_keeps_its_flights(world: World, tmp_path: Path) -> None:
    run_quick(tmp_path)
    kept = ("zou2024", "positioning", "commanded_site")
    whole = reproduce.reproduce(tmp_path, quick=False, jobs=1, skip=kept)
    assert whole.successful
    assert {name: state.edition for name, state in whole.results.items()} == {
        name: "quick" if name in (*kept, *_SAME) else "whole" for name in USUAL
    }
    assert world.count("turf-zou2024-s20111-allowed_classeslawn_field_path") == 1
    assert world.count("training") == 1 + 18
    with pytest.raises(UsageError, match="begun without --quick"):
        run_quick(tmp_path)


_SAME = ("calibration", "edges", "world", "sites", "speed")
"""Parts that are equal in the quick and the whole edition."""


def test_a_part_that_fails_its_purpose_is_reported(
    world: World, tmp_path: Path, says: Says
) -> None:
    world.consistent = False
    skips = [argument for name in (*CAMPAIGNS, "recognition") for argument in ("--skip", name)]
    arguments = ["reproduce", "--out", str(tmp_path), "--quick", "--quiet", *skips]
    output = says(1, *arguments)
    assert output.err == ""
    assert re.search(r"calibration +quick .* FAILED: its errors exceed", output.out)
    text = (tmp_path / "report" / "report.md").read_text(encoding="utf-8")
    assert "`calibration` (Fig. 2) failed: its errors exceed" in text
    assert "`zou2024` (Fig. 9 b) is left out" in text
    assert cli.main(arguments) == 1 and world.count("calibration") == 1


def test_a_part_that_breaks_leaves_the_others(world: World, tmp_path: Path) -> None:
    world.broken = "speed"
    done = run_quick(tmp_path, skip=["recognition", *CAMPAIGNS])
    assert not done.successful and done.results["speed"].error == "RuntimeError: a wing came off"
    assert "Traceback" in (tmp_path / "speed" / "error.txt").read_text()
    assert not done.results["sites"].failure
    assert "`speed` (Table 7) failed: RuntimeError" in (
        tmp_path / "report" / "report.md"
    ).read_text(encoding="utf-8")
    world.broken = ""
    assert run_quick(tmp_path, skip=["recognition", *CAMPAIGNS]).successful


@pytest.mark.usefixtures("no_report")
def test_a_campaign_without_some_outcomes_fails(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part = part_named("zou2024_sites")
    figures = {"runs": 5, "crashed": 2, "remaining": 0, "as_expected": True}
    figures |= dict.fromkeys(("name", "mode", "finished", "outcomes", "errors"), 0)
    monkeypatch.setattr(
        "touchdown.experiments.campaign.session.fly_campaign", lambda *a, **o: figures
    )
    skip = [other.name for other in PARTS if other is not part]
    done = run_quick(tmp_path, skip=skip)
    assert done.results["zou2024_sites"].why == "2 of 5 flights have no outcome"
    assert not reproduce.is_done(part, tmp_path, parts.Extent(quick=True)), "it is gone on with"


@pytest.mark.usefixtures("no_report")
def test_trained_networks_are_kept(world: World, tmp_path: Path) -> None:
    skip = [part.name for part in PARTS if part.name != "recognition"]
    world.broken = "scores"
    assert not run_quick(tmp_path, skip=skip).successful
    world.broken = ""
    home = tmp_path / "recognition" / "quick"
    assert (home / "pictures").is_dir()
    (home / "settings.json").write_text("{}")
    assert run_quick(tmp_path, skip=skip).successful
    assert world.count("pictures") == 2, "other settings start over"
    assert (home.with_name("quick-2") / "pictures").is_dir(), "nothing is deleted"
    assert (home / "networks" / "resnet18-d_land" / "scores.json").is_file()


def test_photographs_train_every_network_until_it_has_converged(
    world: World, tmp_path: Path
) -> None:
    seeds = {"": (0.80, 0.70), "-1": (0.82, 0.70), "-2": (0.84, 0.70)}
    for end, (with_block, without) in seeds.items():
        world.top1 |= {f"resnet50_cbam-d_land{end}": with_block, f"resnet50-d_land{end}": without}
    world.course = lambda epoch: 0.01 * min(epoch, 64)
    done = run_photographs(tmp_path, "ucmerced=/pictures")
    state = done.results["photographs"]
    assert not state.error and not state.why
    assert state.figures["size"]["photographs"] == ["ucmerced=/pictures"]
    assert world.count("training") == 9 * 2 + 2 * 2 and world.count("pictures") == 0
    table = claim_table(state.figures["networks"])
    cbam = table.numbers["cbam"]
    assert cbam["differences"] == pytest.approx([0.10, 0.12, 0.14])
    # Student's t of 2 degrees of freedom, 4.303, times 0.02 over the root of 3
    half = 4.303 * 0.02 / 3**0.5
    assert (cbam["low"], cbam["high"]) == pytest.approx((0.12 - half, 0.12 + half), rel=1e-3)
    assert len(table.numbers["d_land"]["differences"]) == 9
    text = (tmp_path / "report" / "report.md").read_text(encoding="utf-8")
    assert "photographs of pictures alone" in text and "22 of 22 trainings converged" in text


def test_every_network_of_every_edition_can_see_its_images(tmp_path: Path) -> None:
    for edition in parts.TRAININGS.values():
        for size in edition.values():
            for one in _trainings(tmp_path, size, ()):
                check_network(one.network, one.options["image_size"])


@pytest.mark.usefixtures("no_report")
def test_a_network_that_still_improves_has_not_converged(world: World, tmp_path: Path) -> None:
    world.course = lambda epoch: 0.01 * epoch
    done = run_photographs(tmp_path, "x")
    assert done.results["photographs"].why.startswith("not converged: resnext50, d_scene; ")


@pytest.mark.usefixtures("no_report")
@pytest.mark.parametrize(("fall", "converged"), [(0.04, True), (0.06, False)])
def test_patience_that_ends_while_a_network_learns_is_no_convergence(
    world: World, tmp_path: Path, fall: float, converged: bool
) -> None:
    world.ended = 40
    world.loss = lambda epoch: 1.0 - fall * (epoch >= 32)  # the last tenth of 80 epochs
    done = run_photographs(tmp_path, "x")
    assert ("not converged" in done.results["photographs"].why) is not converged


@pytest.mark.parametrize(("arguments", "message"), [
    (["--quick"], "missing option '--out'"),
    (["--out", "OUT", "--skip", "calibraton"], "did you mean 'calibration'"),
    (["--out", "UNRELATED"], "holds something that is no reproduction"),
    (["--out", "UNRELATED/file"], "is a file"),
    (
        ["--out", "OUT", *(w for part in PARTS for w in ("--skip", part.name))],
        "leaves nothing to do",
    ),
])  # fmt: skip
def test_usage_errors_are_one_line(
    world: World, tmp_path: Path, says: Says, arguments: list[str], message: str
) -> None:
    (tmp_path / "UNRELATED").mkdir()
    (tmp_path / "UNRELATED" / "file").write_text("mine")
    command = [
        str(tmp_path / argument) if argument.startswith(("OUT", "UNRELATED")) else argument
        for argument in arguments
    ]
    output = says(2, "reproduce", *command)
    assert output.err.count("\n") == 1 and message in output.err
    assert not (tmp_path / "OUT").exists() and not world.calls


def test_recognition_needs_torch_or_to_be_skipped(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UsageError, match="--skip recognition"):
        run_quick(tmp_path / "out")
    assert not (tmp_path / "out" / "calibration").exists()


def test_two_reproductions_in_one_directory_are_refused(world: World, tmp_path: Path) -> None:
    with reproduce._locked(tmp_path), pytest.raises(UsageError, match="another reproduction"):
        run_quick(tmp_path)


def state(part: str, **changes: Any) -> PartResult:
    given: dict[str, Any] = {
        "part": part, "edition": "whole", "settings": {}, "figures": {}, "why": "", "error": "",
        "wall_s": 1.0, "finished_utc": "", "git_revision": "0123abc",
    }  # fmt: skip
    return PartResult(**given | changes)


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


def test_a_failed_training_gives_its_reason(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    pytest.importorskip("onnx")
    (tmp_path / PICTURES / "lawn").mkdir(parents=True)
    two = ("mobilenet_v3_large", "resnet18")
    size = replace(
        parts.TRAININGS["quick"]["recognition"],
        networks=two,
        labels=("d_land",),
        image_size=32,
        epochs=1,
    )
    with pytest.raises(UsageError, match="is empty: it holds no image"):
        train_and_score(tmp_path, size, [], {}, 2, lambda note: None)
