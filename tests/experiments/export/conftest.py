"""The run, its bag and the messages in it, once for all tests of exports."""

from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.export.flown_run import ExportOptions
from touchdown.experiments.export.run import export

from support.export_support import make_flown, read_bag


@pytest.fixture(scope="package")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_flown(tmp_path_factory.mktemp("runs") / "flown")


@pytest.fixture(scope="package")
def bag(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("bags") / "flown-bag"
    return export(run, "mcap", out, ExportOptions()).out


@pytest.fixture(scope="package")
def messages(bag: Path) -> dict[str, list[Any]]:
    return read_bag(bag)
