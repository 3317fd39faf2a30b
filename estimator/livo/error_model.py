"""Error model of the sensors as `livo` assumes it, and figures of its updates for the recording."""

from __future__ import annotations

import numpy as np

from touchdown.estimator.api import LivoParams
from touchdown.estimator.livo.anchored_update import LidarReport, ScanErrors
from touchdown.estimator.livo.visual import VisualReport
from touchdown.sim.api import SensorRig


def scan_errors(rig: SensorRig, params: LivoParams) -> ScanErrors:
    """The errors of a scan by the LIDAR's data and the parameters."""
    tilt, yaw = np.radians([params.scan_tilt_sigma_deg, params.scan_yaw_sigma_deg])
    aside, height = params.scan_lateral_sigma_m, params.scan_height_sigma_m
    weak = float(np.radians(params.weak_sigma_deg)), params.weak_sigma_m
    return ScanErrors(
        range_sigma_m=rig.lidar.range_sigma_m,
        angle_sigma_rad=float(np.radians(rig.lidar.angle_sigma_deg)),
        plane_sigma_m=params.plane_sigma_m,
        floor_sigmas=np.array([tilt, tilt, yaw, aside, aside, height]),
        weak_sigmas=weak if params.use_degeneracy else None,
    )


def scan_diagnostics(report: LidarReport, returns: int, voxels: int) -> dict[str, float]:
    """Figures of an update by one scan, by the name of their plot."""
    return {
        "scan_returns": float(returns),
        "lidar_matched": float(report.matched),
        "lidar_rms_m": report.rms_m,
        "lidar_lateral_weakest": float(report.lateral_strength[0]),
        "lidar_lateral_middle": float(report.lateral_strength[1]),
        "lidar_weak_translation": float(report.weak_translation),
        "lidar_weak_rotation": float(report.weak_rotation),
        "map_voxels": float(voxels),
    }


def visual_diagnostics(report: VisualReport, keyframes: int) -> dict[str, float]:
    """Figures of an update by one image, by the name of their plot."""
    return {
        "features_tracked": float(report.used),
        "visual_rms_px": report.rms_px,
        "keyframes_tracked": float(report.keyframes_tracked),
        "overlap": report.best_share,
        "keyframes": float(keyframes),
    }
