"""Checks of names on the pages: files, modules, code, keys and their defaults."""

import contextlib
import importlib
import re
from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.config.loading import known_keys, load_config
from touchdown.experiments.io.results import columns

from support.docs_support import FOLDERS, PAGES, ROOT, inline_of, name_of


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_files_exist_and_dotted_names_are_keys_or_can_be_imported(page: Path) -> None:
    """Keys of the configuration, keys of a run's result, or names in the code."""
    keys = load_config(profile="ideal").model_dump()
    results = " ".join(f'"{part}"' for column in columns() for part in column.split("."))
    for code in inline_of(page):
        if re.fullmatch(rf"({'|'.join(FOLDERS)}|tests)/[\w/.]*", code):
            assert (ROOT / code).exists(), f"{name_of(page)}: {code}"
        if not re.fullmatch(r"[a-z_]+(\.\w+)+", code) or code.split(".")[-1] in ("py", "md"):
            continue
        if code.startswith("touchdown."):
            assert _importable(code), f"{name_of(page)}: {code} is not in the code"
            continue
        section, _, key = code.partition(".")
        if f'"{key}"' in results or code in known_keys():
            continue
        if section in FOLDERS and key not in (keys.get(section) or {}):
            assert _importable(code), f"{name_of(page)}: {code} is neither a key nor in the code"
        elif isinstance(keys.get(section), dict) and section != "external":  # any key goes there
            assert key in keys[section], f"{name_of(page)}: {code} is no key"


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
