"""The page on untrusted files: its limits are those of the code, its kinds those that are
read."""

import re

import pytest

from support.docs_support import rows_of, text_of

PAGE = "docs/trust.md"
KINDS = (
    "MJCF", "textures", "GeoTIFF", "PNG", "ONNX", "checkpoint", "calibration", "configuration",
    "campaign (TOML)", "config.json", "campaign.json", "part.json", "result.json", "baselines",
    "TUM", "CSV", "MCAP", "SQL", "estimator",
)  # fmt: skip


def test_every_promise_has_tests() -> None:
    for promise, tests in rows_of(PAGE, "promise"):
        nodes = re.findall(r"`(tests/\S+)::(\w+)`", tests)
        assert nodes, promise
        for path, name in nodes:
            assert f"\ndef {name}(" in text_of(path), f"{promise}: {path} has no {name}"


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_file_is_in_the_table(kind: str) -> None:
    rows = rows_of(PAGE, "file")
    assert any(kind in cells[0] for cells in rows)
    assert all(len(cells) == 4 and all(cells) for cells in rows)
