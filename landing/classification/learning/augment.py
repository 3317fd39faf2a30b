"""Variations of training images, a batch at a time, on whatever device they are on.

All numbers but the grain of the noise are drawn on the CPU from one generator, so that every device
sees the same ones.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

_ZOOM = math.log(1.35)
_SHIFT = 0.12
"""of half an image"""
_LIGHT, _TINT = 0.25, 0.07
"""deviation of the logarithm of brightness, and of each channel's"""
_CONTRAST, _COLOUR = (0.7, 1.3), (0.5, 1.4)
_NOISE = 0.03
_ERASED = (0.1, 0.35)
"""side of the rectangle that hides part of one image in four"""
_PERIOD, _THICKNESS = (0.1, 0.7), (0.03, 0.25)
"""between painted lines, in images; how wide they are, of that"""
_WAVE, _WAVE_LENGTH = 0.03, (0.15, 0.6)
"""deviation and length of the waves of lines seen through water, in images"""
_DASH, _EDGE = (0.08, 0.4), (0.004, 0.03)
"""of a dashed line, and of a blurred edge, in images"""


def as_input(images: Tensor) -> Tensor:
    """(B, S, S, 3) uint8 to (B, 3, S, S) float32 within 0..1, as networks get them."""
    return images.permute(0, 3, 1, 2).float() / 255.0


def augmented(
    images: Tensor, generator: torch.Generator, strength: float = 1.0, markings: float = 0.0
) -> Tensor:
    """(B, 3, S, S) within 0..1, turned, mirrored, zoomed, lit otherwise, partly hidden; with lines
    painted on a share ``markings`` of them.

    ``strength`` 0 leaves turning and mirroring, and a shift."""
    moved = _moved(images, generator, strength)
    if markings > 0.0:
        moved = marked(moved, generator, markings)
    return _hidden(_relit(moved, generator, strength), generator, strength)


def _uniform(generator: torch.Generator, shape: tuple[int, ...], low: float, high: float) -> Tensor:
    return low + (high - low) * torch.rand(shape, generator=generator)


def _moved(images: Tensor, generator: torch.Generator, strength: float = 1.0) -> Tensor:
    """Seen from above there is no up: any angle is as likely, and so is the mirror image."""
    count = len(images)
    angle = _uniform(generator, (count,), 0.0, 2.0 * math.pi)
    zoom = torch.exp(strength * _uniform(generator, (count,), -_ZOOM, _ZOOM))
    mirror = torch.where(torch.rand(count, generator=generator) < 0.5, -1.0, 1.0)
    shift = _uniform(generator, (count, 2, 1), -_SHIFT, _SHIFT)
    cosine, sine = zoom * torch.cos(angle), zoom * torch.sin(angle)
    rows = torch.stack([cosine * mirror, -sine, sine * mirror, cosine], dim=1)
    transforms = torch.cat([rows.reshape(count, 2, 2), shift], dim=2).to(images)
    grid = functional.affine_grid(transforms, list(images.shape), align_corners=False)
    return functional.grid_sample(images, grid, padding_mode="reflection", align_corners=False)


def _relit(images: Tensor, generator: torch.Generator, strength: float) -> Tensor:
    count = len(images)
    light = strength * _LIGHT * torch.randn(count, 1, 1, 1, generator=generator)
    tint = strength * _TINT * torch.randn(count, 3, 1, 1, generator=generator)
    contrast, colour = (
        1.0 + strength * (_uniform(generator, (count, 1, 1, 1), *span).to(images) - 1.0)
        for span in (_CONTRAST, _COLOUR)
    )
    noise = strength * _uniform(generator, (count, 1, 1, 1), 0.0, _NOISE).to(images)
    # millions of numbers: drawn where the images are, from a seed that is drawn here
    local = torch.Generator(images.device)
    local.manual_seed(int(torch.randint(2**62, (), generator=generator)))
    grain = torch.randn(images.shape, generator=local, device=images.device)
    images = images * torch.exp(light + tint).to(images)
    grey = images.mean(dim=1, keepdim=True)
    images = grey + colour * (images - grey)
    mean = images.mean(dim=(1, 2, 3), keepdim=True)
    return (mean + contrast * (images - mean) + noise * grain).clamp(0.0, 1.0)


def _hidden(images: Tensor, generator: torch.Generator, strength: float) -> Tensor:
    """A grey rectangle over one image in four (Zhong et al., AAAI 2020)."""
    count, size = len(images), images.shape[-1]
    pick = torch.rand(count, generator=generator) < 0.25 * strength
    sides = size * _uniform(generator, (count, 2), *_ERASED)
    first = torch.rand(count, 2, generator=generator) * (size - sides)
    pixel = torch.arange(size)
    inside = (pixel >= first[..., None]) & (pixel < (first + sides)[..., None])
    covered = pick[:, None, None] & inside[:, 0, :, None] & inside[:, 1, None, :]
    return torch.where(covered[:, None].to(images.device), 0.5, images)


def marked(images: Tensor, generator: torch.Generator, share: float) -> Tensor:
    """Parallel lines over a share of the images (B, 3, S, S): whole or dashed, straight or wavy,
    of any colour, half of them white. Lanes, bays and courts are painted on all sorts of ground,
    and in pools; what it is they do not tell."""
    count, size = len(images), images.shape[-1]

    def draw(low: float, high: float) -> Tensor:
        return _uniform(generator, (count, 1, 1), low, high)

    def chance(of: float) -> Tensor:
        return torch.rand(count, 1, 1, generator=generator) < of

    pixel = (torch.arange(size) + 0.5) / size - 0.5
    angle = draw(0.0, math.pi)
    along = torch.cos(angle) * pixel + torch.sin(angle) * pixel[:, None]
    across = torch.cos(angle) * pixel[:, None] - torch.sin(angle) * pixel
    wave = _WAVE * torch.randn(count, 1, 1, generator=generator) * chance(0.5)
    bent = torch.sin(2.0 * math.pi * (along / draw(*_WAVE_LENGTH) + draw(0.0, 1.0)))
    period = draw(*_PERIOD)
    phase = (across + wave * bent) / period + draw(0.0, 1.0)
    half = 0.5 * draw(*_THICKNESS) * period
    inside = half - period * (phase - torch.floor(phase) - 0.5).abs()
    edge = draw(*_EDGE)
    paint = (0.5 + inside / edge).clamp(0.0, 1.0)
    dashes = along / draw(*_DASH) + draw(0.0, 1.0)
    paint = torch.where(chance(0.5) & (dashes - torch.floor(dashes) < 0.5), 0.0, paint)
    # lines that begin, and end, somewhere
    paint = torch.where((along - draw(-0.4, 0.4)).abs() < draw(0.2, 1.0), paint, 0.0)
    paint = paint * draw(0.4, 1.0) * chance(share)
    colour = torch.rand(count, 3, 1, 1, generator=generator)
    white = _uniform(generator, (count, 1, 1, 1), 0.75, 1.0)
    colour = torch.where(chance(0.5)[..., None], white, colour).to(images)
    return torch.lerp(images, colour.expand_as(images), paint[:, None].to(images))


def blended(
    images: Tensor, targets: Tensor, generator: torch.Generator, strength: float
) -> tuple[Tensor, Tensor]:
    """Images (B, 3, S, S) and probabilities of their classes (B, C), blended with those that a
    permutation gives (Zhang et al., ICLR 2018): all by one share from Beta(``strength``,
    ``strength``), at least half of it their own."""
    pair = torch.randperm(len(images), generator=generator).to(images.device)
    draw = _beta(strength, generator)
    own = max(draw, 1.0 - draw)
    return own * images + (1.0 - own) * images[pair], own * targets + (1.0 - own) * targets[pair]


def _beta(strength: float, generator: torch.Generator) -> float:
    """One draw of Beta(a, a) for a up to 1, by Joehnk's method: torch's own takes no generator."""
    while True:
        u, v = torch.rand(2, generator=generator, dtype=torch.float64).tolist()
        x, y = u ** (1.0 / strength), v ** (1.0 / strength)
        if 0.0 < x + y <= 1.0:
            return float(x / (x + y))
