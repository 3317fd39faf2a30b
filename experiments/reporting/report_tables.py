"""The tables of a report: which columns each has, and its notes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from touchdown.experiments.campaign.expectations import Verdict
from touchdown.experiments.io.result_parts import WATCH_RULE, PartNames
from touchdown.experiments.io.results import RunResult
from touchdown.experiments.reporting import published
from touchdown.experiments.reporting.flights import values
from touchdown.experiments.reporting.measures import AXES
from touchdown.experiments.reporting.tables import (
    INDEPENDENT,
    Cell,
    Column,
    Table,
    cell,
    count,
    counts,
    fraction,
    groups,
    largest,
    make_table,
    mean,
    median,
    pooled_variance,
    value,
)
from touchdown.scenes.api import RISKY_CLASSES, SAFE_CLASSES

_ERROR, _PATH = "position_error_m.mean", "trajectory_error_m"
_COMMIT, _CONTACT = (
    f"landing.estimate_error_at_{when}_m" for when in ("commit", "contact")
)  # fmt: skip
_NEAR_M = 3.0
"""distance to a person within which a touchdown is unsafe"""
FLIGHTS = count("flights")
LANDED = count("landed", lambda own: own["outcome"] == "LANDED")
UNSAFE = count("unsafe touchdowns", lambda own: _is(own, "ground_safe", False))
OUTCOMES = counts("outcomes", "outcome")


_LANDING_NOTES = (
    "Fractions are of all flights that were to land, with Wilson's 95 % interval; safe means that "
    "the true ground around the touchdown is safe by geometry, and of a safe class in flights with "
    "the ground classifier. The other figures are over the flights that landed.",
    "Offset from the site, d_L: from the first contact to the site as committed at 4 m, or as "
    "commanded. Slope, α_L: of the true ground.",
    "v_z, a_z: mean absolute values over the last 0.5 s. Tilt: of the vehicle, the largest from "
    "the first contact on.",
)


def _is(own: pd.DataFrame, column: str, wanted: bool) -> Any:
    """Which flights have ``wanted`` in a column that may be missing, as it may be in each row."""
    return own[column].eq(wanted) if column in own else np.zeros(len(own), bool)


def _landed_safely(own: pd.DataFrame) -> Any:
    return (own["outcome"] == "LANDED") & _is(own, "ground_safe", True)


_SAFE = fraction("safe landings", _landed_safely)


def landed_of(frame: pd.DataFrame) -> pd.DataFrame:
    """The flights that landed."""
    return frame[frame["outcome"] == "LANDED"]


def flight_table(frame: pd.DataFrame) -> Table:
    """A line for each condition, method and scene."""
    columns = [
        FLIGHTS,
        INDEPENDENT,
        OUTCOMES,
        largest(_ERROR, "worst flight's error (m)"),
    ]
    return make_table(frame, "flights", "Outcomes", columns, plain=True)


def accuracy_table(frame: pd.DataFrame, *, paper: bool = False) -> Table:
    """Table 2, with the error of the estimate itself and NEES. ``paper``, here and below: with the
    paper's figures beside."""
    columns = [
        mean(_PATH, best=True, printed=_of_analysed_scene(published.TRAJECTORY_ERROR_M)),
        pooled_variance(
            "trajectory_variance_m2",
            _PATH,
            best=True,
            printed=_of_analysed_scene(published.TRAJECTORY_VARIANCE_M2),
        ),
        mean(_ERROR, best=True),
        mean("nees.median"),
    ]
    notes = [
        "E_tra: mean deviation of the flown path from the reference; σ²_tra: variance of all its "
        "samples of all flights, each flight weighing the same. Position error: mean 3-D distance "
        "of the estimate from the truth, not aligned. Median NEES: 2.4 if consistent, above it an "
        "estimator is overconfident."
    ]
    printed = ["The paper's figures are of a crossroad scene in Gazebo, 10 flights per method."]
    title = "Table 2: deviation of the path, and error of the estimate"
    return make_table(frame, "table2", title, columns, notes=notes + printed * paper,
                      plain=not paper)  # fmt: skip


def _of_analysed_scene(figures: Any) -> Callable[[str, str], float | None]:
    return lambda method, scene: (
        figures.get(method) if scene in ("", published.ANALYSED_SCENE) else None
    )


def axis_table(frame: pd.DataFrame, *, paper: bool = False) -> Table:
    """The numbers of Fig. 10 b-e."""
    columns = [
        mean(f"{kind}.{axis}") for kind in ("path_deviation", "position_error_m")
        for axis, *_ in AXES
    ]  # fmt: skip
    notes = [
        "Mean absolute deviation of the flown path from the reference, and mean absolute error of "
        "the estimate."
    ]
    printed = ["The paper shows its Fig. 10 without numbers, so none are compared."]
    return make_table(frame, "axes", "Errors by axis", columns, notes=notes + printed * paper,
                      plain=not paper)  # fmt: skip


def map_table(frame: pd.DataFrame, *, paper: bool = False) -> Table:
    """Table 1: scan time, map density, levelness, of the flights that made a map."""
    mapped = (
        frame[frame["map.density_per_m2"] > 0.0] if "map.density_per_m2" in frame else frame[:0]
    )
    columns = [
        mean("map.duration_s"),
        mean("map.density_per_m2"),
        mean("map.levelness_error_deg.mean"),
        mean("map.levelness_error_deg.max"),
    ]
    printed = ", ".join(f"±{value:g}" for value in published.LEVELNESS_DEG)
    notes = [
        "Δα: mean angle between map and true normal at 10 points per flight, drawn from the seed "
        "where the ground is planar, and that of the worst of them.",
    ]
    told = [
        "The paper's Table 1 prints T_total and ρ_map run together as "
        f'"{published.SCAN_TIME_AND_DENSITY}", so neither is compared. For its scenes 1 to 4, '
        f"which it does not name, it prints Δα = {printed}°, without saying what ± is, and the "
        f"bound {published.LEVELNESS_BOUND_DEG:g}° over all of them.",
    ]
    return make_table(mapped, "table1", "Table 1: scan time, map density and levelness", columns,
                      notes=notes + told * paper, plain=not paper)  # fmt: skip


def landing_tables(frame: pd.DataFrame, *, paper: bool = False) -> list[Table]:
    """Tables 5 and 6 and the extremes, of the flights in landing mode; Table 6 is of the paper's
    kinds of sites, and alone beside its figures."""
    landings = frame[frame["mode"] == "land"]
    on_sites = landings[landings["scene"].isin(list(published.SITES))]
    if not paper:
        return [_site_table(landings), _contact_table(landings)]
    return [_table_5(landings), _table_6(on_sites), _touchdown_table(landings)]


def _site_table(landings: pd.DataFrame) -> Table:
    columns = [
        _SAFE,
        *(
            _when_landed(mean(f"landing.{name}"))
            for name in ("slope_deg", "obstacle_distance_m", "target_offset_m")
        ),
    ]
    return make_table(
        landings, "sites", "Where they landed", columns, notes=_LANDING_NOTES[:2], plain=True
    )


def _contact_table(landings: pd.DataFrame) -> Table:
    columns = [
        _when_landed(mean(column))
        for column in (_COMMIT, _CONTACT, "landing.vertical_speed_mps", "landing.tilt_deg")
    ]
    return make_table(landings, "contacts", "How they touched down", columns,
                      notes=_LANDING_NOTES[2:], plain=True)  # fmt: skip


def _when_landed(column: Column) -> Column:
    """``column`` over the flights that landed."""
    return replace(column, of=lambda own: column.of(landed_of(own)))


def _table_5(landings: pd.DataFrame) -> Table:
    columns = [
        count("landings"),
        INDEPENDENT,
        fraction("landed", lambda own: own["outcome"] == "LANDED"),
        fraction("safe", _landed_safely),
        *(
            _when_landed(mean(column, printed=_by_method(column)))
            for column in (
                "landing.target_offset_m",
                "landing.vertical_speed_mps",
                "landing.vertical_accel_mps2",
                "landing.slope_deg",
                "landing.tilt_deg",
            )
        ),
    ]
    printed = ["The paper's figures are of five flights per method on a real vehicle."]
    return make_table(landings, "table5", "Table 5: landings", columns,
                      notes=[*_LANDING_NOTES, *printed])  # fmt: skip


def _by_method(column: str) -> Callable[[str, str], float | None]:
    figures = published.LANDINGS.get(column, {})
    return lambda method, _scene: figures.get(method)


def _table_6(landings: pd.DataFrame) -> Table:
    columns = [
        count("landings"),
        INDEPENDENT,
        LANDED,
        _when_landed(mean("landing.obstacle_distance_m", printed=_of_site("obstacle_distance_m"))),
        _when_landed(mean("landing.slope_deg", "level (°)", printed=_of_site("level_deg"))),
        _when_landed(mean("landing.vertical_speed_mps")),
        _when_landed(
            Column(
                key="type of site",
                title="type of site",
                of=_types_of_sites,
                printed=_of_site("site_type"),
            )
        ),
    ]
    notes = [
        "Over the flights that landed. Obstacle distance: from the touchdown to the nearest thing "
        "that stands more than 0.25 m over the ground, 15 m where there is none so near. Level: "
        "slope of the true ground at the touchdown. Type: the true class of the ground there, with "
        "the number of landings."
    ]
    printed = ["The paper's sites are real places, these are made to be alike."]
    return make_table(
        landings, "table6", "Table 6: five kinds of sites", columns, notes=notes + printed
    )


def _of_site(name: str) -> Callable[[str, str], Any]:
    return lambda _method, scene: getattr(published.SITES.get(scene), name, None)


def _types_of_sites(landed: pd.DataFrame) -> str | None:
    """The true classes of the ground, each with its safety in the paper and its number."""
    if "landing.class_true" not in landed:
        return None
    found = landed["landing.class_true"].dropna().value_counts()
    return ", ".join(f"{name} ({_safety(name)}) {n}" for name, n in found.items()) or None


def _safety(name: str) -> str:
    return "safe" if name in SAFE_CLASSES else "risky" if name in RISKY_CLASSES else "unsafe"


def _touchdown_table(landings: pd.DataFrame) -> Table:
    columns = [
        FLIGHTS,
        counts("other outcomes", "outcome", leave="LANDED"),
        UNSAFE,
        *(
            _when_landed(largest(f"landing.{name}"))
            for name in ("target_offset_m", "vertical_speed_mps", "bounce_m", "impact_peak_mps2",
                         "tilt_deg")
        ),
    ]  # fmt: skip
    notes = [
        "Unsafe touchdowns are counted whatever the outcome; the extremes are over the flights "
        "that landed. Bounce: how far the vehicle rose again after its first contact. "
        "Deceleration: its largest acceleration in any tick from the first contact on."
    ]
    return make_table(landings, "touchdowns", "How landings went, and the extremes", columns,
                      notes=notes)  # fmt: skip


def intruder_table(frame: pd.DataFrame) -> Table:
    """What became of flights that somebody was sent into, and of those without beside them."""
    columns = [
        FLIGHTS,
        fraction("descent interrupted", _interrupted),
        _sent(_SAFE),
        _sent(fraction("hit", _hit)),
        _sent(fraction("touchdowns within 3 m", lambda own: _nearest(own) < _NEAR_M)),
        _sent(count("too late to stop", lambda own: _is(own, "intrusion.avoidable", False))),
        _sent(median("intrusion.reaction_s")),
        _sent(largest("intrusion.reaction_s")),
    ]
    notes = [
        "Where nobody is sent, each interruption is a false alarm. The other figures are of "
        "flights that somebody was sent into. Hit: touched by what moves while the rotors "
        "turn. Too late to stop: when he came within 8 m in view, the vehicle could not have "
        "stopped 2 m above the ground. "
        "Reaction: from then to the first interruption, 0 where it came before."
    ]
    sent = "intrusion.avoidable" in frame and frame["intrusion.avoidable"].notna().any()
    return make_table(
        frame if sent else frame[:0], "intruders", "Who came", columns, notes=notes, plain=True
    )


def _sent(column: Column) -> Column:
    """``column`` over the flights that somebody was sent into; empty without one."""

    def of(own: pd.DataFrame) -> Any:
        sent = own[own["intrusion.avoidable"].notna()]
        return column.of(sent) if len(sent) else None

    return replace(column, of=of)


def _interrupted(own: pd.DataFrame) -> Any:
    return own["events"].astype(str).str.contains(f" {WATCH_RULE}: ", regex=False)


def _hit(own: pd.DataFrame) -> Any:
    return (own["outcome"] == "COLLIDED") & own["reason"].str.contains("traffic/", regex=False)


def _nearest(own: pd.DataFrame) -> Any:
    return own.get("landing.nearest_person_m", np.inf)


def expectation_table(verdicts: Sequence[Verdict]) -> Table:
    """A line for each expectation of the campaign's file."""
    rows = [
        [
            Cell(verdict.name, kind="name"),
            Cell(verdict.expected),
            Cell(", ".join(f"{name} {n}" for name, n in sorted(verdict.outcomes.items()))),
            cell(verdict.largest_error_m),
            Cell(verdict.word),
        ]
        for verdict in verdicts
    ]
    header = ["runs", "expected", "outcomes", "largest error, m", "verdict"]
    notes = [f"`{run_id}`: {why}." for v in verdicts for run_id, why in v.failures.items()]
    return Table("expected", "Expectations and outcomes", header, rows, notes)


_RUN_COLUMNS = (
    *(value(name) for name in ("scene", "estimator")),
    *(value(f"parts.{kind}", kind) for kind in PartNames.model_fields),
    *(value(name) for name in ("seed", "outcome")),
    *(
        value(column)
        for column in (
            "position_error_m.mean",
            "position_error_m.max",
            "position_error_m.yaw_deg",
            "trajectory_error_m",
            "landing.target_offset_m",
            "landing.vertical_speed_mps",
            "landing.vertical_accel_mps2",
            "landing.slope_deg",
            "landing.tilt_deg",
        )
    ),
    value("landing.safe_geometry", "safe geometry"),
    value("landing.class_true", "true class"),
    value("landing.class_predicted", "predicted class"),
    value("map.levelness_error_deg.mean"),
    value("timing.real_time_factor"),
)


def run_table(frame: pd.DataFrame) -> Table:
    """A table with a line per run; columns without any value are left out."""
    return make_table(frame, "runs", "Runs", _RUN_COLUMNS, ("run_id",), names=("run",))


def summary(frame: pd.DataFrame) -> dict[str, Any]:
    """Counts of outcomes and unsafe landings, and means over the runs that have the value, by
    method and condition."""
    means = {
        ", ".join(filter(None, names)): {
            column.column: float(found.mean())
            for column in _RUN_COLUMNS
            if column.column != "seed" and (found := _numbers(own, column.column)).size
        }
        for names, own in groups(frame, ("estimator", "condition"))
    }
    return {
        "runs": len(frame),
        "outcomes": {name: int(n) for name, n in frame["outcome"].value_counts().items()},
        "unsafe_touchdowns": UNSAFE.of(landed_of(frame)),
        "means": means,
    }


def _numbers(own: pd.DataFrame, column: str) -> Any:
    is_number = column in own and own[column].dtype.kind == "f"
    return values(own, column) if is_number else values(own, "")


def summary_line(totals: Mapping[str, Any]) -> str:
    """Returns ``3 runs: LANDED 2, NO_SITE 1; 1 unsafe touchdown`` of a `summary`."""
    runs, unsafe = totals["runs"], totals["unsafe_touchdowns"]
    counts = ", ".join(f"{name} {count}" for name, count in sorted(totals["outcomes"].items()))
    line = f"{runs} run{'s' * (runs != 1)}: {counts}"
    return line + (f"; {unsafe} unsafe touchdown{'s' * (unsafe != 1)}" if unsafe else "")


def missed_lines(runs: Mapping[str, RunResult]) -> list[str]:
    """A line for each run without a site, or that gave one up: what it refused, by the truth."""
    return [
        f"{name}: {run.outcome}: {run.choice.missed.sentence()}"
        for name, run in runs.items()
        if run.choice is not None and run.choice.missed is not None
    ]
