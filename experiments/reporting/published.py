"""Published figures of Zou, Sun and Kong (2024), doi:10.3390/app14146079, by their tables."""

from collections.abc import Mapping
from typing import NamedTuple

SOURCE = (
    "C. Zou, Y. Sun, L. Kong: Unmanned Aerial Vehicle Landing on Rugged Terrain by On-Board "
    "LIDAR–Camera Positioning System. Applied Sciences 2024, 14(14), 6079, "
    "doi:10.3390/app14146079"
)

ANALYSED_SCENE = "crossroad"
"""the only scene that the paper analyses method by method (its section 5.1)"""

TRAJECTORY_ERROR_M = {
    "gps": 1.0112, "optical_flow": 2.0538, "hybrid_flow": 0.5193, "zou2024": 0.3671,
}  # fmt: skip
"""Table 2, E_tra: mean deviation of the flown path from the expected one."""
TRAJECTORY_VARIANCE_M2 = {
    "gps": 0.5083, "optical_flow": 1.5819, "hybrid_flow": 0.1828, "zou2024": 0.1568,
}  # fmt: skip
"""Table 2, variance of that deviation."""

SCAN_TIME_AND_DENSITY = "36.11111"
"""Table 1, T_total (s) and rho_map (points per square metre): the text runs the two numbers
together, and the position of the boundary is unknown."""

LEVELNESS_DEG: tuple[float, ...] = (1.19, 0.89, 0.96, 1.19)
"""Table 1, "±" in its scenes 1 to 4, which the text does not name."""

LEVELNESS_BOUND_DEG = 1.5
"""section 5.1: the bound that the paper states over all its scenes"""

LANDINGS: Mapping[str, Mapping[str, float]] = {
    "landing.target_offset_m": {
        "gps": 1.41, "optical_flow": 1.31, "hybrid_flow": 0.54, "zou2024": 0.41,
    },
    "landing.vertical_accel_mps2": {
        "gps": 0.21, "optical_flow": 0.18, "hybrid_flow": 0.15, "zou2024": 0.04,
    },
    "landing.slope_deg": {
        "gps": 3.11, "optical_flow": 2.36, "hybrid_flow": 1.83, "zou2024": 1.99,
    },
}  # fmt: skip
"""Table 5, by the column of our rows and method. Its v_z is not compared: ours is commanded."""


class PublishedSite(NamedTuple):
    """A column of Table 6."""

    obstacle_distance_m: float
    level_deg: float
    """the average level of site selection of the paper"""
    site_type: str


SITES: Mapping[str, PublishedSite] = {
    "turf": PublishedSite(4.52, 3.52, "Lawn (safe)"),
    "rooftop_parking": PublishedSite(2.12, 2.32, "Path (safe)"),
    "cottage": PublishedSite(1.58, 4.11, "Road (safe)"),
    "footbridge": PublishedSite(1.86, 2.45, "Road (risky)"),
    "pools": PublishedSite(4.33, 3.18, "Field (safe)"),
}
"""Table 6, five landings each, by the scene of this project that is of the same kind."""


NETWORK_NAMES: Mapping[str, str] = {
    "resnext50": "ResNeXt50",
    "vgg19": "Vgg19",
    "inception_v4": "GoogleNetV4",
    "mobilenet_v3_large": "MobileNetV3",
    "resnet18": "ResNet18",
    "resnet34": "ResNet34",
    "resnet50": "ResNet50",
    "resnet101": "ResNet101",
    "resnet50_cbam": "ResNet50+CBAM",
}
"""Networks of this project and the names that the paper's tables give to them, in its order."""


class Scores(NamedTuple):
    loss: float
    macro_f1: float
    recall: float
    top1: float


class Cost(NamedTuple):
    """Table 4 heads ROM and RAM with "Mb"."""

    rom_mb: float
    ram_mb: float
    run_s: float


VALIDATION: Mapping[tuple[str, str], Scores] = {
    ("resnext50", "d_scene"): Scores(0.417, 0.736, 0.732, 0.762),
    ("resnext50", "d_land"): Scores(0.362, 0.791, 0.782, 0.839),
    ("vgg19", "d_scene"): Scores(0.389, 0.768, 0.753, 0.776),
    ("vgg19", "d_land"): Scores(0.332, 0.811, 0.792, 0.832),
    ("inception_v4", "d_scene"): Scores(0.468, 0.681, 0.668, 0.756),
    ("inception_v4", "d_land"): Scores(0.402, 0.769, 0.706, 0.844),
    ("mobilenet_v3_large", "d_scene"): Scores(0.437, 0.703, 0.671, 0.754),
    ("mobilenet_v3_large", "d_land"): Scores(0.384, 0.775, 0.742, 0.821),
    ("resnet18", "d_scene"): Scores(0.521, 0.621, 0.548, 0.703),
    ("resnet18", "d_land"): Scores(0.469, 0.714, 0.625, 0.769),
    ("resnet34", "d_scene"): Scores(0.491, 0.695, 0.683, 0.714),
    ("resnet34", "d_land"): Scores(0.412, 0.743, 0.714, 0.801),
    ("resnet50", "d_scene"): Scores(0.441, 0.686, 0.674, 0.737),
    ("resnet50", "d_land"): Scores(0.356, 0.813, 0.808, 0.829),
    ("resnet101", "d_scene"): Scores(0.398, 0.765, 0.761, 0.793),
    ("resnet101", "d_land"): Scores(0.305, 0.838, 0.832, 0.851),
    ("resnet50_cbam", "d_scene"): Scores(0.402, 0.767, 0.758, 0.786),
    ("resnet50_cbam", "d_land"): Scores(0.322, 0.845, 0.842, 0.857),
}
"""Table 3, by network and labels."""

TEST: Mapping[str, tuple[Cost, Scores]] = {
    "resnext50": (Cost(88, 901.493, 0.95), Scores(0.342, 0.726, 0.712, 0.794)),
    "vgg19": (Cost(532, 896.237, 0.84), Scores(0.331, 0.713, 0.703, 0.761)),
    "inception_v4": (Cost(157, 887.847, 1.09), Scores(0.385, 0.748, 0.735, 0.792)),
    "mobilenet_v3_large": (Cost(154, 914.367, 1.18), Scores(0.379, 0.734, 0.721, 0.777)),
    "resnet18": (Cost(72, 966.265, 0.92), Scores(0.396, 0.682, 0.657, 0.761)),
    "resnet34": (Cost(83, 923.461, 0.96), Scores(0.329, 0.715, 0.703, 0.773)),
    "resnet50": (Cost(90, 874.207, 0.96), Scores(0.336, 0.716, 0.698, 0.799)),
    "resnet101": (Cost(162, 863.052, 1.03), Scores(0.314, 0.765, 0.753, 0.817)),
    "resnet50_cbam": (Cost(92, 855.925, 0.98), Scores(0.328, 0.817, 0.823, 0.841)),
}
"""Table 4, by network. Where ROM ends and RAM begins is not printed in the text of the page: of the
two numbers run together, RAM is taken to have three digits before its point in every row."""


class StepTime(NamedTuple):
    """Milliseconds: ``mean`` and the number that the paper prints after its "±"."""

    name: str
    mean: float
    spread: float


STEP_TIMES: Mapping[str, StepTime] = {
    "down_sampling": StepTime("Down simple", 101.75, 5.49),
    "flatness": StepTime("Flatness", 103.35, 8.27),
    "smoothness": StepTime("Smooth canny", 8.64, 2.51),
    "distance": StepTime("Euclidean distance", 7.17, 2.93),
    "places": StepTime("Places classification", 3920.21, 54.04),
    "total": StepTime("Total", 4141.12, 73.24),
}
"""Table 7, by the step of `touchdown bench landing` that is the same. It has no row for
clustering."""
