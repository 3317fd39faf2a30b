"""Methods of `runner.py`: their packages, what they lack or ask for, and the settings to try."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Method:
    """``grids``: settings, of which all combinations run; all others are the defaults of the
    package. ``start``: ``rest`` gives it the IMU from the beginning of the log, on the ground, and
    the scans that have returns; ``survey`` begins at the height of the survey."""

    package: str
    imu: bool
    remarks: str
    grids: tuple[Mapping[str, tuple[Any, ...]], ...]


_REST, _SURVEY = {"start": ("rest",)}, {"start": ("survey",)}
_RKO = {"voxel_size": (0.5, 1.0), "double_downsample": (True, False)}
_GENZ_AVIA = {
    "noise_model.ranging_cov": (0.02,),
    "noise_model.angle_cov": (0.05,),
    "noise_model.acc_cov": (0.01,),
    "noise_model.gyr_cov": (1e-5,),
    "noise_model.b_acc_cov": (1e-6,),
    "noise_model.b_gyr_cov": (1e-6,),
}
"""The noise that the package's configurations have for a Livox Avia in a hand."""
_NO_IMAGE = "no camera, no intensity"

METHODS: dict[str, Method] = {
    "rko_lio": Method(
        "rko-lio",
        True,
        f"{_NO_IMAGE}; takes the time between its first two scans for rest, or its start for level",
        (
            {**_REST, "initialization_phase": (True,), **_RKO},
            {**_SURVEY, "initialization_phase": (False,), **_RKO},
        ),
    ),
    "genz_lio": Method(
        "genz-lio",
        True,
        f"{_NO_IMAGE}; takes the first IMU samples for rest",
        (
            {"start": ("rest", "survey")},
            {**_SURVEY, **_GENZ_AVIA, "mapping.voxel_size": (0.5, 1.0)},
        ),
    ),
    "se3_lio": Method(
        "se3-lio",
        True,
        f"{_NO_IMAGE}; takes the first IMU samples for rest",
        (
            _REST,
            {
                **_SURVEY,
                "downsample_resolution": (0.25, 0.5),
            },
        ),
    ),
    "dlio": Method(
        "evalio",
        True,
        f"{_NO_IMAGE}; calibrates its IMU in 2.5 s at rest, or takes it for calibrated",
        (
            {**_REST, "gravity": (9.81,), "imu_calib_time": (2.5,)},
            {
                **_SURVEY,
                "gravity": (9.81,),
                "imu_calibrate": (False,),
                "gicp_max_corr_dist": (0.5, 1.0),
            },
        ),
    ),
    "lio_sam": Method(
        "evalio",
        True,
        f"{_NO_IMAGE}; features of scan lines, no loop closure; holds back two scans",
        ({**_SURVEY, "mappingProcessInterval": (0.0,), "numberOfCores": (1,)},),
    ),
    "loam": Method(
        "evalio",
        False,
        f"no IMU, {_NO_IMAGE}; features of scan lines",
        ({**_SURVEY, "num_local_map_scans": (3, 20)},),
    ),
    "ct_icp": Method(
        "evalio",
        False,
        f"no IMU, {_NO_IMAGE}",
        ({**_SURVEY, "size_voxel_map": (1.0,), "ls_num_threads": (1,)},),
    ),
    "mad_icp": Method(
        "evalio",
        False,
        f"no IMU, {_NO_IMAGE}",
        (
            {
                **_SURVEY,
                "deskew": (False, True),
                "realtime": (False,),
                "num_threads": (1,),
            },
        ),
    ),
    "genz_icp": Method(
        "evalio",
        False,
        f"no IMU, {_NO_IMAGE}",
        ({**_SURVEY, "deskew": (False, True), "voxel_size": (0.5, 1.0)},),
    ),
}
