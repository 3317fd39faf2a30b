"""Convolutional block attention (Woo, Park, Lee and Kweon, ECCV 2018), the paper's Fig. 6.

Equation numbers are those of Woo et al. Features F are (B, C, H, W).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional

REDUCTION = 16
"""r: the hidden layer of the channel attention has C / r units"""
WINDOW = 7
"""side of the window of the spatial attention, pixels"""


def channel_attention(features: Tensor, mlp: Callable[[Tensor], Tensor]) -> Tensor:
    """Eq. 2: M_c(F) = sigmoid(MLP(AvgPool(F)) + MLP(MaxPool(F))), (B, C, 1, 1).

    The pools go over all pixels; both share ``mlp``, (B, C) to (B, C)."""
    mean = functional.adaptive_avg_pool2d(features, 1).flatten(1)
    most = functional.adaptive_max_pool2d(features, 1).flatten(1)
    return torch.sigmoid(mlp(mean) + mlp(most))[:, :, None, None]


def spatial_attention(features: Tensor, window: Callable[[Tensor], Tensor]) -> Tensor:
    """Eq. 3: M_s(F) = sigmoid(f7x7([AvgPool(F); MaxPool(F)])), (B, 1, H, W).

    The pools go over the channels; ``window`` maps (B, 2, H, W) to (B, 1, H, W)."""
    mean, most = features.mean(dim=1, keepdim=True), features.amax(dim=1, keepdim=True)
    return torch.sigmoid(window(torch.cat([mean, most], dim=1)))


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
