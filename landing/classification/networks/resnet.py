"""Residual networks: He et al. (CVPR 2016); grouped, Xie et al. (CVPR 2017); with attention: Woo,
Park, Lee and Kweon (ECCV 2018), CBAM, the paper's Fig. 6, whose equation numbers are cited.

The stride of a bottleneck is in its 3x3 convolution, as in every network published with weights
since Goyal et al. (2017).
"""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor, nn
from torch.nn import functional

from touchdown.landing.classification.networks.blocks import ConvNorm, GlobalMean

_WIDTHS = (64, 128, 256, 512)
REDUCTION = 16
"""r: the hidden layer of the channel attention has C / r units"""
WINDOW = 7
"""side of the window of the spatial attention, pixels"""


def channel_attention(features: Tensor, mlp: Callable[[Tensor], Tensor]) -> Tensor:
    """Eq. 2: M_c(F) = sigmoid(MLP(AvgPool(F)) + MLP(MaxPool(F))), (B, C, 1, 1).

    The pools go over all pixels; both share ``mlp``, (B, C) to (B, C)."""
    mean = functional.adaptive_avg_pool2d(features, 1).flatten(1)
    maximum = functional.adaptive_max_pool2d(features, 1).flatten(1)
    return torch.sigmoid(mlp(mean) + mlp(maximum))[:, :, None, None]


def spatial_attention(features: Tensor, window: Callable[[Tensor], Tensor]) -> Tensor:
    """Eq. 3: M_s(F) = sigmoid(f7x7([AvgPool(F); MaxPool(F)])), (B, 1, H, W).

    The pools go over the channels; ``window`` maps (B, 2, H, W) to (B, 1, H, W)."""
    mean, maximum = features.mean(dim=1, keepdim=True), features.amax(dim=1, keepdim=True)
    return torch.sigmoid(window(torch.cat([mean, maximum], dim=1)))


def attend(
    features: Tensor, mlp: Callable[[Tensor], Tensor], window: Callable[[Tensor], Tensor]
) -> Tensor:
    """Eq. 1: F' = M_c(F) * F, then F'' = M_s(F') * F'."""
    features = channel_attention(features, mlp) * features
    return spatial_attention(features, window) * features


class Cbam(nn.Module):
    """Eq. 1 with weights of its own: an MLP of one hidden layer, and a 7x7 convolution whose one
    channel is normalised over the batch, as in the authors' networks."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        hidden = channels // REDUCTION
        self.mlp = nn.Sequential(
            nn.Linear(channels, hidden), nn.ReLU(), nn.Linear(hidden, channels)
        )
        self.window = nn.Sequential(
            nn.Conv2d(2, 1, WINDOW, padding=WINDOW // 2, bias=False), nn.BatchNorm2d(1)
        )

    def forward(self, features: Tensor) -> Tensor:
        return attend(features, self.mlp, self.window)


class Residual(nn.Module):
    """relu(shortcut(x) + attention(branch(x))). It begins as its shortcut (Goyal et al. 2017,
    section 5.1)."""

    def __init__(
        self, inside: int, outside: int, branch: list[ConvNorm], stride: int, attention: bool
    ) -> None:
        super().__init__()
        nn.init.zeros_(branch[-1][1].weight)  # type: ignore[arg-type]
        self.branch = nn.Sequential(*branch)
        self.attention = Cbam(outside) if attention else nn.Identity()
        same = stride == 1 and inside == outside
        self.shortcut = (
            nn.Identity() if same else ConvNorm(inside, outside, 1, stride=stride, activation=None)
        )
        self.relu = nn.ReLU()

    def forward(self, features: Tensor) -> Tensor:
        change = self.attention(self.branch(features))
        return self.relu(self.shortcut(features) + change)


def _basic(inside: int, width: int, stride: int) -> list[ConvNorm]:
    """Two 3x3 convolutions."""
    return [
        ConvNorm(inside, width, 3, stride=stride, padding=1),
        ConvNorm(width, width, 3, padding=1, activation=None),
    ]


def _bottleneck(inside: int, width: int, stride: int, groups: int = 1) -> list[ConvNorm]:
    """1x1, 3x3, 1x1 to 4 ``width``; with ``groups`` the middle has as many, of width / 16 channels
    each."""
    middle = width if groups == 1 else width * groups // 16
    return [
        ConvNorm(inside, middle, 1),
        ConvNorm(middle, middle, 3, stride=stride, padding=1, groups=groups),
        ConvNorm(middle, 4 * width, 1, activation=None),
    ]


def _resnet(
    classes: int,
    depths: tuple[int, ...],
    branch: Callable[[int, int, int], list[ConvNorm]] = _bottleneck,
    expansion: int = 4,
    attention: bool = False,
) -> nn.Module:
    """A stem, four stages of residual blocks, the mean over all pixels, a linear layer."""
    layers: list[nn.Module] = [
        ConvNorm(3, 64, 7, stride=2, padding=3),
        nn.MaxPool2d(3, 2, padding=1),
    ]
    inside = 64
    for stage, (width, depth) in enumerate(zip(_WIDTHS, depths, strict=True)):
        blocks = []
        for number in range(depth):
            stride = 2 if number == 0 and stage > 0 else 1
            outside = expansion * width
            block = branch(inside, width, stride)
            blocks.append(Residual(inside, outside, block, stride, attention))
            inside = outside
        layers.append(nn.Sequential(*blocks))
    return nn.Sequential(*layers, GlobalMean(), nn.Linear(inside, classes))


def resnet18(classes: int, image_size: int) -> nn.Module:
    return _resnet(classes, (2, 2, 2, 2), _basic, expansion=1)


def resnet34(classes: int, image_size: int) -> nn.Module:
    return _resnet(classes, (3, 4, 6, 3), _basic, expansion=1)


def resnet50(classes: int, image_size: int) -> nn.Module:
    return _resnet(classes, (3, 4, 6, 3))


def resnet101(classes: int, image_size: int) -> nn.Module:
    return _resnet(classes, (3, 4, 23, 3))


def resnet50_cbam(classes: int, image_size: int) -> nn.Module:
    """The paper's network: `Cbam` in every residual block."""
    return _resnet(classes, (3, 4, 6, 3), attention=True)


def resnext50(classes: int, image_size: int) -> nn.Module:
    """32x4d: 32 groups of 4 channels in the first stage."""
    return _resnet(classes, (3, 4, 6, 3), partial(_bottleneck, groups=32))
