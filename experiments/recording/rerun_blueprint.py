"""Layout and styles of a recording in the Rerun viewer."""

from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

TIMELINE = "sim_time"
PATHS = {"true": (70, 220, 110), "estimated": (255, 170, 40), "reference": (90, 160, 255)}
"""Recorded paths and their colours."""
AXES = {"x": (235, 80, 80), "y": (80, 200, 90), "z": (90, 140, 255)}
_PATH_WIDTHS = {"true": 2.2, "estimated": 1.6, "reference": 1.0}
"""Widths in screen points; where paths coincide, the wider one is visible as a rim."""
_MOTION_STYLE = {
    "height_m": (120, 200, 255),
    "speed_mps": (255, 200, 80),
    "tilt_deg": (255, 110, 150),
    "wind_mps": (150, 150, 160),
}
_ROTOR_STYLE = ((240, 120, 90), (250, 200, 90), (110, 200, 130), (110, 160, 250))
_TRAIL_OF_SCANS_S = 0.5


def flight_blueprint(centre_xy_m: NDArray[np.float64], span_m: float) -> rrb.Blueprint:
    """3-D world on the left; camera and costmap on the right; plots and phases below. The eye looks
    at ``centre_xy_m`` from the south-west, far enough to see ``span_m`` metres."""
    top = rrb.Horizontal(
        _world_view(centre_xy_m, span_m),
        rrb.Vertical(
            rrb.Spatial2DView(origin="world/vehicle/camera", name="Camera"),
            rrb.Spatial2DView(origin="costmap", name="Map and landing cost"),
            row_shares=[1, 1],
        ),
        column_shares=[5, 3],
    )
    bottom = rrb.Horizontal(
        _plot("plots/error", "Position error [m]"),
        rrb.Tabs(
            _plot("plots/motion", "Height, speed, tilt"),
            _plot("plots/rotors", "Rotor speeds [rad/s]"),
            _plot("plots/tracking", "Tracking error [m]"),
            _plot("plots/estimator", "Estimator"),
            active_tab=0,
        ),
        _text_log(),
        column_shares=[3, 3, 3],
    )
    return _laid_out(top, bottom)


def pair_blueprint(
    centre_xy_m: NDArray[np.float64], span_m: float, labels: Mapping[str, str]
) -> rrb.Blueprint:
    """As `flight_blueprint`, of two flights: ``labels`` by the names below which their entities
    stand. The map and the scans are those of the first."""
    _, *others = labels
    hidden = [f"- /world/{name}/{what}" for name in others for what in ("map/**", "scan")]
    images = [
        rrb.Vertical(
            rrb.Spatial2DView(origin=f"world/{name}/vehicle/camera", name=label),
            rrb.Spatial2DView(origin=f"costmap/{name}", name="Map and landing cost"),
        )
        for name, label in labels.items()
    ]
    top = rrb.Horizontal(
        _world_view(centre_xy_m, span_m, tuple(f"{name}/" for name in labels), hidden),
        rrb.Horizontal(*images),
        column_shares=[1, 1],
    )
    bottom = rrb.Horizontal(
        _plot("plots/pair/error", "Position error [m]"),
        _plot("plots/pair", "Distance between the flights [m]", ["- $origin/error/**"]),
        rrb.Tabs(*(_text_log(f"log/{name}", label) for name, label in labels.items())),
        column_shares=[3, 3, 3],
    )
    return _laid_out(top, bottom)


def _laid_out(top: rrb.Container, bottom: rrb.Container) -> rrb.Blueprint:
    return rrb.Blueprint(
        rrb.Vertical(top, bottom, row_shares=[3, 1]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(
            state="collapsed", timeline=TIMELINE, playback_speed=2.0, play_state="following"
        ),
        auto_views=False,
    )


def _text_log(origin: str = "log", name: str = "Phases, estimator, faults") -> rrb.TextLogView:
    return rrb.TextLogView(
        origin=origin,
        name=name,
        columns=rrb.TextLogColumns(
            timeline_columns=[TIMELINE], text_log_columns=[rrb.encodings.TextLogColumn("Body")]
        ),
    )


def _plot(origin: str, name: str, but: Sequence[str] = ()) -> rrb.TimeSeriesView:
    """Plot of the whole flight; by default the viewer follows the cursor."""
    whole = rrb.TimeRange(
        start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.infinite()
    )
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        contents=["$origin/**", *but],
        axis_x=rrb.TimeAxis(view_range=whole),
    )


def _world_view(
    centre_xy_m: NDArray[np.float64],
    span_m: float,
    flights: Sequence[str] = ("",),
    but: Sequence[str] = (),
) -> rrb.Spatial3DView:
    """``flights``: beginnings of the entities of each flight, below the world; ``but``: entities
    that are not shown."""
    everything = rrb.VisibleTimeRanges(
        timeline=TIMELINE,
        start=rrb.TimeRangeBoundary.infinite(),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    recent = rrb.VisibleTimeRanges(
        timeline=TIMELINE,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-_TRAIL_OF_SCANS_S),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    x, y = centre_xy_m
    return rrb.Spatial3DView(
        origin="world",
        name="Flight",
        contents=["$origin/**", *but],
        background=rrb.Background(color=[24, 28, 36], kind=rrb.BackgroundKind.SolidColor),
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=[x - 0.62 * span_m, y - 0.72 * span_m, 0.75 * span_m],
            look_target=[x, y, 5.0],
            eye_up=[0.0, 0.0, 1.0],
        ),
        overrides={
            **{f"world/{one}path/{name}": everything for one in flights for name in PATHS},
            **{f"world/{one}scan": recent for one in flights},
        },
    )


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
