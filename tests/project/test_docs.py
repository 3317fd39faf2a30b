"""Checks of the pages: links, the site, commands, code blocks."""

import contextlib
import importlib.util
import io
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import click
import pytest
import yaml

from touchdown.experiments.campaign.plan import load_plan
from touchdown.experiments.cli import main as cli
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.config.slots import SLOTS
from touchdown.experiments.external.examination import RULES
from touchdown.experiments.scene_tools.flyability import check_scene_file
from touchdown.scenes.importers.mjcf import read_mjcf

from support.command import lines_of, without_display
from support.docs_support import (
    FOLDERS,
    PAGES,
    ROOT,
    blocks_of,
    inline_of,
    name_of,
    prose_of,
    rows_of,
    text_of,
)


def _anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", prose_of(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}


def _links(page: Path, mark: str) -> Iterator[tuple[Path, str]]:
    """Files and anchors that links (mark "") or pictures (mark "!") of a page lead to."""
    pattern = r"(!?)\[[^\]]*\]\(([^)\s]+)\)"
    for found, target in re.findall(pattern, page.read_text(encoding="utf-8")):
        if found == mark and not target.startswith(("http://", "https://", "mailto:")):
            file, _, anchor = target.partition("#")
            yield (page.parent / file).resolve() if file else page, anchor


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_and_pictures_lead_somewhere(page: Path) -> None:
    assert [target.name for target, _ in _links(page, "!") if not target.is_file()] == []
    for target, anchor in _links(page, ""):
        assert target.exists(), f"{name_of(page)} links to {target.name}, which does not exist"
        assert not anchor or anchor in _anchors(target), f"{name_of(page)}: no heading #{anchor}"


def test_the_front_page_links_every_page() -> None:
    """Pages of single modules of the reference are linked by the page of the reference."""
    reference = ROOT / "docs" / "reference" / "index.md"
    linked = {target for page in (ROOT / "README.md", reference) for target, _ in _links(page, "")}
    assert [name_of(page) for page in PAGES if page not in linked] == []


def _site_hooks() -> ModuleType:
    spec = importlib.util.spec_from_file_location("site_hooks", ROOT / "docs" / "site_hooks.py")
    assert spec is not None and spec.loader is not None
    hooks = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hooks)
    return hooks


def _in_nav(entries: Any) -> Iterator[str]:
    if isinstance(entries, str):
        yield entries
    else:
        for entry in entries.values() if isinstance(entries, dict) else entries:
            yield from _in_nav(entry)


def test_the_site_has_every_page_once() -> None:
    site = yaml.safe_load(text_of("mkdocs.yml"))
    hooks = _site_hooks()
    files = [p for kind in ("md", "ipynb") for p in (ROOT / "docs").rglob(f"*.{kind}")]
    written = {str(p.relative_to(ROOT / "docs")) for p in files}
    added = {*hooks.ROOT_PAGES.values(), hooks.COMMANDS_PAGE, hooks.CONFIGURATION_PAGE}
    assert not written & added, "pages that the site adds would hide pages of docs/"
    assert sorted(_in_nav(site["nav"])) == sorted(written | added)
    assert set(hooks.ROOT_PAGES) == {page.name for page in ROOT.glob("*.md")}
    for file in (*site["hooks"], *(f"docs/{sheet}" for sheet in site["extra_css"])):
        assert (ROOT / file).is_file()


def test_the_reference_has_every_api() -> None:
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    described = set(re.findall(r"^::: ([\w.]+)$", text, re.MULTILINE))
    assert described >= {f"touchdown.{folder}.api" for folder in FOLDERS} | {"touchdown.sim.frames"}
    for module in described:
        assert (ROOT / "src" / (module.replace(".", "/") + ".py")).is_file(), module


@pytest.mark.parametrize(("source", "link", "in_the_site"), [
    ("README.md", "docs/scenes.md#truth-maps", "scenes.md#truth-maps"),
    ("README.md", "docs/images/costmap.webp", "images/costmap.webp"),
    ("README.md", "ARCHITECTURE.md", "architecture.md"),
    ("docs/reference/index.md", "../../README.md#results", "../index.md#results"),
    ("docs/results/field.md", "../images/pools.jpg", "../images/pools.jpg"),
    ("docs/scenes.md", "#truth-maps", "#truth-maps"),
    ("docs/scenes.md", "https://example.org/README.md", "https://example.org/README.md"),
    ("docs/scenes.md", "../Makefile", "../Makefile"),
])  # fmt: skip
def test_links_are_moved_with_their_pages(source: str, link: str, in_the_site: str) -> None:
    assert _site_hooks().links_of_the_site(f"[a]({link})", source) == f"[a]({in_the_site})"


def _commands(text: str) -> Iterator[list[str]]:
    """Arguments of every ``touchdown`` command in shell text, or in the steps of a workflow.
    Variables of loops have their first value."""
    for name, value in re.findall(r"\bfor (\w+) in (\S+)", text):
        text = text.replace(f"${name}", value)
    for line in text.replace("\\\n", " ").splitlines():
        line = re.sub(r"^\s*(- )?run: |^\$ ", "", line)
        words = shlex.split(line, comments=True)
        while words:
            end = next((i for i, word in enumerate(words) if word in ("&&", "|", ">")), len(words))
            if words[0] in ("touchdown", ".venv/bin/touchdown"):
                yield words[1:end]
            words = words[end + 1 :]


def _leaves(group: click.Group) -> Iterator[str]:
    """Every command that does something, by its full name without the program's. Some groups do."""
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        if not isinstance(command, click.Group) or type(command) is not type(cli.cli):
            yield name
        if isinstance(command, click.Group):
            yield from (f"{name} {inner}" for inner in _leaves(command))


def _parse(arguments: list[str]) -> click.Context:
    """Parses as the command line does, without running anything."""
    command: click.Command = cli.cli
    context = click.Context(command, info_name="touchdown")
    while isinstance(command, click.Group) and arguments and not arguments[0].startswith("-"):
        name, found, arguments = command.resolve_command(context, arguments)
        assert found is not None
        command = found
        context = click.Context(command, info_name=name, parent=context)
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(click.exceptions.Exit):
        return command.make_context(context.info_name, list(arguments), parent=context.parent)
    return context


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_in_blocks_parse(page: Path) -> None:
    for block in (*blocks_of(page, "sh"), *blocks_of(page, "yaml")):
        for arguments in _commands(block):
            try:
                options = _parse(arguments).params
            except click.ClickException as error:
                pytest.fail(f"{name_of(page)}: touchdown {' '.join(arguments)}: {error.message}")
            parts: dict[str, Any] = {kind: options[kind] for kind in SLOTS if kind in options}
            if "name" in options:
                parts[options.get("kind", "estimator")] = options["name"]
            if isinstance(options.get("scene"), str):
                parts["scene"] = options["scene"]
            elif options.get("scenes"):
                parts["scene"] = options["scenes"][0]
            load_config(None, options.get("overrides", ()), **parts)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_in_prose_exist(page: Path) -> None:
    """Placeholders stand for arguments there, and arguments may be left out."""
    for code in inline_of(page):
        for arguments in _commands(code):
            try:
                _parse(arguments)
            except (click.BadParameter, click.exceptions.NoArgsIsHelpError):
                continue
            except click.ClickException as error:
                pytest.fail(f"{name_of(page)}: {code}: {error.message}")


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_python_blocks_compile_and_toml_blocks_are_configurations(
    page: Path, tmp_path: Path
) -> None:
    for block in blocks_of(page, "python"):
        compile(block, name_of(page), "exec")
    for block in blocks_of(page, "toml"):
        file = tmp_path / "block.toml"
        file.write_text(block, encoding="utf-8")
        load_plan(file) if "[axes]" in block else load_config(file)


def test_the_smallest_place_is_a_place(tmp_path: Path) -> None:
    file = tmp_path / "my_place.xml"
    file.write_text(blocks_of(ROOT / "docs" / "your-own-place.md", "xml")[0], encoding="utf-8")
    surfaces = read_mjcf(file).surfaces
    classes = {surface.land_class for surface in surfaces.values()}
    assert classes == {"lawn", "building", "trees"}
    row = check_scene_file(str(file))
    assert row["problems"] == row["remarks"] == []


def test_the_smallest_estimator_satisfies_the_contract() -> None:
    module: dict[str, Any] = {"__name__": "my_lab.vio"}
    block = blocks_of(ROOT / "docs" / "writing-an-estimator.md", "python")[0]
    exec(compile(block, "vio.py", "exec", dont_inherit=True), module)
    estimator = module["build"]({}, None)
    assert estimator.needs.lidar and callable(estimator.update)


def test_the_page_of_slots_holds_the_examples_and_readme_names_slots_that_are_there() -> None:
    printed = _site_hooks().with_examples(text_of("docs/bring-your-own.md"))
    for row in rows_of("docs/bring-your-own.md", "slot"):
        for file in re.findall(r"`(examples/\w+\.py)`", row[-1]):
            assert f"```python\n{text_of(file)}```" in printed
    slots, named = (
        {option for row in rows_of(*table) for option in re.findall(r"--(\w+)", " ".join(row[:2]))}
        for table in (("docs/bring-your-own.md", "slot"), ("README.md", "yours"))
    )
    assert named == slots == RULES.keys()
    context = click.Context(cli.cli)
    for command in (cli.cli.get_command(context, name) for name in ("fly", "land")):
        assert slots <= {param.name for param in command.params}


@pytest.mark.parametrize("number", range(3), ids=["dm_control", "physics", "gymnasium"])
def test_environments_do_what_the_page_says(number: int) -> None:
    """All blocks but that of the viewer, which needs a display; the others need neither that nor
    a backend in the environment."""
    pytest.importorskip(("dm_control", "dm_control", "gymnasium")[number])
    page = ROOT / "docs" / "environments.md"
    promised = re.findall(r"^It prints `([^`]+)`", text_of("docs/environments.md"), re.MULTILINE)
    blocks = [block for block in blocks_of(page, "python") if "viewer" not in block]
    assert len(blocks) == len(promised) == 3
    assert lines_of(blocks[number], env=without_display()) == [promised[number]]


@pytest.mark.slow
def test_the_blocks_of_the_python_page_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All but the first, which flies the default survey."""
    import matplotlib

    matplotlib.use("agg")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(ROOT))
    printed = io.StringIO()
    blocks = blocks_of(ROOT / "docs" / "python.md", "python")
    assert len(blocks) == 7
    with contextlib.redirect_stdout(printed):
        for block in blocks[1:]:
            exec(compile(block, "python.md", "exec", dont_inherit=True), {"__name__": "block"})
    assert (tmp_path / "runs" / "study.png").stat().st_size > 0
    assert [line.split()[:3] for line in printed.getvalue().splitlines()[1:5]] == [
        [estimator, str(seed), "COMPLETED"]
        for estimator in ("gps", "optical_flow")
        for seed in (0, 1)
    ]


def test_every_promise_has_tests() -> None:
    for promise, tests in rows_of("docs/trust.md", "promise"):
        nodes = re.findall(r"`(tests/\S+)::(\w+)`", tests)
        assert nodes, promise
        for path, name in nodes:
            assert f"\ndef {name}(" in text_of(path), f"{promise}: {path} has no {name}"


def test_the_notice_names_every_trained_file() -> None:
    notice = (ROOT / "NOTICE").read_text(encoding="utf-8")
    named = re.findall(r"^([\w/.]+\.(?:onnx|gz))$", notice, re.MULTILINE)
    found = [
        path for pattern in ("*.onnx", "*.yml.gz") for path in ROOT.glob(f"[a-z]*/**/{pattern}")
    ]
    trained = {str(path.relative_to(ROOT)) for path in found if "src" not in path.parts}
    assert set(named) == {name for name in trained if not name.startswith(("runs", "build"))}
