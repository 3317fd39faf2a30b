"""Workflows of the hosted CI parse, and call what there is."""

import re
import shlex
from pathlib import Path
from typing import Any

import click
import pytest
import yaml

from touchdown.experiments.cli import main as cli
from touchdown.experiments.results_tables.edition import chosen

ROOT = Path(__file__).parents[2]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
FORMS = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
OTHERS = {"docker", "pip", "twine"}
"""programs that a runner or an earlier command of the step brings"""


def read(path: Path) -> dict[Any, Any]:
    document = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert isinstance(document, dict)
    return document


def targets() -> set[str]:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8").replace("$(VENV)", ".venv")
    named = dict(re.findall(r"^(\w+) := (\S+)$", makefile, re.M))
    found = re.findall(r"^([\w.$()/-]+):(?!=)", makefile, re.M)
    return {re.sub(r"\$\((\w+)\)", lambda name: named[name[1]], target) for target in found}


def check(words: list[str]) -> None:
    program = words[0]
    if program == "make":
        assert {word for word in words[1:] if "=" not in word} <= targets(), words
    elif program == ".ci/run":
        script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
        assert words[1:] and all(
            re.search(rf"^    [\w |]*\b{p}\b.*\)", script, re.M) for p in words[1:]
        )
    elif program == ".venv/bin/touchdown":
        name, command, rest = cli.cli.resolve_command(click.Context(cli.cli), words[1:])
        assert command is not None
        command.make_context(name, rest, resilient_parsing=False)
    elif program.startswith(".ci/"):
        assert (ROOT / program).stat().st_mode & 0o100, program
    else:
        assert program in OTHERS, words


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_a_workflow_calls_what_there_is(path: Path) -> None:
    workflow = read(path)
    assert workflow["permissions"] == {"contents": "read"} and True in workflow, (
        "on is true in YAML"
    )
    steps = [step for job in workflow["jobs"].values() for step in job["steps"]]
    assert all("timeout-minutes" in job for job in workflow["jobs"].values())
    assert all(
        re.fullmatch(r"actions/[\w-]+@v\d+", step["uses"]) for step in steps if "uses" in step
    )
    for step in steps:
        for command in re.split(r"\n|&&", step.get("run", "")):
            if command.strip():
                check(shlex.split(command))


def test_there_is_what_the_workflows_name() -> None:
    assert {path.stem for path in WORKFLOWS} == {"tests", "pages", "nightly"}
    part = read(ROOT / ".github/workflows/nightly.yml")[True]["workflow_dispatch"]["inputs"]["part"]
    assert [one.name for one in chosen([part["default"]])] == [part["default"]]
    for form in map(read, FORMS):
        assert form["name"] and form["description"]
        names = [item["id"] for item in form["body"]]
        assert len(set(names)) == len(names) and all(i["attributes"]["label"] for i in form["body"])
