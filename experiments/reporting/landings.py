"""Landings: the paper's Tables 5 and 6, the table of touchdowns, and sentences."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
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
    outcome_counts,
    scenes_of,
    values,
)
from touchdown.experiments.reporting.statistics import Estimate, mean_interval, share_interval
from touchdown.experiments.reporting.tables import (
    MISSING,
    Cell,
    Table,
    digits,
    figure,
    interval_text,
    mean_of,
    name_cell,
    published_cell,
)
from touchdown.scenes.api import RISKY_CLASSES, SAFE_CLASSES

LANDED = "LANDED"
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
"""unsafe touchdowns that are named one by one"""


def landings_of(rows: Sequence[Row]) -> list[Row]:
    """The flights that were to land."""
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
    """All tables of landings; none where no flight was to land."""
    landings = landings_of(rows)
    if not landings:
        return []
    return [_table_5(landings), *_tables_6(landings), _safety_table(landings)]


def _groups(landings: Sequence[Row], method: str) -> list[tuple[str, list[Row]]]:
    """A method's flights by scene, and together where there are several scenes."""
    found = [(s, own) for s in scenes_of(landings) if (own := cell(landings, s, method))]
    if len(found) > 1:
        found.append(("all scenes", cell(landings, None, method)))
    return found


# --------------------------------------------------------------------------------- Tables 5 and 6


def _table_5(landings: Sequence[Row]) -> Table:
    titles = [f"{name} ({unit})" for name, unit, _, _ in _MEASURES]
    header = ["method", "scene", "landings", "landed", "safe", *titles]
    table = Table("landing", "Table 5: landings", header, [])
    flown = methods_of(landings)
    compared = flies_paper_methods(landings)
    printed_methods = published.LANDING_OFFSET_M if compared else ()
    others = [method for method in printed_methods if method not in flown]
    for method in (*flown, *others):
        printed = [published_cell(measure[3], method) for measure in _MEASURES]
        if compared and any(c.text != MISSING for c in printed):
            blanks = [Cell(MISSING, kind="published")] * 3
            where = Cell("paper prints", kind="published")
            table.rows.append([name_cell(method), where, *blanks, *printed])
        for scene, own in _groups(landings, method):
            landed = landed_of(own)
            safe = sum(touched_safe_ground(row) is True for row in landed)
            measured = [mean_of(measure[2])(landed) for measure in _MEASURES]
            line = [name_cell(method), Cell(scene, kind="name"), Cell(str(len(own)))]
            line += [_share(len(landed), len(own)), _share(safe, len(own))]
            table.rows.append([*line, *map(figure, measured)])
            table.numbers.setdefault(method, {})[scene] = {
                "landings": len(own),
                "landed": share_interval(len(landed), len(own)).as_json(),
                "safe": share_interval(safe, len(own)).as_json(),
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
    ]
    return table


def _share(hits: int, flights: int) -> Cell:
    share = share_interval(hits, flights)
    low, high = 100.0 * (share.low or 0.0), 100.0 * (share.high or 0.0)
    return Cell(f"{100.0 * share.value:.0f} %", f"[{low:.0f}, {high:.0f}]")


def _tables_6(landings: Sequence[Row]) -> list[Table]:
    """A table for each method that landed on one of the paper's five kinds of sites."""
    tables = []
    for method in methods_of(landings):
        own = [row for row in cell(landings, None, method) if row["scene"] in published.SITES]
        if own:
            tables.append(_table_6(own, method))
    return tables


def _table_6(own: Sequence[Row], method: str) -> Table:
    printed = "paper prints"
    header = ["scene", "landed", "obstacle distance (m)", printed, "level (°)", printed]
    header += ["v_z (m/s)", printed, "type of site", printed]
    table = Table(f"table6_{method}", f"Table 6: five kinds of sites, `{method}`", header, [])
    for scene, site in published.SITES.items():
        flights = cell(own, scene)
        if not flights:
            continue
        landed = landed_of(flights)
        line = [name_cell(scene), Cell(f"{len(landed)} of {len(flights)}")]
        numbers: dict[str, Any] = {"flights": len(flights), "landed": len(landed)}
        for key, value in (
            ("landing.obstacle_distance_m", site.obstacle_distance_m),
            ("landing.slope_deg", site.level_deg),
            ("landing.vertical_speed_mps", site.speed_mps),
        ):
            measured = mean_of(key)(landed)
            line += [figure(measured), Cell(f"{value:.2f}", kind="published")]
            if measured is not None:
                numbers[key] = measured.as_json()
        numbers["classes"] = dict(Counter(str(row.get("landing.class_true")) for row in landed))
        types = ", ".join(f"{_verdict(name)} {count}" for name, count in numbers["classes"].items())
        line += [Cell(types or MISSING), Cell(site.site_type, kind="published")]
        table.rows.append(line)
        table.numbers[scene] = numbers
    table.notes = [
        "Over the flights that landed. Obstacle distance: from the touchdown to the nearest thing "
        "that stands more than 0.25 m over the ground, 15 m where there is none so near. Level: "
        "slope of the true ground at the touchdown. Type: the true class of the ground there, with "
        "the number of landings. The paper's sites are real places, these are made to be alike.",
    ]
    return table


def _verdict(name: str) -> str:
    """A class with its safety in the paper."""
    kind = "safe" if name in SAFE_CLASSES else "risky" if name in RISKY_CLASSES else "unsafe"
    return f"{name} ({kind})"


# ----------------------------------------------------------------------------------- how they went


def _safety_table(landings: Sequence[Row]) -> Table:
    header = ["method", "scene", "flights", "landed", "otherwise", "unsafe touchdowns"]
    header += [f"largest {title}" for title, _, _ in _EXTREMES]
    table = Table("touchdowns", "How landings went, and the extremes", header, [])
    for method in methods_of(landings):
        for scene, own in _groups(landings, method):
            landed, unsafe = landed_of(own), unsafe_of(own)
            worst = [_largest(landed, key, scale) for _, key, scale in _EXTREMES]
            otherwise = {k: n for k, n in outcome_counts(own).items() if k != LANDED}
            words = ", ".join(f"{name} {count}" for name, count in otherwise.items())
            line = [name_cell(method), Cell(scene, kind="name"), Cell(str(len(own)))]
            line += [Cell(str(len(landed))), Cell(words or MISSING), Cell(str(len(unsafe)))]
            line += [Cell(MISSING if value is None else digits(value)) for value in worst]
            table.rows.append(line)
            table.numbers.setdefault(method, {})[scene] = {
                "flights": len(own),
                "landed": len(landed),
                "otherwise": otherwise,
                "unsafe": len(unsafe),
                **{
                    f"largest {key}": value / scale
                    for (_, key, scale), value in zip(_EXTREMES, worst, strict=True)
                    if value is not None
                },
            }
    table.notes = [
        "Unsafe touchdowns are counted whatever the outcome; the extremes are over the flights "
        "that landed. Bounce: how far the vehicle rose again after its first contact. "
        "Deceleration: its largest acceleration in any tick from the first contact on.",
    ]
    return table


def _largest(rows: Sequence[Row], key: str, scale: float) -> float | None:
    found = values(rows, key)
    return scale * max(found) if found else None


def landing_words(rows: Sequence[Row]) -> list[str]:
    """Per method: landings, beside those of the paper where it flew; then the order by d_L."""
    landings = landings_of(rows)
    lines = []
    for method in methods_of(landings):
        own = cell(landings, None, method)
        lines += _method_words(method, own, compare=flies_paper_methods(landings))
    return lines + _closest_words(landings)


def _method_words(method: str, own: Sequence[Row], *, compare: bool) -> list[str]:
    landed, unsafe = landed_of(own), unsafe_of(own)
    share = share_interval(len(landed), len(own))
    low, high = 100.0 * (share.low or 0.0), 100.0 * (share.high or 0.0)
    lines = [
        f"`{method}`: {len(landed)} of {len(own)} flights landed "
        f"({100.0 * share.value:.0f} % [{low:.0f}, {high:.0f}])."
    ]
    if unsafe:
        named = (f"{row['scene']} seed {row['seed']}" for row in unsafe[:_NAMED])
        more = f" and {len(unsafe) - _NAMED} more" if len(unsafe) > _NAMED else ""
        lines[0] += (
            f" {len(unsafe)} touched ground that is {_unsafe_word(own)}: {', '.join(named)}{more}."
        )
    else:
        lines[0] += f" None touched ground that is {_unsafe_word(own)}."
    extremes = [
        f"{title.partition(' (')[0]} {digits(worst)} {title.partition('(')[2].rstrip(')')}"
        for title, key, scale in _EXTREMES[2:]
        if (worst := _largest(landed, key, scale)) is not None
    ]
    if extremes:
        lines.append(f"`{method}`, the worst of its landings: {', '.join(extremes)}.")
    beside = [
        _beside_the_paper(name, unit, measured, printed, method)
        for name, unit, key, printed in _MEASURES
        if compare and printed and (measured := mean_interval(values(landed, key))) is not None
    ]
    if beside:
        lines.append(f"`{method}`: {'; '.join(beside)}.")
    return lines


def _beside_the_paper(
    name: str, unit: str, measured: Estimate, printed: dict[str, published.Published], method: str
) -> str:
    theirs = printed.get(method) or printed["paper"]
    whose = published.METHOD_NAMES.get(method, published.METHOD_NAMES["paper"])
    text = f"{name} {digits(measured.value)} {unit} {interval_text(measured)}".rstrip()
    return f'{text}, {theirs.value:g} printed for "{whose}"'


def _closest_words(landings: Sequence[Row]) -> list[str]:
    """The order of the methods by d_L, where there is more than one."""
    ranked = sorted(
        (found.value, method)
        for method in methods_of(landings)
        if method != "oracle"
        and (found := mean_of("landing.target_offset_m")(landed_of(cell(landings, None, method))))
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
    none was commanded, metres; None where the row does not say."""
    spot = row.get("landing.commanded_xy_m") or row.get("landing.site_xy_m")
    contact = row.get("landing.touchdown_xy_m")
    if not spot or not contact or number(row, "landing.target_offset_m") is None:
        return None
    return float(contact[0] - spot[0]), float(contact[1] - spot[1])
