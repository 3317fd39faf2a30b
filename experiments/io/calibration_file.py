"""Calibrations as JSON files, which flights load."""

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from touchdown.experiments.api import CalibrationResult
from touchdown.experiments.errors import UsageError, reason_of
from touchdown.experiments.io.run_directory import write_text
from touchdown.experiments.io.untrusted import read_object
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.files.opening import no_file
from touchdown.sim.frames import Pose, matrix_from_quat_wxyz, quat_wxyz_from_matrix


def _unit(quat: tuple[float, ...]) -> tuple[float, ...]:
    if abs(float(np.linalg.norm(quat)) - 1.0) > _MAX_QUAT_ERROR:
        raise ValueError("must have length 1")
    return quat


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


_MAX_QUAT_ERROR = 1e-3

Vector3 = tuple[float, float, float]
UnitQuaternion = Annotated[tuple[float, float, float, float], AfterValidator(_unit)]
Vector5 = tuple[float, float, float, float, float]
Pixels = Annotated[int, Field(gt=0)]
Focal = Annotated[float, Field(gt=0.0)]


class CameraPart(_Strict):
    """K without skew, and OpenCV's distortion k1, k2, p1, p2, k3."""

    width: Pixels
    height: Pixels
    fx: Focal
    fy: Focal
    cx: float
    cy: float
    distortion: Vector5


class ExtrinsicPart(_Strict):
    """p_camera = R p_lidar + t"""

    rotation_quat_wxyz: UnitQuaternion
    translation_m: Vector3


class CalibrationFile(_Strict):
    """The whole file. Of these, a flight needs ``camera`` and ``camera_from_lidar``; the others are
    what the calibration states of itself."""

    camera: CameraPart
    camera_from_lidar: ExtrinsicPart
    covariance: dict[Literal["camera", "camera_from_lidar"], list[list[float]]] | None = None
    """(9, 9) of fx, fy, cx, cy (pixels), k1, k2, p1, p2, k3; (6, 6) of a small rotation (rad)
    applied on the left, then of the translation (m)"""
    residuals: dict[Literal["reprojection_rms_px", "plane_rms_m"], float] | None = None
    """root mean squares"""
    views_used: int | None = None

    def intrinsics(self) -> CameraIntrinsics:
        """Nominal intrinsics."""
        part = self.camera.model_dump(exclude={"distortion"})
        return CameraIntrinsics(**part, distortion=np.array(self.camera.distortion))

    def lidar_pose(self) -> Pose:
        """camera_from_lidar"""
        part = self.camera_from_lidar
        return Pose(
            matrix_from_quat_wxyz(np.array(part.rotation_quat_wxyz)), np.array(part.translation_m)
        )


def write_calibration(path: Path, result: CalibrationResult) -> None:
    """Writes a calibration. Raises OSError."""
    k, pose = result.camera, result.camera_from_lidar
    size = {name: getattr(k, name) for name in CameraPart.model_fields if name != "distortion"}
    content = CalibrationFile(
        camera=CameraPart(**size, distortion=_numbers(k.distortion)),
        camera_from_lidar=ExtrinsicPart(
            rotation_quat_wxyz=_numbers(quat_wxyz_from_matrix(pose.rotation)),
            translation_m=_numbers(pose.translation),
        ),
        covariance={
            "camera": result.camera_covariance.tolist(),
            "camera_from_lidar": result.extrinsic_covariance.tolist(),
        },
        residuals={
            "reprojection_rms_px": result.reprojection_rms_px,
            "plane_rms_m": result.plane_rms_m,
        },
        views_used=len(result.used),
    )
    write_text(path, content.model_dump_json(indent=2) + "\n")


def read_calibration(path: Path) -> CalibrationFile:
    """Raises UsageError, one line: the file is missing or unreadable, a key is missing, unknown
    or of the wrong kind."""
    if reason := no_file(path):
        raise UsageError(f"calibration file '{path}' {reason}; make one with `touchdown calibrate`")
    try:
        # JSON, because strict validation of JSON takes arrays for tuples.
        return CalibrationFile.model_validate_json(json.dumps(read_object(path)))
    except (ValueError, OSError) as error:
        raise UsageError(f"'{path}' is no calibration: {reason_of(error)}") from None


def _numbers(values: Any) -> Any:
    return tuple(float(value) for value in np.ravel(values))
