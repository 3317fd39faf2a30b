"""The rules of ARCHITECTURE.md, checked on the source itself."""

import ast
import functools
import os
import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.command import lines_of

ROOT = Path(__file__).parents[2]
FOLDERS = ("sim", "scenes", "estimator", "landing", "controller", "experiments")
API_MAY_USE = {
    "sim": set(), "scenes": {"sim"}, "estimator": {"sim"}, "controller": {"sim", "estimator"},
    "landing": {"sim", "estimator", "controller", "scenes"},
    "experiments": set(FOLDERS) - {"experiments"},
}  # fmt: skip
"""Folders whose ``api`` (and ``sim.frames``) a folder's own ``api`` may import."""


def _table(header: str) -> list[list[str]]:
    """Cells of the rows of the table of ARCHITECTURE.md with this first column."""
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    lines = text[text.index(f"| {header} |") :].partition("\n\n")[0].splitlines()[2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def _library_packages() -> list[str]:
    """``sim/geometry``, ... in the order of the table: each may import those before it."""
    found, folder = [], ""
    for first, packages, _ in _table("folder"):
        folder = first.strip("`") or folder
        found += [folder + name for name in re.findall(r"`([\w/]+)/`", packages)]
    return found


def _experiments_packages() -> dict[str, set[str]]:
    """Packages and modules of ``experiments/`` in order, and what each may import."""
    found: dict[str, set[str]] = {}
    for name, _, imports in _table("package of `experiments/`"):
        key = name.split("`")[1].removesuffix(".py").strip("/")
        if imports.startswith("all above but "):
            found[key] = set(found) - set(imports.removeprefix("all above but ").split(", "))
        else:
            found[key] = set(imports.split(", ")) - {""}
    return found


LIBRARY_PACKAGES = _library_packages()
PACKAGE_MAY_IMPORT = _experiments_packages()
ROOT_FILES = {"__init__", "errors", "terminal", "api", "python_api", "pytest_plugin"}

SHARED = (
    "touchdown.sim.frames", "touchdown.sim.typing", "touchdown.sim.geometry.",
    "touchdown.sim.files.",
)  # fmt: skip
"""What all library folders may use beside the apis."""
TORCH_FOLDERS = (
    Path("landing/classification/networks"), Path("landing/classification/learning"),
    Path("experiments/people/learning"),
)  # fmt: skip
"""The only places that load torch; ``registry`` among them does not."""
MAX_LINES = 450
MAX_MODULES = 20
MAX_PARAMETERS = 8
PACKAGE = "touchdown"
SOURCES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))


def _texts() -> Iterator[Path]:
    """Files of the project; the many of its environment are not looked at."""
    for folder, folders, names in os.walk(ROOT):
        folders[:] = set(folders) - {".venv", ".git", "build", "runs", "src"}
        for name in names:
            if name in ("Makefile", "run") or name.endswith(
                (".py", ".md", ".toml", ".xml", ".cff")
            ):
                yield Path(folder, name)


TEXTS = sorted(_texts())
STANDARD = sys.stdlib_module_names


def _module_of(path: Path) -> str:
    """``touchdown.sim.frames`` of ``sim/frames.py``."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join((PACKAGE, *(parts[:-1] if parts[-1] == "__init__" else parts)))


MODULES = {_module_of(path): path for path in SOURCES}


@functools.cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@functools.cache
def _imports(path: Path) -> tuple[tuple[int, str], ...]:
    """(line, module) of every import in a file, lazy ones too. ``from a import b`` gives ``a.b``
    where that is a module of ours, else ``a``."""
    found = []
    for node in ast.walk(_tree(path)):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno} is a relative import"
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                found.append((node.lineno, inner if inner in MODULES else str(node.module)))
    return tuple(found)


def _ours(path: Path) -> list[tuple[int, str, str, str]]:
    """(line, module, folder, rest) of imports of this project; ``rest`` is below the folder."""
    found = []
    for line, module in _imports(path):
        package, _, inner = module.partition(".")
        if package == PACKAGE and inner:
            folder, _, rest = inner.partition(".")
            found.append((line, module, folder, rest))
    return found


def _id(path: Path) -> str:
    return str(path.relative_to(ROOT))


def _sources_of(folder: str) -> list[Path]:
    return [path for path in SOURCES if path.relative_to(ROOT).parts[0] == folder]


@pytest.mark.parametrize("own", FOLDERS[:-1])
def test_library_folders_meet_only_at_their_apis(own: str) -> None:
    """``experiments`` is the composition root and may import any public module."""
    for path in _sources_of(own):
        for line, module, folder, rest in _ours(path):
            allowed = folder == own or rest == "api" or module.startswith(SHARED)
            assert allowed, f"{_id(path)}:{line} imports {module}; only {folder}.api is open to it"


@pytest.mark.parametrize("package", ["geometry", "files"])
def test_shared_packages_depend_on_one_another_alone(package: str) -> None:
    """``sim.geometry`` and ``sim.files`` stand below all folders, as ``sim.frames`` does."""
    for path in sorted((ROOT / "sim" / package).glob("*.py")):
        for line, module, _, _ in _ours(path):
            assert module.startswith(SHARED), f"{_id(path)}:{line} imports {module}"


@pytest.mark.parametrize("folder", FOLDERS)
def test_apis_use_numpy_alone_and_only_the_apis_below(folder: str) -> None:
    """annotated_types may be used beside numpy: a tiny package in pure Python that pydantic brings;
    the ranges of parameters are written in its terms."""
    allowed = ("numpy", "annotated_types", PACKAGE)
    for path in (ROOT / folder / "api.py", ROOT / "sim" / "frames.py"):
        for line, module, other, _ in _ours(path):
            assert other in API_MAY_USE[folder] | {folder}, f"{path}:{line} imports {module}"
        for line, module in _imports(path):
            top = module.partition(".")[0]
            assert top in STANDARD or top in allowed, f"{path}:{line} imports {module}"


def _package(module: str) -> str:
    """The unit of which circles are counted: ``sim/lidar`` of ``touchdown.sim.lidar.beams``, a
    module of a folder's root by itself. ``types`` modules are part of their folder's ``api``."""
    *folders, name = MODULES[module].relative_to(ROOT).with_suffix("").parts
    if name == "types" or name.endswith("_types"):
        return f"{folders[0]}/api"
    return "/".join(folders if len(folders) > 1 else (*folders, name))


def _experiments_package(module: str) -> str:
    """``flight`` of ``touchdown.experiments.flight.loop``; a module of the root is by itself."""
    return module.split(".")[2] if module.count(".") > 1 else "__init__"


def test_library_packages_import_only_packages_above_them() -> None:
    known = {p.parent.relative_to(ROOT).as_posix() for p in SOURCES}
    for module, path in MODULES.items():
        own = path.parent.relative_to(ROOT).as_posix()
        folder = own.partition("/")[0]
        if folder == "experiments" or own == folder:
            continue
        for line, imported in _imports(path):
            other = _package(imported) if imported in MODULES else ""
            if other != own and other in known and other.startswith(f"{folder}/"):
                above = _place_in_order(other) < _place_in_order(own)
                assert above, f"{_id(path)}:{line} imports {imported}, {module} stands below"


def _place_in_order(package: str) -> int:
    """Row of a package, or of the one that it is in (``scenes/places/lake``)."""
    while package not in LIBRARY_PACKAGES:
        package = package.rpartition("/")[0]
        assert package, "every package of a library folder is in ARCHITECTURE's table"
    return LIBRARY_PACKAGES.index(package)


def test_packages_of_experiments_import_only_those_of_their_row() -> None:
    packages = list(PACKAGE_MAY_IMPORT)
    for path in _sources_of("experiments"):
        package = _experiments_package(_module_of(path))
        if package == "__init__":
            continue
        allowed = PACKAGE_MAY_IMPORT[package] | {package}
        above = packages[: packages.index(package) + 1]
        assert allowed <= set(above), f"{package} may import a package after it"
        for line, module, folder, _ in _ours(path):
            if folder == "experiments":
                known = _experiments_package(module) in allowed
                assert known, f"{_id(path)}:{line} imports {module}"


def test_every_package_of_experiments_is_in_the_table() -> None:
    home = ROOT / "experiments"
    assert {path.stem for path in home.glob("*.py")} == ROOT_FILES
    packages = {path.parent.name for path in home.glob("*/__init__.py")}
    assert packages | ROOT_FILES - {"__init__"} == set(PACKAGE_MAY_IMPORT)


def _in_circles(graph: dict[str, set[str]]) -> list[str]:
    """Nodes in circles, or above one."""
    while leaves := [node for node, used in graph.items() if not used & graph.keys()]:
        for node in leaves:
            del graph[node]
    return sorted(graph)


def test_no_import_circle() -> None:
    """Lazy imports count: a circle of them is a circle of ideas."""
    modules: dict[str, set[str]] = {}
    packages: dict[str, set[str]] = {}
    for module, path in MODULES.items():
        used = {imported for _, imported in _imports(path) if imported in MODULES} - {module}
        modules[module] = used
        own = _package(module)
        packages.setdefault(own, set()).update({_package(other) for other in used} - {own})
    assert not _in_circles(modules)
    assert not _in_circles(packages)


def test_estimator_api_loads_without_the_simulator() -> None:
    script = (
        "import sys, touchdown.estimator.api; "
        "print([m for m in ('mujoco', 'torch', 'open3d', 'cv2', 'scipy') if m in sys.modules])"
    )
    assert lines_of(script) == ["[]"]


@pytest.mark.parametrize("folder", FOLDERS)
def test_torch_and_ray_are_imported_when_they_are_needed(folder: str) -> None:
    """Neither they, nor modules that load torch, are imported with any other module."""
    for path in _sources_of(folder):
        if path.relative_to(ROOT).parent in TORCH_FOLDERS and path.name != "registry.py":
            continue
        for node in _tree(path).body:
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            assert not {name.partition(".")[0] for name in names} & {"torch", "ray"}
            for torch_folder in TORCH_FOLDERS:
                home = ".".join((PACKAGE, *torch_folder.parts))
                assert all(n == f"{home}.registry" or not n.startswith(home) for n in names)


# readability


@pytest.mark.parametrize("folder", FOLDERS)
def test_modules_stay_readable(folder: str) -> None:
    for path in _sources_of(folder):
        text = path.read_text(encoding="utf-8")
        assert text.count("\n") <= MAX_LINES
        assert ast.get_docstring(_tree(path)), "a module says in one line what it is"


@pytest.mark.parametrize(
    "path", sorted({path.parent for path in SOURCES if "__init__" in path.name}), ids=_id
)
def test_folders_stay_readable(path: Path) -> None:
    modules = [file for file in path.glob("*.py") if file.name != "__init__.py"]
    assert len(modules) <= MAX_MODULES
    docstring = ast.get_docstring(_tree(path / "__init__.py"))
    assert docstring, "a package says what belongs there"


@pytest.mark.parametrize("folder", FOLDERS)
def test_no_function_has_many_parameters(folder: str) -> None:
    """Kernels compiled by numba are exempt outside of ``estimator``, where they take records."""
    for path in _sources_of(folder):
        for node in ast.walk(_tree(path)):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            if folder != "estimator" and _compiled(node):
                continue
            given = node.args
            names = [a.arg for a in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
            count = len([name for name in names if name not in ("self", "cls")])
            assert count <= MAX_PARAMETERS, f"{_id(path)}:{node.lineno} {node.name} takes {count}"


def _compiled(node: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    return any("njit" in ast.unparse(decorator) for decorator in node.decorator_list)


def _bare_indices(source: ast.AST) -> list[str]:
    """Subscripts of compiled functions with a number above 2, the last axis of space: what they
    name is written nowhere."""
    kernels = [n for n in ast.walk(source) if isinstance(n, ast.FunctionDef) and _compiled(n)]
    return [
        f"{node.lineno} {ast.unparse(node)}"
        for kernel in kernels
        for node in ast.walk(kernel)
        if isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Load | ast.Store)
        for part in ast.walk(node.slice)
        if isinstance(part, ast.Constant) and isinstance(part.value, int) and part.value > 2
    ]


def test_kernels_of_estimation_take_their_columns_by_name() -> None:
    """``filtering/error_state.py`` is the one place that knows the order of the coordinates."""
    for path in _sources_of("estimator"):
        assert not _bare_indices(_tree(path)), f"{_id(path)}: {_bare_indices(_tree(path))}"
    kernel = "@njit\ndef f(row, k):\n    row[6 + k] = row[VELOCITY.start + k] + row[k, 2]"
    assert _bare_indices(ast.parse(kernel)) == ["3 row[6 + k]"]


def test_kernels_that_reorder_sums_have_one_machine_code() -> None:
    """What a compiled function calls exists twice, optimised apart: either must do the same."""
    kernels = [
        node for path in SOURCES for node in ast.walk(_tree(path))
        if isinstance(node, ast.FunctionDef) and _compiled(node)
    ]  # fmt: skip
    decorators = {node.name: ast.unparse(node.decorator_list[0]) for node in kernels}
    called = {
        call.func.id for node in kernels for call in ast.walk(node)
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Name)
    }  # fmt: skip
    loose = {name for name, how in decorators.items() if "fastmath" in how and "inline" not in how}
    assert loose and not loose & called, "set forceinline=True"


def test_no_paths_of_one_machine() -> None:
    pattern = re.compile(r"""(?<![\w.])/(home|Users|work|root|tmp|mnt)/[A-Za-z_]""")
    for path in TEXTS:
        if not path.is_file():
            continue
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            assert not pattern.search(line), f"{path.relative_to(ROOT)}:{number}: {line.strip()}"


def test_every_data_file_is_packaged() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
    patterns = settings["setuptools"]["package-data"]["*"]
    for folder in FOLDERS:
        for path in (ROOT / folder).rglob("*"):
            if path.is_file() and path.suffix not in (".py", ".pyc", ".nbi", ".nbc"):
                assert any(path.match(pattern) for pattern in patterns), _id(path)
