"""The rules of the house, checked on the source itself."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FOLDERS = ("sim", "scenes", "estimator", "landing", "controller", "experiments")
API_MAY_USE = {
    "sim": set(),
    "scenes": {"sim"},
    "estimator": {"sim"},
    "controller": {"sim", "estimator"},
    "landing": {"sim", "estimator", "controller", "scenes"},
    "experiments": set(FOLDERS) - {"experiments"},
}
"""Folders whose ``api`` (and ``sim.frames``) a folder's own ``api`` may import."""
WIRING = (Path("experiments/build.py"), Path("experiments/build_tools.py"))
TORCH_FOLDERS = (
    Path("landing/recognition/networks"),
    Path("landing/recognition/learning"),
)
"""The only places that load torch; ``registry`` among them does not."""
MAX_LINES = 450
SOURCES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
TEXTS = sorted(
    path
    for pattern in ("*.py", "*.md", "*.toml", "*.xml", "Makefile", "run")
    for path in ROOT.rglob(pattern)
    if not any(part in (".venv", ".git", "build", "runs") for part in path.parts)
)
STANDARD = sys.stdlib_module_names


def _imports(path: Path) -> list[tuple[int, str]]:
    """(line, module) of every import in a file; ``from a import b`` gives ``a.b`` and ``a``."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno} is a relative import"
            found.append((node.lineno, node.module or ""))
            if node.module in FOLDERS:
                found += [(node.lineno, f"{node.module}.{alias.name}") for alias in node.names]
    return found


def _id(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("path", SOURCES, ids=_id)
def test_folders_meet_only_at_their_apis(path: Path) -> None:
    relative = path.relative_to(ROOT)
    if relative in WIRING:
        return
    for line, module in _imports(path):
        folder, _, rest = module.partition(".")
        if folder not in FOLDERS or folder == relative.parts[0] or not rest:
            continue
        allowed = rest == "api" or rest.startswith("api.") or module == "sim.frames"
        assert allowed, f"{relative}:{line} imports {module}; only {folder}.api is open to it"


@pytest.mark.parametrize("folder", FOLDERS)
def test_apis_use_numpy_alone_and_only_the_apis_below(folder: str) -> None:
    for path in (ROOT / folder / "api.py", ROOT / "sim" / "frames.py"):
        for line, module in _imports(path):
            top = module.partition(".")[0]
            if top in FOLDERS:
                assert top in API_MAY_USE[folder] | {folder}, f"{path}:{line} imports {module}"
            else:
                assert top in STANDARD or top == "numpy", f"{path}:{line} imports {module}"


def test_estimator_api_loads_without_the_simulator() -> None:
    script = (
        "import sys, estimator.api; "
        "print([m for m in ('mujoco', 'torch', 'open3d', 'cv2', 'scipy') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("path", SOURCES, ids=_id)
def test_modules_stay_readable(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert text.count("\n") <= MAX_LINES
    assert ast.get_docstring(ast.parse(text)), "a module says in one line what it is"


@pytest.mark.parametrize("path", SOURCES, ids=_id)
def test_torch_and_ray_are_imported_when_they_are_needed(path: Path) -> None:
    """Neither they, nor modules that load torch, are imported with any other module."""
    if path.relative_to(ROOT).parent in TORCH_FOLDERS and path.name != "registry.py":
        return
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        assert not {name.partition(".")[0] for name in names} & {"torch", "ray"}
        for folder in TORCH_FOLDERS:
            home = ".".join(folder.parts)
            assert all(n == f"{home}.registry" or not n.startswith(home) for n in names)


def test_no_paths_of_one_machine() -> None:
    pattern = re.compile(r"""(?<![\w.])/(home|Users|work|root|tmp|mnt)/[A-Za-z_]""")
    for path in TEXTS:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            assert not pattern.search(line), f"{path.relative_to(ROOT)}:{number}: {line.strip()}"


def test_console_script_exists() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    module, _, function = project["scripts"]["touchdown"].partition(":")
    assert callable(getattr(__import__(module, fromlist=[function]), function))


def test_every_folder_and_data_file_is_packaged() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
    assert set(settings["setuptools"]["packages"]["find"]["include"]) == {f"{f}*" for f in FOLDERS}
    patterns = settings["setuptools"]["package-data"]["*"]
    for folder in FOLDERS:
        for path in (ROOT / folder).rglob("*"):
            if path.is_file() and path.suffix not in (".py", ".pyc", ".nbi", ".nbc"):
                assert any(path.match(pattern) for pattern in patterns), _id(path)
