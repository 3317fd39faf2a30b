"""The paper's estimator as a whole on a short made-up flight, and against broken input."""

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest

from touchdown.estimator.api import PaperParams
from touchdown.estimator.filtering.message_order import stamp_of
from touchdown.estimator.paper.estimator import PaperEstimator
from touchdown.sim.api import (
    GRAVITY_MPS2,
    CameraImage,
    ImuSample,
    LidarScan,
    Observation,
    SimParams,
)
from touchdown.sim.delivery import Latency

from support.paper_flight import (
    FLIGHT,
    HZ,
    IMU_TICKS,
    LATENCY,
    PLAIN,
    RIG,
    SCAN_TICKS,
    START_Z,
    error,
    fly,
    image_at,
    make_rig,
    scan_ending_at,
)


def test_a_clean_flight_is_followed() -> None:
    estimates = fly(FLIGHT)
    last = estimates[-1]
    assert max(map(error, estimates)) < 0.03
    np.testing.assert_allclose(last.velocity_odom, [last.time_s, 0.0, 0.0], atol=0.03)
    assert last.diagnostics["landmarks_used"] >= 15
    assert last.diagnostics["lidar_planes"] > 60
    assert last.diagnostics["keyframes"] >= 2
    assert last.healthy
    for a, b in itertools.pairwise(estimates):
        step = b.odom_from_body.translation - a.odom_from_body.translation
        expected = 0.5 * (a.velocity_odom + b.velocity_odom) * (b.time_s - a.time_s)
        assert np.linalg.norm(step - expected) < 2e-3


def test_same_input_same_output_to_the_bit() -> None:
    for a, b in zip(fly(FLIGHT), fly(FLIGHT), strict=True):
        np.testing.assert_array_equal(a.world_from_body.translation, b.world_from_body.translation)
        np.testing.assert_array_equal(a.odom_from_body.rotation, b.odom_from_body.rotation)
        assert a.diagnostics == b.diagnostics


@pytest.mark.parametrize("part", ["lidar_pose", "camera_pose", "colour_smoothness", "bundle"])
def test_every_part_can_be_left_out(part: str) -> None:
    estimates = fly(FLIGHT, left_out(part))
    assert max(map(error, estimates)) < 0.06


def test_scans_and_images_that_overtake_one_another_are_all_used() -> None:
    sim = SimParams(latency_sigma=0.4)
    latencies = {name: Latency(sim, 3, name.encode()) for name in ("scans", "images")}
    arrivals: dict[int, dict[str, list[Any]]] = {}
    for obs in FLIGHT:
        for name, latency in latencies.items():
            for message in getattr(obs, name):
                due = latency.due(stamp_of(message))
                arrivals.setdefault(due, {"scans": [], "images": []})[name].append(message)
    nothing: dict[str, list[Any]] = {"scans": [], "images": []}
    flight = [
        dataclasses.replace(
            obs, **{k: tuple(m) for k, m in arrivals.get(obs.tick, nothing).items()}
        )
        for obs in FLIGHT
    ]
    apart = [len(o.scans) != len(o.images) for o in flight if o.scans or o.images]
    assert sum(apart) > len(apart) // 2
    estimates = fly(flight)
    assert max(map(error, estimates)) < 0.03
    assert estimates[-1].diagnostics["skipped"] == fly(FLIGHT)[-1].diagnostics["skipped"]


def left_out(part: str) -> PaperParams:
    switches: dict[str, Any] = {f"use_{part}": False}
    return dataclasses.replace(PLAIN, **switches)


def broken(kind: str) -> list[Observation]:
    flight = list(FLIGHT)
    k = max(i for i, obs in enumerate(flight) if obs.scans and obs.tick < 700)
    scan, image = flight[k].scans[0], flight[k].images[0]
    if kind == "nan ranges":
        ranges = np.where(np.arange(len(scan.ranges)) % 2 == 0, np.nan, scan.ranges)
        worse = dataclasses.replace(scan, ranges=ranges.astype(np.float32))
        flight[k] = dataclasses.replace(flight[k], scans=(worse,))
    elif kind == "all nan":
        worse = dataclasses.replace(scan, ranges=np.full_like(scan.ranges, np.nan))
        flight[k] = dataclasses.replace(flight[k], scans=(worse,))
    elif kind == "empty scan":
        none = dataclasses.replace(
            scan, directions=scan.directions[:0], ranges=scan.ranges[:0],
            time_offsets=scan.time_offsets[:0], intensity=scan.intensity[:0],
        )  # fmt: skip
        flight[k] = dataclasses.replace(flight[k], scans=(none,))
    elif kind == "black images":
        for i in range(k, len(flight)):
            black = tuple(
                dataclasses.replace(im, rgb=np.zeros_like(im.rgb)) for im in flight[i].images
            )
            flight[i] = dataclasses.replace(flight[i], images=black)
    elif kind == "late":
        flight[k + 30] = dataclasses.replace(flight[k + 30], scans=(scan,), images=(image,))
    elif kind == "no lidar":
        flight[k:] = [dataclasses.replace(obs, scans=()) for obs in flight[k:]]
    elif kind == "no camera":
        flight[k:] = [dataclasses.replace(obs, images=()) for obs in flight[k:]]
    elif kind == "nan imu":
        sample = dataclasses.replace(flight[k].imu[0], angular_velocity=np.full(3, np.nan))
        flight[k] = dataclasses.replace(flight[k], imu=(sample,))
    return flight


@pytest.mark.parametrize(
    "kind",
    ["nan ranges", "all nan", "empty scan", "black images", "late", "no lidar", "no camera",
     "nan imu"],
)  # fmt: skip
def test_broken_input_costs_centimetres_at_most(kind: str) -> None:
    estimates = fly(broken(kind))
    assert max(map(error, estimates)) < 0.06
    for estimate in estimates:
        assert np.isfinite(estimate.position_covariance).all()
    if kind in ("black images", "late", "nan imu"):
        assert estimates[-1].diagnostics["skipped"] >= 1.0


def test_a_distorted_lens_is_accepted() -> None:
    assert fly(FLIGHT[:150], rig=make_rig(-0.01))[-1].healthy


def test_a_missing_edge_model_is_named() -> None:
    with pytest.raises(FileNotFoundError, match="nowhere"):
        PaperEstimator(RIG, PaperParams(edge_model="nowhere.yml.gz"))


def test_standing_without_returns_it_does_not_drift() -> None:
    """On the pad the ground is nearer than the LIDAR's smallest range and the image never changes:
    an unknown bias of 0.05 m/s^2 would move the estimate by 0.22 m in 3 s without zero-velocity
    updates."""
    bias = np.array([0.05, 0.0, 0.0])
    force = np.array([0.0, 0.0, GRAVITY_MPS2]) + bias
    image = image_at(0)
    estimator = PaperEstimator(RIG, PLAIN)
    worst = 0.0
    for tick in range(IMU_TICKS, 3 * HZ + 1, IMU_TICKS):
        imu = ImuSample(
            tick=tick, time_s=tick / HZ, angular_velocity=np.zeros(3), specific_force=force
        )
        made = tick - LATENCY
        scans: tuple[LidarScan, ...] = ()
        images: tuple[CameraImage, ...] = ()
        if made >= SCAN_TICKS and made % SCAN_TICKS == 0:
            scan = scan_ending_at(made)
            scans = (dataclasses.replace(scan, ranges=np.zeros_like(scan.ranges)),)
            images = (dataclasses.replace(image, tick=made, time_s=made / HZ),)
        obs = Observation(
            tick=tick, time_s=tick / HZ, imu=(imu,), scans=scans, images=images,
            rotor_speed_radps=np.zeros(4), battery_fraction=1.0,
        )  # fmt: skip
        off = estimator.update(obs).world_from_body.translation - [0.0, 0.0, START_Z]
        worst = max(worst, float(np.linalg.norm(off)))
    assert worst < 0.01
