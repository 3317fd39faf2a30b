"""Logs of PX4, constant twists, and the real IMU of EuRoC against its truth."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.imu_propagation import ImuBuffer, NavState
from touchdown.experiments.errors import UsageError
from touchdown.experiments.recordings.clock import at_rest
from touchdown.experiments.recordings.compose import ComposedLog
from touchdown.experiments.recordings.contract import RigParts
from touchdown.experiments.recordings.folders import EurocFolder
from touchdown.experiments.recordings.px4_logs import Px4Log
from touchdown.experiments.recordings.registration import moved_by_twist
from touchdown.experiments.recordings.run import ReplayOptions, replay_recording
from touchdown.sim.api import SensorNeeds
from touchdown.sim.frames import matrices_from_quats_wxyz, so3_log
from touchdown.sim.typing import Array

from support.command import Says
from support.recorded_data import assert_estimates_equal, recorded
from support.replay_support import make_run
from support.ulog_support import write_ulog
from support.unwritten import ulog_unwritten

GPS = SensorNeeds(gps=True, barometer=True, magnetometer=True)


@pytest.fixture(scope="module")
def ulog(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("pyulog")
    folder = tmp_path_factory.mktemp("px4")
    run = make_run(folder / "run", seconds=3.0, needs=GPS, shared=GPS)
    return write_ulog(run, folder / "flight.ulg")


def test_a_log_of_px4_is_replayed(ulog: Path, tmp_path: Path) -> None:
    """The receiver errs by half a metre; the heading is that of the field of the log."""
    rig = tmp_path / "rig.toml"
    rig.write_text("[magnetometer]\ndeclination_deg = -7.2\n")
    errors = {}
    for align in ("origin", "none"):
        asked = ReplayOptions(estimator="gps", rig=rig, align=align)
        result = replay_recording(ulog, tmp_path / align, asked)
        assert result.position_error_m is not None
        errors[align] = result.position_error_m
    assert errors["origin"].mean is not None and errors["origin"].mean < 1.0
    away = np.linalg.norm([4.0, -2.0, 0.31])  # of the first fix, from the origin of PX4's frame
    assert errors["none"].mean == pytest.approx(away, abs=0.8)
    # the heading is found after a quarter of a second, and was 0 until then
    assert errors["none"].yaw_deg is not None and errors["none"].yaw_deg < 3.0


def test_a_log_of_px4_gives_the_estimate_of_what_was_written(
    ulog: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To the digit: values of 32 bits at stamps of a microsecond."""
    asked = ReplayOptions(estimator="gps", align="none")
    replay_recording(ulog, tmp_path / "file", asked)
    monkeypatch.setattr(
        "touchdown.experiments.recordings.run.open_recording",
        lambda _path, _parts: ulog_unwritten(ulog.parent / "run"),
    )
    replay_recording(ulog, tmp_path / "log", asked)
    assert_estimates_equal(tmp_path / "log", tmp_path / "file")


def test_axes_and_units_of_px4(ulog: Path) -> None:
    log = Px4Log(ulog)
    imu, nav, truth = log.imu(), log.nav(), log.truth()
    assert imu is not None and nav is not None and truth is not None
    np.testing.assert_allclose(imu.force[:100].mean(axis=0), [0.0, 0.0, 9.81], atol=0.1)
    assert 1e-9 * imu.stamps_ns[0] == pytest.approx(40.005)
    np.testing.assert_allclose(truth.positions[0], [4.0, -2.0, 0.31], atol=1e-5)
    turn = matrices_from_quats_wxyz(truth.quats_wxyz[:1])[0]
    assert np.arctan2(turn[1, 0], turn[0, 0]) == pytest.approx(0.3, abs=1e-5)
    assert turn[2, 2] == pytest.approx(1.0, abs=1e-6)
    assert np.linalg.norm(nav.fields_ut[0]) == pytest.approx(54.8, abs=2.0)
    assert nav.pressures_pa[0] == pytest.approx(100_725.0, abs=200.0)
    np.testing.assert_allclose(nav.fixes[0, :3], 0.0, atol=1e-6)
    assert nav.fixes[:, 5].max() > 1.0  # it climbs
    composed = ComposedLog(log, log.found)
    counts = {"gps": 0, "barometer": 0, "magnetometer": 0}
    for obs in composed.observations():
        for name in counts:
            arrived = getattr(obs, name)
            counts[name] += len(arrived)
            assert all(0 <= obs.tick - one.tick < composed.clock.imu_ticks for one in arrived)
    assert counts["gps"] == len(nav.fix_ns) and counts["barometer"] == len(nav.pressure_ns)


def test_a_log_of_px4_that_is_none(ulog: Path, tmp_path: Path, says: Says) -> None:
    broken = tmp_path / "a.ulg"
    broken.write_bytes(ulog.read_bytes()[:4])
    assert "no log of PX4, or damaged" in says(2, "replay", str(broken)).err
    told = says(2, "replay", str(ulog), "--estimator", "livo", "--out", str(tmp_path / "x")).err
    assert "lacks what livo needs" in told and told.count("\n") == 1


def test_an_imu_in_g_is_told(ulog: Path) -> None:
    log = Px4Log(ulog)
    whole = log.imu()
    assert whole is not None

    class InG(Px4Log):
        def imu(self):  # type: ignore[no-untyped-def]
            return dataclasses.replace(whole, force=whole.force / 9.81)

    other = ComposedLog(InG(ulog), RigParts())
    assert "states g" in " ".join(other.notes())
    first = next(iter(other.observations())).imu[0].specific_force
    np.testing.assert_allclose(first, whole.force[0])
    whole = dataclasses.replace(whole, force=whole.force * 3.0)
    with pytest.raises(UsageError, match="not gravity's"):
        ComposedLog(InG(ulog), RigParts())


def test_data_sets_are_listed(says: Says) -> None:
    listed = says(0, "datasets").out
    assert listed.count("\n") == 7 and "mars-lvig" in listed
    one = says(0, "datasets", "euroc").out
    assert "address: https://" in one and "command: touchdown replay" in one
    assert "did you mean 'euroc'" in says(2, "datasets", "eurok").err


def test_points_are_moved_by_a_constant_twist() -> None:
    points = np.array([[2.0, 0.0, 1.0]] * 2)
    quarter = np.array([0.0, 0.0, np.pi / 2.0, 3.0, 0.0, -1.0])
    early = [0.3 + 2.0 * np.cos(0.05 * np.pi), 2.0 * np.sin(0.05 * np.pi), 0.9]
    found = moved_by_twist(points, np.array([1.0, 0.1]), quarter)
    np.testing.assert_allclose(found, [[3.0, 2.0, 0.0], early])


def _off(twist: Array, raw: Array, times: Array, still: Array) -> Array:
    return (moved_by_twist(raw, times, twist) - still).ravel()


def test_real_sweeps_are_moved_onto_their_deskewed_twins() -> None:
    """The best constant twists leave 0.052, 0.016 and 0.072 m, since the sensor did not turn
    evenly; 0.92, 0.92 and 2.75 m undone."""
    folder = recorded("newer_college") / "newer_06"
    left = []
    for n in range(3):
        raw, still = (np.fromfile(folder / f"{kind}_{n:02}.bin", "<f4").reshape(-1, 3)
                      .astype(np.float64) for kind in ("raw", "deskewed"))  # fmt: skip
        times = np.fromfile(folder / f"times_{n:02}.bin", "<f4").astype(np.float64)
        raw = raw * [-1.0, -1.0, 1.0]
        off = least_squares(_off, np.zeros(6), args=(raw, times, still)).fun.reshape(-1, 3)
        left.append(np.linalg.norm(off, axis=1).mean())
    assert np.mean(left) < 0.05 and max(left) < 0.08


@pytest.mark.slow
def test_the_real_imu_against_its_truth() -> None:
    """Every second from the truth's state: the truth is the trapezoidal sum of the IMU for 50 ms
    and jumps then, always the same way; that is most of what is left after a second."""
    data = recorded("euroc_v101")
    folder = EurocFolder(data)
    imu, sheet = folder.imu(), folder.found.imu
    table = np.loadtxt(data / "mav0/state_groundtruth_estimate0/data.csv", delimiter=",")
    truth = folder.truth()
    assert truth is not None
    rows = np.searchsorted(imu.stamps_ns, truth.stamps_ns - 1000)
    turns = matrices_from_quats_wxyz(truth.quats_wxyz)
    errors: dict[int, list[tuple[float, float]]] = {5: [], 200: []}
    for count, found in errors.items():
        for a in range(0, len(rows) - 200, 200):
            if rows[a + count] - rows[a] != count:
                continue
            state = NavState(0, turns[a], table[a, 1:4], table[a, 8:11], table[a, 11:14],
                             table[a, 14:17])  # fmt: skip
            eskf, buffer = Eskf(state, np.full(15, 1e-18)), ImuBuffer(sheet, 0.005)
            for i in range(rows[a] + 1, rows[a] + count + 1):
                gyro, force = (0.5 * (part[i] + part[i - 1]) for part in (imu.gyro, imu.force))
                buffer.push(3 * (i - rows[a]), gyro, force, False)
            eskf.propagate(buffer, count)
            off = np.linalg.norm(eskf.state.position - table[a + count, 1:4])
            stated = np.sqrt(np.trace(eskf.covariance[3:6, 3:6]))
            found.append((float(off), float(stated)))
            turned = so3_log(turns[a + count].T @ eskf.state.rotation)
            assert np.linalg.norm(turned) < 0.04
    seconds = np.array(errors[200])
    assert len(seconds) > 140
    assert 0.03 < np.median(seconds[:, 0]) < 0.045 and np.quantile(seconds[:, 0], 0.95) < 0.085
    assert 0.002 < np.median(seconds[:, 1]) < 0.003
    assert np.median([off for off, _ in errors[5]]) < 1e-5
    rest = at_rest(imu, int(truth.stamps_ns[0]))
    np.testing.assert_allclose(rest.rate, table[0, 11:14], atol=0.004)
    # the accelerometer's bias is what its mean over a second has beside the truth's velocities
    means, left = [], []
    for a in range(0, len(rows) - 200, 200):
        if rows[a + 200] - rows[a] != 200:
            continue
        turn, force = turns[a : a + 201], imu.force[rows[a : a + 201]]
        felt = np.einsum("nij,nj->ni", turn, force)
        mean = (felt.sum(axis=0) - 0.5 * (felt[0] + felt[-1])) / 200.0
        gained = (table[a + 200, 8:11] - table[a, 8:11]) / (
            1e-9 * (table[a + 200, 0] - table[a, 0])
        )
        means.append(turn.mean(axis=0))
        left.append(mean - [0.0, 0.0, 9.81] - gained)
    bias, *_ = np.linalg.lstsq(np.concatenate(means), np.concatenate(left), rcond=None)
    np.testing.assert_allclose(bias, table[:, 14:17].mean(axis=0), atol=0.003)
