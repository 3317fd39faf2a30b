"""Light, weather and sharpness of training images as a camera of a vehicle meets them.

Coarser resolution, haze, low sun, a lamp at night, snow, wet ground, shadows and exposure: each
falls on a share of the images of a batch. Random numbers are drawn on the CPU from one generator.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

_SHARES = {
    "coarse": 0.3, "shadows": 0.25, "snow": 0.04, "wet": 0.12, "low sun": 0.12, "lamp": 0.06,
    "haze": 0.15, "exposure": 0.5,
}  # fmt: skip
_COARSE = (1.5, 4.0)
"""how many times the pixels of a coarser image are as wide"""
_EXPOSURE = (0.55, 2.2)
"""exponent of the grey levels: dark images are as likely as bright ones"""


def weathered(images: Tensor, generator: torch.Generator, strength: float = 1.0) -> Tensor:
    """Returns images (B, 3, S, S) in [0, 1], each with every effect by its share times
    ``strength``."""
    changed = images.clone()
    for name, share in _SHARES.items():
        chosen = torch.rand(len(images), generator=generator) < share * strength
        if chosen.any():
            where = chosen.to(images.device)
            changed[where] = _EFFECTS[name](changed[where], generator).clamp(0.0, 1.0)
    return changed


def _draw(images: Tensor, generator: torch.Generator, low: float, high: float) -> Tensor:
    drawn = low + (high - low) * torch.rand(len(images), 1, 1, 1, generator=generator)
    return drawn.to(images)


def _blotches(images: Tensor, generator: torch.Generator, cells: int) -> Tensor:
    """Returns a smooth random field (B, 1, S, S) about 0.5."""
    coarse = torch.rand(len(images), 1, cells, cells, generator=generator).to(images)
    return functional.interpolate(
        coarse, size=images.shape[-2:], mode="bicubic", align_corners=False
    )


def _coarse(images: Tensor, generator: torch.Generator) -> Tensor:
    low, high = _COARSE
    factor = low + (high - low) * float(torch.rand((), generator=generator))
    size = images.shape[-1]
    small = functional.interpolate(images, size=(max(8, round(size / factor)),) * 2, mode="area")
    return functional.interpolate(small, size=(size, size), mode="bilinear", align_corners=False)


def _shadows(images: Tensor, generator: torch.Generator) -> Tensor:
    """Shadows of clouds, trees and walls: areas with soft or sharp edges."""
    field = _blotches(images, generator, 4) - _draw(images, generator, 0.35, 0.65)
    inside = torch.sigmoid(field * _draw(images, generator, 10.0, 120.0))
    return images * (1.0 - inside * _draw(images, generator, 0.3, 0.7))


def _snow(images: Tensor, generator: torch.Generator) -> Tensor:
    """Thin snow in patches: what is below shows through."""
    field = _blotches(images, generator, 6) - _draw(images, generator, 0.5, 0.7)
    cover = torch.sigmoid(40.0 * field) * _draw(images, generator, 0.4, 0.9)
    return torch.lerp(images, _draw(images, generator, 0.75, 0.95).expand_as(images), cover)


def _wet(images: Tensor, generator: torch.Generator) -> Tensor:
    """Wet ground is darker, its colours are stronger, and the sky gleams on it."""
    grey = images.mean(dim=1, keepdim=True)
    strong = grey + _draw(images, generator, 1.0, 1.4) * (images - grey)
    dark = strong * _draw(images, generator, 0.5, 0.85)
    gleam = (_blotches(images, generator, 5) - 0.6).clamp(0.0) * _draw(images, generator, 0.0, 0.6)
    return dark + gleam


def _low_sun(images: Tensor, generator: torch.Generator) -> Tensor:
    """Warm light, brighter on one side."""
    warm = _draw(images, generator, 0.0, 0.25)
    tint = torch.cat([1.0 + warm, torch.ones_like(warm), 1.0 - warm], dim=1)
    ramp = torch.linspace(-0.5, 0.5, images.shape[-1], device=images.device)
    slope = _draw(images, generator, -0.5, 0.5)
    return images * tint * (1.0 + slope * ramp)


def _lamp(images: Tensor, generator: torch.Generator) -> Tensor:
    """Ground under a lamp at night, brightened afterwards: light about a middle, grain."""
    pixel = torch.linspace(-1.0, 1.0, images.shape[-1], device=images.device)
    x = pixel - _draw(images, generator, -0.4, 0.4)
    y = pixel[:, None] - _draw(images, generator, -0.4, 0.4)
    light = torch.exp(-(x**2 + y**2) * _draw(images, generator, 0.3, 1.5))
    grain = torch.randn(images.shape, generator=generator).to(images)
    return 1.1 * images * light + 0.06 * grain


def _haze(images: Tensor, generator: torch.Generator) -> Tensor:
    air = _draw(images, generator, 0.55, 0.9).expand_as(images)
    return torch.lerp(images, air, _draw(images, generator, 0.05, 0.5))


def _exposure(images: Tensor, generator: torch.Generator) -> Tensor:
    low, high = (torch.tensor(value).log().item() for value in _EXPOSURE)
    return images ** torch.exp(_draw(images, generator, low, high))


_EFFECTS = {
    "coarse": _coarse, "shadows": _shadows, "snow": _snow, "wet": _wet, "low sun": _low_sun,
    "lamp": _lamp, "haze": _haze, "exposure": _exposure,
}  # fmt: skip
