"""Blocks that networks share: convolution with batch normalisation, pooling, initialisation."""

import torch
from torch import Tensor, nn
from torch.nn import functional


class ConvNorm(nn.Sequential):
    """Convolution without bias, batch normalisation, and an activation unless that is None."""

    def __init__(
        self,
        inside: int,
        outside: int,
        kernel: int | tuple[int, int],
        *,
        stride: int = 1,
        padding: int | tuple[int, int] = 0,
        groups: int = 1,
        eps: float = 1e-5,
        activation: type[nn.Module] | None = nn.ReLU,
    ) -> None:
        layers: list[nn.Module] = [
            nn.Conv2d(inside, outside, kernel, stride, padding, groups=groups, bias=False),
            nn.BatchNorm2d(outside, eps=eps),
        ]
        if activation is not None:
            layers.append(activation())
        super().__init__(*layers)


class GlobalMean(nn.Module):
    """(B, C, H, W) to (B, C), whatever H and W."""

    def forward(self, features: Tensor) -> Tensor:
        return features.mean(dim=(2, 3))


class MeanGrid(nn.Module):
    """(B, C, side, side) to (B, C, cells, cells): each cell the mean of the pixels that it
    overlaps, as torch's adaptive average pooling, but written as two matrix products, which every
    engine has also where ``cells`` does not divide ``side``."""

    weights: Tensor

    def __init__(self, side: int, cells: int) -> None:
        super().__init__()
        weights = functional.adaptive_avg_pool1d(torch.eye(side)[None], cells)[0].T
        self.register_buffer("weights", weights, persistent=False)

    def forward(self, features: Tensor) -> Tensor:
        return self.weights @ features @ self.weights.T


def fresh_weights(network: nn.Module) -> None:
    """Draws weights in place: convolutions after He et al. (2015, Eq. 10, by outputs), linear
    layers with deviation 0.01 and no bias. Batch normalisation keeps torch's."""
    for layer in network.modules():
        if isinstance(layer, nn.Conv2d):
            nn.init.kaiming_normal_(layer.weight, mode="fan_out", nonlinearity="relu")
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
        elif isinstance(layer, nn.Linear):
            nn.init.normal_(layer.weight, 0.0, 0.01)
            nn.init.zeros_(layer.bias)
