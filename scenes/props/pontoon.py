"""A concrete work pontoon."""

import numpy as np

from touchdown.scenes.api import Array, Image, Surface
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plots import Plot
from touchdown.scenes.authoring.textures import to_texture
from touchdown.scenes.props import waterside

CONCRETE = Surface(land_class="path", reflectivity=0.36)


def place_pontoon(builder: SceneBuilder) -> None:
    """Adds a concrete work pontoon with a painted circle, bollards, a rail and crates."""
    rng = builder.rng
    size = (float(rng.uniform(9.0, 12.0)), float(rng.uniform(6.2, 7.4)))
    plot = Plot(origin_xy_m=np.zeros(2), angle=float(rng.uniform(-0.6, 0.6)))
    deck = waterside.Deck(plot=plot, size_m=size, top_m=0.0, thick_m=0.9)
    waterside.add_deck(builder, deck, _concrete(rng, size), CONCRETE)
    builder.claim(np.zeros(2), 0.7 * max(size))
    x, y = 0.5 * size[0], 0.5 * size[1]
    for corner in [plot.at(sx * (x - 0.3), sy * (y - 0.3)) for sx in (-1, 1) for sy in (-1, 1)]:
        builder.geom("bollard", waterside.PILE, cylinder=(0.12, 0.2),
                     pos=[*corner, 0.18], rgba=[0.80, 0.64, 0.12, 1])  # fmt: skip
        square_shadow(builder, corner, 0.12, 0.36)
    side = -1.0 if rng.random() < 0.5 else 1.0
    posts = [plot.at(side * (x - 0.1), t) for t in np.linspace(-y + 0.8, y - 0.8, 4)]
    for post in posts:
        builder.geom("rail_post", waterside.PILE, capsule=0.03,
                     fromto=[*post, 0.0, *post, 1.05], rgba=[0.86, 0.86, 0.84, 1])  # fmt: skip
        square_shadow(builder, post, 0.03, 1.05)
    for height in (0.55, 1.05):
        builder.geom("rail", waterside.PILE, capsule=0.025, rgba=[0.86, 0.86, 0.84, 1],
                     fromto=[*posts[0], height, *posts[-1], height])  # fmt: skip
    for index in range(int(rng.integers(1, 4))):
        spot = plot.at(-side * (x - 0.8), -y + 1.0 + 1.3 * index)
        half = rng.uniform([0.35, 0.3, 0.25], [0.5, 0.45, 0.45])
        builder.geom("crate", waterside.PILE, box=half, pos=[*spot, half[2]],
                     heading=plot.angle + rng.uniform(-0.3, 0.3),
                     rgba=[0.30, 0.36 + 0.08 * index, 0.46, 1])  # fmt: skip


def _concrete(rng: np.random.Generator, size_m: tuple[float, float]) -> Image:
    """Slabs with joints and rust, a yellow edge and a white ring in the middle."""
    px = 96.0
    width, height = (round(s * px) for s in size_m)
    y, x = np.mgrid[0:height, 0:width].astype(np.float32) / px
    tone = 150.0 + 7.0 * fractal_noise(rng, (height, width), 1.2 * px, 4, 0.6)
    tone += 5.0 * rng.standard_normal((height, width), dtype=np.float32)
    pitch = size_m[0] / round(size_m[0] / 2.5)
    tone[((x % pitch) < 0.025) | (np.abs(y - 0.5 * size_m[1]) < 0.012)] *= 0.6
    image = tone[..., None] * np.array([1.0, 0.985, 0.955], np.float32)
    rust = np.clip(fractal_noise(rng, (height, width), 0.7 * px, 4, 0.6) - 1.5, 0.0, 0.8)
    image += rust[..., None] * (np.array([132.0, 84.0, 56.0], np.float32) - image)
    edge = np.minimum(np.minimum(x, size_m[0] - x), np.minimum(y, size_m[1] - y))
    worn = fractal_noise(rng, (height, width), 0.15 * px, 3, 0.6) > -1.1
    image[(edge > 0.12) & (edge < 0.27) & worn] = (206.0, 170.0, 48.0)
    ring = np.abs(np.hypot(x - 0.5 * size_m[0], y - 0.5 * size_m[1]) - 1.9) < 0.1
    image[ring & worn] = (224.0, 224.0, 220.0)
    return to_texture(image)


def square_shadow(builder: SceneBuilder, xy_m: Array, half_m: float, top_m: float) -> None:
    """Registers an upright post of square section as a caster, from height 0 up."""
    builder.cast_box((half_m, half_m), (0.0, top_m), 0.0, np.array([*xy_m, 0.0]))
