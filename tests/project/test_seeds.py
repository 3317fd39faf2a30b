"""Every seed that is named somewhere has the owner that the place stands for."""

import re

import pytest

from touchdown.experiments.campaign.plan import load_plan
from touchdown.experiments.config.seeds import owner_of, owners
from touchdown.experiments.results_tables.edition import SETS

from support.docs_support import FOLDERS, ROOT

EDITION = {found.file for found in SETS}
RUGGED = {"configs/rugged.toml", "configs/rugged_whole.toml"}
REGRESSION = {"configs/regress.toml", "configs/regress_baseline.toml"}
_SPAN = r"\d+(?:\s*(?:-|to)\s*\d+)?"
NAMED = re.compile(rf"seeds?\W{{1,6}}({_SPAN}(?:\s*(?:,|and)\s*{_SPAN})*)")


def plans() -> list[str]:
    files = (ROOT / "configs").glob("*.toml")
    return sorted(str(f.relative_to(ROOT)) for f in files if "[axes]" in f.read_text("utf-8"))


@pytest.mark.parametrize("file", plans())
def test_a_campaign_uses_seeds_of_its_own_kind(file: str) -> None:
    found = {owner_of(run.values["seed"]) for run in load_plan(ROOT / file).runs}
    if file in {*EDITION, "configs/others.toml"}:
        assert found == {"verdict of edition 1"}
    elif file in RUGGED:
        assert found == {"verdict on rugged ground"}
    elif file in {"configs/blind.toml", "configs/lying.toml"}:
        assert found == {"verdict on blindness"}
    elif file == "configs/intruders.toml":
        assert found == {"verdict on intruders"}
    elif file in {"configs/vehicles.toml", "configs/rigs.toml"}:
        assert found == {"verdict on vehicles and rigs"}
    elif file in {"configs/deck.toml", "configs/deck_curve.toml"}:
        assert found == {"verdict on a moving deck"}
    elif file in REGRESSION:
        assert found <= {"regression", "short"}
    else:
        assert found == {"development"}


def test_nothing_else_names_a_verdict() -> None:
    folders = (*FOLDERS, "examples", "docs")
    files = [ROOT / "README.md", ROOT / "Makefile", ROOT / "CONTRIBUTING.md"]
    for folder in folders:
        files += [
            f
            for ending in ("py", "md", "toml", "ipynb")
            for f in (ROOT / folder).rglob(f"*.{ending}")
        ]
    count = 0
    for file in files:
        if (
            file.is_relative_to(ROOT / "docs" / "results")
            or file.name == "seeds.toml"
            or file.is_symlink()
        ):
            continue
        written = re.sub(
            r"<!-- results .*?<!-- end of results -->", "", file.read_text("utf-8"), flags=re.S
        )
        for seeds in named(written):
            count += 1
            assert {owner_of(seed) for seed in seeds} <= {"development", "user"}, (file, seeds)
    assert count > 40


def named(text: str) -> list[list[int]]:
    """The ends of every range of seeds, by place."""
    return [[int(n) for n in re.findall(r"\d+", found[1])] for found in NAMED.finditer(text)]


def test_owners_are_ranges_with_ends() -> None:
    seeds = (0, 9999, 10000, 10100, 20000, 20999, 21000, 22000, 22200)
    assert [owner_of(seed) for seed in seeds] == [
        "development", "development", "regression", "short",
        "verdict of edition 1", "verdict of edition 1", "verdict on rugged ground",
        "verdict on blindness", "user",
    ]  # fmt: skip
    assert owners([20000, 20000, 3, 4]) == "3 seeds: 1 verdict of edition 1, 2 development"
    assert owners([50000]) == "1 seed: user"
    assert named("--seeds 3-5, seed = 7; seeds 1 to 2 and 9") == [[3, 5], [7], [1, 2, 9]]
