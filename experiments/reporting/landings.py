"""Landings: the paper's Tables 5 and 6, the table of touchdowns, and sentences."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from touchdown.experiments.campaign.results_table import touched_safe_ground
from touchdown.experiments.reporting import published
from touchdown.experiments.reporting.flights import (
    Row,
    cell,
    flies_paper_methods,
    judged_by_class,
    methods_of,
    number,
    scenes_of,
)
from touchdown.experiments.reporting.measures import (
    estimates,
    mean_of,
    setting_notes,
    setting_of,
    titled,
)
from touchdown.experiments.reporting.queries import (
    LANDED,
    CellKey,
    LandingCounts,
    landings_by_cell,
    largest_by_cell,
    outcomes_by_cell,
    texts_by_cell,
)
from touchdown.experiments.reporting.statistics import Estimate, share_interval
from touchdown.experiments.reporting.tables import (
    ALL_SCENES,
    MISSING,
    Cell,
    Table,
    cell_names,
    digits,
    figure,
    interval_text,
    name_cell,
    published_cell,
)
from touchdown.scenes.api import RISKY_CLASSES, SAFE_CLASSES

_MEASURES: tuple[tuple[str, str, str, Any], ...] = (
    ("d_L", "m", "landing.target_offset_m", published.LANDING_OFFSET_M),
    ("v_z", "m/s", "landing.vertical_speed_mps", published.LANDING_SPEED_MPS),
    ("a_z", "m/s²", "landing.vertical_accel_mps2", published.LANDING_ACCEL_MPS2),
    ("α_L", "°", "landing.slope_deg", published.LANDING_SLOPE_DEG),
    ("tilt", "°", "landing.tilt_deg", {}),
)
_EXTREMES: tuple[tuple[str, str, float], ...] = (
    ("d_L (m)", "landing.target_offset_m", 1.0),
    ("v_z (m/s)", "landing.vertical_speed_mps", 1.0),
    ("bounce (cm)", "landing.bounce_m", 100.0),
    ("deceleration (m/s²)", "landing.impact_peak_mps2", 1.0),
    ("tilt (°)", "landing.tilt_deg", 1.0),
)
_NAMED = 10
"""largest number of unsafe touchdowns that are listed by name"""


def landings_of(rows: Sequence[Row]) -> list[Row]:
    """Returns the flights in landing mode."""
    return [row for row in rows if row["mode"] == "land"]


def landed_of(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if row["outcome"] == LANDED]


def unsafe_of(rows: Sequence[Row]) -> list[Row]:
    """Flights that touched unsafe ground, whatever their outcome: unsafe by geometry or, with the
    ground classifier, by class."""
    return [row for row in rows if touched_safe_ground(row) is False]


def _unsafe_word(rows: Sequence[Row]) -> str:
    """The wording of unsafe ground by what the flights are judged on."""
    return "unsafe" if any(map(judged_by_class, rows)) else "unsafe by geometry"


def landing_tables(rows: Sequence[Row]) -> list[Table]:
    """Returns all tables of landings; none without a flight in landing mode."""
    landings = landings_of(rows)
    if not landings:
        return []
    return [_table_5(landings), *_tables_6(landings), _safety_table(landings)]


def _keys(flown: Collection[CellKey], scenes: Sequence[str], method: str) -> list[CellKey]:
    """The cells of a method by scene, and the pooled one where there are several scenes."""
    keys = [key for scene in scenes if (key := CellKey(method, scene)) in flown]
    return [*keys, CellKey(method)] if len(keys) > 1 else keys


def _landing_counts(landings: Sequence[Row]) -> dict[CellKey, LandingCounts]:
    """Counts of every cell, and of every method over all its scenes."""
    return landings_by_cell(landings) | landings_by_cell(landings, pooled=True)


def _landing_estimates(landings: Sequence[Row], column: str) -> dict[CellKey, Estimate]:
    """Means over the flights that landed, of every cell and of every method."""
    landed, measure = landed_of(landings), mean_of(column)
    return estimates(landed, measure) | estimates(landed, measure, pooled=True)


# --------------------------------------------------------------------------------- Tables 5 and 6


def _table_5(landings: Sequence[Row]) -> Table:
    titles = [titled(f"{name} ({unit})", column) for name, unit, column, _ in _MEASURES]
    header = ["method", "scene", "landings", "landed", "safe", *titles]
    table = Table("landing", "Table 5: landings", header, [])
    flown, scenes, counts = methods_of(landings), scenes_of(landings), _landing_counts(landings)
    found = [_landing_estimates(landings, column) for _, _, column, _ in _MEASURES]
    compared = flies_paper_methods(landings)
    printed_methods = published.LANDING_OFFSET_M if compared else ()
    others = [method for method in printed_methods if method not in flown]
    for method in (*flown, *others):
        printed = [
            published_cell({} if setting_of(column) else theirs, method)
            for _, _, column, theirs in _MEASURES
        ]
        if compared and any(c.text != MISSING for c in printed):
            blanks = [Cell(MISSING, kind="published")] * 3
            where = Cell("paper prints", kind="published")
            table.rows.append([name_cell(method), where, *blanks, *printed])
        for key in _keys(counts, scenes, method):
            own = counts[key]
            measured = [by_cell.get(key) for by_cell in found]
            line = [*cell_names(key), Cell(str(own.flights))]
            line += [_share(own.landed, own.flights), _share(own.landed_safely, own.flights)]
            table.rows.append([*line, *map(figure, measured)])
            table.numbers.setdefault(method, {})[key.scene or ALL_SCENES] = {
                "landings": own.flights,
                "landed": share_interval(own.landed, own.flights).as_json(),
                "safe": share_interval(own.landed_safely, own.flights).as_json(),
                **{m[2]: e.as_json() for m, e in zip(_MEASURES, measured, strict=True) if e},
            }
    table.notes = [
        "Shares are of all flights that were to land, with Wilson's 95 % interval; safe means that "
        "the true ground around the touchdown is safe by geometry, and of a safe class in flights "
        "with the ground classifier. The other figures are over the flights that landed."
        + (" The paper's are of five flights per method on a real vehicle." if compared else ""),
        "d_L: from the first contact to the site as committed at 4 m, or as commanded. v_z, a_z: "
        "mean absolute values over the last 0.5 s. α_L: slope of the true ground. Tilt: of the "
        "vehicle, the largest from the first contact on.",
        *setting_notes((measure[2] for measure in _MEASURES), flown),
    ]
    return table


def _share(hits: int, flights: int) -> Cell:
    share = share_interval(hits, flights)
    low, high = 100.0 * (share.low or 0.0), 100.0 * (share.high or 0.0)
    return Cell(f"{100.0 * share.value:.0f} %", f"[{low:.0f}, {high:.0f}]")


def _tables_6(landings: Sequence[Row]) -> list[Table]:
    """A table for each method that landed on one of the paper's five kinds of sites."""
    own = [row for row in landings if row["scene"] in published.SITES]
    landed, counts = landed_of(own), landings_by_cell(own)
    found = _SiteFigures(
        counts,
        {column: estimates(landed, mean_of(column)) for column in _SITE_COLUMNS},
        texts_by_cell(landed, "landing.class_true"),
    )
    return [_table_6(found, method) for method in methods_of(own)]


_SITE_COLUMNS = ("landing.obstacle_distance_m", "landing.slope_deg", "landing.vertical_speed_mps")


@dataclass(frozen=True, slots=True)
class _SiteFigures:
    """Counts, means by column, and landings by true class of the ground, of every cell."""

    counts: Mapping[CellKey, LandingCounts]
    means: Mapping[str, Mapping[CellKey, Estimate]]
    classes: Mapping[CellKey, dict[str, int]]


def _table_6(found: _SiteFigures, method: str) -> Table:
    printed = "paper prints"
    header = ["scene", "landed", "obstacle distance (m)", printed, "level (°)", printed]
    header += [titled("v_z (m/s)", _SITE_COLUMNS[-1]), "type of site", printed]
    table = Table(f"table6_{method}", f"Table 6: five kinds of sites, `{method}`", header, [])
    for scene, site in published.SITES.items():
        key = CellKey(method, scene)
        if key not in found.counts:
            continue
        flights, landed, *_ = found.counts[key]
        line = [name_cell(scene), Cell(f"{landed} of {flights}")]
        numbers: dict[str, Any] = {"flights": flights, "landed": landed}
        theirs = (site.obstacle_distance_m, site.level_deg, site.speed_mps)
        for column, value in zip(_SITE_COLUMNS, theirs, strict=True):
            measured = found.means[column].get(key)
            line.append(figure(measured))
            if setting_of(column) is None:
                line.append(Cell(f"{value:.2f}", kind="published"))
            if measured is not None:
                numbers[column] = measured.as_json()
        numbers["classes"] = found.classes.get(key, {})
        types = ", ".join(f"{_verdict(name)} {count}" for name, count in numbers["classes"].items())
        line += [Cell(types or MISSING), Cell(site.site_type, kind="published")]
        table.rows.append(line)
        table.numbers[scene] = numbers
    table.notes = [
        "Over the flights that landed. Obstacle distance: from the touchdown to the nearest thing "
        "that stands more than 0.25 m over the ground, 15 m where there is none so near. Level: "
        "slope of the true ground at the touchdown. Type: the true class of the ground there, with "
        "the number of landings. The paper's sites are real places, these are made to be alike.",
        *setting_notes(_SITE_COLUMNS, [method]),
    ]
    return table


def _verdict(name: str) -> str:
    """A class with its safety in the paper."""
    kind = "safe" if name in SAFE_CLASSES else "risky" if name in RISKY_CLASSES else "unsafe"
    return f"{name} ({kind})"


# --------------------------------------------------------------------------- outcomes and extremes


def _safety_table(landings: Sequence[Row]) -> Table:
    header = ["method", "scene", "flights", "landed", "otherwise", "unsafe touchdowns"]
    header += [titled(f"largest {title}", column) for title, column, _ in _EXTREMES]
    table = Table("touchdowns", "How landings went, and the extremes", header, [])
    counts, scenes = _landing_counts(landings), scenes_of(landings)
    outcomes = outcomes_by_cell(landings) | outcomes_by_cell(landings, pooled=True)
    extremes = _extremes(landings) | _extremes(landings, pooled=True)
    for method in methods_of(landings):
        for key in _keys(counts, scenes, method):
            own, worst = counts[key], extremes.get(key, _NO_EXTREMES)
            otherwise = {k: n for k, n in outcomes[key].items() if k != LANDED}
            words = ", ".join(f"{name} {count}" for name, count in otherwise.items())
            line = [*cell_names(key), Cell(str(own.flights)), Cell(str(own.landed))]
            line += [Cell(words or MISSING), Cell(str(own.unsafe))]
            line += [Cell(MISSING if value is None else digits(value)) for value in worst]
            table.rows.append(line)
            table.numbers.setdefault(method, {})[key.scene or ALL_SCENES] = {
                "flights": own.flights,
                "landed": own.landed,
                "otherwise": otherwise,
                "unsafe": own.unsafe,
                **{
                    f"largest {column}": value / scale
                    for (_, column, scale), value in zip(_EXTREMES, worst, strict=True)
                    if value is not None
                },
            }
    table.notes = [
        "Unsafe touchdowns are counted whatever the outcome; the extremes are over the flights "
        "that landed. Bounce: how far the vehicle rose again after its first contact. "
        "Deceleration: its largest acceleration in any tick from the first contact on."
    ]
    return table


_Extremes = tuple[float | None, ...]
"""one value for each of `_EXTREMES`, in its unit; None without a number"""
_NO_EXTREMES: _Extremes = (None,) * len(_EXTREMES)


def _extremes(landings: Sequence[Row], *, pooled: bool = False) -> dict[CellKey, _Extremes]:
    """The largest values over the flights that landed."""
    columns = [column for _, column, _ in _EXTREMES]
    largest = largest_by_cell(landed_of(landings), columns, pooled=pooled)
    return {
        key: tuple(
            None if value is None else scale * value
            for value, (_, _, scale) in zip(found, _EXTREMES, strict=True)
        )
        for key, found in largest.items()
    }


def landing_sentences(rows: Sequence[Row]) -> list[str]:
    """Returns the landings of each method, compared with the paper where one of its methods flew,
    and the order by d_L."""
    landings = landings_of(rows)
    landed = landed_of(landings)
    counts, extremes = landings_by_cell(landings, pooled=True), _extremes(landings, pooled=True)
    found = {m[2]: estimates(landed, mean_of(m[2]), pooled=True) for m in _MEASURES}
    compare = flies_paper_methods(landings)
    lines = []
    for method in methods_of(landings):
        key = CellKey(method)
        lines.append(_share_text(counts[key], cell(landings, None, method)))
        lines += _extreme_sentences(method, extremes.get(key, _NO_EXTREMES))
        if compare:
            means = {column: by_method.get(key) for column, by_method in found.items()}
            lines += _comparison_sentences(method, means)
    return lines + _closest_sentences(landings, found["landing.target_offset_m"])


def _share_text(counts: LandingCounts, own: Sequence[Row]) -> str:
    """The share that landed, and the unsafe touchdowns, of the flights ``own`` of a method."""
    share = share_interval(counts.landed, counts.flights)
    low, high = 100.0 * (share.low or 0.0), 100.0 * (share.high or 0.0)
    line = (
        f"`{own[0]['estimator']}`: {counts.landed} of {counts.flights} flights landed "
        f"({100.0 * share.value:.0f} % [{low:.0f}, {high:.0f}])."
    )
    if unsafe := unsafe_of(own):
        named = (f"{row['scene']} seed {row['seed']}" for row in unsafe[:_NAMED])
        more = f" and {len(unsafe) - _NAMED} more" if len(unsafe) > _NAMED else ""
        return (
            f"{line} {len(unsafe)} touched ground that is {_unsafe_word(own)}: "
            f"{', '.join(named)}{more}."
        )
    return f"{line} None touched ground that is {_unsafe_word(own)}."


def _extreme_sentences(method: str, worst: _Extremes) -> list[str]:
    """The largest bounce, deceleration and tilt of a method, where they are known."""
    extremes = [
        f"{title.partition(' (')[0]} {digits(value)} {title.partition('(')[2].rstrip(')')}"
        for (title, _, _), value in list(zip(_EXTREMES, worst, strict=True))[2:]
        if value is not None
    ]
    return [f"`{method}`, the worst of its landings: {', '.join(extremes)}."] if extremes else []


def _comparison_sentences(method: str, means: Mapping[str, Estimate | None]) -> list[str]:
    """The means of a method compared with those that the paper prints."""
    beside = [
        _beside_the_paper(name, unit, measured, printed, method)
        for name, unit, column, printed in _MEASURES
        if printed and setting_of(column) is None and (measured := means[column]) is not None
    ]
    return [f"`{method}`: {'; '.join(beside)}."] if beside else []


def _beside_the_paper(
    name: str, unit: str, measured: Estimate, printed: dict[str, published.Published], method: str
) -> str:
    theirs = printed.get(method) or printed["zou2024"]
    whose = published.METHOD_NAMES.get(method, published.METHOD_NAMES["zou2024"])
    text = f"{name} {digits(measured.value)} {unit} {interval_text(measured)}".rstrip()
    return f'{text}, {theirs.value:g} printed for "{whose}"'


def _closest_sentences(landings: Sequence[Row], offsets: Mapping[CellKey, Estimate]) -> list[str]:
    """The order of the methods by d_L, where there is more than one."""
    ranked = sorted(
        (offset.value, key.method) for key, offset in offsets.items() if key.method != "oracle"
    )
    if len(ranked) < 2:
        return []
    order = ", then ".join(f"`{method}` ({digits(value)} m)" for value, method in ranked)
    line = f"Closest to the site, by mean d_L: {order}."
    if flies_paper_methods(landings):
        theirs = ", ".join(
            f"`{m}`" for m in sorted(published.LANDING_OFFSET_M, key=_printed_offset)
        )
        line += f" In the paper's Table 5 the order is {theirs}."
    return [line]


def _printed_offset(method: str) -> float:
    return published.LANDING_OFFSET_M[method].value


def offset_xy(row: Row) -> tuple[float, float] | None:
    """East and north of the first contact from the commanded spot, or from the committed site where
    none was commanded, metres; None where a position is missing."""
    spot = row.get("landing.commanded_xy_m") or row.get("landing.site_xy_m")
    contact = row.get("landing.touchdown_xy_m")
    if not spot or not contact or number(row, "landing.target_offset_m") is None:
        return None
    return float(contact[0] - spot[0]), float(contact[1] - spot[1])
