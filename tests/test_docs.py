"""The pages say what is there: links, commands, code blocks, names, keys and their defaults."""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import importlib
import importlib.util
import io
import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import click
import pytest
import yaml

from experiments import cli
from experiments.campaign import load_plan
from experiments.config import load_config

ROOT = Path(__file__).parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
FOLDERS = ("sim", "scenes", "estimator", "landing", "controller", "experiments")
SENSOR_KEYS = (
    "lidar",
    "camera",
    "imu",
    "gps",
    "barometer",
    "magnetometer",
    "rangefinder",
    "rig_error",
)


def _name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def _text(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


def _blocks(page: Path, language: str) -> list[str]:
    text = page.read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def _prose(page: Path) -> str:
    """A page without its code blocks."""
    text = page.read_text(encoding="utf-8")
    return re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)


def _inline(page: Path) -> list[str]:
    return [" ".join(code.split()) for code in re.findall(r"`([^`]+)`", _prose(page))]


def _rows(page: str, header: str) -> list[list[str]]:
    """Cells of the rows of every table whose first heading is ``header``."""
    rows: list[list[str]] = []
    inside = False
    for line in _text(page).splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if not line.startswith("|"):
            inside = False
        elif cells[0] == header:
            inside = True
        elif inside and not set(line) <= set("|-: "):
            rows.append(cells)
    assert rows, f"{page} has no table with the heading '{header}'"
    return rows


# ------------------------------------------------------------------------------------------ links


def _anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", _prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}


def _links(page: Path, mark: str) -> Iterator[tuple[Path, str]]:
    """Files and anchors that links (mark "") or pictures (mark "!") of a page lead to."""
    pattern = r"(!?)\[[^\]]*\]\(([^)\s]+)\)"
    for found, target in re.findall(pattern, page.read_text(encoding="utf-8")):
        if found == mark and not target.startswith(("http://", "https://", "mailto:")):
            file, _, anchor = target.partition("#")
            yield (page.parent / file).resolve() if file else page, anchor


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_links_lead_somewhere(page: Path) -> None:
    for target, anchor in _links(page, ""):
        assert target.exists(), f"{_name(page)} links to {target.name}, which does not exist"
        assert not anchor or anchor in _anchors(target), f"{_name(page)}: no heading #{anchor}"


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_pictures_exist(page: Path) -> None:
    missing = [target.name for target, _ in _links(page, "!") if not target.is_file()]
    assert missing == []


def test_the_front_page_links_every_page() -> None:
    """Pages of single modules of the reference are linked by the page of the reference."""
    reference = ROOT / "docs" / "reference" / "index.md"
    linked = {target for page in (ROOT / "README.md", reference) for target, _ in _links(page, "")}
    assert [_name(page) for page in PAGES if page not in linked] == []


# ------------------------------------------------------------------------------------------- site


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
    site = yaml.safe_load(_text("mkdocs.yml"))
    hooks = _site_hooks()
    written = {str(p.relative_to(ROOT / "docs")) for p in (ROOT / "docs").rglob("*.md")}
    added = {*hooks.ROOT_PAGES.values(), hooks.COMMANDS_PAGE}
    assert not written & added, "pages that the site adds would hide pages of docs/"
    assert sorted(_in_nav(site["nav"])) == sorted(written | added)
    assert set(hooks.ROOT_PAGES) == {page.name for page in ROOT.glob("*.md")}
    for file in (*site["hooks"], *(f"docs/{sheet}" for sheet in site["extra_css"])):
        assert (ROOT / file).is_file()


def test_the_reference_has_every_api() -> None:
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    described = set(re.findall(r"^::: ([\w.]+)$", text, re.MULTILINE))
    assert described >= {f"{folder}.api" for folder in FOLDERS} | {"sim.frames"}
    for module in described:
        assert (ROOT / (module.replace(".", "/") + ".py")).is_file(), module


@pytest.mark.parametrize(
    ("source", "link", "in_the_site"),
    [
        ("README.md", "docs/scenes.md#truth-maps", "scenes.md#truth-maps"),
        ("README.md", "docs/images/costmap.png", "images/costmap.png"),
        ("README.md", "ARCHITECTURE.md", "architecture.md"),
        ("docs/reference/index.md", "../../README.md#commands", "../index.md#commands"),
        ("docs/results/landing.md", "../images/pools.jpg", "../images/pools.jpg"),
        ("docs/scenes.md", "#truth-maps", "#truth-maps"),
        ("docs/scenes.md", "https://example.org/README.md", "https://example.org/README.md"),
        ("docs/scenes.md", "../Makefile", "../Makefile"),
    ],
)
def test_links_are_moved_with_their_pages(source: str, link: str, in_the_site: str) -> None:
    assert _site_hooks().links_of_the_site(f"[a]({link})", source) == f"[a]({in_the_site})"


def test_the_site_describes_every_command() -> None:
    page = _site_hooks().help_of_commands()
    described = re.findall(r"^## (.+)$", page, re.MULTILINE)
    assert described == ["touchdown", *(f"touchdown {path}" for path in _leaves(cli.cli))]
    assert re.findall(r"^Usage: ([a-z -]+[a-z])", page, re.MULTILINE) == described


# --------------------------------------------------------------------------------------- commands


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
    for name, command in sorted(group.commands.items()):
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


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_commands_in_blocks_parse(page: Path) -> None:
    for block in (*_blocks(page, "sh"), *_blocks(page, "yaml")):
        for arguments in _commands(block):
            try:
                options = _parse(arguments).params
            except click.ClickException as error:
                pytest.fail(f"{_name(page)}: touchdown {' '.join(arguments)}: {error.message}")
            load_config(None, options.get("overrides", ()))


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_commands_in_prose_exist(page: Path) -> None:
    """Placeholders stand for arguments there, and arguments may be left out."""
    for code in _inline(page):
        for arguments in _commands(code):
            try:
                _parse(arguments)
            except (click.BadParameter, click.exceptions.NoArgsIsHelpError):
                continue
            except click.ClickException as error:
                pytest.fail(f"{_name(page)}: {code}: {error.message}")


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_no_command_is_written_where_nobody_checks_it(page: Path) -> None:
    """Wherever a page writes ``touchdown`` and a command's name, the tests above have read it."""
    text = page.read_text(encoding="utf-8")
    codes = [*_blocks(page, "sh"), *_blocks(page, "yaml"), *_inline(page)]
    checked = sum(1 for code in codes for arguments in _commands(code) if arguments)
    names = "|".join(cli.cli.commands)
    text = re.sub(r"(?<=\s)#\s.*?$", "", text, flags=re.MULTILINE)
    assert checked >= len(re.findall(rf"(?<![\w-])touchdown\s+(?:{names})(?![\w-])", text))


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_options_in_prose_exist(page: Path) -> None:
    """Options that are written without their command are options of some command."""
    described = _site_hooks().help_of_commands() + _text("experiments/pytest_plugin.py")
    known = set(re.findall(r"--[a-z][\w-]*", described))
    for code in _inline(page):
        if code.startswith("--"):
            assert code.split()[0].split("=")[0] in known, f"{_name(page)}: {code}"


def test_the_front_page_names_every_command() -> None:
    table = " ".join(row[0] for row in _rows("README.md", "command")) + " "
    for command in _leaves(cli.cli):
        assert re.search(rf"`touchdown {command}[ `]", table), f"README.md lacks '{command}'"


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_make_targets_exist(page: Path) -> None:
    targets = set(re.findall(r"^(\w+):", _text("Makefile"), re.MULTILINE))
    for text in (*_blocks(page, "sh"), *_inline(page)):
        for target in re.findall(r"^make (\w+)", text, re.MULTILINE):
            assert target in targets, f"{_name(page)}: make {target}"


@pytest.mark.parametrize("arguments", [["scenes", "list"], ["--help"], ["land", "--help"]])
def test_cheap_commands_run(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(arguments) == 0
    assert capsys.readouterr().out.strip()


# ------------------------------------------------------------------------------------------- code


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_python_blocks_compile(page: Path) -> None:
    for block in _blocks(page, "python"):
        compile(block, _name(page), "exec")


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_toml_blocks_are_configurations(page: Path, tmp_path: Path) -> None:
    for block in _blocks(page, "toml"):
        file = tmp_path / "block.toml"
        file.write_text(block, encoding="utf-8")
        load_plan(file) if "[axes]" in block else load_config(file)


def test_the_smallest_place_is_a_place(tmp_path: Path) -> None:
    from scenes.foreign import read_mjcf

    file = tmp_path / "my_place.xml"
    file.write_text(_blocks(ROOT / "docs" / "your-own-place.md", "xml")[0], encoding="utf-8")
    surfaces = read_mjcf(file).surfaces
    assert {surface.land_class for surface in surfaces.values()} == {"lawn", "building"}


def test_the_smallest_estimator_satisfies_the_contract() -> None:
    module: dict[str, Any] = {"__name__": "my_lab.vio"}
    block = _blocks(ROOT / "docs" / "writing-an-estimator.md", "python")[0]
    exec(compile(block, "vio.py", "exec", dont_inherit=True), module)
    estimator = module["build"]({}, None)
    assert estimator.needs.lidar and callable(estimator.update)


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 1], ids=["gymnasium", "dm_env"])
def test_environments_do_what_the_page_says(number: int) -> None:
    pytest.importorskip("gymnasium")
    pytest.importorskip("dm_env")
    page = ROOT / "docs" / "environments.md"
    promised = re.findall(r"^It prints `([^`]+)`", _text("docs/environments.md"), re.MULTILINE)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(_blocks(page, "python")[number], {"__name__": "block"})
    assert printed.getvalue().strip() == promised[number]


# ------------------------------------------------------------------------------------------ names


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_files_that_are_named_exist(page: Path) -> None:
    for code in _inline(page):
        if re.fullmatch(rf"({'|'.join(FOLDERS)}|tests)/[\w/.]*", code):
            assert (ROOT / code).exists(), f"{_name(page)}: {code}"


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_modules_in_tables_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for folder in re.findall(r"^\| module of `(\w+)/`", text, re.MULTILINE):
        for cells in _rows(_name(page), f"module of `{folder}/`"):
            for module in re.findall(r"`([\w/]+(?:\.py)?/?)`", cells[0]):
                assert (ROOT / folder / module).exists(), f"{_name(page)}: {folder}/{module}"


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_dotted_names_are_keys_or_can_be_imported(page: Path) -> None:
    """Keys of the configuration, keys of a run's result, or names in the code."""
    keys = load_config().model_dump()
    results = "".join(_text(f"experiments/{name}.py") for name in ("metrics", "referee", "flight"))
    for code in _inline(page):
        if not re.fullmatch(r"[a-z_]+(\.\w+)+", code) or code.split(".")[-1] in ("py", "md"):
            continue
        section, _, key = code.partition(".")
        if f'"{key}"' in results:
            continue
        if section in FOLDERS and key not in (keys.get(section) or {}):
            assert _importable(code), f"{_name(page)}: {code} is neither a key nor in the code"
        elif isinstance(keys.get(section), dict):
            assert key in keys[section], f"{_name(page)}: {code} is no key"


def _importable(dotted: str) -> bool:
    parts = dotted.split(".")
    for count in range(len(parts), 0, -1):
        with contextlib.suppress(ImportError):
            found: Any = importlib.import_module(".".join(parts[:count]))
            for part in parts[count:]:
                fields = getattr(found, "__dataclass_fields__", {})
                if part not in fields and not hasattr(found, part):
                    return False
                found = getattr(found, part, None)
            return True
    return False


@pytest.mark.parametrize("page", ["README.md", "docs/scenes.md"])
def test_scenes_are_listed(page: str) -> None:
    from scenes.registry import scene_names

    assert sorted(row[0].strip("`") for row in _rows(page, "scene")) == scene_names()


# --------------------------------------------------------------------------------- keys, defaults


def _value(cell: str) -> Any:
    cell = cell.strip("`")
    if cell == "none":
        return None
    try:
        return json.loads(cell)
    except json.JSONDecodeError:
        return cell


def test_sensor_keys_and_defaults() -> None:
    """Every key of the sensors is on the page, with its default."""
    config = load_config().model_dump(mode="json")
    listed: dict[str, Any] = {}
    for cells in _rows("docs/sensors.md", "key"):
        keys = re.findall(r"`([\w.]+)`", cells[0])
        values = [cells[1]] if len(keys) == 1 else cells[1].split(", ")
        listed |= {key: _value(value) for key, value in zip(keys, values, strict=True)}
    actual = {f"{s}.{key}": value for s in SENSOR_KEYS for key, value in config[s].items()}
    assert listed == actual


def test_lidar_presets() -> None:
    from sim.livox import PATTERNS

    rows = {row[0].strip("`"): row[1:] for row in _rows("docs/sensors.md", "preset")}
    for name, p in PATTERNS.items():
        limits = zip(p.range_limits_m, p.range_reflectivities, strict=True)
        assert rows[name] == [
            f"{p.point_rate_hz:,}".replace(",", " "),
            "{:g}° x {:g}°".format(*p.field_of_view_deg),
            ", ".join(f"{metres:g} m at {100.0 * share:g} %" for metres, share in limits),
            "{:g}° x {:g}°".format(*p.divergence_deg),
        ]


def test_gps_presets() -> None:
    from sim.gps import PRESETS

    rows = {row[0].strip("`"): row[1:] for row in _rows("docs/sensors.md", "preset")}
    for name, model in PRESETS.items():
        if model.receives:
            spread = [float(cell.removesuffix(" m")) for cell in rows[name][:2]]
            assert spread == pytest.approx([model.sigma_xy_m, model.sigma_z_m], rel=5e-3)
        else:
            assert rows[name][-1] == "no fix ever"


def test_classes_and_reflectivities_of_the_ground() -> None:
    from scenes.api import LAND_CLASSES, RISKY_CLASSES, SAFE_CLASSES, UNSAFE_CLASSES
    from scenes.ground import Canvas, Ground

    on_ground: dict[str, set[float]] = {name: set() for name in LAND_CLASSES}
    for material in Ground:
        canvas = Canvas.of_size(1.0, 8)
        canvas.material[:] = int(material)
        raster = canvas.raster("ground")
        name = LAND_CLASSES[int(raster.class_id[0, 0])]
        on_ground[name].add(round(float(raster.reflectivity[0, 0]), 2))
    verdicts = {"safe": SAFE_CLASSES, "risky": RISKY_CLASSES, "unsafe": UNSAFE_CLASSES}
    rows = {row[0].strip("`"): row[1:] for row in _rows("docs/scenes.md", "class")}
    assert set(rows) == {*LAND_CLASSES, "other"}
    for name in LAND_CLASSES:
        assert name in verdicts[rows[name][0]]
        listed = {float(number) for number in re.findall(r"\d\.\d+", rows[name][1])}
        assert on_ground[name] <= listed
        assert name not in ("lawn", "field", "path", "road") or listed == on_ground[name]


def test_classes_of_files_by_others() -> None:
    from scenes.foreign import REFLECTIVITY_905NM

    rows = {
        row[0].strip("`"): row[1] for row in _rows("docs/your-own-place.md", "name begins with")
    }
    assert {name: float(value) for name, value in rows.items()} == {
        "anything else" if name == "other" else name: value
        for name, value in REFLECTIVITY_905NM.items()
    }


def test_options_of_the_environments() -> None:
    pytest.importorskip("gymnasium")
    from experiments.environments.task import TaskOptions

    listed = {
        row[0].strip("`"): ast.literal_eval(row[1].strip("`"))
        for row in _rows("docs/environments.md", "option")
    }
    assert listed == {f.name: f.default for f in dataclasses.fields(TaskOptions)}


def test_sensors_of_the_environments() -> None:
    pytest.importorskip("gymnasium")
    from experiments.environments.senses import SENSORS, Senses

    senses = Senses(tuple(SENSORS), privileged=True, camera_pixels=(84, 84))
    listed = {row[0].strip("`"): row[1] for row in _rows("docs/environments.md", "name")}
    shapes = {name: str(bounds.shape) for name, bounds in senses.bounds.items()}
    assert listed == shapes | {"camera": "(H, W, 3)"}
