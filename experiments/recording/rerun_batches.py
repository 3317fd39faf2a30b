"""Fixed-size buffers, each sent to Rerun as columns in one call."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from touchdown.experiments.recording.rerun_blueprint import AXES, PATHS, TIMELINE
from touchdown.sim.frames import Pose, quat_wxyz_from_matrix

Array = NDArray[np.float64]

_PATH_WIDTHS = {"true": 2.2, "estimated": 1.6, "reference": 1.0}
"""Widths in screen points; where paths coincide, the wider one is visible as a rim."""
_MOTION_STYLE = {
    "height_m": (120, 200, 255),
    "speed_mps": (255, 200, 80),
    "tilt_deg": (255, 110, 150),
    "wind_mps": (150, 150, 160),
}
_XYZW = [1, 2, 3, 0]
_ROTOR_STYLE = ((240, 120, 90), (250, 200, 90), (110, 200, 130), (110, 160, 250))


class ScalarBatch:
    """Named scalars over time."""

    def __init__(self) -> None:
        self._rows: defaultdict[str, tuple[list[float], list[float]]] = defaultdict(
            lambda: ([], [])
        )

    def add(self, time_s: float, values: dict[str, float]) -> None:
        for path, value in values.items():
            times, numbers = self._rows[path]
            times.append(time_s)
            numbers.append(value)

    def send(self, stream: rr.RecordingStream) -> None:
        for path, (times, numbers) in self._rows.items():
            stream.send_columns(
                path, [rr.TimeColumn(TIMELINE, duration=times)], rr.Scalars.columns(scalars=numbers)
            )
        self._rows.clear()


class PoseBatch:
    """The vehicle's true pose over time."""

    def __init__(self) -> None:
        self._times: list[float] = []
        self._positions: list[Array] = []
        self._quats_xyzw: list[Array] = []

    def add(self, time_s: float, world_from_body: Pose) -> None:
        self._times.append(time_s)
        self._positions.append(world_from_body.translation)
        self._quats_xyzw.append(quat_wxyz_from_matrix(world_from_body.rotation)[_XYZW])

    def send(self, stream: rr.RecordingStream) -> None:
        if not self._times:
            return
        stream.send_columns(
            "world/vehicle",
            [rr.TimeColumn(TIMELINE, duration=self._times)],
            rr.Transform3D.columns(
                translation=np.array(self._positions), quaternion=np.array(self._quats_xyzw)
            ),
        )
        self.__init__()  # type: ignore[misc]


class PathBatch:
    """Paths as short pieces, each at its own time; the blueprint shows all pieces up to now."""

    def __init__(self) -> None:
        self._times: list[float] = []
        self._pieces: dict[str, list[Array]] = {name: [] for name in PATHS}
        self._ends: dict[str, Array] = {}

    def add(self, time_s: float, **positions_world: Array) -> None:
        """Positions (3,) by path name."""
        if self._ends:
            self._times.append(time_s)
            for name, position in positions_world.items():
                self._pieces[name].append(np.stack([self._ends[name], position]))
        self._ends = {name: position.copy() for name, position in positions_world.items()}

    def send(self, stream: rr.RecordingStream) -> None:
        if not self._times:
            return
        for name, pieces in self._pieces.items():
            stream.send_columns(
                f"world/path/{name}",
                [rr.TimeColumn(TIMELINE, duration=self._times)],
                rr.LineStrips3D.columns(strips=pieces),
            )
            pieces.clear()
        self._times.clear()


def log_styles(stream: rr.RecordingStream) -> None:
    """Sends colours, widths and names once."""
    for name, colour in PATHS.items():
        style = rr.LineStrips3D.from_fields(
            colors=[colour], radii=rr.Radius.ui_points([_PATH_WIDTHS[name]])
        )
        stream.log(f"world/path/{name}", style, static=True)
    series = {f"plots/error/{axis}": (axis, AXES[axis]) for axis in "xyz"}
    series |= {f"plots/tracking/{axis}": (axis, AXES[axis]) for axis in "xyz"}
    series |= {f"plots/motion/{name}": (name, rgb) for name, rgb in _MOTION_STYLE.items()}
    series |= {f"plots/rotors/{i}": (f"rotor {i}", rgb) for i, rgb in enumerate(_ROTOR_STYLE)}
    for path, (name, colour) in series.items():
        stream.log(path, rr.SeriesLines(colors=[colour], names=[name], widths=[1.5]), static=True)
