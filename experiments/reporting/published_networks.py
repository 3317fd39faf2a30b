"""Published figures of the paper's networks and of the time of site selection: Tables 3, 4, 7."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

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


@dataclass(frozen=True, slots=True)
class Scores:
    loss: float
    macro_f1: float
    recall: float
    top1: float


@dataclass(frozen=True, slots=True)
class Cost:
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


@dataclass(frozen=True, slots=True)
class StepTime:
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
