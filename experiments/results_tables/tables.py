"""The tables of README and the results pages, as lines of Markdown, of frames of stored rows."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from touchdown.experiments.drawing.style import INK
from touchdown.experiments.reporting import published
from touchdown.experiments.reporting.figures import Picture, drawn
from touchdown.experiments.reporting.flights import condition_of, ordered
from touchdown.experiments.reporting.measures import setting_notes, titled
from touchdown.experiments.reporting.report_tables import FLIGHTS, LANDED, OUTCOMES, UNSAFE
from touchdown.experiments.reporting.statistics import (
    clustered_fraction,
    geometric_ratio,
    rank_correlation,
    ratio_interval,
)
from touchdown.experiments.reporting.tables import (
    INDEPENDENT,
    MISSING,
    Column,
    cell,
    digits,
    interval_text,
    largest,
    make_table,
    markdown_lines,
    mean,
    with_notes,
)
from touchdown.scenes.truth.maps import MAX_SLOPE_DEG

_ERROR, _PATH, _NEES = "position_error_m.mean", "trajectory_error_m", "nees.below_14_2"
_LEVEL, _LEVEL_MAX = "map.levelness_error_deg.mean", "map.levelness_error_deg.max"
_D_L, _V_Z = "landing.target_offset_m", "landing.vertical_speed_mps"
_A_Z, _SLOPE = "landing.vertical_accel_mps2", "landing.slope_deg"
_COMMIT, _CONTACT = (f"landing.estimate_error_at_{when}_m" for when in ("commit", "contact"))
_INTERVALS = (
    "Brackets: 95 % intervals of the mean (bootstrap), of fractions Wilson's, over independent "
    "flights."
)
_LEVELNESS = (
    mean(_LEVEL, "levelness, mean (°)"),
    largest(_LEVEL_MAX, "largest at any place (°)"),
)


def landings(frame: pd.DataFrame, profile: str = "field") -> list[str]:
    """A line for each scene and one for all of them."""
    frame = frame[frame["profile"] == profile]
    if frame.empty:
        return [f"Not flown in `{profile}` yet."]
    columns = [
        FLIGHTS,
        INDEPENDENT,
        LANDED,
        UNSAFE,
        mean(_ERROR),
        *(mean(column) for column in (_D_L, _V_Z, _A_Z, _SLOPE)),
        *_LEVELNESS,
    ]
    notes = [
        "Figures of touchdowns are over the flights that touched ground. "
        "d_L: from the first contact to the site as committed at 4 m; v_z, a_z: mean absolute "
        f"values over the last 0.5 s; α_L: slope of the true ground. {_INTERVALS}"
    ]
    table = make_table(frame, "landings", "", columns, ("scene",), notes=notes)
    table.notes += _failures(frame)
    return with_notes(table)


def _failures(frame: pd.DataFrame) -> list[str]:
    """A sentence for each flight that did not land on safe ground."""
    told = []
    for row in frame.to_dict("records"):
        place = ", on unsafe ground" * (row.get("ground_safe") is False)
        reason = f" ({row['reason']})" if isinstance(row.get("reason"), str) else ""
        if place or row["outcome"] not in ("LANDED", "COMPLETED"):
            names = filter(None, (row["scene"], row["estimator"], row["condition"]))
            flight = ", ".join(f"`{name}`" for name in names)
            told.append(f"{flight}, seed {row['seed']}: {row['outcome']}{place}{reason}.")
    return told


def positioning(surveys: pd.DataFrame, landed: pd.DataFrame) -> list[str]:
    """A line for each method, over all scenes: of five flights over one no line would tell much."""
    frame = _positioned(surveys, landed)
    columns = [
        FLIGHTS,
        INDEPENDENT,
        OUTCOMES,
        mean(_ERROR, "mean error (m)"),
        largest(_ERROR, "worst flight (m)"),
        _over(frame, "estimator", "livo"),
        mean(_PATH),
        mean(_NEES),
    ]
    notes = [
        "mean error: distance of the estimate from the truth, not aligned; E_tra: deviation of the "
        "flown path from the reference; both from lift-off to the end of the survey. The surveys "
        f"of `livo` are those of the landings. {_PAIRED} {_INTERVALS}"
    ]
    return with_notes(make_table(frame, "positioning", "", columns, ("estimator",), notes=notes))


def _positioned(surveys: pd.DataFrame, landed: pd.DataFrame) -> pd.DataFrame:
    """The flights that show a method's positioning: a landing begins with the same survey, over
    which position error and deviation from the reference are taken."""
    field = landed[landed["profile"] == "field"]
    return pd.concat([field, surveys[surveys["estimator"] != "oracle"]])


_PAIRED = (
    "times that of `livo`: ratio of the mean errors over flights of equal scene and seed, which "
    "share place, sensors and wind."
)


def _over(frame: pd.DataFrame, by: str, base: str) -> Column:
    """Ratio of the mean errors of a line and of the flights with ``base`` in the column ``by``, on
    equal scenes, seeds and all else."""
    keys = [key for key in ("scene", "seed", "estimator", "condition") if key != by]
    others = frame.loc[frame[by] == base, [*keys, _ERROR]]

    def of(own: pd.DataFrame) -> Any:
        if (own[by] == base).all():
            return None
        both = own[[*keys, "unit", _ERROR]].merge(others, on=keys, suffixes=("", " base")).dropna()
        return ratio_interval(both[[_ERROR, f"{_ERROR} base"]].to_numpy(np.float64), both["unit"])

    return Column(key=f"over {base}", title=f"times that of `{base}`", of=of)


def levelness(surveys: pd.DataFrame, landed: pd.DataFrame) -> list[str]:
    """A line for each kind of flight that made a map: Δα, mean and largest."""
    kinds = [
        surveys[surveys["estimator"] == method].assign(flight=f"survey, `{method}`")
        for method in ("oracle", "zou2024")
    ]
    field = landed[landed["profile"] == "field"]
    frame = pd.concat([*kinds, field.assign(flight="landing, `livo`")])
    printed = ", ".join(f"±{value:g}" for value in published.LEVELNESS_DEG)
    notes = [
        "Angle between the normals of map and true ground at 10 places of a flight, at the end of "
        f"the survey; `oracle` has the true pose. {_INTERVALS}",
        f"The paper's Table 1 prints {printed}° for its scenes 1 to 4, which it does not name, and "
        f"the bound {published.LEVELNESS_BOUND_DEG:g}° over all of them.",
    ]
    columns = [FLIGHTS, INDEPENDENT, *_LEVELNESS]
    return with_notes(make_table(frame, "levelness", "", columns, ("flight",), notes=notes))


def conditions(frame: pd.DataFrame) -> list[str]:
    """A line for each condition, over all scenes."""
    frame = _with_conditions(frame)
    columns = [
        FLIGHTS,
        INDEPENDENT,
        OUTCOMES,
        UNSAFE,
        mean(_ERROR, "mean error (m)"),
        largest("position_error_m.max", "largest error (m)"),
        mean(_PATH),
        mean(_COMMIT),
        largest(_CONTACT, "error at contact, worst (m)"),
        mean(_D_L),
        mean(_NEES),
    ]
    notes = [_INTERVALS, *_failures(frame)]
    return with_notes(make_table(frame, "conditions", "", columns, ("condition",), notes=notes))


def _with_conditions(frame: pd.DataFrame) -> pd.DataFrame:
    rows = frame.drop(columns="condition").to_dict("records")
    return frame.assign(condition=[condition_of(row) for row in rows])


_AS_IS = "as_is"
"""The variant in which the world is what the estimator believes."""


def beliefs(frame: pd.DataFrame) -> list[str]:
    """A line for each method and thing that is wrong."""
    frame = _with_conditions(frame)
    columns = [
        FLIGHTS,
        INDEPENDENT,
        OUTCOMES,
        mean(_ERROR, "mean error (m)"),
        largest(_ERROR, "worst flight (m)"),
        _over(frame, "condition", _AS_IS),
        mean(_NEES),
    ]
    return with_notes(
        make_table(frame, "beliefs", "", columns, ("estimator", "condition"), notes=[_INTERVALS])
    )


_MEASURES = (
    ("d_L, offset from the chosen site", "m", _D_L, _D_L),
    ("v_z before the first contact", "m/s", _V_Z, _V_Z),
    ("a_z before it", "m/s²", _A_Z, _A_Z),
    ("α_L, slope of the ground there", "°", _SLOPE, _SLOPE),
    ("levelness of the map", "°", _LEVEL, _LEVEL_MAX),
)
"""Title, unit, and the columns of mean and largest value."""


def summary(landed: pd.DataFrame, surveys: pd.DataFrame) -> list[str]:
    """README's sentences on the landings in `field`, and its table of methods, over all scenes."""
    positioned = _positioned(surveys, landed)
    columns = [
        Column(key="completed", title="surveys completed", of=_completed),
        mean(_ERROR),
        _over(positioned, "estimator", "livo"),
    ]
    table = make_table(positioned, "surveys", "", columns, ("estimator",))
    notes = setting_notes([_ERROR], ordered(positioned, "estimator"))
    words = " ".join([*_failures(positioned), *notes, _INTERVALS])
    return [*_landing_words(landed[landed["profile"] == "field"]), "", *table.lines, "", words]


def _completed(own: pd.DataFrame) -> str:
    done = own["outcome"].isin(["COMPLETED", "LANDED"]).sum()
    units = own["unit"].nunique()
    return f"{done} of {len(own)}" + f" ({units} independent)" * (units < len(own))


def _landing_words(frame: pd.DataFrame) -> list[str]:
    is_safe = frame["outcome"].eq("LANDED") & frame["ground_safe"].eq(True)
    safe, fraction = int(is_safe.sum()), clustered_fraction(is_safe, frame["unit"])
    low, high = 100.0 * (fraction.low or 0.0), 100.0 * (fraction.high or 0.0)
    offset, slope, error, cost = (
        (cell(mean(column).of(frame)).markdown, cell(largest(column).of(frame)).text)
        for column in (_D_L, _SLOPE, _ERROR, "cpu_s")
    )
    scenes, units = frame["scene"].nunique(), frame["unit"].nunique()
    return [
        f"**{safe} of {len(frame)} flights with `livo` land on safe ground: "
        f"{100.0 * fraction.value:.0f} % [{low:.0f}, {high:.0f}]; {UNSAFE.of(frame)} touch unsafe "
        "ground.**",
        "",
        f"They are {units} independent flights over {scenes} scenes. They touch down {offset[0]} m "
        f"from the site that they chose (largest {offset[1]} m), where the ground slopes by "
        f"{slope[0]}° (largest {slope[1]}°). Over the survey the position is off by {error[0]} m "
        f"(worst flight {error[1]} m). A landing takes {cost[0]} s of a processor.",
    ]


def paper_landings(landed: pd.DataFrame) -> list[str]:
    """A line for each measure of the landings in `field`, beside the paper's figure."""
    frame = landed[landed["profile"] == "field"]
    rows = []
    for title, unit, column, worst in _MEASURES:
        theirs = published.LANDINGS.get(column, {}).get("zou2024", MISSING)
        if column == _LEVEL:
            theirs = f"within {published.LEVELNESS_BOUND_DEG:g}"
        figures = mean(column).of(frame), largest(worst).of(frame)
        name = f"{titled(title, column)} ({unit})"
        rows.append([name, str(theirs), *(cell(figure).markdown for figure in figures)])
    flights = f"{len(frame)} landings ({frame['unit'].nunique()} independent)"
    return [*markdown_lines([flights, "paper", "mean", "largest"], rows), "", _INTERVALS]


_COMPARED = (
    ("position error (m)", _ERROR),
    ("largest position error (m)", "position_error_m.max"),
    ("error at the commit (m)", _COMMIT),
    ("NEES below 14.2 (share)", _NEES),
    ("E_tra (m)", _PATH),
    ("d_L (m)", _D_L),
    ("a_z (m/s²)", _A_Z),
    ("levelness (°)", _LEVEL),
    ("CPU time (s)", "cpu_s"),
)


def pairs(short: pd.DataFrame, whole: pd.DataFrame) -> list[str]:
    """Short flights beside whole ones of equal scene, method and seed, a line for each figure:
    means, ratio and rank correlation over the pairs."""
    whole = whole[whole["profile"] == "field"]
    both = short.merge(whole, on=["scene", "estimator", "seed"], suffixes=("", " whole"))
    landed = [int((both[name] == "LANDED").sum()) for name in ("outcome", "outcome whole")]
    header = ["figure", "pairs", "whole, mean", "short, mean", "short over whole",
              "rank correlation"]  # fmt: skip
    return [
        *markdown_lines(header, [_pair_line(title, column, both) for title, column in _COMPARED]),
        "",
        f"- Landed: {landed[0]} of {len(both)} short flights, {landed[1]} of {len(both)} whole "
        "ones. Ratio of the geometric means, with its 95 % interval (bootstrap); Spearman's "
        "correlation, with its 95 % interval (Fisher's z).",
    ]


def _pair_line(title: str, column: str, both: pd.DataFrame) -> list[str]:
    columns = [column, f"{column} whole", "unit"]
    sides = both.reindex(columns=columns).dropna()
    if len(sides) < 2:
        return [title, str(len(sides)), *[MISSING] * 4]
    short, whole = (sides[name].to_numpy(np.float64) for name in columns[:2])
    rank = rank_correlation(short, whole, sides["unit"])
    text = f"{rank.value:.2f} [{rank.low:.2f}, {rank.high:.2f}]" if rank else MISSING
    ratio = geometric_ratio(short, whole, sides["unit"])
    return [
        title,
        str(len(sides)),
        digits(float(whole.mean())),
        digits(float(short.mean())),
        f"{digits(ratio.value)} {interval_text(ratio)}".strip() if ratio else MISSING,
        text,
    ]


def limit(figures: Mapping[str, Any]) -> list[str]:
    """Of ``limit.json``; of the changes those with all sensors."""
    from touchdown.experiments.benchmarks.limit.survey import table

    lines = table(figures["runs"]).splitlines()
    _, second, *_ = (at for at, line in enumerate(lines) if line.endswith("with a change"))
    return lines[: second - 1]


def tunings(found: Sequence[Mapping[str, Any]]) -> list[str]:
    """Of files of `touchdown bench tune`, a line for each method: errors are geometric means over
    logs."""
    header = ["method", "trials", "keys", "logs", "as shipped (m)", "best (m)",
              "other logs: as shipped (m)", "best (m)"]  # fmt: skip
    rows = []
    for one in sorted(found, key=lambda one: one["best_error_m"]):
        errors = [one["default_error_m"], one["best_error_m"]]
        for which in ("default", "best"):
            others = [log[f"{which}_error_m"] for log in one.get("check", [])]
            errors.append(float(np.exp(np.mean(np.log(others)))) if others else None)
        counts = one["trials"], len(one["best_settings"]), len(one["logs"])
        rows.append([
            f"`{one['estimator']}`",
            *map(str, counts),
            *(MISSING if error is None else digits(error) for error in errors),
        ])  # fmt: skip
    return markdown_lines(header, rows)


def cost(figures: Mapping[str, Any]) -> list[str]:
    """Of ``cost.json``."""
    rows = [
        [f"{title} ({one['unit']})" if one["unit"] else title,
         MISSING if one["value"] is None else digits(one["value"])]
        for title, one in figures.items()
    ]  # fmt: skip
    return markdown_lines(["measure", "value"], rows)


def chosen_ground(frame: pd.DataFrame) -> Picture:
    """Slope and roughness of the ground at every touchdown, by scene, beside the limit of safe
    slopes."""
    frame = frame[frame["profile"] == "field"]
    picture = Picture("chosen_ground", "Ground at the touchdowns", "")
    with drawn(picture, 6.4, 3.2) as figure:
        axes = figure.subplots()
        for number, scene in enumerate(ordered(frame, "scene")):
            own = frame[frame["scene"] == scene]
            rough = 1000.0 * own["landing.roughness_m"]
            axes.plot(own[_SLOPE], rough, "o^sD"[number % 4], markersize=4, label=scene, alpha=0.8)
        axes.axvline(MAX_SLOPE_DEG, color=INK, linewidth=0.8, linestyle="--", label="safe up to")
        axes.set(xlabel="slope of the true ground (°)", ylabel="deviation from the plane (mm)")
        axes.set(xlim=(0.0, MAX_SLOPE_DEG + 0.5), ylim=(0.0, None))
        axes.legend(title=f"{len(frame)} landings", frameon=False)
    return picture
