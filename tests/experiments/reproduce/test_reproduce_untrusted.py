"""Directories of reproductions that other people made: nothing outside is read or touched."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from touchdown.experiments.errors import UsageError
from touchdown.experiments.reproduce import run as reproduce
from touchdown.experiments.reproduce.parts import PARTS

if TYPE_CHECKING:
    from support.reproduce_world import World

pytest_plugins = ("support.reproduce_world",)

CHEAP = ("world", "sites", "recognition", "speed")


def run_cheap(out: Path) -> reproduce.Reproduction:
    skip = [part.name for part in PARTS if part.name not in CHEAP]
    return reproduce.reproduce(out, quick=True, jobs=1, skip=skip)


@pytest.fixture
def out(world: World, tmp_path: Path) -> Path:
    directory = tmp_path / "home" / "out"
    run_cheap(directory)
    victim = tmp_path / "home" / "victim"
    victim.mkdir()
    (victim / "thesis.txt").write_text("years of work")
    world.calls.clear()
    return directory


def changed(file: Path, **changes: Any) -> None:
    """``figures`` are added to those of the state; None leaves none."""
    state = json.loads(file.read_text())
    if (figures := changes.pop("figures", {})) is not None:
        figures = state["figures"] | figures
    file.write_text(json.dumps(state | changes | {"figures": figures or {}}))


@pytest.mark.parametrize("changes", [
    {"part": "world"}, {"part": None}, {"edition": "../x"}, {"wall_s": "long"}, {"error": None},
    {"settings": []}, {"more": 1},
])  # fmt: skip
def test_states_of_other_shape_are_damaged(
    changes: dict[str, Any], out: Path, world: World
) -> None:
    changed(out / "speed" / "part.json", **changes)
    with pytest.raises(UsageError, match=r"part\.json' is damaged .*; delete it") as caught:
        run_cheap(out)
    assert "\n" not in str(caught.value) and not world.calls


def test_figures_name_no_files(out: Path) -> None:
    names = {path.name for path in (out / "report" / "figures").iterdir()}
    changed(out / "world" / "part.json", figures={"scenes": ["../../../victim/thesis"]})
    place = {"scene": "/../../victim/x", "chosen_safe": True, "accepted": 1, "accepted_safe": 1}
    changed(out / "sites" / "part.json", figures={"places": [place]})
    run_cheap(out)
    assert {path.name for path in (out / "report" / "figures").iterdir()} == names


def test_figures_that_the_report_lacks_are_named(out: Path) -> None:
    changed(out / "speed" / "part.json", figures=None)
    with pytest.raises(UsageError, match=r"speed/part\.json' lacks figures of its part; delete it"):
        run_cheap(out)


@pytest.mark.parametrize(
    "name",
    [".lock", "report", "speed", "world/pictures", "speed/part.json", "positioning",
     "recognition/quick/networks/resnet18-d_land", "speed/.part.json.1"],
)  # fmt: skip
@pytest.mark.parametrize("target", ["victim", "nothing"])
def test_links_in_the_directory_are_refused(
    name: str, target: str, out: Path, world: World
) -> None:
    link, home = out / name, out.parent
    if link.is_dir():
        shutil.rmtree(link)
    link.unlink(missing_ok=True)
    link.symlink_to(home / target)
    with pytest.raises(UsageError, match="is a link; a reproduction uses none"):
        run_cheap(out)
    assert not world.calls and not (home / "nothing").exists()
    assert [path.name for path in (home / "victim").iterdir()] == ["thesis.txt"]
    assert (home / "victim" / "thesis.txt").read_text() == "years of work"
