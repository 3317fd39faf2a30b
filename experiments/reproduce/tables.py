"""Tables of a reproduction that no campaign of flights gives: ours beside the paper's."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from touchdown.experiments.reporting.published_networks import (
    NETWORK_NAMES,
    STEP_TIMES,
    TEST,
    VALIDATION,
    Scores,
)
from touchdown.experiments.reporting.tables import MISSING, Cell, Table, digits, name_cell

Figures = Mapping[str, Any]

_PRINTED = "paper prints"
_SCORES = (("loss", "loss"), ("macro_f1", "F1"), ("recall", "recall"), ("top1", "top-1"))


def _printed(text: str) -> Cell:
    return Cell(text, kind="published")


def _number(value: float | None) -> Cell:
    return Cell(MISSING if value is None else digits(value))


def calibration_table(report: Figures) -> Table:
    """Errors of a calibration beside the standard deviations that it states."""
    error, sigma = report["error"], report["stated_sigma"]
    rows = [
        [
            Cell("rotation of the LIDAR (°)", kind="name"),
            _number(error["rotation_deg"]),
            _number(math.hypot(*sigma["rotation_deg"])),
        ],
        [
            Cell("its place (mm)", kind="name"),
            _number(1e3 * error["translation_m"]),
            _number(1e3 * math.hypot(*sigma["translation_m"])),
        ],
    ]
    rows += [
        [Cell(f"{name} (%)", kind="name"), _number(percent), Cell(MISSING)]
        for name, percent in error["camera_percent"].items()
    ]
    views = report["views"]
    agree = "agree" if report["consistency"]["consistent"] else "do not agree"
    return Table(
        "calibration",
        "Errors of the calibration",
        ["what", "error", "stated σ"],
        rows,
        [f"{views['used']} of {views['given']} views used. Errors and covariance {agree}."],
        {"error": error, "consistent": report["consistency"]["consistent"]},
    )


def rig_table(facts: Figures) -> Table:
    """Table 2: the vehicle and its sensors."""
    width, height = facts["camera_px"]
    across, down = facts["camera_deg"]
    rows = [
        ("mass", f"{facts['mass_kg']:.2f} kg"),
        ("radius that holds rotors and legs", f"{facts['footprint_radius_m']:.2f} m"),
        ("LIDAR", f"Livox {facts['lidar'].capitalize()}, {facts['lidar_scan_hz']:g} scans/s"),
        ("camera", f"{width} x {height} pixels, {across:g}° x {down:g}°, straight down"),
        ("IMU", f"{facts['imu_hz']:g} Hz"),
    ]
    return Table(
        "rig",
        "The vehicle and its sensors",
        ["what", "here"],
        [[Cell(name, kind="name"), Cell(value)] for name, value in rows],
        ["The paper flies a Livox Horizon and a RealSense camera as well."],
    )


def site_table(figures: Figures) -> Table:
    """The places of Fig. 11: safety of the chosen sites by the true map."""
    words = {True: "safe", False: "unsafe", None: "none chosen"}
    rows = [
        [
            name_cell(place["scene"]),
            Cell(words[place["chosen_safe"]]),
            Cell(f"{place['accepted_safe']} of {place['accepted']}"),
        ]
        for place in figures["places"]
    ]
    header = ["scene", "the site", "safe among the accepted"]
    return Table("sites", "The sites, by the true map", header, rows)


def speed_table(figures: Figures) -> Table:
    """Table 7: milliseconds of each step."""
    ours = dict(figures["stage_ms"])
    places = figures.get("classifier_ms", {})
    ours["places"] = places.get("ten_patches")
    ours["total"] = places.get("selection", ours["selection"])
    theirs = figures.get("reference_ms", {})
    rows = []
    steps = ("down_sampling", "flatness", "smoothness", "distance", "clustering", "places", "total")
    for step in steps:
        printed = STEP_TIMES.get(step)
        text = MISSING if printed is None else f"{printed.mean:g} ± {printed.spread:g}"
        name = step.replace("_", " ") + ("" if printed is None else f' ("{printed.name}")')
        rows.append(
            [Cell(name, kind="name"), _number(ours.get(step)), _number(theirs.get(step))]
            + [_printed(text)]
        )
    other = "the other version is made of Open3D, SciPy and scikit-image"
    if not theirs:
        other = "the other version was left out: it needs scikit-image (extra `bench`)"
    notes = [
        f"Milliseconds, medians on the map of a whole survey of {figures['scene']}, "
        f"{figures['cells'][0]} x {figures['cells'][1]} cells, one thread; {other}. The paper's "
        "are of an NVIDIA NX.",
    ]
    if places:
        notes.append(
            f"Places: ten patches on {figures['classifier_threads']} threads; total: a whole "
            f"decision, {figures['classified_sites']} sites asked about."
        )
    else:
        notes.append(
            "No network comes with this copy, so places are not timed, and the total is a decision "
            "by geometry alone."
        )
    numbers = {step: value for step in steps if (value := ours.get(step)) is not None}
    header = ["step", "here (ms)", "of libraries (ms)", _PRINTED]
    return Table("table7", "Table 7: time of choosing a site", header, rows, notes, numbers)


def network_tables(networks: Sequence[Figures]) -> list[Table]:
    """Tables 3 and 4."""
    return [_table_3(networks), _table_4(networks)]


def _score_cells(found: Figures, printed: Scores) -> list[Cell]:
    cells = []
    for key, _ in _SCORES:
        low, high = found.get("top1_interval", (None, None))
        interval = f"[{low:.3f}, {high:.3f}]" if key == "top1" and low is not None else ""
        cells += [Cell(f"{found[key]:.3f}", interval), _printed(f"{getattr(printed, key):.3f}")]
    return cells


def _score_header() -> list[str]:
    return [title for _, name in _SCORES for title in (name, _PRINTED)]


def _table_3(networks: Sequence[Figures]) -> Table:
    rows, numbers = [], {}
    for one in networks:
        key = one["network"], one["labels"]
        head = [name_cell(one["network"]), Cell(one["labels"]), Cell(str(one["val"]["pictures"]))]
        rows.append([*head, *_score_cells(one["val"], VALIDATION[key])])
        numbers["-".join(key)] = one["val"]
    return Table(
        "table3",
        "Table 3: networks on the validation pictures",
        ["network", "labels", "pictures", *_score_header()],
        rows,
        ["F1 and recall are means over the classes that occur; top-1 with Wilson's 95 % interval."],
        numbers,
    )


def _table_4(networks: Sequence[Figures]) -> Table:
    rows, numbers = [], {}
    header = ["network", "pictures"]
    for title in ("ROM (MB)", "peak RAM (MB)", "time a picture (s)"):
        header += [title, _PRINTED]
    for one in networks:
        if one["labels"] != "d_land":
            continue
        found, (cost, scores) = one["test"], TEST[one["network"]]
        line = [name_cell(one["network"]), Cell(str(found["pictures"]))]
        image_s = None if "image_ms" not in found else 1e-3 * found["image_ms"]
        for ours, theirs in (
            (found["rom_mb"], cost.rom_mb),
            (found.get("peak_ram_mb"), cost.ram_mb),
            (image_s, cost.run_s),
        ):
            line += [_number(ours), _printed(f"{theirs:g}")]
        rows.append([*line, *_score_cells(found, scores)])
        numbers[one["network"]] = found
    missing = [name for name in NETWORK_NAMES if name not in numbers]
    notes = [
        "Time and memory here: one thread of a processor, ONNX Runtime, float16 weights; the "
        "paper's are of an NVIDIA NX. Its page runs ROM and RAM together: RAM is taken to have "
        "three digits before its point.",
    ]
    if missing:
        notes.append(f"Not trained here: {', '.join(missing)}.")
    return Table("table4", "Table 4: networks on the test pictures, D_Land",
                 [*header, *_score_header()], rows, notes, numbers)  # fmt: skip
