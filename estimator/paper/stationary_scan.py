"""Edge energy and feature points of one scan and one image of a stationary vehicle, for figures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import PaperParams
from touchdown.estimator.filtering.deskew import screen_scan
from touchdown.estimator.paper.depth_field import half_size_energy
from touchdown.estimator.paper.lidar_pose import scan_features
from touchdown.estimator.paper.projection import inside_image, project
from touchdown.estimator.paper.structured_edges.detector import edge_detector
from touchdown.sim.api import LidarScan, SensorRig

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class StationaryFeatures:
    """Features of the N returns inside the image."""

    energy: NDArray[np.float32]
    """(H/2, W/2) edge energy of the image"""
    pixels: Array
    """(N, 2) in the image"""
    f_c: Array
    """(N,) colour smoothness, Eq. 8"""
    edge: NDArray[np.bool_]
    """(N,) chosen as edge points"""
    planar: NDArray[np.bool_]
    """(N,) chosen as planar points"""


def features_of_stationary_scan(
    scan: LidarScan, rgb: NDArray[np.uint8], rig: SensorRig, params: PaperParams
) -> StationaryFeatures:
    """Returns the features of ``scan`` and ``rgb`` (H, W, 3), both taken from the same pose by a
    camera without distortion."""
    pulses = screen_scan(scan, rig.lidar)
    points = scan.points[pulses].astype(np.float64)
    in_camera = (rig.body_from_camera.inverse() @ rig.body_from_lidar).apply(points)
    energy = half_size_energy(rgb, edge_detector(params.edge_model))
    chosen, f_c = scan_features(points, points, in_camera, pulses, energy, rig.camera, params)
    pixels, front = project(in_camera, rig.camera.matrix())
    seen = inside_image(pixels, front, (rig.camera.width, rig.camera.height))
    picked = np.zeros((2, len(points)), bool)
    picked[0, chosen.edges] = True
    picked[1, chosen.planes] = True
    return StationaryFeatures(
        energy=energy, pixels=pixels[seen], f_c=f_c[seen], edge=picked[0, seen],
        planar=picked[1, seen],
    )  # fmt: skip
