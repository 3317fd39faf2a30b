"""Textures for roofs, walls and leaves, painted by code; all uint8 RGB, top row first."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.authoring.noise import fractal_noise, tileable_noise

Image = NDArray[np.uint8]
Colour = tuple[float, float, float]

TILE_PX = 512


def to_texture(rgb: NDArray[np.float32]) -> Image:
    """Clips (H, W, 3) floats in 0..255 to a texture."""
    return np.clip(rgb, 0.0, 255.0).astype(np.uint8)


def foliage(rng: np.random.Generator, base: Colour, leaf_px: tuple[int, int]) -> Image:
    """(512, 512, 3), periodic: layers of leaves, lighter and yellower towards the outside, over
    dark gaps. base: RGB 0..255; leaf_px: shortest and longest half axis of a leaf."""
    size = TILE_PX
    tone = tileable_noise(rng, size, 1.2, 2.0)
    image = np.empty((size, size, 3), np.float32)
    image[:] = np.array(base, np.float32) * 0.40
    layers, per_layer = 5, 420
    for layer in range(layers):
        light = 0.5 + 0.6 * layer / (layers - 1)
        centres = rng.integers(0, size, (per_layer, 2))
        angles = rng.uniform(0.0, 180.0, per_layer)
        axes = rng.integers(leaf_px[0], leaf_px[1] + 1, (per_layer, 2))
        tints = rng.normal(0.0, 0.09, (per_layer, 3)) + rng.normal(0.0, 0.10, (per_layer, 1))
        for centre, angle, half, tint in zip(centres, angles, axes, tints, strict=True):
            local = light * (1.0 + 0.16 * tone[centre[1], centre[0]])
            colour = np.array(base) * local * (1.0 + tint) + [7.0 * layer, 5.0 * layer, 0.0]
            for dx in (-size, 0, size) if min(centre[0], size - centre[0]) < 20 else (0,):
                for dy in (-size, 0, size) if min(centre[1], size - centre[1]) < 20 else (0,):
                    where = (int(centre[0] + dx), int(centre[1] + dy))
                    shape = (int(half[0]), max(2, int(half[1] * 0.55)))
                    cv2.ellipse(image, where, shape, float(angle), 0, 360, colour.tolist(), -1)
    return to_texture(image)


def roof_tiles(
    rng: np.random.Generator, base: Colour, size_m: tuple[float, float], px_per_m: float
) -> Image:
    """Courses of interlocking tiles, courses run along the texture's width. size_m: (width,
    height); base: RGB 0..255."""
    width, height = (max(8, round(s * px_per_m)) for s in size_m)
    rows, cols = np.mgrid[0:height, 0:width].astype(np.float32) / px_per_m
    course_m, tile_m = 0.34, 0.30
    course = np.floor(rows / course_m)
    shifted = cols / tile_m + 0.5 * (course % 2)
    number = np.floor(shifted)
    along, down = shifted - number, rows / course_m - course
    table = rng.normal(0.0, 1.0, (97, 89)).astype(np.float32)
    tone = table[course.astype(int) % 97, number.astype(int) % 89]
    shade = 1.0 + 0.10 * tone
    shade *= 0.86 + 0.22 * np.sin(np.pi * along)
    shade *= np.where(down > 0.86, 0.55, 1.0) * np.where(down < 0.10, 1.12, 1.0)
    stain = fractal_noise(rng, (height, width), 1.6 * px_per_m, 4, 0.6)
    shade *= 1.0 + 0.07 * stain
    image = shade[..., None] * np.array(base, np.float32)
    moss = np.clip(fractal_noise(rng, (height, width), 0.9 * px_per_m, 3, 0.7) - 1.15, 0.0, 1.0)
    image += moss[..., None] * (np.array([86.0, 92.0, 58.0], np.float32) - image) * 0.8
    grain = rng.standard_normal((height, width), dtype=np.float32)
    return to_texture(image + 4.0 * grain[..., None])


def flat_roof(rng: np.random.Generator, size_m: tuple[float, float], px_per_m: float) -> Image:
    """Gravelled bitumen with sheet seams, puddle stains and a swept walkway."""
    width, height = (max(8, round(s * px_per_m)) for s in size_m)
    grain = rng.standard_normal((height, width), dtype=np.float32)
    pebbles = cv2.GaussianBlur(rng.standard_normal((height, width), dtype=np.float32), (0, 0), 1.3)
    tone = 138.0 + 26.0 * pebbles + 5.0 * grain
    tone += 7.0 * fractal_noise(rng, (height, width), 2.5 * px_per_m, 4)
    puddle = fractal_noise(rng, (height, width), 2.0 * px_per_m, 3)
    tone -= 30.0 * np.clip(puddle - 0.9, 0.0, 0.6)
    for seam in np.arange(1.0, size_m[0], 1.0):
        col = int(seam * px_per_m)
        tone[:, col : col + 2] *= 0.72
    walkway = int(0.42 * height)
    slab = max(2, int(0.5 * px_per_m))
    band = slice(walkway, walkway + 2 * slab)
    tone[band] = 168.0 + 4.0 * grain[band] + 6.0 * pebbles[band]
    tone[walkway : walkway + 2 * slab : slab] *= 0.7
    tone[band, ::slab] *= 0.7
    return to_texture(tone[..., None] * np.array([1.0, 0.985, 0.95], np.float32))


def facade_bay(rng: np.random.Generator, wall: Colour, brick: bool, px: int = 224) -> Image:
    """(2 px, px, 3): a window bay, 3.0 m wide and 2.8 m high, to be repeated along the wall, above
    as much plain wall. wall: RGB 0..255."""
    rows, cols = np.mgrid[0 : 2 * px, 0:px].astype(np.float32)
    y, x = rows * 2.8 / px, cols * 3.0 / px
    shade = np.ones((2 * px, px), np.float32)
    if brick:
        course = np.floor(y / 0.0875)
        shifted = x / 0.25 + 0.5 * (course % 2)
        table = rng.normal(0.0, 0.10, (64, 16)).astype(np.float32)
        shade += table[course.astype(int) % 64, np.floor(shifted).astype(int) % 12]
        joint = (y / 0.0875 - course < 0.16) | (shifted - np.floor(shifted) < 0.07)
        shade = np.where(joint, 1.18, shade)
    shade += 0.03 * fractal_noise(rng, (2 * px, px), 60.0, 4)
    shade += 0.02 * rng.standard_normal((2 * px, px))
    image = (shade[..., None] * np.array(wall, np.float32)).astype(np.float32)

    def fill(x0: float, y0: float, x1: float, y1: float, colour: Colour) -> None:
        first = (round(x0 * px / 3.0), round(y0 * px / 2.8))
        last = (round(x1 * px / 3.0), round(y1 * px / 2.8))
        cv2.rectangle(image, first, last, colour, -1)

    fill(0.82, 0.72, 2.18, 2.02, (232, 230, 224))
    fill(0.90, 0.80, 2.10, 1.92, (52, 64, 78))
    fill(0.90, 0.80, 2.10, 1.15, (104, 126, 148))
    fill(1.47, 0.80, 1.53, 1.92, (228, 226, 220))
    fill(0.74, 2.00, 2.26, 2.12, (176, 172, 164))
    fill(0.0, 2.72, 3.0, 2.8, (118, 112, 104))
    return to_texture(image)


def hedge_or_soil_tint(rng: np.random.Generator, base: Colour, spread: float) -> Colour:
    """A colour near ``base`` (RGB 0..255): overall brightness and each channel vary by
    ``spread``."""
    factor = 1.0 + spread * rng.uniform(-1.0, 1.0) + 0.5 * spread * rng.uniform(-1.0, 1.0, 3)
    red, green, blue = np.array(base) * factor
    return float(red), float(green), float(blue)


def planks(rng: np.random.Generator, px: int = 256) -> Image:
    """(px, px, 3), light grey-brown boards of an eighth of the texture, to be tinted."""
    rows, _ = np.mgrid[0:px, 0:px].astype(np.float32)
    board = np.floor(rows / (px / 8)).astype(int)
    tone = 0.86 + 0.07 * rng.standard_normal(8).astype(np.float32)[board]
    grain = cv2.GaussianBlur(
        rng.standard_normal((px, px), dtype=np.float32), (0, 0), 9.0, None, 0.7
    )
    tone += 0.35 * grain
    tone[(rows % (px / 8)) < 2] *= 0.55
    return to_texture(tone[..., None] * np.array([255.0, 250.0, 242.0], np.float32))
