"""`touchdown export`: output, paths, usage errors in one line."""

import json
from pathlib import Path

import pytest

from touchdown.experiments.errors import UsageError
from touchdown.experiments.export.flown_run import open_flown
from touchdown.experiments.external.synthetic_stream import synthetic_rig

from support.command import RunCli


def test_the_command_prints_what_it_wrote(
    run: Path, bag: Path, tmp_path: Path, run_cli: RunCli
) -> None:
    out = tmp_path / "new" / "flown-bag"
    code, printed, _ = run_cli("export", run, "--format", "mcap", "--out", out, "--json")
    facts = json.loads(printed)
    assert (
        code == 0
        and facts["file"] == str(out)
        and facts["bytes"] == sum(f.stat().st_size for f in out.iterdir())
    )
    assert facts["counts"]["/lidar/points"] == 23 and facts["counts"]["/tf_static"] == 1
    rig = synthetic_rig()
    pose = rig.body_from_imu.inverse() @ rig.body_from_lidar
    assert facts["imu_from_lidar"]["rotation_row_major"] == pose.rotation.ravel().tolist()
    # equal runs, equal files
    assert (out / "flown-bag.mcap").read_bytes() == (bag / "flown-bag.mcap").read_bytes()
    code, printed, _ = run_cli("export", run, "--format", "tum", "--out", tmp_path / "e.tum")
    assert code == 0 and printed.splitlines()[-1].startswith(f"written: {tmp_path / 'e.tum'}")


def test_default_output_is_beside_the_run_and_is_replaced(run: Path, run_cli: RunCli) -> None:
    for _ in range(2):  # an earlier export is replaced
        for kind, name in (
            ("tum", "flown-estimate.tum"),
            ("csv", "flown.csv"),
            ("ply", "flown.ply"),
            ("mcap", "flown-bag/flown-bag.mcap"),
        ):
            assert run_cli("export", run, "--format", kind)[0] == 0
            assert (run.parent / name).is_file()
    names = {path.name for path in run.parent.iterdir()}
    assert names == {"flown", "flown-bag", "flown-estimate.tum", "flown.csv", "flown.ply"}


@pytest.mark.parametrize(("arguments", "message"), [
    (["nowhere", "--format", "csv"], "no run directory"), (["{run}", "--format", "bag"], "bag"),
    (["{run}"], "--format"),
    (["{run}", "--format", "csv", "--tf", "odom"], "--tf is for --format mcap, not csv"),
    (["{run}", "--format", "mcap", "--judged"], "--judged is for --format tum or csv"),
    (["{run}", "--format", "ply", "--every", "0"], "--every"),
    (["{run}", "--format", "ply", "--every", "3"], "ply of scans"),
    (["{run}", "--format", "ply", "--poses", "truth"], "ply of scans"),
    (["{run}", "--format", "csv", "--poses", "truth"], "not csv"),
    (["{run}", "--format", "mcap", "--poses", "reference"], "reference"),
    (["{run}", "--format", "tum", "--poses", "reference"], "its reference.tum does not exist"),
    (["{run}", "--format", "mcap", "--origin", "here"], "LAT,LON,HEIGHT"),
    (["{run}", "--format", "mcap", "--origin", "91,0,0"], "LAT,LON,HEIGHT"),
    (["{run}", "--format", "mcap", "--origin", "nan,0,0"], "LAT,LON,HEIGHT"),
    (["{blind}", "--format", "mcap"], "--log-sensors"),
    (["{blind}", "--format", "ply", "--points", "scans"], "--log-sensors"),
    (["{blind}", "--format", "ply"], "its map.ply does not exist"),
    (["{run}", "--format", "csv", "--out", "{tmp}"], "is a directory"),
    (["{run}", "--format", "mcap", "--out", "{tmp}"], "no earlier export"),
    (["{run}", "--format", "mcap", "--out", "{run}"], "no earlier export"),
    (["{run}", "--format", "mcap", "--out", "{tmp}/note.txt"], "a bag or data set is a folder"),
    (["{run}", "--format", "csv", "--out", "{tmp}/note.txt"], "no earlier export"),
    (["{run}", "--format", "tum", "--out", "{tmp}/note.tum"], "no earlier export"),
    (["{run}", "--format", "mcap", "--out", "{run}/sensors.mcap"], "file of the run itself"),
    (["{run}", "--format", "csv", "--out", "{tmp}/note.txt/x.csv"], "cannot be written"),
    (["{broken}", "--format", "csv"], "no trajectory"),
    (["{broken}", "--format", "mcap"], "no trajectory"),
    (["{cut}", "--format", "mcap"], "no complete MCAP"),
    (["{broken}", "--format", "ply"], "no map"),
])  # fmt: skip
def test_invalid_input_is_one_line_and_leaves_no_files(
    run: Path, tmp_path: Path, run_cli: RunCli, arguments: list[str], message: str
) -> None:
    (tmp_path / "note.txt").write_text("mine")
    (tmp_path / "note.tum").write_text("a line of exactly eight words is no trajectory")
    blind, broken, cut = (tmp_path / name for name in ("blind", "broken", "cut"))
    for folder in (blind, broken, cut):
        folder.mkdir()
        (folder / "result.json").write_text("{}")
        for name in ("truth", "estimate"):
            (folder / f"{name}.tum").write_text("0 0 0 0 0 0 0 1\n9 0 0 0 0 0 0 1\n")
    (broken / "truth.tum").write_text("0 0 0 0 0 0 0 1\n1 2 3\n")
    for folder in (broken, cut):
        (folder / "sensors.mcap").write_bytes((run / "sensors.mcap").read_bytes()[:300_000])
    (broken / "map.ply").write_text("ply\n")
    before = sorted(path for path in tmp_path.rglob("*"))
    names = {"run": run, "blind": blind, "broken": broken, "cut": cut, "tmp": tmp_path}
    code, printed, errors = run_cli("export", *[a.format(**names) for a in arguments])
    assert code == 2 and printed == "" and errors.count("\n") == 1 and message in errors
    assert sorted(path for path in tmp_path.rglob("*")) == before
    assert (tmp_path / "note.txt").read_text() == "mine"


def test_a_log_named_in_a_result_must_be_of_its_flight(run: Path, tmp_path: Path) -> None:
    """`replay_of` comes from a file: it does not open any log of the machine."""
    other = tmp_path / "replay"
    other.mkdir()
    for name in ("truth.tum", "estimate.tum"):
        (other / name).write_bytes((run / name).read_bytes())
    flown = json.loads((run / "result.json").read_text())
    facts = {key: flown.get(key) for key in ("scene", "seed", "estimator")}
    facts |= {"replay_of": str(run), "flown_by": flown.get("estimator")}
    (other / "result.json").write_text(json.dumps(facts))
    assert open_flown(other).sensors() == run / "sensors.mcap"
    for change in ({"seed": 77}, {"scene": "lake"}, {"flown_by": "x"}, {"replay_of": [str(run)]}):
        (other / "result.json").write_text(json.dumps(facts | change))
        with pytest.raises(UsageError, match=r"has no sensors\.mcap"):
            open_flown(other).sensors()
