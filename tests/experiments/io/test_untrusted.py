"""Names, documents and links in files of other people; unfinished files of dead processes."""

import os
import socket
from pathlib import Path

import pytest

from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.run_directory import (
    check_out_dir,
    default_out_dir,
    run_directory,
    write_text,
)
from touchdown.experiments.io.untrusted import inside, is_plain_name, read_object

STRANGE = (
    "", ".", "..", "a/b", "/a", "../a", "a\n", "\x1b[2J", "\ud800", "a\0", "x" * 201, 3, None,
)  # fmt: skip


def test_names_stay_in_their_folder(tmp_path: Path) -> None:
    for name in ("a", "...", ".a", "crossroad-gps-s3-w6", "Wäldchen-a b-s0"):
        assert is_plain_name(name) and inside(tmp_path, name) == tmp_path / name
    assert inside(tmp_path, "lake/3.png") == tmp_path / "lake" / "3.png"
    assert not any(map(is_plain_name, STRANGE))
    for name in (*(name for name in STRANGE if name != "a/b"), "a/../../b", "a//b", "a/"):
        with pytest.raises(ValueError, match="is no name of a file in"):
            inside(tmp_path, name)


@pytest.mark.parametrize(("content", "reason"), [
    (b"[]", "holds no object"), (b"[" * 100_000, "nested too deeply"), (b"\xff\xfe{}", "not UTF-8"),
    (b"{", "Expecting property name"), (b'{"a": ' + b"9" * 5000 + b"}", "digits"),
])  # fmt: skip
def test_documents_that_are_none_have_a_reason_of_one_line(
    content: bytes, reason: str, tmp_path: Path
) -> None:
    file = tmp_path / "x.json"
    file.write_bytes(content)
    with pytest.raises(ValueError, match=reason) as caught:
        read_object(file)
    assert "\n" not in str(caught.value)


def test_a_link_in_the_way_of_a_file_leads_nowhere(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    partial = tmp_path / f".file.partial-{socket.gethostname()}.{os.getpid()}"
    partial.symlink_to(tmp_path / "mine")
    write_text(tmp_path / "file", "new")
    assert (tmp_path / "file").read_text() == "new" and (tmp_path / "mine").read_text() == "mine"


def test_only_runs_are_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "papers"
    folder.mkdir()
    check_out_dir(folder)
    for text in ("{}", "[1]", '{"outcome": "of an election"}'):
        (folder / "result.json").write_text(text)
        with pytest.raises(UsageError, match="holds something that is no run"):
            check_out_dir(folder)
    run = '{"outcome": "LANDED", "scene": "flat", "seed": 0, "estimator": "gps"}'
    (folder / "result.json").write_text(run)
    (folder / "flight.rrd").touch()
    check_out_dir(folder)
    for foreign in ("thesis.txt", "other-run/", "map.ply/", "row.parquet", ".notes"):
        entry = folder / foreign
        entry.mkdir() if foreign.endswith("/") else entry.touch()
        with pytest.raises(UsageError, match=f"holds '{entry.name}', which no run writes"):
            check_out_dir(folder)
        entry.rmdir() if foreign.endswith("/") else entry.unlink()
    (folder / "truth.tum").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UsageError, match=r"holds 'truth\.tum'"):
        check_out_dir(folder)
    (folder / "truth.tum").unlink()
    with monkeypatch.context() as mounted:
        mounted.setattr("os.path.ismount", lambda path: path == folder)
        with pytest.raises(UsageError, match="is a mount point"):
            check_out_dir(folder)
    monkeypatch.chdir(folder)
    for here in (Path(), folder, Path(".."), tmp_path):
        with pytest.raises(UsageError, match="is the working directory or above it"):
            check_out_dir(here)


def test_a_folder_that_cannot_be_written_to_is_named_before_the_flight() -> None:
    with pytest.raises(UsageError, match=r"--out /proc/x/y: '/proc' cannot be written to \("):
        check_out_dir(Path("/proc/x/y"))


def test_a_link_as_out_stays_and_its_target_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "big-disk" / "run").mkdir(parents=True)
    (tmp_path / "big-disk" / "run" / "map.ply").touch()
    (tmp_path / "run").symlink_to(tmp_path / "big-disk" / "run")
    with run_directory(tmp_path / "run") as partial:
        (partial / "new").touch()
    assert (tmp_path / "run").is_symlink()
    assert [path.name for path in (tmp_path / "big-disk" / "run").iterdir()] == ["new"]


def test_names_of_a_configuration_make_no_path() -> None:
    assert default_out_dir("places/yard.xml", "lab.vio:build", 3) == Path(
        "runs/yard-lab.vio.build-3"
    )
    assert default_out_dir("flat", "gps", 0, "-replay") == Path("runs/flat-gps-0-replay")
    strange = default_out_dir("..", "a/../../home/b:c", 0)
    assert strange.parent == Path("runs") and is_plain_name(strange.name)
