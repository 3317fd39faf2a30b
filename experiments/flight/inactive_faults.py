"""Faults that befall nobody: of sensors that no part of a flight reads."""

from __future__ import annotations

from touchdown.experiments.config.schema import Config
from touchdown.sim.api import FAULT_KINDS, SensorNeeds


def idle_faults(config: Config, needs: SensorNeeds) -> list[str]:
    """One sentence for each scheduled fault that does nothing in a flight of which estimator,
    mapper and lander together want ``needs``."""
    read = {"scans": needs.lidar, "images": needs.camera_hz > 0, "gps": needs.gps}
    names = {"scans": "the LIDAR", "images": "the camera", "gps": "GPS"}
    told = []
    for fault in config.faults.schedule():
        streams = FAULT_KINDS[fault.kind]
        if not any(read.get(stream, True) for stream in streams):
            sensors = " or ".join(names[stream] for stream in streams)
            told.append(
                f"fault '{fault.text}' does nothing here: neither estimator '{config.estimator}' "
                f"nor the map reads {sensors}"
            )
    return told
