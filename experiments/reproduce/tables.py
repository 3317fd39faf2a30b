"""Tables of a reproduction from other sources than campaigns: our values beside the paper's."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from touchdown.experiments.reporting.published import (
    NETWORK_NAMES,
    STEP_TIMES,
    TEST,
    VALIDATION,
    Scores,
)
from touchdown.experiments.reporting.statistics import student_interval
from touchdown.experiments.reporting.tables import (
    PRINTED,
    Cell,
    Table,
    cell,
    name_cell,
)

Figures = Mapping[str, Any]

_SCORES = (("loss", "loss"), ("macro_f1", "F1"), ("recall", "recall"), ("top1", "top-1"))
"""Keys of the scores of a network, and their titles."""


def _line(name: str | Cell, *figures: Any) -> list[Cell]:
    """A line of a table: its name, and cells or figures."""
    head = Cell(name, kind="name") if isinstance(name, str) else name
    return [head, *(found if isinstance(found, Cell) else cell(found) for found in figures)]


def _printed(text: str) -> Cell:
    return Cell(text, kind="published")


def calibration_table(report: Figures) -> Table:
    """Errors of a calibration beside the standard deviations that it states."""
    error, sigma = report["error"], report["stated_sigma"]
    rows = [
        _line("rotation of the LIDAR (°)", error["rotation_deg"],
              math.hypot(*sigma["rotation_deg"])),
        _line("position of the LIDAR (mm)", 1e3 * error["translation_m"],
              1e3 * math.hypot(*sigma["translation_m"])),
        *(_line(f"{name} (%)", value, None) for name, value in error["camera_percent"].items()),
    ]  # fmt: skip
    views, consistent = report["views"], report["consistency"]["consistent"]
    agree = "agree" if consistent else "do not agree"
    return Table(
        "calibration",
        "Errors of the calibration",
        ["what", "error", "stated σ"],
        rows,
        [
            f"{views['used']} of {views['given']} views used. Errors are against the simulated "
            f"camera and LIDAR; they and the covariance {agree}."
        ],
        {"error": error, "consistent": consistent},
    )


def site_table(figures: Figures) -> Table:
    """Fig. 11: safety of the chosen site on the true map, by scene."""
    verdicts = {True: "safe", False: "unsafe", None: "none chosen"}
    rows = [
        _line(
            name_cell(check["scene"]),
            verdicts[check["chosen_safe"]],
            f"{check['accepted_safe']} of {check['accepted']}",
        )
        for check in figures["places"]
    ]
    header = ["scene", "chosen site", "safe among the accepted"]
    return Table("sites", "The sites, by the true map", header, rows)


def speed_table(figures: Figures) -> Table:
    """Table 7: milliseconds of each step."""
    ours = dict(figures["stage_ms"])
    classifier, reference = figures.get("classifier_ms", {}), figures.get("reference_ms", {})
    ours["places"] = classifier.get("ten_patches")
    ours["total"] = classifier.get("selection", ours["selection"])
    steps = ("down_sampling", "flatness", "smoothness", "distance", "clustering", "places", "total")
    rows = []
    for step in steps:
        title = "ground classification" if step == "places" else step.replace("_", " ")
        theirs = STEP_TIMES.get(step)
        name = title if theirs is None else f'{title} ("{theirs.name}")'
        text = "–" if theirs is None else f"{theirs.mean:g} ± {theirs.spread:g}"
        rows.append(_line(name, ours.get(step), reference.get(step), _printed(text)))
    other = "the reference implementation uses Open3D, SciPy and scikit-image"
    if not reference:
        other = "the reference implementation was left out: it needs scikit-image (extra `bench`)"
    last = "No network comes with this copy: the total is a decision by geometry alone."
    if classifier:
        last = (
            f"Ground classification: ten patches on {figures['classifier_threads']} threads; "
            f"total: a whole decision with {figures['classified_sites']} sites classified."
        )
    notes = [
        f"Milliseconds, medians on the map of a whole survey of {figures['scene']}, "
        f"{figures['cells'][0]} x {figures['cells'][1]} cells, one thread; {other}. The paper's "
        "times are of an NVIDIA NX.",
        last,
    ]
    numbers = {step: value for step in steps if (value := ours.get(step)) is not None}
    header = ["step", "here (ms)", "reference (ms)", PRINTED]
    return Table("table7", "Table 7: time of site selection", header, rows, notes, numbers)


def network_tables(networks: Sequence[Figures]) -> list[Table]:
    """Tables 3 and 4, of the first training of each network under each label scheme."""
    first = min((one.get("seed", 0) for one in networks), default=0)
    once = [one for one in networks if one.get("seed", 0) == first]
    return [_table_3(once), _table_4(once)]


def _score_cells(found: Figures, printed: Scores) -> list[Cell]:
    low, high = found.get("top1_interval", (None, None))
    interval = f"[{low:.3f}, {high:.3f}]" if low is not None else ""
    cells = []
    for key, _ in _SCORES:
        ours = Cell(f"{found[key]:.3f}", interval if key == "top1" else "")
        cells += [ours, _printed(f"{getattr(printed, key):.3f}")]
    return cells


_SCORE_HEADER = [title for _, name in _SCORES for title in (name, PRINTED)]


def _table_3(networks: Sequence[Figures]) -> Table:
    rows = [
        _line(
            name_cell(one["network"]),
            one["labels"],
            one["val"]["pictures"],
            *_score_cells(one["val"], VALIDATION[one["network"], one["labels"]]),
        )
        for one in networks
    ]
    return Table(
        "table3",
        "Table 3: networks on the validation images",
        ["network", "labels", "images", *_SCORE_HEADER],
        rows,
        ["F1 and recall are means over the classes that occur; top-1 with Wilson's 95 % interval."],
        {f"{one['network']}-{one['labels']}": one["val"] for one in networks},
    )


def _table_4(networks: Sequence[Figures]) -> Table:
    numbers = {one["network"]: one["test"] for one in networks if one["labels"] == "d_land"}
    rows = []
    for network, found in numbers.items():
        cost, scores = TEST[network]
        image_ms = found.get("image_ms")
        figures: list[Any] = []
        for ours, theirs in (
            (found["rom_mb"], cost.rom_mb),
            (found.get("peak_ram_mb"), cost.ram_mb),
            (None if image_ms is None else 1e-3 * image_ms, cost.run_s),
        ):
            figures += [ours, _printed(f"{theirs:g}")]
        rows.append(
            _line(name_cell(network), found["pictures"], *figures, *_score_cells(found, scores))
        )
    missing = [name for name in NETWORK_NAMES if name not in numbers]
    notes = [
        "Time and memory here: one thread of a processor, ONNX Runtime, float16 weights; the "
        "paper's are of an NVIDIA NX. The paper prints ROM and RAM without a gap; RAM is read with "
        "three digits before the point.",
        *([f"Not trained here: {', '.join(missing)}."] if missing else []),
    ]
    costs = ("ROM (MB)", "peak RAM (MB)", "time per image (s)")
    header = ["network", "images", *(title for name in costs for title in (name, PRINTED))]
    return Table("table4", "Table 4: networks on the test images, D_Land",
                 [*header, *_SCORE_HEADER], rows, notes, numbers)  # fmt: skip


def claim_table(networks: Sequence[Figures]) -> Table:
    """What the paper claims of its networks, as differences of top-1 on the test images: D_Land
    over D_Scene by network, CBAM over none by seed, each with the mean's 95 % interval."""
    first = min(one["seed"] for one in networks)
    top1 = {(o["network"], o["labels"], o["seed"]): float(o["test"]["top1"]) for o in networks}
    seeds = sorted({seed for name, _, seed in top1 if name == "resnet50_cbam"})
    pairs = {
        "d_land": [((name, "d_land", first), (name, "d_scene", first)) for name in NETWORK_NAMES],
        "cbam": [(("resnet50_cbam", "d_land", s), ("resnet50", "d_land", s)) for s in seeds],
    }
    titles = {
        "d_land": "D_Land over D_Scene, nine networks",
        "cbam": "ResNet50 with CBAM over ResNet50, D_Land, by seed",
    }
    rows, numbers = [], {}
    for key, both in pairs.items():
        found = [top1[a] - top1[b] for a, b in both if a in top1 and b in top1]
        if len(found) >= 2:
            mean = student_interval(found)
            numbers[key] = {"differences": found, **mean.as_json()}
            each = ", ".join(f"{value:+.3f}" for value in found)
            interval = f"{mean.low:+.3f} to {mean.high:+.3f}"
            rows.append(_line(titles[key], len(found), f"{mean.value:+.3f}", interval, each))
    header = ["difference of top-1", "pairs", "mean", "95 % interval", "each"]
    notes = ["Test images; the interval is Student's of the mean of the pairs."]
    return Table("claims", "Label scheme and attention", header, rows, notes, numbers)
