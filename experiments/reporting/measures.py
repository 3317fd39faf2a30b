"""Measures of a flight by the column of its row: name, unit, and which setting decides them."""

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Measure:
    """A number of a flight. ``scale``: from the unit of ``column`` to ``unit``, in which tables
    print it; ``meaning``: of a name that is the paper's symbol."""

    column: str
    name: str
    unit: str = ""
    scale: float = 1.0
    meaning: str = ""

    @property
    def title(self) -> str:
        return f"{self.name} ({self.unit})" if self.unit else self.name

    @property
    def words(self) -> str:
        """The name without the paper's symbols."""
        return self.meaning or self.name

    @property
    def plain(self) -> str:
        """`title` without the paper's symbols."""
        return f"{self.words} ({self.unit})" if self.unit else self.words


AXES = (("x", "x", "m"), ("y", "y", "m"), ("z", "z", "m"), ("yaw_deg", "yaw", "°"))
"""Ending of a column, name and unit of the errors by axis."""

_ALL = (
    Measure("safe", "safe landings", "%", 100.0),
    Measure("success", "successful", "%", 100.0),
    Measure("go_arounds", "go-arounds"),
    Measure("trajectory_error_m", "E_tra", "m", meaning="tracking error"),
    Measure("trajectory_variance_m2", "σ²_tra", "m²", meaning="tracking variance"),
    Measure("position_error_m.mean", "position error", "m"),
    Measure("position_error_m.max", "position error at worst", "m"),
    *(Measure(f"position_error_m.{axis}", f"error {name}", unit) for axis, name, unit in AXES),
    *(Measure(f"path_deviation.{axis}", f"deviation {name}", unit) for axis, name, unit in AXES),
    Measure("nees.median", "median NEES"),
    Measure("nees.below_14_2", "NEES below 14.2", "%", 100.0),
    Measure("map.duration_s", "T_total", "s", meaning="scan time"),
    Measure("map.density_per_m2", "ρ_map", "1/m²", meaning="density"),
    Measure("map.levelness_error_deg.mean", "Δα", "°", meaning="map's levelness"),
    Measure("map.levelness_error_deg.max", "Δα at worst", "°", meaning="map's levelness at worst"),
    Measure("landing.target_offset_m", "d_L", "m", meaning="offset from the site"),
    Measure("landing.vertical_speed_mps", "v_z", "m/s", meaning="vertical speed"),
    Measure("landing.vertical_accel_mps2", "a_z", "m/s²", meaning="vertical acceleration"),
    Measure("landing.slope_deg", "α_L", "°", meaning="slope"),
    Measure("landing.tilt_deg", "tilt", "°"),
    Measure("landing.bounce_m", "bounce", "cm", 100.0),
    Measure("landing.impact_peak_mps2", "deceleration", "m/s²"),
    Measure("landing.obstacle_distance_m", "obstacle distance", "m"),
    Measure("landing.nearest_person_m", "nearest person", "m"),
    Measure("landing.nearest_person_10s_m", "nearest person, last 10 s", "m"),
    Measure("intrusion.reaction_s", "reaction", "s", meaning="from sight to reaction"),
    Measure("intrusion.in_view_height_m", "height at first sight", "m"),
    Measure("intrusion.stopping_m", "stopping distance", "m"),
    Measure("landing.estimate_error_at_commit_m", "error at the commit", "m"),
    Measure("landing.estimate_error_at_contact_m", "error at contact", "m"),
    Measure("timing.wall_s", "wall time", "s"),
    Measure("timing.real_time_factor", "real-time factor"),
    Measure("cpu_s", "CPU time", "s"),
)
MEASURES = {measure.column: measure for measure in _ALL}
YES_OR_NO = ("safe", "success")
"""columns that are 1 or 0, whose means are shares of flights"""


def measure_of(column: str) -> Measure:
    """The measure of a column; one that is called as the column where none is listed."""
    return MEASURES.get(column) or Measure(column, column)


@dataclass(frozen=True, slots=True)
class Setting:
    """Figures that a key of the configuration sets. They are marked wherever they are printed, and
    no comparison with the paper has them.

    ``columns``: columns of the rows, or their beginnings up to a dot. ``methods``: the estimators
    whose figures are set; of all of them where it is empty.
    """

    name: str
    columns: tuple[str, ...]
    key: str
    why: str
    methods: tuple[str, ...] = ()

    def has(self, column: str, methods: Iterable[str]) -> bool:
        """True if it sets the figures of ``column`` with each of ``methods``."""
        named = any(
            column == name or (name.endswith(".") and column.startswith(name))
            for name in self.columns
        )
        return named and (not self.methods or set(methods) <= set(self.methods))

    @property
    def note(self) -> str:
        return (
            f"{SET_MARK}: {self.name} is set by `{self.key}`, not measured ({self.why}), and is "
            "not compared with the paper."
        )


SETTINGS: tuple[Setting, ...] = (
    Setting(
        "T_total", ("map.duration_s",), "survey.duration_s", "the survey is planned to last as long"
    ),
    Setting(
        "v_z",
        ("landing.vertical_speed_mps",),
        "landing.touchdown_speed_mps",
        "the last part of the descent is commanded at it",
    ),
    Setting(
        "the error of `gps`",
        ("trajectory_error_m", "trajectory_variance_m2", "position_error_m.", "path_deviation."),
        "gps.preset",
        "the error is the receiver's, whose preset was fitted to the paper's Table 2",
        ("gps",),
    ),
)  # fmt: skip
SET_MARK = "(set)"


def is_marked(column: str, methods: Iterable[str]) -> bool:
    """True if a figure is set with ``methods`` and measured with others, so that its own cell and
    not the title of its column bears the mark."""
    known = list(methods)
    return bool(known) and any(s.methods and s.has(column, known) for s in SETTINGS)


def titled(title: str, column: str) -> str:
    """``title`` of a column, marked where the configuration sets its figures with all methods."""
    is_set = any(not setting.methods and setting.has(column, ()) for setting in SETTINGS)
    return f"{title} {SET_MARK}" if is_set else title


def setting_notes(columns: Iterable[str], methods: Iterable[str]) -> list[str]:
    """A sentence on each setting that ``columns`` show with ``methods``."""
    shown, flown = list(columns), list(methods)
    return [
        setting.note
        for setting in SETTINGS
        if any(setting.has(column, [method]) for column in shown for method in flown)
    ]
