"""Exported clouds: the map, and the registered and coloured scans."""

from pathlib import Path
from typing import Any

import numpy as np
from plyfile import PlyData

from touchdown.experiments.export.flown_run import ExportOptions
from touchdown.experiments.export.point_cloud import seen_in_image
from touchdown.experiments.export.run import export
from touchdown.experiments.external.synthetic_stream import SyntheticStream, synthetic_rig
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import interpolate_pose

from support.export_support import ALL, SECONDS, links_of, points_of, stamp_of


def _read_ply(path: Path) -> Any:
    return PlyData.read(path)["vertex"].data


def _xyz(rows: Any) -> np.ndarray:
    return np.column_stack([rows["x"], rows["y"], rows["z"]]).astype(np.float64)


def _placed(messages: dict[str, list[Any]], body: str) -> np.ndarray:
    """Returns every point of every cloud in the map's frame, by the transforms of the bag."""
    times = np.array([time_ns for time_ns, _ in messages["/tf"]]) * 1e-9
    poses = []
    for _, message in messages["/tf"]:
        links = links_of(message)
        estimated = links["map", "odom"] @ links["odom", "base_link"]
        poses.append(links["map", body] if body == "base_link_gt" else estimated)
    mount = links_of(messages["/tf_static"][0][1])["base_link", "lidar_link"]
    placed = []
    for _, cloud in messages["/lidar/points"]:
        points = points_of(cloud)
        at = 1e-9 * stamp_of(cloud) + points["time"].astype(np.float64)
        rows = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
        xyz = mount.apply(np.column_stack([points["x"], points["y"], points["z"]]).astype(float))
        for row in np.unique(rows):
            fraction = (at[rows == row] - times[row - 1]) / (times[row] - times[row - 1])
            # level flight without rotation: one rotation holds for the span
            rotation = interpolate_pose(poses[row - 1], poses[row], 0.5).rotation
            way = poses[row].translation - poses[row - 1].translation
            origin = poses[row - 1].translation + fraction[:, None] * way
            placed.append(xyz[rows == row] @ rotation.T + origin)
    return np.vstack(placed)


def test_the_fused_cloud_is_the_bag_seen_through_its_transforms(
    run: Path, messages: Any, tmp_path: Path
) -> None:
    for poses, body in (("truth", "base_link_gt"), ("estimate", "base_link")):
        options = ExportOptions(points="scans", poses=poses)
        rows = _read_ply(export(run, "ply", tmp_path / f"{poses}.ply", options).out)
        expected = _placed(messages, body)
        assert len(rows) == len(expected)
        # the same points, in the order of the scans
        ours = _xyz(rows)
        assert np.abs(np.sort(ours, axis=0) - np.sort(expected, axis=0)).max() < 1e-5
    assert set(rows["intensity"]) == {60.0}


def test_returns_have_the_colour_of_the_ground_under_them(run: Path, tmp_path: Path) -> None:
    """The ground is a mosaic of coloured tiles, blurred between their middles."""
    options = ExportOptions(points="scans", poses="truth")
    rows = _read_ply(export(run, "ply", tmp_path / "c.ply", options).out)[-15000:]
    grey = (rows["red"] == 120) & (rows["green"] == 120) & (rows["blue"] == 120)
    assert 0.02 < grey.mean() < 0.9  # the LIDAR sees more than the camera does
    tiles = SyntheticStream(synthetic_rig(), ALL, SECONDS)._tiles
    positions = _xyz(rows)[~grey][:, :2] / 0.05
    middle = np.abs(positions - np.rint(positions)).max(axis=1) < 0.1
    col, row = np.rint(positions[middle]).astype(int).T & 255
    seen = np.column_stack([rows[name][~grey][middle] for name in ("red", "green", "blue")])
    assert len(seen) > 30 and np.median(np.abs(seen - tiles[row, col])) < 12.0


def test_projection_by_hand() -> None:
    lens = CameraIntrinsics(width=100, height=80, fx=50.0, fy=40.0, cx=49.5, cy=39.5)
    points = np.array([[0.0, 0.0, 2.0], [1.0, -1.0, 2.0], [0.0, 0.0, -2.0], [3.0, 0.0, 2.0]])
    pixels, seen = seen_in_image(points, lens)
    np.testing.assert_allclose(pixels[:2], [[49.5, 39.5], [74.5, 19.5]])
    assert seen.tolist() == [True, True, False, False]
