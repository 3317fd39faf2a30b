"""The network that finds people, and its training.

A U-shaped network of separable convolutions, 0.1 million weights: a stem at a quarter of the size,
three levels down to 1/16 for those who are near, and back. The loss is that of CenterNet: a focal
loss on the marks of middles, and the size of the box at each middle.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from touchdown.landing.watch.people import SIZE, STRIDE
from touchdown.sim.typing import Bytes, Float32

CROP = (212, 120)
"""width and height of what is trained on"""
_LEARNING_RATE = 3e-3
_SIZE_LOSS = 0.1
_WIDTHS = (16, 32, 48, 64)


class _Separable(nn.Module):
    def __init__(self, inner: int, outer: int, stride: int = 1) -> None:
        super().__init__()
        self.way = nn.Sequential(
            nn.Conv2d(inner, inner, 3, stride, 1, groups=inner, bias=False),
            nn.BatchNorm2d(inner),
            nn.Conv2d(inner, outer, 1, bias=False),
            nn.BatchNorm2d(outer),
            nn.ReLU(),
        )
        self.same = inner == outer and stride == 1

    def forward(self, x: Tensor) -> Tensor:
        found: Tensor = self.way(x)
        return found + x if self.same else found


class PeopleNetwork(nn.Module):
    """(N, 3, 240, 424) images in [0, 1] -> heat (N, 1, 60, 106) in [0, 1] and box sizes (N, 2, 60,
    106) in pixels."""

    def __init__(self) -> None:
        super().__init__()
        first, a, b, c = _WIDTHS
        self.stem = nn.Sequential(
            nn.Conv2d(3, first, 3, 2, 1, bias=False), nn.BatchNorm2d(first), nn.ReLU(),
            nn.Conv2d(first, a, 3, 2, 1, bias=False), nn.BatchNorm2d(a), nn.ReLU(),
            _Separable(a, a),
        )  # fmt: skip
        self.down1 = nn.Sequential(_Separable(a, b, 2), _Separable(b, b), _Separable(b, b))
        self.down2 = nn.Sequential(
            _Separable(b, c, 2), _Separable(c, c), _Separable(c, c), _Separable(c, c)
        )
        self.up1, self.up2 = _Separable(c + b, b), _Separable(b + a, a)
        self.last = nn.Sequential(_Separable(a, a), nn.Conv2d(a, a, 3, 1, 1), nn.ReLU())
        self.heads = nn.Conv2d(a, 3, 1)
        nn.init.constant_(self.heads.bias, -2.5)  # type: ignore[arg-type]

    def raw(self, images: Tensor) -> Tensor:
        """(N, 3, h, w): the logit of a middle, and logarithms of width and height over the
        stride."""
        fine = self.stem(images - 0.45)
        middle = self.down1(fine)
        coarse = self.down2(middle)
        middle = self.up1(torch.cat([_grown(coarse, middle), middle], 1))
        fine = self.up2(torch.cat([_grown(middle, fine), fine], 1))
        return self.heads(self.last(fine))  # type: ignore[no-any-return]

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        found = self.raw(images)
        return torch.sigmoid(found[:, :1]), STRIDE * torch.exp(found[:, 1:].clamp(-2.0, 5.0))


def _grown(small: Tensor, like: Tensor) -> Tensor:
    return functional.interpolate(small, size=like.shape[2:], mode="nearest")


class Targets(NamedTuple):
    """What a network should answer: (h, w) heat, (2, h, w) logarithms of sizes over the stride, and
    (h, w) where a middle is."""

    heat: Float32
    sizes: Float32
    middle: Float32


def targets_of(boxes: Float32) -> Targets:
    """Targets of (N, 4) boxes in a crop: a mark whose width is a sixth of its box, at its
    middle."""
    rows, cols = CROP[1] // STRIDE, CROP[0] // STRIDE
    heat, sizes = np.zeros((rows, cols), np.float32), np.zeros((2, rows, cols), np.float32)
    middle = np.zeros((rows, cols), np.float32)
    y, x = np.mgrid[:rows, :cols]
    for x0, y0, x1, y1 in boxes:
        col = min(int(0.5 * (x0 + x1) / STRIDE), cols - 1)
        row = min(int(0.5 * (y0 + y1) / STRIDE), rows - 1)
        spread = np.maximum(np.array([x1 - x0, y1 - y0]) / STRIDE / 6.0, 0.5)
        mark = np.exp(-0.5 * (((x - col) / spread[0]) ** 2 + ((y - row) / spread[1]) ** 2))
        heat = np.maximum(heat, mark.astype(np.float32))
        sizes[:, row, col] = np.log(np.maximum([x1 - x0, y1 - y0], 1.0) / STRIDE)
        middle[row, col] = 1.0
    return Targets(heat, sizes, middle)


def augmented(image: Bytes, boxes: Float32, rng: np.random.Generator) -> tuple[Bytes, Float32]:
    """A part of an image, or all of it smaller, (120, 212, 3), and its boxes (N, 4), as another
    height, light or attitude would have them."""
    width, height = CROP
    found, places = _cropped(image, boxes, rng)
    if rng.random() < 0.5:
        found, places[:, [0, 2]] = found[:, ::-1], width - places[:, [2, 0]]
    if rng.random() < 0.5:
        found, places[:, [1, 3]] = found[::-1], height - places[:, [3, 1]]
    values = found.astype(np.float32) / 255.0
    values = np.clip(values, 1e-3, 1.0) ** float(np.exp(rng.normal(0.0, 0.25)))
    values *= np.exp(rng.normal(0.0, 0.08, 3) + rng.normal(0.0, 0.2)).astype(np.float32)
    if rng.random() < 0.3:
        values = cv2.GaussianBlur(values, (0, 0), float(rng.uniform(0.4, 1.2)))
    values += rng.normal(0.0, float(rng.uniform(0.0, 0.03)), values.shape).astype(np.float32)
    return (np.clip(values, 0.0, 1.0) * 255.0).astype(np.uint8), places


def _cropped(image: Bytes, boxes: Float32, rng: np.random.Generator) -> tuple[Bytes, Float32]:
    """A window of 1 to 2 times the size of a crop, three times of four about somebody."""
    size = np.array(CROP) * float(rng.uniform(1.0, 2.0))
    room = np.array(SIZE) - size
    corner = rng.uniform(0.0, 1.0, 2) * room
    if len(boxes) and rng.random() < 0.75:
        x0, y0, x1, y1 = boxes[int(rng.integers(len(boxes)))]
        middle = np.array([x0 + x1, y0 + y1]) / 2.0 + rng.normal(0.0, 0.25, 2) * size
        corner = np.clip(middle - 0.5 * size, 0.0, room)
    first, last = corner.astype(int), (corner + size).astype(int)
    part = image[first[1] : last[1], first[0] : last[0]]
    scale = CROP / np.array(part.shape[1::-1])
    places = (boxes - np.tile(first, 2)) * np.tile(scale, 2)
    whole = (places[:, 2] - places[:, 0]) * (places[:, 3] - places[:, 1])
    places = np.clip(places, 0.0, np.tile(CROP, 2))
    shown = (places[:, 2] - places[:, 0]) * (places[:, 3] - places[:, 1])
    small = cv2.resize(part, CROP, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8), places[shown > 0.3 * whole].astype(np.float32)


def loss_of(found: Tensor, heat: Tensor, sizes: Tensor, middle: Tensor) -> Tensor:
    """Loss of raw answers (N, 3, h, w) beside targets."""
    logit = found[:, 0]
    chance = torch.sigmoid(logit)
    count = middle.sum().clamp(min=1.0)
    hit = middle * (1.0 - chance) ** 2 * functional.logsigmoid(logit)
    miss = (1.0 - middle) * (1.0 - heat) ** 4 * chance**2 * functional.logsigmoid(-logit)
    size = (middle[:, None] * (found[:, 1:] - sizes).abs()).sum()
    return (_SIZE_LOSS * size - hit.sum() - miss.sum()) / count


def train(
    images: Sequence[Bytes],
    boxes: Sequence[Float32],
    epochs: int,
    seed: int,
    report: Callable[[int, float], None] = lambda epoch, loss: None,
    batch_size: int = 24,
) -> PeopleNetwork:
    """Trains on images (240, 424, 3) uint8 and the boxes (K, 4) of each. The learning rate rises
    and falls once."""
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    network = PeopleNetwork()
    optimiser = torch.optim.AdamW(network.parameters(), lr=_LEARNING_RATE, weight_decay=1e-4)
    steps = epochs * (len(images) // batch_size)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, _LEARNING_RATE, total_steps=steps)
    for epoch in range(epochs):
        order, total = rng.permutation(len(images)), 0.0
        for first in range(0, len(images) - batch_size + 1, batch_size):
            drawn = [augmented(images[i], boxes[i], rng) for i in order[first : first + batch_size]]
            batch = np.stack([image for image, _ in drawn]).transpose(0, 3, 1, 2)
            wanted = [targets_of(places) for _, places in drawn]
            found = network.raw(torch.from_numpy(batch.astype(np.float32) / 255.0))
            parts = (torch.from_numpy(np.stack(part)) for part in zip(*wanted, strict=True))
            loss = loss_of(found, *parts)
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(network.parameters(), 5.0)
            optimiser.step()
            schedule.step()
            total += float(loss.detach())
        report(epoch, total / max(len(images) // batch_size, 1))
    return network.eval()


def export(network: PeopleNetwork, file: Path) -> None:
    """Writes the network as ONNX: ``image`` (1, 3, 240, 424) -> ``heat``, ``sizes``."""
    example = torch.zeros(1, 3, SIZE[1], SIZE[0])
    torch.onnx.export(
        network, (example,), str(file), input_names=["image"], output_names=["heat", "sizes"],
        dynamo=False,
    )  # fmt: skip
