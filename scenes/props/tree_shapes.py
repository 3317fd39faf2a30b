"""Meshes and textures of woodland plants: conifers, crowns, trunks; needles and bark."""

from __future__ import annotations

import cv2
import numpy as np

from touchdown.scenes.api import Array, Image
from touchdown.scenes.authoring.meshes import MeshData, wrapped
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.textures import TILE_PX, Colour, to_texture


def conifer_mesh(rng: np.random.Generator, height_m: float, radius_m: float) -> MeshData:
    """Returns whorls of drooping branches, each a ragged cone over the next; the foot is at z = 0.
    Texture: around the trunk and from it outwards."""
    whorls = 4 if height_m < 4.0 else 6
    spikes = 7 if height_m < 4.0 else 9
    parts = []
    low = 0.13 * height_m
    for index in range(whorls):
        share = index / whorls
        base = low + (height_m - low) * share**0.92
        top = min(base + (height_m - low) * (0.42 - 0.10 * share), height_m)
        if index == whorls - 1:
            top = height_m
        radius = radius_m * (1.0 - share) ** 0.85
        parts.append(_whorl(rng, base, top, radius, spikes))
    return joined(parts)


def _whorl(
    rng: np.random.Generator, base_m: float, top_m: float, radius_m: float, spikes: int
) -> MeshData:
    """One ragged cone: branch tips and the notches between them alternate around the rim."""
    count = 2 * spikes
    angle = rng.uniform(0.0, 2.0 * np.pi) + np.linspace(0.0, 2.0 * np.pi, count + 1)
    out = np.where(np.arange(count + 1) % 2 == 0, 1.0, 0.60)
    reach = radius_m * out * rng.uniform(0.86, 1.12, count + 1)
    reach[-1] = reach[0]
    droop = np.where(np.arange(count + 1) % 2 == 0, 0.0, 0.16) * (top_m - base_m)
    rim = np.stack([reach * np.cos(angle), reach * np.sin(angle), base_m + droop], axis=-1)
    middle = 0.5 * (angle[:-1] + angle[1:])
    apex = np.tile([0.0, 0.0, top_m], (count, 1))
    under = np.tile([0.0, 0.0, base_m + 0.25 * (top_m - base_m)], (count, 1))
    lean = (top_m - base_m) / radius_m
    outward = np.stack([np.cos(angle), np.sin(angle), np.full(count + 1, 1.0 / max(lean, 0.3))], -1)
    peak = np.stack([np.cos(middle), np.sin(middle), np.full(count, 1.6)], -1)
    down = np.tile([0.0, 0.0, -1.0], (count, 1))
    turns = 3.0 / (2.0 * np.pi)
    edge = np.where(np.arange(count + 1) % 2 == 0, 0.98, 0.62)
    uv = np.concatenate([np.stack([turns * angle, edge], -1),
                        np.stack([turns * middle, np.full(count, 0.06)], -1),
                        np.stack([turns * middle, np.full(count, 0.02)], -1)])  # fmt: skip
    i = np.arange(count)
    upper = np.stack([count + 1 + i, i, i + 1], -1)
    lower = np.stack([2 * count + 1 + i, i + 1, i], -1)
    return MeshData(
        vertices=np.concatenate([rim, apex, under]),
        faces=np.concatenate([upper, lower]).astype(np.int32),
        uv=uv,
        normals=np.concatenate([outward, peak, down]),
    )


def joined(parts: list[MeshData]) -> MeshData:
    """`MeshData.join` that keeps the normals."""
    whole = MeshData.join(parts)
    normals = [part.normals for part in parts if part.normals is not None]
    return MeshData(
        vertices=whole.vertices, faces=whole.faces, uv=whole.uv, normals=np.concatenate(normals)
    )


def canopy_mesh(
    rng: np.random.Generator, half: Array, rings: int, metres_per_uv: float
) -> MeshData:
    """Returns a crown like a cauliflower: seen from its middle, the farthest wall of a dozen balls
    that lie around it. half: (3,) half axes in metres."""
    theta, phi = np.meshgrid(np.linspace(0.0, np.pi, rings + 1), np.linspace(0.0, 2.0 * np.pi,
                             2 * rings + 1), indexing="ij")  # fmt: skip
    unit = np.stack(
        [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1
    )
    reach = np.full(theta.shape, 0.62)
    count = 13
    height = np.linspace(0.95, -0.55, count) + rng.uniform(-0.08, 0.08, count)
    azimuth = 2.4 * np.arange(count) + rng.uniform(-0.4, 0.4, count)
    flat = np.sqrt(np.maximum(1.0 - height**2, 0.0))
    ways = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), height], axis=-1)
    for way in ways:
        centre = rng.uniform(0.50, 0.66) * way
        radius = rng.uniform(0.34, 0.50)
        along = unit @ centre
        inside = along**2 - centre @ centre + radius**2
        reach = np.maximum(reach, np.where(inside > 0.0, along + np.sqrt(np.abs(inside)), 0.0))
    reach *= 1.0 + 0.05 * rng.standard_normal(reach.shape)
    reach[:, -1], reach[0], reach[-1] = reach[:, 0], reach[0, 0], reach[-1, 0]
    return wrapped(rng, unit * reach[..., None] * half, metres_per_uv)


def lathe(rng: np.random.Generator, profile: Array, sides: int, wobble: float) -> MeshData:
    """Bark turned about +z through ``profile``, (K, 2) heights and radii, with sawn ends; each side
    is off by up to ``wobble`` (share of the radius)."""
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    rough = 1.0 + rng.uniform(-wobble, wobble, sides + 1)
    rough[-1] = rough[0]
    ring = np.stack([np.cos(angle) * rough, np.sin(angle) * rough], axis=-1)
    levels = len(profile)
    wall = np.concatenate([np.column_stack([r * ring, np.full(sides + 1, z)]) for z, r in profile])
    out = np.tile(np.column_stack([ring, np.zeros(sides + 1)]), (levels, 1))
    around = np.tile(np.linspace(0.0, 1.0, sides + 1), levels)
    along = np.repeat(0.7 * (profile[:, 0] - profile[0, 0]) / np.ptp(profile[:, 0]), sides + 1)
    index = np.arange(levels * (sides + 1)).reshape(levels, sides + 1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = [np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)]
    parts = [MeshData(vertices=wall, faces=np.concatenate(faces).astype(np.int32),
                      uv=np.column_stack([around, along]), normals=out)]  # fmt: skip
    for (z, r), way in ((profile[0], -1.0), (profile[-1], 1.0)):
        loop = ring[:-1][:: int(way)]
        points = np.column_stack([r * loop, np.full(sides, z)])
        uv = np.column_stack([0.5 + 0.45 * loop[:, 0], 0.87 + 0.11 * loop[:, 1]])
        fan = [[0, i, i + 1] for i in range(1, sides - 1)]
        parts.append(MeshData(vertices=points, faces=np.array(fan, np.int32), uv=uv,
                              normals=np.tile([0.0, 0.0, way], (sides, 1))))  # fmt: skip
    return joined(parts)


def needles(rng: np.random.Generator, base: Colour) -> Image:
    """(512, 512, 3), periodic to the right: sprays that hang outwards from the dark inside (top) to
    the young tips (bottom). base: RGB 0..255."""
    size = TILE_PX
    depth = np.linspace(0.0, 1.0, size, dtype=np.float32)[:, None, None]
    image = np.array(base, np.float32) * (0.34 + 0.30 * depth) * np.ones((1, size, 1), np.float32)
    count = 1500
    tops = np.sort(rng.uniform(-30.0, size, count))
    lefts = rng.uniform(0.0, size, count)
    lengths, leans = rng.uniform(24.0, 70.0, count), rng.normal(0.0, 0.35, count)
    tones, hues = rng.normal(0.0, 0.13, count), rng.normal(0.0, 0.06, (count, 3))
    widths = rng.integers(2, 6, count)
    for i in range(count):
        share = (tops[i] + lengths[i]) / size
        tone = (0.48 + 0.75 * np.clip(share, 0.0, 1.0)) * (1.0 + tones[i])
        colour = (np.array(base) * tone * (1.0 + hues[i]) + [4.0, 6.0, 0.0]).tolist()
        for shift in (-size, 0, size):
            x = lefts[i] + shift
            first = (round(x), round(tops[i]))
            last = (round(x + leans[i] * lengths[i]), round(tops[i] + lengths[i]))
            cv2.line(image, first, last, colour, int(widths[i]), cv2.LINE_AA)
    return to_texture(image)


def bark(rng: np.random.Generator, base: Colour) -> Image:
    """(256, 256, 3): furrowed bark above, and in the lowest quarter a sawn face with its rings.
    base: RGB 0..255."""
    size = 256
    furrows = cv2.blur(fractal_noise(rng, (size, size), 9.0, 3, 0.7), (1, 13))
    tone = 1.0 + 0.32 * furrows + 0.06 * rng.standard_normal((size, size), dtype=np.float32)
    image = tone[..., None] * np.array(base, np.float32)
    rows, cols = np.mgrid[0:size, 0:size].astype(np.float32) / size
    radius = np.hypot((cols - 0.5) / 0.45, (rows - 0.87) / 0.11)
    rings = 1.0 + 0.10 * np.sin(34.0 * radius) - 0.18 * np.exp(-((radius / 0.12) ** 2))
    face = rings[..., None] * np.array([206.0, 172.0, 122.0], np.float32)
    return to_texture(np.where((rows > 0.74)[..., None], face, image).astype(np.float32))
