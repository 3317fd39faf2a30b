"""Augmentation of training images, batch by batch, on the device of the images: pose, light,
paint, colours and textures, and the weather that a camera of a vehicle meets.

All random numbers except the pixel noise are drawn on the CPU from one generator, so that they are
the same on every device.
"""

import math

import torch
from torch import Tensor
from torch.nn import functional

_ZOOM = math.log(1.35)
_SHIFT = 0.12
"""relative to half of an image"""
_LIGHT, _TINT = 0.25, 0.07
"""standard deviation of the logarithm of brightness, and of that of each channel"""
_CONTRAST, _COLOUR = (0.7, 1.3), (0.5, 1.4)
_NOISE = 0.03
_MADE, _WATER = (0.4, 0.5, 0.12, 0.0), (0.5, 0.6, 0.2, 1.0)
"""standard deviations of the logarithms of brightness, of red over blue and of green, in linear
light, of built and bare ground and of water; and whether blue may gain on red: what is blue of all
that one may stand on is rare, and of water it is common"""
_GAMMA = 2.2
_MIN_MEAN = 0.02
"""lower bound of a channel's mean, in [0, 1], that a texture's grain is relative to"""
_ERASED = (0.1, 0.35)
"""side of the rectangle that covers part of one image in four"""
_PERIOD, _THICKNESS = (0.1, 0.7), (0.03, 0.25)
"""distance of painted lines relative to the image, and their width relative to the distance"""
_WAVE, _WAVE_LENGTH = 0.03, (0.15, 0.6)
"""amplitude and length of the waves of lines under water, relative to the image"""
_DASH, _EDGE = (0.08, 0.4), (0.004, 0.03)
"""length of dashes and of blurred edges, relative to the image"""
_COURT, _LINE = (0.1, 0.6), (0.01, 0.05)
"""half of the sides of courts and the width of their lines, relative to the image"""

_FRACTIONS = {
    "coarse": 0.3, "shadows": 0.25, "snow": 0.04, "wet": 0.12, "low sun": 0.12, "lamp": 0.06,
    "haze": 0.15, "exposure": 0.5,
}  # fmt: skip
_COARSE = (1.5, 4.0)
"""how many times the pixels of a coarser image are as wide"""
_EXPOSURE = (0.55, 2.2)
"""exponent of the grey levels: dark images are as likely as bright ones"""


def as_input(images: Tensor) -> Tensor:
    """Converts (B, S, S, 3) uint8 to the network input (B, 3, S, S) float32 in [0, 1]."""
    return images.permute(0, 3, 1, 2).float() / 255.0


def augmented(
    images: Tensor, generator: torch.Generator, strength: float = 1.0, markings: float = 0.0
) -> Tensor:
    """Returns images (B, 3, S, S) in [0, 1] rotated, mirrored, scaled, with changed light, partly
    covered, and with lines painted on a fraction ``markings`` of them.

    With ``strength`` 0 only rotation, mirroring and a shift remain."""
    moved = _moved(images, generator, strength)
    if markings > 0.0:
        for _ in range(2):  # bays along lanes, lanes over the lines of a pool's bed
            moved = marked(moved, generator, markings)
    return _hidden(_relit(moved, generator, strength), generator, strength)


def _uniform(generator: torch.Generator, shape: tuple[int, ...], low: float, high: float) -> Tensor:
    return low + (high - low) * torch.rand(shape, generator=generator)


def _moved(images: Tensor, generator: torch.Generator, strength: float = 1.0) -> Tensor:
    """Returns images in random pose. Aerial images have no preferred direction: rotation and
    mirroring are uniform."""
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
    """Covers a rectangle of one image in four with grey (Zhong et al., AAAI 2020)."""
    count, size = len(images), images.shape[-1]
    pick = torch.rand(count, generator=generator) < 0.25 * strength
    sides = size * _uniform(generator, (count, 2), *_ERASED)
    first = torch.rand(count, 2, generator=generator) * (size - sides)
    pixel = torch.arange(size)
    inside = (pixel >= first[..., None]) & (pixel < (first + sides)[..., None])
    covered = pick[:, None, None] & inside[:, 0, :, None] & inside[:, 1, None, :]
    return torch.where(covered[:, None].to(images.device), 0.5, images)


def marked(images: Tensor, generator: torch.Generator, fraction: float) -> Tensor:
    """Paints lines on a fraction of the images (B, 3, S, S).

    Lines are parallel, or in one image of three the outline of a court, whole or dashed, straight
    or wavy, of any colour, half of them white. Lanes, bays and courts are marked on many kinds of
    ground and in pools: lines must not determine the class."""
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
    lines = half - period * (phase - torch.floor(phase) - 0.5).abs()
    centre, sides = draw(-0.5, 0.5), draw(*_COURT)
    reach = torch.maximum((along - centre).abs() - sides, across.abs() - draw(*_COURT))
    inside = torch.where(chance(1.0 / 3.0), 0.5 * draw(*_LINE) - reach.abs(), lines)
    edge = draw(*_EDGE)
    paint = (0.5 + inside / edge).clamp(0.0, 1.0)
    dashes = along / draw(*_DASH) + draw(0.0, 1.0)
    paint = torch.where(chance(0.5) & (dashes - torch.floor(dashes) < 0.5), 0.0, paint)
    # lines that begin, and end, somewhere
    paint = torch.where((along - draw(-0.4, 0.4)).abs() < draw(0.2, 1.0), paint, 0.0)
    paint = paint * draw(0.4, 1.0) * chance(fraction)
    colour = torch.rand(count, 3, 1, 1, generator=generator)
    white = _uniform(generator, (count, 1, 1, 1), 0.75, 1.0)
    colour = torch.where(chance(0.5)[..., None], white, colour).to(images)
    return torch.lerp(images, colour.expand_as(images), paint[:, None].to(images))


def recoloured(
    images: Tensor, spreads: Tensor, generator: torch.Generator, fraction: float
) -> Tensor:
    """Gives a fraction of the images (B, 3, S, S) another colour, changed in linear light, by the
    ``spreads`` (B, 4) of `colour_spreads`.

    Courts are of red clay, roads of pale chippings, pools are turquoise: what is built or bare is
    known by its texture, and water by its surface, as its colour is that of its bed."""
    drawn = torch.randn(len(images), 3, generator=generator)
    light, warm, green = (spreads[:, :3] * drawn).unbind(dim=1)
    warm = torch.where(spreads[:, 3] > 0.0, warm, warm.abs())
    gains = torch.exp(torch.stack([light + warm, light + green, light - warm], dim=1))
    picked = torch.rand(len(images), 1, generator=generator) < fraction
    gains = torch.where(picked, gains, 1.0) ** (1.0 / _GAMMA)
    return (images * gains[..., None, None].to(images)).clamp(0.0, 1.0)


def colour_spreads(classes: tuple[str, ...]) -> Tensor:
    """Returns (C + 1, 4) spreads of the colours of each class for `recoloured`, the last of no
    class, which is number -1. Plants keep theirs."""
    by_class = dict.fromkeys(("lawn", "trees"), (0.0, 0.0, 0.0, 0.0)) | {"water": _WATER}
    return torch.tensor([*(by_class.get(name, _MADE) for name in classes), _MADE])


def textured(images: Tensor, textures: Tensor, generator: torch.Generator) -> Tensor:
    """Returns images (B, 3, S, S) with the grain and the colour of ``textures`` (B, 3, S, S), one
    for each: shadows, edges and what else stands out remain.

    A scene has one paving and one asphalt; photographs of others make its ground many kinds."""
    turned = _moved(textures, generator)
    mean = images.mean(dim=(2, 3), keepdim=True).clamp(min=_MIN_MEAN)
    return (images / mean * turned).clamp(0.0, 1.0)


def weathered(images: Tensor, generator: torch.Generator, strength: float = 1.0) -> Tensor:
    """Returns images (B, 3, S, S) in [0, 1], each with every effect by its fraction times
    ``strength``."""
    changed = images.clone()
    for name, fraction in _FRACTIONS.items():
        chosen = torch.rand(len(images), generator=generator) < fraction * strength
        if chosen.any():
            where = chosen.to(images.device)
            changed[where] = _EFFECTS[name](changed[where], generator).clamp(0.0, 1.0)
    return changed


def _draw(images: Tensor, generator: torch.Generator, low: float, high: float) -> Tensor:
    return _uniform(generator, (len(images), 1, 1, 1), low, high).to(images)


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
