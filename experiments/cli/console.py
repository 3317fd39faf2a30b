"""Tables of commands on the terminal."""

from __future__ import annotations

import json
import math
import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from touchdown.experiments.config.slots import MODE_KEY, SLOTS
from touchdown.experiments.errors import visible
from touchdown.experiments.terminal import make_console, make_table

if TYPE_CHECKING:
    from rich.text import Text

    from touchdown.experiments.io.results import RunResult

_ROWS = (
    ("outcome", "outcome", "{}"),
    ("reason", "reason", "{}"),
    ("position error, mean", "position_error_m.mean", "{:.3f} m"),
    ("position error, max", "position_error_m.max", "{:.3f} m"),
    ("heading error", "position_error_m.yaw_deg", "{:.3f} deg"),
    ("tracking error E_tra", "trajectory_error_m", "{:.3f} m"),
    ("offset from the site d_L", "landing.target_offset_m", "{:.3f} m"),
    ("ground slope", "landing.slope_deg", "{:.2f} deg"),
    ("vertical speed", "landing.vertical_speed_mps", "{:.3f} m/s"),
    ("horizontal speed", "landing.horizontal_speed_mps", "{:.3f} m/s"),
    ("tilt at touchdown", "landing.tilt_deg", "{:.2f} deg"),
    ("ground class", "landing.class_true", "{}"),
    ("predicted class", "landing.class_predicted", "{}"),
    ("safe geometry", "landing.safe_geometry", "{}"),
    ("map levelness error", "map.levelness_error_deg.mean", "{:.2f} deg"),
    ("simulated time", "timing.sim_s", "{:.1f} s"),
    ("real-time factor", "timing.real_time_factor", "{:.2f}"),
)
_LAST_EVENTS, _FIRST_SITES = 5, 3
_STAGE_ORDER = ("world", "estimator", "mapper", "lander", "controller", "recorder", "referee")


def print_result(result: RunResult, out_dir: Path | None) -> None:
    """Prints the table of a flight and the paths of its files."""
    parts = {} if result.parts is None else result.parts.model_dump(exclude_none=True)
    titles = [
        result.scene, result.estimator, f"seed {result.seed}", result.profile,
        result.preset if result.preset != "whole" else None,
        *(f"{kind} {visible(name)}" for kind, name in parts.items()),
        None if result.wind_kmh is None else f"wind {result.wind_kmh:g} km/h",
        *map(visible, fault_texts(result)),
        *(visible(f"{key}={_value(value)}") for key, value in _other_settings(result)),
    ]  # fmt: skip
    rows: list[tuple[str, str | Text]] = []
    for label, path, form in _ROWS:
        value = result.value(path)
        if path == "outcome":
            rows.append((label, _verdict(str(value), result.is_success)))
        elif isinstance(value, bool):
            rows.append((label, _yes(value)))
        elif value is not None and value != "":
            rows.append((label, form.format(value)))
    if remark := _remark(result):
        rows.append(("remark", remark))
    _print_facts(", ".join(filter(None, titles)), rows)
    lines = [*_print_choice(result), *condition_lines(result), *_last_events(result)]
    if out_dir is not None:
        lines.append(f"run directory: {out_dir}")
        if (out_dir / "flight.rrd").exists():
            program = "touchdown" if shutil.which("touchdown") else f"{sys.executable} -m touchdown"
            lines.append(f"recording:     {out_dir / 'flight.rrd'}")
            lines.append(f"view it:       {program} view {out_dir}")
    _print_lines(lines)


def _other_settings(result: RunResult) -> Iterator[tuple[str, Any]]:
    """What was set and has no words of its own in the title."""
    told = {slot.key for slot in SLOTS.values()} | {"wind.mean_kmh", "faults.events", MODE_KEY}
    settings = result.settings_set or {}
    return ((key, value) for key, value in settings.items() if key not in told)


def _value(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _print_facts(title: str, rows: Iterable[tuple[str, str | Text]]) -> None:
    from rich.table import Table

    table = Table(title=title, show_header=False, title_justify="left", min_width=52)
    table.add_column(style="dim")
    table.add_column(justify="right")
    for row in rows:
        table.add_row(*row)
    make_console().print(table)


def _print_lines(lines: Iterable[str]) -> None:
    console = make_console()
    for line in lines:
        console.print(line, soft_wrap=True)


def _verdict(text: str, good: bool) -> Text:
    from rich.text import Text

    return Text(visible(text), style=f"bold {'green' if good else 'red'}")


def _yes(value: bool) -> str:
    return "yes" if value else "no"


def _print_choice(result: RunResult) -> list[str]:
    """Prints the first candidates of the last decision; returns why the first one won."""
    choice = result.choice
    if choice is None:
        return []
    heads = ("", "x, y (m)", "score", "slope", "clearance", "ground", "rule")
    title = f"candidate sites, selector {choice.selector}"
    table = make_table(title, *heads, left=("ground", "rule"))
    for site in choice.candidates[:_FIRST_SITES]:
        position, ground = site.position_m, site.class_predicted
        table.add_row(
            str(site.rank),
            "-" if position is None else f"{position[0]:.1f}, {position[1]:.1f}",
            _figure("{:.3f}", site.value),
            _figure("{:.1f} deg", site.slope_deg),
            _figure("{:.1f} m", site.clearance_m),
            "-" if ground is None else f"{ground} {_figure('{:.2f}', site.class_probability)}",
            site.rule.replace("_", " "),
        )
    if choice.candidates:
        make_console().print(table)
    lines = [choice.why]
    if choice.missed is not None:
        lines.append(f"missed: {choice.missed.sentence()}")
    for earlier in choice.earlier:
        end = f"given up: {earlier.given_up}" if earlier.given_up else earlier.why
        lines.append(f"before, at {earlier.time_s:.1f} s: {end}")
    return lines


def _figure(form: str, value: float | None) -> str:
    return "-" if value is None else form.format(value)


def fault_texts(result: RunResult) -> list[str]:
    """The faults that were flown, or given to a replay, as they were asked for."""
    return [str(fault["fault"]) for fault in result.faults if "fault" in fault]


def _remark(result: RunResult) -> str:
    """Remark on a touchdown on risky ground that is judged by geometry alone; "" elsewhere."""
    from touchdown.scenes.api import RISKY_CLASSES

    kind = None if result.landing is None else result.landing.class_true
    if kind not in RISKY_CLASSES or result.classifier != "off":
        return ""
    return f"a {kind} is risky ground; ground classification was off"


def condition_lines(result: RunResult) -> list[str]:
    """One line for each condition of a flight; those that did not happen begin with ``warning``."""
    return [
        ("" if one.get("happened") is True else "warning: did not happen: ")
        + visible(one.get("text", one.get("name")))
        for one in result.conditions
    ]


def _last_events(result: RunResult) -> list[str]:
    """The last messages of the estimator of a flight that diverged."""
    events = result.events
    if result.outcome != "DIVERGED" or not events:
        return []
    count, kept = result.event_count or len(events), len(events)
    which = "the last" if count <= kept else f"the last of the first {kept}"
    lines = [f"{event.time_s:6.1f} s  {event.text}" for event in events[-_LAST_EVENTS:]]
    return [f"{which} of {count} messages of {result.estimator}:", *lines]


def print_stages(result: RunResult) -> None:
    """Prints the real-time factor and the wall time of each stage."""
    timing = result.plain()["timing"]
    stages: dict[str, float] = dict(timing["stage_ms"])
    total = 100.0 / timing["real_time_factor"]
    title = f"{result.scene}, {result.estimator}, per 0.1 s of flight"
    table = make_table(title, "stage", "ms", "fraction")
    for name in sorted(stages, key=_STAGE_ORDER.index):
        table.add_row(name, f"{stages[name]:.1f}", f"{stages[name] / total:.0%}")
    rest = total - sum(stages.values())
    table.add_row("rest of the loop", f"{rest:.1f}", f"{rest / total:.0%}")
    table.add_section()
    table.add_row("all", f"{total:.1f}", "100%")
    console = make_console()
    console.print(table)
    console.print(f"real-time factor {timing['real_time_factor']:.2f} ({timing['sim_s']:.1f} s)")
    console.print(f"drawn by {result.renderer or 'nothing'}")


def print_margins(figures: Mapping[str, Any]) -> None:
    heads = ("gain (dB)", "phase (deg)", "crossover (rad/s)")
    table = make_table("loop margins", "loop", *heads)
    for row in figures["loops"]:
        table.add_row(
            row["name"],
            f"{row['gain_margin_db']:.1f}",
            f"{row['phase_margin_deg']:.0f}",
            f"{row['crossover_rad_s']:.2f}",
        )
    make_console().print(table)


def print_scene_check(rows: Sequence[Mapping[str, Any]]) -> None:
    """Prints a row per scene: seeds that build, difference of the two most alike, safe ground."""
    heads = ("built", "closest", "height", "class", "grey", "safe ground", "s a seed")
    table = make_table("seeds of each scene", "scene", *heads)
    notes = []
    for row in rows:
        pair = row["closest"] or {"seeds": [], "height_m": 0.0, "class_fraction": 0.0, "grey": 0.0}
        low, middle = row["safe_fraction_min"] or 0.0, row["safe_fraction_median"] or 0.0
        table.add_row(
            row["scene"],
            f"{row['built']} of {row['built'] + len(row['failed'])}",
            ", ".join(str(seed) for seed in pair["seeds"]) + ("" if row["differ"] else " SAME"),
            f"{pair['height_m']:.2f} m",
            f"{pair['class_fraction']:.1%}",
            f"{pair['grey']:.1f}",
            f"{low:.1%}, {middle:.1%}",
            f"{row['seconds_per_seed']:.1f}",
        )
        if row["without_safe_site"]:
            seeds = ", ".join(str(seed) for seed in row["without_safe_site"])
            notes.append(f"{row['scene']}: no safe site in the surveyed area in seeds {seeds}")
        notes += [f"{row['scene']} seed {seed}: {why}" for seed, why in row["failed"].items()]
    console = make_console()
    console.print(table)
    console.print(
        "closest: the two most alike seeds, their mean absolute difference in height, fraction of "
        "cells of another class, mean absolute difference of the images from above (of 255); "
        "safe ground: least and median fraction of the area seen",
        style="dim",
    )
    _print_lines(notes)


def _origin_row(origin_m: Sequence[float]) -> list[tuple[str, str]]:
    """Where the world's origin lies in a file that counts from elsewhere."""
    if not any(origin_m):
        return []
    return [("origin in the file", ", ".join(f"{value:.1f}" for value in origin_m) + " m")]


def _some(names: Sequence[str], maximum: int = 4) -> str:
    """The first names of what may be hundreds, as of a terrain of boxes; ``--json`` has all."""
    more = [f"{len(names) - maximum} more"] if len(names) > maximum else []
    return ", ".join([*names[:maximum], *more]) or "none"


def _guessed_rows(guessed: Iterable[tuple[str, str, str]]) -> list[tuple[str, str]]:
    """A row for each class and reason."""
    names: dict[str, list[str]] = {}
    for name, kind, why in guessed:
        names.setdefault(f"{kind} ({why})", []).append(name)
    return [(f"guessed: {_some(found)}", guess) for guess, found in names.items()]


def print_place(row: Mapping[str, Any]) -> None:
    """Prints the facts of an imported scene, its problems and remarks."""
    facts, usable = row["facts"], not row["problems"]
    x, y = facts["takeoff_xy_m"]
    _print_facts(row["place"], [
        ("can be flown", _verdict(_yes(usable), usable)),
        ("take-off", f"{x:.1f}, {y:.1f} m, heading {facts['takeoff_yaw_deg']:.0f} deg"),
        *_origin_row(facts["origin_m"]),
        ("ground at take-off", f"{facts['takeoff_geom']} ({facts['takeoff_class']})"),
        ("height above surroundings", f"{facts['takeoff_above_m'] + 0.0:.1f} m"),
        ("take-off point is safe to land on", _yes(facts["takeoff_safe"])),
        ("ground under the legs", f"{facts['legs_fraction']:.0%}"),
        ("ground in the surveyed view", f"{facts['seen_fraction']:.0%}"),
        ("highest below the legs", f"{facts['highest_m'] + 0.0:.1f} m"),
        ("safe ground", f"{facts['safe_fraction']:.0%} of the surveyed view"),
        (
            "safe but for its class",
            f"{facts['safe_geometry_fraction'] - facts['safe_fraction']:.0%}",
        ),
        ("geoms without a class", _some(facts["without_class"])),
        ("seen, but not touched", _some(facts["untouchable"])),
        ("dressed ground", _some(facts["dressed"])),
        *_guessed_rows(facts["guessed"]),
    ])  # fmt: skip
    _print_lines(f"{kind[:-1]}: {text}" for kind in ("problems", "remarks") for text in row[kind])


def print_calibration(report: Mapping[str, Any]) -> None:
    """Prints the errors of a calibration beside its stated standard deviations."""
    error, sigma = report["error"], report["stated_sigma"]
    views, agreed = report["views"], report["consistency"]["consistent"]
    title = f"{views['used']} of {views['given']} views used"
    table = make_table(title, "", "error", "stated sigma")
    table.add_row(
        "rotation of the LIDAR",
        f"{error['rotation_deg']:.4f} deg",
        f"{math.hypot(*sigma['rotation_deg']):.4f} deg",
    )
    table.add_row(
        "position of the LIDAR",
        f"{1e3 * error['translation_m']:.2f} mm",
        f"{1e3 * math.hypot(*sigma['translation_m']):.2f} mm",
    )
    spreads = zip(error["camera_percent"].items(), sigma["camera_px"], strict=True)
    for (name, percent), spread in spreads:
        table.add_row(name, f"{percent:+.3f} %", f"{spread:.2f} px")
    make_console().print(table)
    refused = views["refused"].items()
    _print_lines(f"view {int(number) + 1} not used: {why}" for number, why in refused)
    _print_lines([f"error and covariance agree: {_yes(agreed)}", f"written: {report['file']}"])


def print_scores(report: Mapping[str, Any]) -> None:
    """Prints the scores of the edge detector beside those of Canny."""
    from touchdown.experiments.edges.scores import DETECTOR_LABELS

    heads = ("ODS", "OIS", "AP", "precision", "recall")
    table = make_table(f"{report['pictures']} pictures", "", *heads)
    for name, row in report["detectors"].items():
        table.add_row(DETECTOR_LABELS.get(name, name), *(f"{value:.3f}" for value in row.values()))
    make_console().print(table)
    blur, threshold = (report["canny_setting"][key] for key in ("sigma_px", "threshold"))
    _print_lines(
        [
            f"Canny at its best: blur {blur:.1f} px, threshold {threshold:.0f}",
            f"ODS above Canny's: {report['ods_above_canny']:+.3f}",
        ]
    )
