"""Faults without effect: of sensors that no part of a flight reads."""

from __future__ import annotations

from touchdown.experiments.config.schema import Config
from touchdown.sim.api import FAULT_KINDS, SensorNeeds


def inactive_faults(config: Config, needs: SensorNeeds) -> list[str]:
    """Returns one sentence for each scheduled fault without effect. ``needs``: sensors that
    estimator, mapper and lander read together."""
    read = {"scans": needs.lidar, "images": needs.camera_hz > 0, "gps": needs.gps}
    names = {"scans": "the LIDAR", "images": "the camera", "gps": "GPS"}
    sentences = []
    for fault in config.faults.schedule():
        streams = FAULT_KINDS[fault.kind]
        if not any(read.get(stream, True) for stream in streams):
            sensors = " or ".join(names[stream] for stream in streams)
            sentences.append(
                f"fault '{fault.text}' has no effect: neither estimator '{config.estimator}' "
                f"nor the map reads {sensors}"
            )
    return sentences
