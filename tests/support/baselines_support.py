"""A rig, a texture and a short flight for the tests of the baselines."""

import cv2
import numpy as np

from touchdown.experiments.config.schema import Config

from support.worlds import load_ideal_config as load_config

HZ = 600


def texture(side: int, seed: int = 3) -> np.ndarray:
    """Blobs of several sizes, (side, side) uint8."""
    rng = np.random.default_rng(seed)
    total = np.zeros((side, side), np.float32)
    for blur in (1.5, 3.0, 8.0):
        layer = cv2.GaussianBlur(rng.standard_normal((side, side)).astype(np.float32), (0, 0), blur)
        total += layer / layer.std()
    return np.clip(128.0 + 30.0 * total, 0, 255).astype(np.uint8)


TINY = (
    "scene_seed=0", "sim.threads=1", "mapper.enabled=false", "survey.height_m=5", "survey.legs=1",
    "survey.leg_length_m=8", "survey.duration_s=4", "camera.width=424", "camera.height=240",
)  # fmt: skip
"""About 10 s in the air."""


def tiny(estimator: str, *more: str) -> Config:
    return load_config(
        None, (*TINY, *more), scene="flat", estimator=estimator, seed=103, survey_only=True
    )
