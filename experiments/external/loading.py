"""External parts: loading of MODULE:FUNCTION and identification of its code.

For a name that cannot be loaded, one line states what is missing and the remedy.
"""

import hashlib
import importlib
import inspect
import os
import pkgutil
import re
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any
from weakref import WeakKeyDictionary

from touchdown.experiments.errors import UsageError, nearest

Build = Callable[[dict[str, Any], Any], Any]
"""``build(params, rig)`` of a part; the rig is that of its kind"""

GIVEN = "given_"
"""begins the names of modules that `name_of` makes"""
_NAME = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*")
_AT_IMPORT: WeakKeyDictionary[ModuleType, str] = WeakKeyDictionary()
"""Hashes of the code of modules at their import."""


def call(function: Callable[..., Any], *arguments: Any) -> tuple[Any, BaseException | None]:
    """Calls code of others: its value, or whatever it raised but Ctrl-C. A copy of this process
    that it has forked ends here: the copy must not go on as well."""
    process = os.getpid()
    try:
        return function(*arguments), None
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        return None, error
    finally:
        if os.getpid() != process:
            os._exit(1)


def describe_error(error: BaseException) -> str:
    """Exception as one line of text."""
    try:
        text = " ".join(str(error).split())
    except Exception:  # of its own __str__
        text = ""
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def external_builder(name: str, kind: str = "estimator") -> Build:
    """Function ``build`` of the module ``my_lab.vio`` for ``my_lab.vio:build``.

    The current directory is searched last, so that it hides no installed module. Raises UsageError.
    """
    module, function = external_module(name, kind), name.partition(":")[2]
    build: Any = getattr(module, function, None)
    if build is None:
        own = {key: getattr(value, "__module__", "") for key, value in vars(module).items()}
        known = [key for key, home in own.items() if home == module.__name__]
        hint = nearest(function, known) or (f"; it has {', '.join(known[:6])}" if known else "")
        raise UsageError(f"{kind} '{name}': {module.__name__} has no function '{function}'{hint}")
    if not callable(build):
        raise UsageError(f"{kind} '{name}': {function} is no function")
    return build  # type: ignore[no-any-return]


def name_of(build: Build) -> str:
    """MODULE:FUNCTION that leads to a function, class or other callable of this process: where it
    lies in a file its own, else one of a module that is made for it and named by its code."""
    home = sys.modules.get(getattr(build, "__module__", None) or "")
    function = str(getattr(build, "__name__", ""))
    if getattr(home, "__file__", None) and getattr(home, function, None) is build:
        return f"{home.__name__}:{function}"  # type: ignore[union-attr]
    code = getattr(build, "__code__", None)
    try:
        source = inspect.getsource(build if code or inspect.isclass(build) else type(build))
    except (OSError, TypeError):
        source = code.co_code.hex() if code else repr(type(build))
    digest = hashlib.sha256(source.encode()).hexdigest()[:12]
    module = ModuleType(f"{GIVEN}{digest}")
    function = function if function.isidentifier() else "build"
    setattr(module, function, build)
    sys.modules[module.__name__] = module
    _AT_IMPORT[module] = digest
    return f"{module.__name__}:{function}"


def check_external(name: str, kind: str = "estimator") -> None:
    """Raises UsageError unless the builder exists and takes (params, rig)."""
    reason = wrong_signature(external_builder(name, kind))
    if reason:
        raise UsageError(f"{kind} '{name}': {reason}")


def wrong_signature(build: Callable[..., Any]) -> str:
    """Defect of the signature of ``build``, or an empty string."""
    try:
        signature = inspect.signature(build)
    except (TypeError, ValueError):
        return ""  # not written in Python: a call will show
    try:
        signature.bind({}, None)
    except TypeError:
        name = getattr(build, "__name__", "build")
        return f"{name}({', '.join(signature.parameters)}) must take (params, rig)"
    return ""


def external_module(name: str, kind: str = "estimator") -> ModuleType:
    """Imported module of MODULE:FUNCTION. Raises UsageError."""
    if not _NAME.fullmatch(name):
        raise UsageError(
            f"{kind} '{name}' is not of the form MODULE:FUNCTION, such as my_lab.vio:build"
        )
    module_name = name.partition(":")[0]
    _look_here()
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        reason = _missing(module_name, error)
        raise UsageError(f"{kind} '{name}': {reason}") from error
    except SyntaxError as error:
        where = f"{_short(error.filename or module_name)}:{error.lineno or 0}"
        raise UsageError(f"{kind} '{name}': syntax error in {where}: {error.msg}") from error
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # code of others may raise anything
        where = location(error, module_name)
        raise UsageError(
            f"{kind} '{name}': importing {module_name} raised {describe_error(error)}{where}"
        ) from error
    if module not in _AT_IMPORT:
        _AT_IMPORT[module] = _hash(module)
    return module


def _look_here() -> None:
    """Appends the current directory to the module search path."""
    try:
        here = os.getcwd()
    except OSError:
        return  # it was removed
    if not {here, ""} & set(sys.path):
        sys.path.append(here)
    importlib.invalidate_caches()


def _missing(module_name: str, error: ModuleNotFoundError) -> str:
    """Message for a missing module: the named one, or one that it imports."""
    missing = error.name or describe_error(error)
    if not f"{module_name}.".startswith(f"{missing}."):
        return f"importing {module_name} needs the module '{missing}', which is not installed"
    parent, _, last = missing.rpartition(".")
    beside = pkgutil.iter_modules(getattr(sys.modules.get(parent), "__path__", ()))
    hint = nearest(last, [found.name for found in beside]) if parent else ""
    return (
        f"there is no module '{missing}' here or among what is installed{hint}; run from the "
        "folder that holds it, or install its project with pip install -e"
    )


def location(error: BaseException, module_name: str) -> str:
    """`` (my_lab/vio.py:12)``: the last line of the part's own code in the traceback of an
    exception, or an empty string."""
    top, found = module_name.partition(".")[0], ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        if str(frame.f_globals.get("__name__", "")).partition(".")[0] == top:
            found = f" ({_short(frame.f_code.co_filename)}:{line})"
    return found


def imported_code(name: str) -> str:
    """Twelve hexadecimal digits that identify the imported code of an external part."""
    return _AT_IMPORT[external_module(name)]


def flown_code(name: str) -> dict[str, str]:
    """``estimator_sha`` of a result: `imported_code` of an external estimator. Empty for built-in
    ones, whose code ``git_revision`` identifies."""
    return {"estimator_sha": imported_code(name)} if ":" in name else {}


def code_now(name: str, kind: str = "estimator") -> str:
    """`imported_code` in its present state on disk. Raises UsageError."""
    return _hash(external_module(name, kind))


def _hash(module: ModuleType) -> str:
    """Hash of the module's file and, for a package, of all Python files of its topmost folder."""
    root, own = _root(module), getattr(module, "__file__", None)
    files = {Path(own)} if own else set()
    if root is not None and root.is_dir():
        parts = {path: path.relative_to(root).parts for path in root.rglob("*.py")}
        files |= {path for path, way in parts.items() if not any(p.startswith(".") for p in way)}
    digest = hashlib.sha256()
    base = root or Path()
    for file in sorted(files):
        try:
            content = file.read_bytes()
        except OSError:
            continue  # of an archive, or removed since
        name = file.relative_to(base).as_posix() if file.is_relative_to(base) else file.name
        digest.update(f"{name} {len(content)} ".encode())
        digest.update(content)
    return digest.hexdigest()[:12]


def _root(module: ModuleType) -> Path | None:
    """Topmost folder of a module's package; None for a module without a package."""
    top = sys.modules.get(module.__name__.partition(".")[0])
    places = [Path(place) for place in getattr(top, "__path__", ())]
    own = getattr(module, "__file__", None)
    if own is not None:
        # A package without __init__.py may lie in several places.
        places = [place for place in places if Path(own).is_relative_to(place)]
    return places[0] if places else None


def _short(path: str) -> str:
    """Path relative to the current directory, if it lies below it."""
    try:
        return Path(path).relative_to(Path.cwd()).as_posix()
    except (ValueError, OSError):
        return path
