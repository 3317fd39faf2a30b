"""The kinds of cases, one for each kind of file that is read, and how many of each are run."""

from collections.abc import Callable, Mapping
from pathlib import Path
from zlib import crc32

import numpy as np

from fuzz import config_kinds, data_kinds, learn_kinds, run_kinds, scene_kinds
from fuzz.cases import Case
from fuzz.mutations import pick

ROOT = Path(__file__).parents[2]
Maker = Callable[[np.random.Generator, Path, Path], Case]


KINDS: Mapping[str, tuple[int, tuple[Maker, ...]]] = {
    "mjcf": (14, (scene_kinds.mjcf_case,)), "asset": (14, (scene_kinds.asset_case,)),
    "toml": (30, (config_kinds.toml_case,)), "campaign": (24, (config_kinds.campaign_case,)),
    "argv": (14, (config_kinds.argv_case,)), "tum": (14, (data_kinds.tum_case,)),
    "json": (24, (
        run_kinds.run_case, run_kinds.run_case, run_kinds.plan_case, run_kinds.plan_case,
        run_kinds.reproduction_case, run_kinds.calibration_case, config_kinds.config_json_case,
    )),
    "mcap": (14, (data_kinds.mcap_case,)), "parquet": (14, (run_kinds.parquet_case,)),
    "baseline": (14, (run_kinds.baseline_case,)), "sql": (14, (data_kinds.sql_case,)),
    "geotiff": (14, (scene_kinds.geotiff_case,)), "image": (14, (learn_kinds.image_case,)),
    "csv": (14, (learn_kinds.csv_case,)), "onnx": (14, (learn_kinds.onnx_case,)),
}  # fmt: skip
"""Number of cases of the quick run, and makers of cases"""
LEARNING = ("onnx", "csv")
"""Kinds whose commands need torch, which makes forks slower: they come last."""


def make(kind: str, number: int, folder: Path, shared: Path) -> Case:
    """The case of that kind and number: always the same."""
    rng = np.random.default_rng([number, crc32(kind.encode())])
    makers = KINDS[kind][1]
    maker = makers[0] if len(makers) == 1 else pick(rng, makers)
    case: Case = maker(rng, folder, shared)
    return case
