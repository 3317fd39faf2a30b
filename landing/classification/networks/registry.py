"""The networks by name. torch is loaded when a network is built."""

from __future__ import annotations

import difflib
import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import nn

_HOME = "touchdown.landing.classification.networks"
_BUILDERS = {
    "resnet18": "resnet:resnet18",
    "resnet34": "resnet:resnet34",
    "resnet50": "resnet:resnet50",
    "resnet101": "resnet:resnet101",
    "resnet50_cbam": "resnet:resnet50_cbam",
    "resnext50": "resnet:resnext50",
    "vgg19": "vgg:vgg19",
    "mobilenet_v3_large": "mobile:mobilenet_v3_large",
    "inception_v4": "inception:inception_v4",
    "efficientnet_lite0": "mobile:efficientnet_lite0",
}
PRETRAINED = ("efficientnet_lite0",)
"""networks whose weights for ImageNet a package brings"""
_SMALLEST = {"inception_v4": 75}
"""image size below which a convolution without padding has no input left"""
_SMALLEST_OF_OTHERS = 32

NETWORKS = tuple(_BUILDERS)


def check_network(name: str, image_size: int) -> None:
    """Raises ValueError for an unknown name or an image size (pixels) that is too small for it."""
    if name not in _BUILDERS:
        near = difflib.get_close_matches(name, NETWORKS, n=1, cutoff=0.5)
        hint = f" did you mean '{near[0]}'?" if near else ""
        raise ValueError(f"unknown network '{name}':{hint} known: {', '.join(NETWORKS)}")
    smallest = _SMALLEST.get(name, _SMALLEST_OF_OTHERS)
    if image_size < smallest:
        raise ValueError(f"{name} needs images of at least {smallest} pixels, not {image_size}")


def build_network(name: str, classes: int, image_size: int) -> nn.Module:
    """A network with fresh weights, (B, 3, image_size, image_size) float32 to (B, classes) scores
    before the softmax. Weights are drawn from torch's default generator: seed it before.

    Raises ValueError as ``check_network``, ImportError without torch.
    """
    check_network(name, image_size)
    module, _, function = _BUILDERS[name].partition(":")
    network: nn.Module = getattr(importlib.import_module(f"{_HOME}.{module}"), function)(
        classes, image_size
    )
    return network


def load_pretrained(network: nn.Module, name: str) -> None:
    """Loads the weights for ImageNet into the network ``name``, all but those of its last layer.

    Raises ValueError for a network without any, ImportError without their package."""
    if name not in PRETRAINED:
        raise ValueError(f"there are no weights for ImageNet of {name}, only of {PRETRAINED[0]}")
    module = importlib.import_module(f"{_HOME}.{_BUILDERS[name].partition(':')[0]}")
    module.load_imagenet(network)
