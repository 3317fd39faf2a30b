"""The kinds of cases, one for each kind of file that is read, and how many of each are run."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from zlib import crc32

import numpy as np

from fuzz import config_kinds, data_kinds, learn_kinds, run_kinds, scene_kinds
from fuzz.cases import Case

ROOT = Path(__file__).parents[2]
Maker = Callable[[np.random.Generator, Path, Path], Case]


@dataclass(frozen=True, slots=True)
class Kind:
    """``short``: number of cases of the quick run."""

    make: Maker
    short: int


KINDS: Mapping[str, Kind] = {
    "mjcf": Kind(scene_kinds.mjcf_case, 14), "asset": Kind(scene_kinds.asset_case, 14),
    "toml": Kind(config_kinds.toml_case, 30), "campaign": Kind(config_kinds.campaign_case, 24),
    "argv": Kind(config_kinds.argv_case, 14), "json": Kind(run_kinds.json_case, 24),
    "tum": Kind(data_kinds.tum_case, 14), "mcap": Kind(data_kinds.mcap_case, 14),
    "parquet": Kind(run_kinds.parquet_case, 14), "baseline": Kind(run_kinds.baseline_case, 14),
    "sql": Kind(data_kinds.sql_case, 14), "geotiff": Kind(scene_kinds.geotiff_case, 14),
    "image": Kind(learn_kinds.image_case, 14), "csv": Kind(learn_kinds.csv_case, 14),
    "onnx": Kind(learn_kinds.onnx_case, 14), "checkpoint": Kind(learn_kinds.checkpoint_case, 17),
}  # fmt: skip
LEARNING = ("onnx", "checkpoint", "csv")
"""Kinds whose commands need torch, which makes forks slower: they come last."""


def make(kind: str, number: int, folder: Path, shared: Path) -> Case:
    """The case of that kind and number: always the same."""
    rng = np.random.default_rng([number, crc32(kind.encode())])
    return KINDS[kind].make(rng, folder, shared)
