"""Tables of a reproduction from other sources than campaigns: our values beside the paper's."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import fmean, stdev
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
_STEP_TITLES = {"places": "ground classification"}
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
            Cell("position of the LIDAR (mm)", kind="name"),
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
    """Fig. 11: safety of the chosen site on the true map, by scene."""
    verdicts = {True: "safe", False: "unsafe", None: "none chosen"}
    rows = [
        [
            name_cell(check["scene"]),
            Cell(verdicts[check["chosen_safe"]]),
            Cell(f"{check['accepted_safe']} of {check['accepted']}"),
        ]
        for check in figures["places"]
    ]
    header = ["scene", "chosen site", "safe among the accepted"]
    return Table("sites", "The sites, by the true map", header, rows)


def speed_table(figures: Figures) -> Table:
    """Table 7: milliseconds of each step."""
    ours = dict(figures["stage_ms"])
    classifier = figures.get("classifier_ms", {})
    ours["places"] = classifier.get("ten_patches")
    ours["total"] = classifier.get("selection", ours["selection"])
    reference = figures.get("reference_ms", {})
    rows = []
    steps = ("down_sampling", "flatness", "smoothness", "distance", "clustering", "places", "total")
    for step in steps:
        printed = STEP_TIMES.get(step)
        text = MISSING if printed is None else f"{printed.mean:g} ± {printed.spread:g}"
        name = _STEP_TITLES.get(step, step.replace("_", " "))
        name += "" if printed is None else f' ("{printed.name}")'
        rows.append(
            [Cell(name, kind="name"), _number(ours.get(step)), _number(reference.get(step))]
            + [_printed(text)]
        )
    other = "the reference implementation uses Open3D, SciPy and scikit-image"
    if not reference:
        other = "the reference implementation was left out: it needs scikit-image (extra `bench`)"
    notes = [
        f"Milliseconds, medians on the map of a whole survey of {figures['scene']}, "
        f"{figures['cells'][0]} x {figures['cells'][1]} cells, one thread; {other}. The paper's "
        "times are of an NVIDIA NX."
    ]
    if classifier:
        notes.append(
            f"Ground classification: ten patches on {figures['classifier_threads']} threads; "
            f"total: a whole decision with {figures['classified_sites']} sites classified."
        )
    else:
        notes.append(
            "No network comes with this copy, so ground classification is not timed, and the total "
            "is a decision by geometry alone."
        )
    numbers = {step: value for step in steps if (value := ours.get(step)) is not None}
    header = ["step", "here (ms)", "reference (ms)", _PRINTED]
    return Table("table7", "Table 7: time of site selection", header, rows, notes, numbers)


def network_tables(networks: Sequence[Figures]) -> list[Table]:
    """Tables 3 and 4, of the first training of each network under each label scheme."""
    first = min((one.get("seed", 0) for one in networks), default=0)
    once = [one for one in networks if one.get("seed", 0) == first]
    return [_table_3(once), _table_4(once)]


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
        "Table 3: networks on the validation images",
        ["network", "labels", "images", *_score_header()],
        rows,
        ["F1 and recall are means over the classes that occur; top-1 with Wilson's 95 % interval."],
        numbers,
    )


def _table_4(networks: Sequence[Figures]) -> Table:
    rows, numbers = [], {}
    header = ["network", "images"]
    for title in ("ROM (MB)", "peak RAM (MB)", "time per image (s)"):
        header += [title, _PRINTED]
    for one in networks:
        if one["labels"] != "d_land":
            continue
        found, (cost, scores) = one["test"], TEST[one["network"]]
        line = [name_cell(one["network"]), Cell(str(found["pictures"]))]
        image_s = None if "image_ms" not in found else 1e-3 * found["image_ms"]
        for ours, printed in (
            (found["rom_mb"], cost.rom_mb),
            (found.get("peak_ram_mb"), cost.ram_mb),
            (image_s, cost.run_s),
        ):
            line += [_number(ours), _printed(f"{printed:g}")]
        rows.append([*line, *_score_cells(found, scores)])
        numbers[one["network"]] = found
    missing = [name for name in NETWORK_NAMES if name not in numbers]
    notes = [
        "Time and memory here: one thread of a processor, ONNX Runtime, float16 weights; the "
        "paper's are of an NVIDIA NX. The paper prints ROM and RAM without a gap; RAM is read with "
        "three digits before the point."
    ]
    if missing:
        notes.append(f"Not trained here: {', '.join(missing)}.")
    return Table("table4", "Table 4: networks on the test images, D_Land",
                 [*header, *_score_header()], rows, notes, numbers)  # fmt: skip


def claim_table(networks: Sequence[Figures]) -> Table:
    """What the paper claims of its networks, as differences of top-1 on the test images: D_Land
    over D_Scene by network, CBAM over none by seed, each with the mean's 95 % interval."""
    first = min(one["seed"] for one in networks)
    top1 = {(o["network"], o["labels"], o["seed"]): float(o["test"]["top1"]) for o in networks}
    names = [name for name in NETWORK_NAMES if (name, "d_land", first) in top1]
    by_labels = [
        top1[name, "d_land", first] - top1[name, "d_scene", first]
        for name in names
        if (name, "d_scene", first) in top1
    ]
    seeds = sorted({seed for name, _, seed in top1 if name == "resnet50_cbam"})
    by_block = [
        top1["resnet50_cbam", "d_land", seed] - top1["resnet50", "d_land", seed]
        for seed in seeds
        if ("resnet50", "d_land", seed) in top1
    ]
    rows, numbers = [], {}
    for key, title, found in (
        ("d_land", "D_Land over D_Scene, nine networks", by_labels),
        ("cbam", "ResNet50 with CBAM over ResNet50, D_Land, by seed", by_block),
    ):
        if len(found) < 2:
            continue
        mean, half = fmean(found), _half_width(found)
        numbers[key] = {"differences": found, "mean": mean, "half_width": half}
        rows.append([
            Cell(title, kind="name"), Cell(str(len(found))), Cell(f"{mean:+.3f}"),
            Cell(f"{mean - half:+.3f} to {mean + half:+.3f}"),
            Cell(", ".join(f"{value:+.3f}" for value in found)),
        ])  # fmt: skip
    header = ["difference of top-1", "pairs", "mean", "95 % interval", "each"]
    notes = ["Test images; the interval is Student's of the mean of the pairs."]
    return Table("claims", "Label scheme and attention", header, rows, notes, numbers)


def _half_width(values: Sequence[float]) -> float:
    from scipy.stats import t

    return float(t.ppf(0.975, len(values) - 1)) * stdev(values) / math.sqrt(len(values))
