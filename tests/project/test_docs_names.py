"""Checks of names on the pages: files, modules, code, keys and their defaults."""

import contextlib
import importlib
import json
import re
from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.config.keys import flatten
from touchdown.experiments.config.loading import known_keys, load_config
from touchdown.experiments.config.profiles import profile_values
from touchdown.experiments.io.results import columns

from support.docs_support import FOLDERS, PAGES, ROOT, inline_of, name_of, rows_of


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
            told = f"{name_of(page)}: {code} is neither a key nor in the code"
            assert _importable(f"touchdown.{code}"), told
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


def _told(names: str) -> list[str]:
    """Keys of a cell, where a key that begins with a dot is of the group of the one before."""
    keys: list[str] = []
    for name in re.findall(r"`([^`]+)`", names):
        keys.append(f"{keys[-1].partition('.')[0]}{name}" if name.startswith(".") else name)
    return keys


@pytest.mark.parametrize(("profile", "place"), [("field", 0), ("harsh", 2)])
def test_every_value_of_a_profile_stands_on_its_page_with_a_source(
    profile: str, place: int
) -> None:
    """Rows are `keys | values of field; of harsh where they differ | source`."""
    flown = dict(flatten(json.loads(load_config(profile=profile).model_dump_json())))
    told: dict[str, Any] = {}
    for names, values, source in rows_of("docs/sensors.md", "profile key"):
        keys, (field, _, harsh) = _told(names), values.partition("; ")
        found = json.loads(f"[{(field, _, harsh or field)[place]}]")
        assert source and not set(keys) & told.keys(), names
        told |= zip(keys, found * len(keys) if len(found) == 1 else found, strict=True)
    assert told == {key: flown[key] for key in {*profile_values("field"), *profile_values("harsh")}}
