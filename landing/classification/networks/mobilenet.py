"""MobileNetV3-Large (Howard et al., ICCV 2019, Table 1).

Its norms keep running statistics as those of the other networks do: with the authors' momentum,
0.99 of what was before, they would not have arrived when a short training ends.
"""

from __future__ import annotations

from torch import Tensor, nn

from touchdown.landing.classification.networks.blocks import ConvNorm, GlobalMean, fresh_weights

_EPS = 1e-3
_DIVISOR = 8
"""numbers of channels are multiples of it"""

_ROWS = (
    # kernel, expanded channels, channels out, squeeze and excite, hard swish, stride
    (3, 16, 16, False, False, 1),
    (3, 64, 24, False, False, 2),
    (3, 72, 24, False, False, 1),
    (5, 72, 40, True, False, 2),
    (5, 120, 40, True, False, 1),
    (5, 120, 40, True, False, 1),
    (3, 240, 80, False, True, 2),
    (3, 200, 80, False, True, 1),
    (3, 184, 80, False, True, 1),
    (3, 184, 80, False, True, 1),
    (3, 480, 112, True, True, 1),
    (3, 672, 112, True, True, 1),
    (5, 672, 160, True, True, 2),
    (5, 960, 160, True, True, 1),
    (5, 960, 160, True, True, 1),
)
_STEM, _HEAD, _HIDDEN = 16, 960, 1280


def rounded_channels(channels: float) -> int:
    """The nearest multiple of 8, but no more than a tenth below ``channels``."""
    nearest = max(_DIVISOR, int(channels + 0.5 * _DIVISOR) // _DIVISOR * _DIVISOR)
    return nearest + _DIVISOR if nearest < 0.9 * channels else nearest


class SqueezeExcite(nn.Module):
    """Scales each channel by a function of the means of all channels."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        hidden = rounded_channels(channels / 4)
        self.gate = nn.Sequential(
            nn.Linear(channels, hidden), nn.ReLU(), nn.Linear(hidden, channels), nn.Hardsigmoid()
        )

    def forward(self, features: Tensor) -> Tensor:
        gate: Tensor = self.gate(features.mean(dim=(2, 3)))
        return gate[:, :, None, None] * features


class InvertedResidual(nn.Module):
    """Widens, filters each channel by itself, narrows; the input is added where shapes agree."""

    def __init__(
        self, inside: int, kernel: int, wide: int, outside: int, squeeze: bool, hard: bool,
        stride: int,
    ) -> None:  # fmt: skip
        super().__init__()
        activation = nn.Hardswish if hard else nn.ReLU
        layers: list[nn.Module] = []
        if wide != inside:
            layers.append(_conv(inside, wide, 1, activation))
        layers.append(_conv(wide, wide, kernel, activation, stride=stride, groups=wide))
        if squeeze:
            layers.append(SqueezeExcite(wide))
        layers.append(_conv(wide, outside, 1, None))
        self.layers = nn.Sequential(*layers)
        self.adds = stride == 1 and inside == outside

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
) -> ConvNorm:
    return ConvNorm(
        inside, outside, kernel, stride=stride, padding=kernel // 2, groups=groups, eps=_EPS,
        activation=activation,
    )  # fmt: skip


def mobilenet_v3_large(classes: int, image_size: int) -> nn.Module:
    blocks: list[nn.Module] = []
    inside = _STEM
    for kernel, wide, outside, squeeze, hard, stride in _ROWS:
        blocks.append(InvertedResidual(inside, kernel, wide, outside, squeeze, hard, stride))
        inside = outside
    network = nn.Sequential(
        _conv(3, _STEM, 3, nn.Hardswish, stride=2),
        *blocks,
        _conv(inside, _HEAD, 1, nn.Hardswish),
        GlobalMean(),
        nn.Linear(_HEAD, _HIDDEN),
        nn.Hardswish(),
        nn.Dropout(0.2),
        nn.Linear(_HIDDEN, classes),
    )
    fresh_weights(network)
    return network
