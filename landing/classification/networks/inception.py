"""Inception-v4 without auxiliary ends (Szegedy et al., AAAI 2017, Figs. 3 to 9)."""

import torch
from torch import Tensor, nn

from touchdown.landing.classification.networks.blocks import ConvNorm, GlobalMean

_EPS = 1e-3


class Branches(nn.Module):
    """Concatenates the outputs of several branches."""

    def __init__(self, *branches: nn.Module) -> None:
        super().__init__()
        self.branches = nn.ModuleList(branches)

    def forward(self, features: Tensor) -> Tensor:
        return torch.cat([branch(features) for branch in self.branches], dim=1)


def _conv(
    inside: int, outside: int, kernel: int | tuple[int, int], stride: int = 1, valid: bool = False
) -> ConvNorm:
    """Keeps the size of the image unless ``valid``."""
    sides = (kernel, kernel) if isinstance(kernel, int) else kernel
    padding = (0, 0) if valid else (sides[0] // 2, sides[1] // 2)
    return ConvNorm(inside, outside, sides, stride=stride, padding=padding, eps=_EPS)


def _chain(inside: int, *layers: tuple[int, int | tuple[int, int]]) -> nn.Sequential:
    """Convolutions of (channels, kernel) that keep the size of the image."""
    chain = []
    for outside, kernel in layers:
        chain.append(_conv(inside, outside, kernel))
        inside = outside
    return nn.Sequential(*chain)


def _pooled(inside: int, outside: int) -> nn.Sequential:
    pool = nn.AvgPool2d(3, 1, padding=1, count_include_pad=False)
    return nn.Sequential(pool, _conv(inside, outside, 1))


def _stem() -> nn.Sequential:
    """Fig. 3: 3 to 384 channels at an eighth of the size."""
    return nn.Sequential(
        _conv(3, 32, 3, 2, valid=True),
        _conv(32, 32, 3, valid=True),
        _conv(32, 64, 3),
        Branches(nn.MaxPool2d(3, 2), _conv(64, 96, 3, 2, valid=True)),
        Branches(
            nn.Sequential(_conv(160, 64, 1), _conv(64, 96, 3, valid=True)),
            nn.Sequential(_chain(160, (64, 1), (64, (1, 7)), (64, (7, 1))),
                          _conv(64, 96, 3, valid=True)),
        ),
        Branches(_conv(192, 192, 3, 2, valid=True), nn.MaxPool2d(3, 2)),
    )  # fmt: skip


def _block_a() -> nn.Module:
    """Fig. 4."""
    return Branches(
        _conv(384, 96, 1),
        _chain(384, (64, 1), (96, 3)),
        _chain(384, (64, 1), (96, 3), (96, 3)),
        _pooled(384, 96),
    )


def _reduction_a() -> nn.Module:
    """Fig. 7 with k = 192, l = 224, m = 256, n = 384: 384 to 1024 channels."""
    return Branches(
        _conv(384, 384, 3, 2, valid=True),
        nn.Sequential(_chain(384, (192, 1), (224, 3)), _conv(224, 256, 3, 2, valid=True)),
        nn.MaxPool2d(3, 2),
    )


def _block_b() -> nn.Module:
    """Fig. 5."""
    return Branches(
        _conv(1024, 384, 1),
        _chain(1024, (192, 1), (224, (1, 7)), (256, (7, 1))),
        _chain(1024, (192, 1), (192, (7, 1)), (224, (1, 7)), (224, (7, 1)), (256, (1, 7))),
        _pooled(1024, 128),
    )


def _reduction_b() -> nn.Module:
    """Fig. 8: 1024 to 1536 channels."""
    return Branches(
        nn.Sequential(_conv(1024, 192, 1), _conv(192, 192, 3, 2, valid=True)),
        nn.Sequential(
            _chain(1024, (256, 1), (256, (1, 7)), (320, (7, 1))), _conv(320, 320, 3, 2, valid=True)
        ),
        nn.MaxPool2d(3, 2),
    )


def _block_c() -> nn.Module:
    """Fig. 6."""
    return Branches(
        _conv(1536, 256, 1),
        nn.Sequential(_conv(1536, 384, 1), _crossed(384)),
        nn.Sequential(_chain(1536, (384, 1), (448, (3, 1)), (512, (1, 3))), _crossed(512)),
        _pooled(1536, 256),
    )


def _crossed(inside: int) -> nn.Module:
    return Branches(_conv(inside, 256, (1, 3)), _conv(inside, 256, (3, 1)))


def inception_v4(classes: int, image_size: int) -> nn.Module:
    return nn.Sequential(
        _stem(),
        *(_block_a() for _ in range(4)),
        _reduction_a(),
        *(_block_b() for _ in range(7)),
        _reduction_b(),
        *(_block_c() for _ in range(3)),
        GlobalMean(),
        nn.Dropout(0.2),
        nn.Linear(1536, classes),
    )
