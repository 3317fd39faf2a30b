"""Two flights in one Rerun recording: one place, one time line, and the instant where they part."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rerun as rr
from rerun.chunk import Chunk, RrdReader

from touchdown.experiments.config.keys import settings_apart
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.results import RunResult, load_result
from touchdown.experiments.io.tum import read_tum
from touchdown.experiments.recording.rerun_blueprint import TIMELINE, pair_blueprint
from touchdown.sim.files.opening import no_file
from touchdown.sim.typing import Array

NAMES = ("a", "b")
COLOURS = ((80, 180, 255), (255, 150, 50))
"""of the flights"""
APART_M = 0.1
"""distance of the vehicles at which the flights part: a tenth of what a landing site needs"""
_SHARED = ("world", "world/scene", "world/moving")
_SPAN_M = 75.0
_PLOT_HZ = 10.0


def write_two_flights(runs: tuple[Path, Path], out: Path) -> None:
    """Writes the recordings of two run directories into the one recording ``out``.

    Entities of a flight stand below ``a`` or ``b`` of their root, such as ``world/a/vehicle``; the
    scene is that of the first. Raises UsageError where a run has no recording, and for flights of
    two places.
    """
    results = [_result(run) for run in runs]
    places = [(result.scene, result.seed) for result in results]
    if places[0] != places[1]:
        (scene, seed), (other, other_seed) = places
        raise UsageError(
            f"'{runs[0]}' flew over {scene}, seed {seed}, '{runs[1]}' over {other}, seed "
            f"{other_seed}; two flights are shown over one place: name runs of one scene and seed"
        )
    labels = _labels(runs, results)
    paths = [read_tum(run / "truth.tum") for run in runs]
    estimates = [read_tum(run / "estimate.tum") for run in runs]
    middle = 0.5 * (paths[0][1].min(axis=0) + paths[0][1].max(axis=0))[:2]
    stream = rr.RecordingStream("touchdown", recording_id=f"{runs[0].name} and {runs[1].name}")
    stream.set_sinks(
        rr.FileSink(out),
        default_blueprint=pair_blueprint(middle, _SPAN_M, dict(zip(NAMES, labels, strict=True))),
    )
    for number, name in enumerate(NAMES):
        stream.send_chunks(list(_moved(runs[number] / "flight.rrd", name)))
        _style(stream, name, COLOURS[number], labels[number])
        error = _distance(estimates[number], paths[number])
        _plot(stream, f"plots/pair/error/{name}", *error)
    times, apart = _distance(paths[1], paths[0])
    _plot(stream, "plots/pair/apart", times, apart)
    _mark(stream, times, apart, paths[0])
    stream.flush()
    stream.disconnect()


def parting(times_s: Array, apart_m: Array) -> float | None:
    """The first of ``times_s`` (N,) at which two flights are more than `APART_M` apart; None where
    they never are."""
    found = np.flatnonzero(apart_m > APART_M)
    return float(times_s[found[0]]) if found.size else None


def _result(run: Path) -> RunResult:
    for name in ("flight.rrd", "truth.tum", "estimate.tum"):
        if reason := no_file(run / name):
            raise UsageError(
                f"'{run / name}' {reason}; name two run directories flown without --no-record"
            )
    return load_result(run / "result.json")


def _labels(runs: tuple[Path, Path], results: list[RunResult]) -> list[str]:
    """Names of the flights by what sets them apart, or their directories."""
    texts = []
    for result, settings in zip(results, settings_apart(runs), strict=True):
        own = [f"{key}={value}" for key, value in settings.items()][:2]
        texts.append(", ".join([result.estimator, *own]))
    return texts if texts[0] != texts[1] else [run.name for run in runs]


def _moved(recording: Path, name: str) -> Iterator[Chunk]:
    """The chunks of a recording at the entity paths of the pair."""
    for chunk in RrdReader(recording).stream().to_chunks():
        entity = chunk.entity_path.strip("/")
        root, _, rest = entity.partition("/")
        if root.startswith("__"):
            continue
        if entity in _SHARED or entity.startswith(tuple(f"{one}/" for one in _SHARED[1:])):
            if name == NAMES[0]:
                yield chunk
        else:
            yield chunk.with_entity_path(f"/{root}/{name}/{rest}")


def _style(stream: rr.RecordingStream, name: str, colour: tuple[int, ...], label: str) -> None:
    for path, width in (("true", 2.4), ("estimated", 1.0)):
        style = rr.LineStrips3D.from_fields(colors=[colour], radii=rr.Radius.ui_points([width]))
        stream.log(f"world/{name}/path/{path}", style, static=True)
    marker = rr.Points3D([[0.0, 0.0, 0.0]], radii=rr.Radius.ui_points([6.0]), colors=[colour])
    stream.log(f"world/{name}/vehicle/marker", marker, static=True)
    line = rr.SeriesLines(colors=[colour], names=[label], widths=[1.5])
    stream.log(f"plots/pair/error/{name}", line, static=True)
    white = rr.SeriesLines(colors=[(230, 230, 230)], names=["distance"], widths=[1.5])
    stream.log("plots/pair/apart", white, static=True)


def _distance(
    path: tuple[Array, Array, Array], other: tuple[Array, Array, Array]
) -> tuple[Array, Array]:
    """Times (N,) of ``path`` within both, and its distance (N,) from ``other`` there."""
    times, positions, _ = path
    both = (times >= other[0][0]) & (times <= other[0][-1])
    there = np.column_stack([np.interp(times[both], other[0], other[1][:, k]) for k in range(3)])
    return times[both], np.linalg.norm(positions[both] - there, axis=1)


def _plot(stream: rr.RecordingStream, entity: str, times: Array, values: Array) -> None:
    if len(times) < 2:
        return
    step = max(1, round(1.0 / (_PLOT_HZ * float(np.median(np.diff(times))))))
    stream.send_columns(
        entity,
        [rr.TimeColumn(TIMELINE, duration=times[::step])],
        rr.Scalars.columns(scalars=values[::step]),
    )


def _mark(
    stream: rr.RecordingStream, times: Array, apart: Array, path: tuple[Array, Array, Array]
) -> None:
    """Marks the instant where the flights part in the world, in the plot and in the logs; nothing
    where they never do."""
    time_s = parting(times, apart)
    if time_s is None:
        return
    stream.set_time(TIMELINE, duration=time_s)
    for name in NAMES:
        stream.log(f"log/{name}", rr.TextLog(f"the flights are {APART_M:g} m apart", level="WARN"))
    place = [np.interp(time_s, path[0], path[1][:, k]) for k in range(3)]
    stream.log(
        "world/parting",
        rr.Points3D([place], radii=rr.Radius.ui_points([9.0]), colors=[(255, 60, 90)],
                    labels=[f"part at {time_s:.1f} s"], show_labels=True),
    )  # fmt: skip
    point = rr.SeriesPoints(
        colors=[(255, 60, 90)], names=[f"part at {time_s:.1f} s"], marker_sizes=[6.0]
    )
    stream.log("plots/pair/parting", point, static=True)
    stream.log("plots/pair/parting", rr.Scalars([APART_M]))
