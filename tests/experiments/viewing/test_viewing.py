"""Two flights in one recording, and a flight in a viewer while it goes on."""

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader

import touchdown
from touchdown.experiments.errors import UsageError
from touchdown.experiments.viewing.processes import free_port
from touchdown.experiments.viewing.two_flights import write_two_flights

from support.command import Says


def _rows(recording: Path) -> Counter[str]:
    rows: Counter[str] = Counter()
    for chunk in RrdReader(recording).stream().to_chunks():
        rows[chunk.entity_path] += chunk.num_rows
    return rows


def _run(folder: Path, side_mps: float, **result: Any) -> Path:
    """A run of 2 s at 50 Hz that flies east and, from 1 s on, north with ``side_mps``."""
    folder.mkdir()
    told = {"outcome": "LANDED", "scene": "flat", "seed": 1, "estimator": "livo"} | result
    (folder / "result.json").write_text(json.dumps(told))
    (folder / "config.json").write_text(json.dumps({"livo": {"features": folder.name}}))
    times = np.arange(101) / 50.0
    north = side_mps * np.maximum(times - 1.0, 0.0)
    for name, error in (("truth", 0.0), ("estimate", 0.25)):
        rows = (f"{t} {t} {y} {5.0 + error} 0 0 0 1" for t, y in zip(times, north, strict=True))
        (folder / f"{name}.tum").write_text("\n".join(rows) + "\n")
    stream = rr.RecordingStream("touchdown")
    stream.save(folder / "flight.rrd")
    for entity in ("world/scene/terrain", "world/vehicle", "plots/error/x", "costmap/total"):
        stream.log(entity, rr.TextLog(folder.name), static=True)
    stream.disconnect()
    return folder


def test_two_flights_stand_side_by_side_and_part_where_they_do(tmp_path: Path, says: Says) -> None:
    runs = _run(tmp_path / "one", 0.0), _run(tmp_path / "two", 0.5)
    os.mkfifo(tmp_path / "pipe")  # opening it would wait for ever
    assert "is a named pipe" in says(2, "view", *runs, "--save", tmp_path / "pipe").err
    assert says(0, "view", *runs, "--save", tmp_path / "pair.rrd").out == ""
    (tmp_path / "own.rrd").write_text("mine")
    assert "is no recording" in says(2, "view", *runs, "--save", tmp_path / "own.rrd").err
    assert (tmp_path / "own.rrd").read_text() == "mine"
    assert says(0, "view", *runs, "--save", tmp_path / "pair.rrd").err == ""
    found = RrdReader(tmp_path / "pair.rrd").stream().to_chunks()
    chunks = {c.entity_path: c for c in sorted(found, key=lambda c: not c.is_static)}
    assert chunks.keys() >= {
        f"/{root}/{name}/{rest}"
        for root, rest in (("world", "vehicle"), ("plots", "error/x"), ("costmap", "total"))
        for name in "ab"
    }
    assert "/world/scene/terrain" in chunks and "/world/b/scene/terrain" not in chunks
    marked = chunks["/world/parting"].to_record_batch().to_pydict()
    (time_ns,) = marked["sim_time"]
    assert time_ns.total_seconds() == 1.22  # 0.5 m/s x 0.2 s is not more than 0.1 m
    np.testing.assert_allclose(marked["Points3D:positions"][0][0], [1.22, 0.0, 5.0], atol=1e-6)
    errors = chunks["/plots/pair/error/b"].to_record_batch().to_pydict()["Scalars:scalars"]
    assert len(errors) == 21 and np.allclose(errors, 0.25)


def test_flights_that_never_part_are_not_marked(tmp_path: Path) -> None:
    write_two_flights((_run(tmp_path / "one", 0.0), _run(tmp_path / "two", 0.1)), tmp_path / "p")
    assert "/world/parting" not in _rows(tmp_path / "p")


def test_flights_over_two_places_are_refused(tmp_path: Path) -> None:
    runs = _run(tmp_path / "one", 0.0), _run(tmp_path / "two", 0.0, seed=2)
    with pytest.raises(UsageError, match=r"over flat, seed 1, .* over flat, seed 2; "):
        write_two_flights(runs, tmp_path / "pair.rrd")
    (runs[1] / "flight.rrd").unlink()
    with pytest.raises(UsageError, match=r"two/flight.rrd' does not exist"):
        write_two_flights(runs, tmp_path / "pair.rrd")


def test_a_viewer_gets_the_flight_and_does_not_change_it(tmp_path: Path) -> None:
    port, got = free_port(0), tmp_path / "got.rrd"
    address = f"rerun+http://127.0.0.1:{port}/proxy"
    command = [sys.executable, "-m", "rerun", "--save", str(got), "--bind", "127.0.0.1"]
    viewer = subprocess.Popen([*command, "--port", str(port)], start_new_session=True)
    short = {"survey.legs": 1, "survey.leg_length_m": 4.0, "survey.duration_s": 3.0,
             "survey.height_m": 4.0, "mapper.enabled": False}  # fmt: skip
    try:
        touchdown.fly("flat", estimator="gps", overrides=short, out=tmp_path / "alone")
        touchdown.fly("flat", estimator="gps", overrides=short, out=tmp_path / "shown",
                      live=address)  # fmt: skip
        flown = _rows(tmp_path / "shown" / "flight.rrd")
        assert flown == _rows(tmp_path / "alone" / "flight.rrd")
        deadline = time.monotonic() + 60.0
        while not got.is_file() or _rows(got) != flown:
            assert time.monotonic() < deadline and viewer.poll() is None
            time.sleep(0.1)
    finally:
        os.killpg(viewer.pid, signal.SIGKILL)  # the command starts the viewer as its child
        viewer.wait()
    for name in ("truth.tum", "estimate.tum"):
        assert (tmp_path / "shown" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes()


def test_a_viewer_that_is_not_there_is_one_line(tmp_path: Path, says: Says) -> None:
    address = f"rerun+http://127.0.0.1:{free_port(0)}/proxy"
    err = says(2, "fly", "flat", "--live", address, "--out", tmp_path / "out").err
    assert f"no viewer answers at --live {address}" in err and err.count("\n") == 1
    assert "give the scene before --live" in says(2, "fly", "--live", "flat").err
    assert list(tmp_path.iterdir()) == []
