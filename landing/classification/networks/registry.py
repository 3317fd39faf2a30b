"""The networks by name. torch is loaded when a network is built."""

from __future__ import annotations

import difflib
import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import nn

_HOME = "touchdown.landing.classification.networks"
_MODULES = {
    **dict.fromkeys(
        ("resnet18", "resnet34", "resnet50", "resnet101", "resnet50_cbam", "resnext50"), "resnet"
    ),
    "vgg19": "vgg",
    "mobilenet_v3_large": "mobile",
    "inception_v4": "inception",
    "efficientnet_lite0": "mobile",
}
"""module in which the function of a network's name builds it"""
PRETRAINED = ("efficientnet_lite0",)
"""networks whose weights for ImageNet a package brings"""
_SMALLEST = {"inception_v4": 75}
"""image size below which a convolution without padding has no input left"""
_SMALLEST_OF_OTHERS = 32

NETWORKS = tuple(_MODULES)


def check_network(name: str, image_size: int) -> None:
    """Raises ValueError for an unknown name or an image size (pixels) that is too small for it."""
    if name not in NETWORKS:
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
    module = importlib.import_module(f"{_HOME}.{_MODULES[name]}")
    network: nn.Module = getattr(module, name)(classes, image_size)
    importlib.import_module(f"{_HOME}.blocks").fresh_weights(network)
    return network


def load_pretrained(network: nn.Module, name: str) -> None:
    """Loads the weights for ImageNet into the network ``name``, all but those of its last layer.

    Raises ValueError for a network without any, ImportError without their package."""
    if name not in PRETRAINED:
        raise ValueError(f"there are no weights for ImageNet of {name}, only of {PRETRAINED[0]}")
    importlib.import_module(f"{_HOME}.mobile").load_imagenet(network)
