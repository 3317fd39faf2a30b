"""Rolling shutter: rows out of one drawing against a drawing for every row."""

from contextlib import closing
from typing import Any

import cv2
import numpy as np
import pytest

from touchdown.scenes.api import Scene
from touchdown.sim.api import CameraParams
from touchdown.sim.camera.optics import intrinsics_of
from touchdown.sim.camera.sensor import CameraSensor
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array, Bytes

from support.camera_support import HEIGHT_M, box, centroid, make_scene
from support.shutter_support import Motion, Stand, boxes_scene, drawn_by_rows, flight

READOUT_S = 0.015
DISTORTION = (-0.11, 0.02, 0.0012, -0.0008, -0.003)


def displacement(first: Bytes, second: Bytes) -> Array:
    """(N,) pixels by which corners of the first image lie elsewhere in the second."""
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (first, second)]
    corners = cv2.goodFeaturesToTrack(grey[0], 600, 0.01, 7)
    found, state, _ = cv2.calcOpticalFlowPyrLK(
        *grey, corners, np.empty_like(corners), winSize=(15, 15), criteria=(3, 50, 1e-4)
    )
    moved = (found - corners)[state[:, 0] == 1][:, 0]
    return np.asarray(np.linalg.norm(moved, axis=1), np.float64)


def row_by_row(
    scene: Scene, motion: Motion, readout_s: float, distortion: tuple[float, ...]
) -> tuple[Bytes, Bytes, Bytes]:
    """The image drawn anew for every row, the one of `render_rows`, and one of the last instant."""
    plain = CameraParams(noise_sigma=0.0, distortion=distortion)
    rolling = CameraParams(noise_sigma=0.0, distortion=distortion, readout_s=readout_s)
    stand, height = Stand(scene, motion), CameraParams().height
    times = (np.arange(height) / (height - 1) - 1.0) * readout_s
    with (
        closing(CameraSensor(scene, plain, 0)) as drawn,
        closing(CameraSensor(scene, rolling, 0)) as warped,
    ):
        truth = drawn_by_rows(drawn, [stand.snapshot(drawn, float(t)) for t in times])
        at_once = drawn.render(stand.snapshot(drawn, 0.0), 0)
        return truth, stand.rows(warped, readout_s), at_once


@pytest.mark.parametrize("distortion", [(0.0,) * 5, DISTORTION])
def test_every_row_is_seen_from_its_own_pose(distortion: tuple[float, ...]) -> None:
    """Over boxes up to 6 m high, at 10 m/s, turning and shaken: corners lie where 480 drawings
    show them within 0.1 px, which are up to 8 px from where a global shutter shows them."""
    truth, rows, at_once = row_by_row(boxes_scene(), flight, READOUT_S, distortion)
    error = displacement(truth, rows)
    assert error.size > 200
    assert np.median(error) < 0.08
    assert np.quantile(error, 0.9) < 0.2
    assert np.median(displacement(truth, at_once)) > 3.0


def test_the_drawing_reaches_as_far_as_its_rows_look() -> None:
    """At 22 m/s backwards and a readout of 60 ms the outermost rows show what is up to 21 pixels
    beyond the border of the instant that is drawn."""

    def backwards(time_s: float) -> Pose:
        return Pose(np.eye(3), np.array([-22.0 * time_s, 0.0, HEIGHT_M]))

    truth, rows, _ = row_by_row(boxes_scene(), backwards, 0.06, (0.0,) * 5)
    for edge in (slice(0, 4), slice(-4, None)):
        assert truth[edge].std() > 20.0
        assert np.abs(truth[edge].astype(int) - rows[edge]).mean() < 1.0


def test_a_longer_exposure_takes_a_wider_drawing() -> None:
    """625 px of focal length at 1.45 rad/s for half the readout and the longest exposure."""
    scene = boxes_scene()

    def width(**changes: Any) -> int:
        camera = CameraSensor(scene, CameraParams(readout_s=0.03, **changes), 0)
        return camera._lens.raster.width - CameraParams().width

    assert width() == width(exposure_max_s=0.02) == 2 * 14
    assert width(exposure=True, exposure_max_s=0.02) == 2 * 32
    assert width(exposure=True, exposure_max_s=0.2) == 2 * 64


def test_a_camera_at_rest_has_no_shutter(closed: Any) -> None:
    scene = boxes_scene()
    plain = closed(CameraSensor(scene, CameraParams(noise_sigma=0.0), 0))
    rolling = closed(CameraSensor(scene, CameraParams(noise_sigma=0.0, readout_s=READOUT_S), 0))
    stand = Stand(scene, lambda _: Pose(np.eye(3), np.array([0.0, 0.0, HEIGHT_M])))
    still = plain.render(stand.snapshot(plain, 0.0), 0)
    rows = stand.rows(rolling, READOUT_S)
    alone = rolling.render(stand.snapshot(rolling, 0.0), 0)
    depth = rolling.render_depth(stand.snapshot(rolling, 0.0))
    np.testing.assert_array_equal(rows, alone)
    # the margin moves the rasterisation of edges by less than a pixel
    assert (still != rows).any(axis=-1).mean() < 0.02
    assert depth.shape == still.shape[:2]


def test_the_last_row_is_of_the_stamp_and_the_first_is_older(closed: Any) -> None:
    """At 10 m/s ahead the top row is exposed 0.15 m earlier: what it shows lies f 0.15 / 20 = 4.7
    pixels higher than in an image of the last instant. The bottom row is of that instant."""
    spots = box("near", -6.0, 0.0, "1 0 0 1") + box("far", 6.5, 0.0, "1 0 0 1")
    scene = make_scene(spots)

    def motion(time_s: float) -> Pose:
        return Pose(np.eye(3), np.array([10.0 * time_s, 0.0, HEIGHT_M]))

    params = CameraParams(noise_sigma=0.0)
    plain = closed(CameraSensor(scene, params, 0))
    rolling = closed(CameraSensor(scene, CameraParams(noise_sigma=0.0, readout_s=READOUT_S), 0))
    stand = Stand(scene, motion)
    last = plain.render(stand.snapshot(plain, 0.0), 0)
    rows = stand.rows(rolling, READOUT_S)
    fy = intrinsics_of(params).fy
    for half in (slice(0, 240), slice(240, 480)):
        before = centroid(last[half, :, 0] > 128) + [0.0, half.start]
        after = centroid(rows[half, :, 0] > 128) + [0.0, half.start]
        age = READOUT_S * (1.0 - after[1] / 479.0)
        assert after[1] - before[1] == pytest.approx(-fy * 10.0 * age / HEIGHT_M, abs=0.6)
        assert after[0] == pytest.approx(before[0], abs=0.1)


def test_a_moving_body_is_where_it_is_at_the_middle_of_the_readout(closed: Any) -> None:
    """The stated error: speed times half the readout over depth times f, at the first and the last
    row. At 10 m/s, 20 m below: 2.3 px."""
    scene = make_scene(box("car", 0.0, 0.0, "1 0 0 1"))
    rolling = closed(CameraSensor(scene, CameraParams(noise_sigma=0.0, readout_s=READOUT_S), 0))
    stand = Stand(scene, lambda _: Pose(np.eye(3), np.array([0.0, 0.0, HEIGHT_M])))
    image = stand.rows(rolling, READOUT_S)
    k = rolling.intrinsics()
    np.testing.assert_allclose(centroid(image[..., 0] > 128), [k.cx, k.cy], atol=0.3)


def test_only_a_camera_of_rows_takes_them() -> None:
    scene = make_scene()
    sensor = CameraSensor(scene, CameraParams(), 0)
    stand = Stand(scene, flight)
    assert not sensor.exposes_rows
    with pytest.raises(RuntimeError, match="exposed at once"):
        stand.rows(sensor, READOUT_S)
