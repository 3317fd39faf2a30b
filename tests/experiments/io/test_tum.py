"""Trajectories as text: what is no pose is refused with its line."""

from pathlib import Path

import pytest

from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.tum import read_tum

GOOD = "0.0 1 2 3 0 0 0 1\n"


@pytest.mark.parametrize(("line", "words"), [
    ("0.1 nan 2 3 0 0 0 1", "line 3 is not eight numbers"),
    ("0.1 1 inf 3 0 0 0 1", "line 3 is not eight numbers"),
    ("nan 1 2 3 0 0 0 1", "line 3 is not eight numbers"),
    ("0.1 1 2 3 nan 0 0 1", "line 3 is not eight numbers"),
    ("0.1 1 2 3 0 0 0 0", "line 3 is not eight numbers"),
    ("0.1 1e300 2 3 0 0 0 1", "line 3 is not eight numbers"),
    ("0.1 1 2 3 0 0 0", "line 3 is not eight numbers"),
    ("0.1 1 2 x 0 0 0 1", "but '0.1 1 2 x 0 0 0 1'"), ("\x1b[31m", "but '\\x1b[31m'"),
    ("\ud800", "line 3"),
    ("-0.1 1 2 3 0 0 0 1", "line 3 is earlier than the one before"),
])  # fmt: skip
def test_a_line_that_is_no_pose_is_named(tmp_path: Path, line: str, words: str) -> None:
    file = tmp_path / "a.tum"
    file.write_bytes((f"# t x y z qx qy qz qw\n{GOOD}{line}\n").encode(errors="surrogatepass"))
    with pytest.raises(UsageError) as refused:
        read_tum(file)
    assert words in str(refused.value) and str(file) in str(refused.value)
    assert str(refused.value).isprintable()


def test_an_empty_trajectory_has_no_rows(tmp_path: Path) -> None:
    file = tmp_path / "a.tum"
    file.write_text("# nothing\n\n")
    assert [len(part) for part in read_tum(file)] == [0, 0, 0]
    file.write_text(GOOD + GOOD)
    assert read_tum(file)[2].tolist() == [[1, 0, 0, 0]] * 2
