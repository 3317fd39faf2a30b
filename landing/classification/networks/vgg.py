"""VGG19, configuration E of Simonyan and Zisserman (ICLR 2015)."""

from torch import nn

from touchdown.landing.classification.networks.blocks import MeanGrid

_STAGES = ((64, 2), (128, 2), (256, 4), (512, 4), (512, 4))
"""channels and number of 3x3 convolutions before each halving"""
_GRID = 7
"""side of the input of the linear layers, cells, for any image size"""
_HIDDEN = 4096


def vgg19(classes: int, image_size: int) -> nn.Module:
    layers: list[nn.Module] = []
    inside = 3
    for width, count in _STAGES:
        for _ in range(count):
            layers += [nn.Conv2d(inside, width, 3, padding=1), nn.ReLU()]
            inside = width
        layers.append(nn.MaxPool2d(2))
    return nn.Sequential(
        *layers,
        MeanGrid(image_size // 2 ** len(_STAGES), _GRID),
        nn.Flatten(),
        nn.Linear(inside * _GRID**2, _HIDDEN),
        nn.ReLU(),
        nn.Dropout(0.5),
        nn.Linear(_HIDDEN, _HIDDEN),
        nn.ReLU(),
        nn.Dropout(0.5),
        nn.Linear(_HIDDEN, classes),
    )
