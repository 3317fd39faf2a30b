"""The page on untrusted files: its limits are those of the code, its kinds those that are
read."""

from __future__ import annotations

import re

import pytest

from touchdown.experiments.io import sensor_log_checks, sensor_log_reader
from touchdown.landing.classification import weights
from touchdown.scenes.importers import geotiff, mjcf_limits, model_check, pictures, trial
from touchdown.sim.files import child, inflating

from support.docs_support import rows_of, text_of

PAGE = "docs/trust.md"
KINDS = (
    "MJCF", "textures", "GeoTIFF", "PNG", "ONNX", "checkpoint", "calibration", "configuration",
    "campaign (TOML)", "config.json", "campaign.json", "part.json", "result.json", "baselines",
    "TUM", "CSV", "MCAP", "SQL", "estimator",
)  # fmt: skip


def _mib(size: int) -> str:
    return f"{size >> 20} MiB"


@pytest.mark.parametrize(
    "limit",
    [
        _mib(mjcf_limits.MAX_TEXT_BYTES),
        _mib(mjcf_limits.MAX_MESH_BYTES),
        _mib(trial.TRIAL_BYTES),
        _mib(geotiff.MAX_BLOCK_BYTES),
        _mib(weights.MAX_BYTES),
        f"{child.TRIAL_S} s of a processor and {child.TRIAL_MEMORY_BYTES >> 30} GiB",
        f"may have {sensor_log_reader.MAX_RECORD_BYTES >> 20} MiB each",
        f"at {sensor_log_checks.MAX_PIXELS} pixels",
        f"{inflating.MAX_TEXT_BYTES >> 10} KiB",
        f"{weights.IMAGE_SIZES[0]} to {weights.IMAGE_SIZES[1]}",
        f"| {mjcf_limits.MAX_DEPTH}; {mjcf_limits.MAX_MODELS_DEEP} |",
        f"| {mjcf_limits.MAX_MOVING} |",
        f"| {mjcf_limits.MAX_ELEMENTS} |",
        f"| {mjcf_limits.MAX_CELLS} |",
        f"| {mjcf_limits.MAX_TEXELS}; {mjcf_limits.MAX_TEXTURE_SIDE} |",
        f"| {model_check.MAX_TRIANGLES} |",
        f"{model_check.FARTHEST_M:.0e} m",
        f"{geotiff.PART_CELLS} rows",
        f"{geotiff.MAX_PART_CELLS} cells",
        f"{geotiff.FINE_CELLS} cells across",
        f"{geotiff.COARSEST_M:g} m",
        f"{pictures.MAX_PIXELS} pixels",
        f"{pictures.MAX_SCANNED_PIXELS} pixels together",
        *(f"{most} each" for most in set(mjcf_limits.MAX_OF_TAG.values())),
    ],
)
def test_limits_are_those_of_the_code(limit: str) -> None:
    assert limit in text_of(PAGE)


def test_every_promise_has_tests() -> None:
    rows = rows_of(PAGE, "promise")
    assert rows
    for promise, tests in rows:
        nodes = re.findall(r"`(tests/\S+)::(\w+)`", tests)
        assert nodes, promise
        for path, name in nodes:
            assert f"\ndef {name}(" in text_of(path), f"{promise}: {path} has no {name}"


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_file_is_in_the_table(kind: str) -> None:
    rows = rows_of(PAGE, "file")
    assert any(kind in cells[0] for cells in rows)
    assert all(len(cells) == 4 and all(cells) for cells in rows)
