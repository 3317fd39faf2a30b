"""What a report says of flights, it says again.

Planted flights of four campaigns; `reports/` has what their reports say. After a wanted change
``PYTHONPATH=tests python tests/experiments/reporting/test_reports_stay.py`` writes them anew: read
the difference.
"""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest

from touchdown.experiments.reporting import published
from touchdown.experiments.reporting.report import Report, as_json, make_report, markdown

from support.marks import check, write

FOLDER = Path(__file__).with_name("reports")
NUMBERS = FOLDER / "numbers.json"
CONSTRAINTS = Path(__file__).parents[3].joinpath("constraints.txt").read_text(encoding="utf-8")
FIGURES = (
    "position_error_m.mean", "position_error_m.max", "position_error_m.x", "position_error_m.y",
    "position_error_m.z", "position_error_m.yaw_deg", "trajectory_error_m",
    "trajectory_variance_m2", "nees.median", "nees.below_14_2", "map.duration_s",
    "map.density_per_m2", "map.levelness_error_deg.mean", "map.levelness_error_deg.max",
    "timing.wall_s", "timing.real_time_factor", "landing.target_offset_m",
    "landing.vertical_speed_mps", "landing.vertical_accel_mps2", "landing.slope_deg",
    "landing.tilt_deg", "landing.bounce_m", "landing.impact_peak_mps2",
    "landing.obstacle_distance_m", "landing.estimate_error_at_commit_m",
    "landing.estimate_error_at_contact_m", "path_deviation.x", "path_deviation.y",
    "path_deviation.z", "path_deviation.yaw_deg",
)  # fmt: skip
SCALES = {name: 0.05 * 1.37 ** (n % 11) for n, name in enumerate(FIGURES)}
CLASSES = ("lawn", "path", "road", "lawn", "field", "trees")

Rows = list[dict[str, Any]]


def flight(
    scene: str, method: str, seed: int, condition: str = "", *, worse: float = 1.0, **more: Any
) -> dict[str, Any]:
    """A flight with figures drawn from its name: one of nine is lost, one of seven is unsafe."""
    rng = np.random.default_rng([seed, len(scene), len(method), len(condition)])
    name = f"{scene}-{method}-s{seed}"
    lost, safe = rng.random() < 1 / 9, rng.random() > 1 / 7
    figures = {key: float(worse * scale * rng.gamma(4.0)) for key, scale in SCALES.items()}
    figures["nees.below_14_2"] = float(rng.uniform(0.8, 1.0))
    told: dict[str, Any] = {
        "run_id": f"{name}-{condition}" if condition else name, "run_dir": "", "scene": scene,
        "seed": seed, "estimator": method, "mode": "land", "wind_kmh": 12.0, "profile": "field",
        "unit": f"{scene}, seed {seed}", "git_revision": "0123abc", "versions.touchdown": "1.0.0",
        "outcome": ("DIVERGED", "COLLIDED", "TIMEOUT")[seed % 3] if lost else "LANDED",
        "reason": "the estimate is 20.1 m off" if lost else "ground contact: motors off",
        "success": not lost and safe, "ground_safe": safe, "go_arounds": float(seed % 3 == 1),
        "landing.safe_geometry": safe, "landing.safe": safe,
        "landing.class_true": CLASSES[seed % 6], "landing.class_predicted": CLASSES[seed % 4],
    }  # fmt: skip
    if lost:
        figures = {key: one for key, one in figures.items() if not key.startswith("landing.")}
        told |= {"ground_safe": None, "landing.safe_geometry": None, "landing.safe": None}
    return told | figures | more


def methods() -> Rows:
    levels = {"livo": 0.6, "zou2024": 1.0, "gps": 4.0, "hybrid_flow": 3.0}
    return [
        flight(scene, method, seed, worse=level)
        for scene in ("crossroad", "lake", "forest")
        for method, level in levels.items()
        for seed in range(6)
    ]


def selectors() -> Rows:
    return [
        flight("lake", "livo", seed, name, worse=worse)
        for name, worse in (("risk", 1.0), ("flat", 1.8), ("mine", 1.05))
        for seed in range(9)
    ]


def intruders() -> Rows:
    """Somebody comes in three of four flights, and is answered in most of them."""
    rows = []
    for seed in range(16):
        rng, somebody = np.random.default_rng(seed), seed % 4 > 0
        hit = seed == 6
        rows.append(flight(
            "houses", "livo", seed, "somebody" if somebody else "nobody",
            **{
                "events": "DESCEND site_not_clear: a dog" if seed % 5 != 3 and somebody else "",
                "faults": "['intruder@5m']" if somebody else "[]",
                "intrusion.avoidable": (seed % 7 != 2) if somebody else None,
                "intrusion.reaction_s": float(rng.gamma(1.0, 0.4)) if seed % 5 != 3 and somebody
                else None,
                "landing.nearest_person_m": float(rng.uniform(1.5, 12.0)) if somebody else None,
            },
            **({"outcome": "COLLIDED", "reason": "rotor touched traffic/intruder_0_dog in DESCEND",
                "success": False} if hit else {}),
        ))  # fmt: skip
    return rows


def dial() -> Rows:
    """Landings that wind makes unsafe, at 30 and at 40 km/h one half of them."""
    rows = []
    for method, half_at in (("livo", 40.0), ("gps", 30.0)):
        rng = np.random.default_rng(len(method))
        for seed in range(12):
            for wind in (0.0, 10.0, 20.0, 30.0, 40.0, 50.0):
                safe = bool(rng.random() < 1.0 / (1.0 + np.exp(0.25 * (wind - half_at))))
                rows.append(flight(
                    "lake", method, seed, f"w{wind:g}", worse=1.0 + 0.02 * wind, outcome="LANDED",
                    wind_kmh=wind, success=safe, ground_safe=safe,
                ))  # fmt: skip
    return rows


def plan(name: str, axes: str) -> str:
    return f'name = "{name}"\n[axes]\nscene = ["lake"]\nseeds = "0-8"\n{axes}\n'


def reported(
    rows: Callable[[], Rows], title: str, configuration: str = "", **more: Any
) -> Callable[[], Report]:
    return lambda: make_report(rows(), title=title, configuration=configuration, **more)


REPORTS: Mapping[str, Callable[[], Report]] = {
    "methods": reported(methods, "Four methods"),
    "paper": reported(methods, "Four methods as the paper tells of them", paper=True),
    "selectors": reported(
        selectors, "Three selectors", plan("selectors", 'selector = ["risk", "flat", "mine"]'),
        first="risk",
    ),
    "intruders": reported(intruders, "Who came"),
    "dial": reported(
        dial, "Wind", plan("wind", "wind_kmh = { from = 0, to = 50, steps = 6 }")
    ),
}  # fmt: skip


def drawn(report: Report) -> dict[str, list[float]]:
    """The numbers of each picture: places, lengths and widths."""
    pictures = [picture for section in report.sections for picture in section.pictures]
    return {one.name: [float(n) for n in re.findall(r"-?\d+\.\d+", one.svg)] for one in pictures}


def published_figures() -> dict[str, Any]:
    return {name: value for name, value in vars(published).items() if name.isupper()}


def test_the_papers_figures_stay() -> None:
    check(NUMBERS, "published", published_figures(), {})


@pytest.mark.parametrize("name", REPORTS)
def test_a_report_says_what_it_said(name: str) -> None:
    report = REPORTS[name]()
    assert markdown(report) == (FOLDER / f"{name}.md").read_text(encoding="utf-8")
    check(NUMBERS, name, {"numbers": as_json(report, [])}, {})
    if f"matplotlib=={matplotlib.__version__}\n" in CONSTRAINTS:  # another one draws otherwise
        check(NUMBERS, f"{name}, drawn", drawn(report), {})


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    made = {each: make() for each, make in REPORTS.items()}
    for each, told in made.items():
        (FOLDER / f"{each}.md").write_text(markdown(told), encoding="utf-8")
    parts = {each: {"numbers": as_json(told, [])} for each, told in made.items()}
    pictures = {f"{each}, drawn": drawn(told) for each, told in made.items()}
    write(NUMBERS, parts | pictures | {"published": published_figures()})
