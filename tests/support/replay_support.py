"""Synthetic run directory: synthetic sensors and their true path, without a simulator."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.experiments.config.loading import dump_config
from touchdown.experiments.external.synthetic_stream import SyntheticStream, synthetic_rig
from touchdown.experiments.io.run_directory import SENSORS_FILE
from touchdown.experiments.io.sensor_log import SensorLog
from touchdown.experiments.io.tum import TumWriter
from touchdown.sim.api import SensorNeeds
from touchdown.sim.frames import Pose

from support.worlds import load_ideal_config as load_config

LIVO = SensorNeeds(camera_hz=10, lidar=True)
LIFT_OFF_S = 0.9


def make_run(
    run: Path, *, seconds: float = 2.0, needs: SensorNeeds = LIVO, shared: SensorNeeds = LIVO,
    estimate: Callable[[Pose], Pose] = lambda pose: pose, **result: Any,
) -> Path:  # fmt: skip
    """``estimate`` maps the true rows to the rows of estimate.tum."""
    rig = synthetic_rig()
    run.mkdir(parents=True)
    stream = SyntheticStream(rig, needs, seconds)
    log = SensorLog(run / SENSORS_FILE, rig, needs, shared)
    writers = [TumWriter(run / f"{name}.tum") for name in ("truth", "estimate")]
    for obs in stream:
        log.add(obs)
        if obs.tick % 12 == 0:
            pose = stream.true_pose(obs.tick)
            writers[0].add(obs.time_s, pose)
            writers[1].add(obs.time_s, estimate(pose))
    for part in (log, *writers):
        part.close()
    facts = {
        "outcome": "COMPLETED", "scene": "crossroad", "seed": 3, "estimator": "livo",
        "span_s": [LIFT_OFF_S, None], "position_error_m": {"mean": 0.0},
    }  # fmt: skip
    (run / "result.json").write_text(json.dumps(facts | result))
    config = load_config(scene="crossroad", seed=3, record=False, survey_only=True)
    (run / "config.json").write_text(dump_config(config))
    return run


def shifted(offset: Any) -> Callable[[Pose], Pose]:
    return lambda pose: Pose(pose.rotation, pose.translation + np.asarray(offset))
