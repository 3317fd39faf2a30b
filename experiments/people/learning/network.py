"""The network that finds people, and its training.

A U-shaped network of 0.2 million weights: a stem at a quarter of the size, levels down to 1/16, and
back. The loss is that of CenterNet: a focal loss on the marks of middles, and the size of the box
at each middle.
"""

import copy
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from touchdown.experiments.people.images import SHOWN, Labelled
from touchdown.landing.watch.people import (
    LEAST_WIDTH,
    PIXEL_M,
    STRIDE,
    levelled,
    overlap,
    peaks,
    resampled,
)
from touchdown.sim.typing import Bytes, Float32

CROP = 160
"""side of the squares that are trained on, pixels"""
_LEARNING_RATE = 3e-3
_SIZE_LOSS = 0.1
_AVERAGED = 0.998
"""of the weights' moving average that a step leaves"""
_CLUTTERED = 0.35
"""part of the squares with more clutter than there is"""
_LEAST_SPREAD = 0.9
"""cells: a mark's neighbours may be the middle as well"""
_MINED_EVERY, _FALSE, _SURE = 6, 0.08, 0.4
"""epochs between searches for mistakes; scores from which on nobody is found falsely, and somebody
is found"""
_WIDTHS = (16, 24, 40, 56)


def _convolved(inner: int, outer: int, stride: int = 1, size: int = 3) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inner, outer, size, stride, size // 2, bias=False), nn.BatchNorm2d(outer),
        nn.ReLU(),
    )  # fmt: skip


class _Residual(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.way = nn.Sequential(
            _convolved(width, width),
            nn.Conv2d(width, width, 3, 1, 1, bias=False), nn.BatchNorm2d(width),
        )  # fmt: skip

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(x + self.way(x))


class PeopleNetwork(nn.Module):
    """(N, 3, H, W) images of `landing.watch.people.levelled` -> heat (N, 1, H / 4, W / 4) in [0, 1]
    and box sizes (N, 2, H / 4, W / 4) in pixels."""

    def __init__(self) -> None:
        super().__init__()
        first, a, b, c = _WIDTHS
        self.stem = nn.Sequential(_convolved(3, first, 2), _convolved(first, a, 2), _Residual(a))
        self.down1 = nn.Sequential(_convolved(a, b, 2), _Residual(b))
        self.down2 = nn.Sequential(_convolved(b, c, 2), _Residual(c), _Residual(c))
        self.to_middle, self.to_fine = _convolved(c, b, size=1), _convolved(b, a, size=1)
        self.up1, self.up2 = _convolved(b, b), _convolved(a, a)
        self.heads = nn.Sequential(_convolved(a, a), nn.Conv2d(a, 3, 1))
        nn.init.constant_(self.heads[-1].bias, -2.5)  # type: ignore[arg-type]

    def raw(self, images: Tensor) -> Tensor:
        """(N, 3, h, w): the logit of a middle, and logarithms of width and height over the
        stride."""
        fine = self.stem(images)
        middle = self.down1(fine)
        coarse = self.down2(middle)
        middle = self.up1(middle + _grown(self.to_middle(coarse), middle))
        fine = self.up2(fine + _grown(self.to_fine(middle), fine))
        return self.heads(fine)  # type: ignore[no-any-return]

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        found = self.raw(images)
        return torch.sigmoid(found[:, :1]), STRIDE * torch.exp(found[:, 1:].clamp(-2.0, 5.0))


def _grown(small: Tensor, like: Tensor) -> Tensor:
    return functional.interpolate(small, size=like.shape[2:], mode="nearest")


class Targets(NamedTuple):
    """What a network should answer: (h, w) heat, (2, h, w) logarithms of sizes over the stride,
    (h, w) where a middle is, and (h, w) 0 where nothing is asked."""

    heat: Float32
    sizes: Float32
    middle: Float32
    asked: Float32


def targets_of(boxes: Float32, shown: Float32) -> Targets:
    """Targets of (N, 4) boxes in a square and the fractions (N,) shown: a mark whose width is a
    sixth of its box, at its middle. Of whom too little is shown nothing is asked."""
    side = CROP // STRIDE
    heat, sizes = np.zeros((side, side), np.float32), np.zeros((2, side, side), np.float32)
    middle, asked = np.zeros((side, side), np.float32), np.ones((side, side), np.float32)
    y, x = np.mgrid[:side, :side]
    for (x0, y0, x1, y1), part in zip(boxes, shown, strict=True):
        if part < SHOWN:
            rows, cols = (
                slice(int(a // STRIDE), math.ceil(b / STRIDE)) for a, b in ((y0, y1), (x0, x1))
            )
            asked[rows, cols] = 0.0
            continue
        col = min(int(0.5 * (x0 + x1) / STRIDE), side - 1)
        row = min(int(0.5 * (y0 + y1) / STRIDE), side - 1)
        spread = np.maximum(np.array([x1 - x0, y1 - y0]) / STRIDE / 6.0, _LEAST_SPREAD)
        mark = np.exp(-0.5 * (((x - col) / spread[0]) ** 2 + ((y - row) / spread[1]) ** 2))
        heat = np.maximum(heat, mark.astype(np.float32))
        sizes[:, row, col] = np.log(np.maximum([x1 - x0, y1 - y0], 1.0) / STRIDE)
        middle[row, col] = 1.0
    return Targets(heat, sizes, middle, np.maximum(asked, middle))


class Sample(NamedTuple):
    """A square (160, 160, 3) uint8, its boxes (N, 4), and how much of each is shown, (N,)."""

    image: Bytes
    boxes: Float32
    shown: Float32


def augmented(
    one: Labelled, rng: np.random.Generator, hard: Sequence[tuple[float, float]] = ()
) -> Sample:
    """A square out of an image, as another height, light or attitude would have it; one time of
    four about one of the ``hard`` places (x, y), pixels of the image, if there are any."""
    image, boxes, shown = _cropped(one, rng, hard)
    if rng.random() < _CLUTTERED:
        clutter(image, boxes, rng)
    for _ in range(int(rng.integers(4))):
        image = np.rot90(image)
        boxes = np.stack([boxes[:, 1], CROP - boxes[:, 2], boxes[:, 3], CROP - boxes[:, 0]], 1)
    if rng.random() < 0.5:
        image, boxes[:, [0, 2]] = image[:, ::-1], CROP - boxes[:, [2, 0]]
    values = np.ascontiguousarray(image).astype(np.float32) / 255.0
    if rng.random() < 0.3:
        hsv = cv2.cvtColor(values, cv2.COLOR_RGB2HSV)
        hsv[..., 0] = (hsv[..., 0] + rng.normal(0.0, 12.0)) % 360.0
        hsv[..., 1] = np.clip(hsv[..., 1] * np.exp(rng.normal(0.0, 0.3)), 0.0, 1.0)
        values = np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB), np.float32)
    values = np.clip(values, 1e-3, 1.0) ** float(np.exp(rng.normal(0.0, 0.2)))
    values *= np.exp(rng.normal(0.0, 0.06, 3) + rng.normal(0.0, 0.2)).astype(np.float32)
    if rng.random() < 0.25:
        values = cv2.GaussianBlur(values, (0, 0), float(rng.uniform(0.3, 1.0)))
    values += rng.normal(0.0, float(rng.uniform(0.0, 0.03)), values.shape).astype(np.float32)
    return Sample((np.clip(values, 0.0, 1.0) * 255.0).astype(np.uint8), boxes, shown)


def clutter(image: Bytes, boxes: Float32, rng: np.random.Generator) -> None:
    """Draws up to six stains, stones and plates of a person's size beside the boxes: they are
    nobody."""
    for _ in range(int(rng.integers(1, 7))):
        half = np.exp(rng.uniform(np.log(2.0), np.log(14.0), 2))
        reach = math.ceil(1.5 * half.max()) + 3
        x, y = rng.integers(reach, CROP - reach, 2)
        near = np.array([x - reach, y - reach, x + reach, y + reach])
        if any(overlap(tuple(near), tuple(box)) > 0.0 for box in boxes):
            continue
        side = 2 * reach
        cover, angle = np.zeros((side, side), np.float32), float(rng.uniform(0.0, 180.0))
        if rng.random() < 0.7:
            axes = (int(half[0]), int(half[1]))
            cv2.ellipse(cover, (reach, reach), axes, angle, 0.0, 360.0, 1.0, -1)
        else:
            corners = cv2.boxPoints(((reach, reach), tuple((2.0 * half).tolist()), angle))
            cv2.fillConvexPoly(cover, corners.astype(np.int32), 1.0)
        grain = cv2.resize(rng.normal(0.0, 1.0, (5, 5)), (side, side)).astype(np.float32)
        cover = np.clip(cover * (1.0 + float(rng.uniform(0.0, 1.0)) * grain), 0.0, 1.0)
        cover = cv2.GaussianBlur(cover, (0, 0), float(rng.uniform(0.4, 1.6)))[..., None]
        part = image[near[1] : near[3], near[0] : near[2]]
        mean = part.mean(axis=(0, 1))
        colour = mean * rng.uniform(0.3, 1.9) + rng.normal(0.0, 25.0, 3)
        stain = colour * (1.0 + 0.15 * grain[..., None])
        part[:] = np.clip(part + cover * (stain - part), 0.0, 255.0)


def _cropped(
    one: Labelled, rng: np.random.Generator, hard: Sequence[tuple[float, float]]
) -> Sample:  # fmt: skip
    """A square at about the network's scale, more than half of them about somebody; what an image
    is too small for is of its mean colour."""
    rows, cols = one.image.shape[:2]
    scale = max(one.metres_per_pixel / PIXEL_M, LEAST_WIDTH / cols)
    scale *= float(np.exp(rng.uniform(-0.3, 0.25)))
    side = CROP / scale
    size = np.array([cols, rows])
    corner = rng.uniform(0.0, 1.0, 2) * (size - side)
    whole = np.flatnonzero(one.shown >= SHOWN)
    about: tuple[float, float] | None = None
    if hard and rng.random() < 0.25:
        about = hard[int(rng.integers(len(hard)))]
    elif len(whole) and rng.random() < 0.7:
        x0, y0, x1, y1 = one.boxes[whole[int(rng.integers(len(whole)))]]
        about = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
    if about is not None:
        corner = np.array(about) - side * rng.uniform(0.1, 0.9, 2)
        corner = np.clip(corner, np.minimum(0.0, size - side), np.maximum(0.0, size - side))
    way = np.array([[scale, 0.0, -scale * corner[0]], [0.0, scale, -scale * corner[1]]])
    first = np.floor(np.clip(corner, 0, size - 1)).astype(int)
    last = np.ceil(np.clip(corner + side, first + 1, size)).astype(int)
    part = one.image[first[1] : last[1], first[0] : last[0]]
    to = np.round((np.array([*first, *last]) - np.tile(corner, 2)) * scale).astype(int)
    to = np.clip(to, 0, CROP)
    image = np.full((CROP, CROP, 3), part.mean(axis=(0, 1)), np.uint8)
    width, height = int(max(to[2] - to[0], 1)), int(max(to[3] - to[1], 1))
    image[to[1] : to[1] + height, to[0] : to[0] + width] = cv2.resize(
        part, (width, height), interpolation=cv2.INTER_AREA
    )[: CROP - to[1], : CROP - to[0]]
    places = one.boxes * scale + np.tile(way[:, 2], 2)
    area = (places[:, 2] - places[:, 0]) * (places[:, 3] - places[:, 1])
    places = np.clip(places, 0.0, CROP)
    left = (places[:, 2] - places[:, 0]) * (places[:, 3] - places[:, 1])
    kept = left > 0.0
    shown = one.shown * left / np.maximum(area, 1e-6)
    return Sample(image, places[kept].astype(np.float32), shown[kept].astype(np.float32))


def loss_of(found: Tensor, heat: Tensor, sizes: Tensor, middle: Tensor, asked: Tensor) -> Tensor:
    """Loss of raw answers (N, 3, h, w) beside targets."""
    logit = found[:, 0]
    chance = torch.sigmoid(logit)
    count = middle.sum().clamp(min=1.0)
    hit = middle * (1.0 - chance) ** 2 * functional.logsigmoid(logit)
    miss = (1.0 - middle) * (1.0 - heat) ** 4 * chance**2 * functional.logsigmoid(-logit)
    size = (middle[:, None] * (found[:, 1:] - sizes).abs()).sum()
    return (_SIZE_LOSS * size - hit.sum() - (asked * miss).sum()) / count


def train(
    images: Sequence[Labelled],
    epochs: int,
    seed: int,
    report: Callable[[int, float], None] = lambda epoch, loss: None,
    batch_size: int = 24,
) -> PeopleNetwork:
    """Trains anew. The learning rate rises and falls once; the network returned is the moving
    average of the weights. From time to time squares are drawn about mistakes."""
    batch_size = min(batch_size, len(images))
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    network = PeopleNetwork().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    averaged = copy.deepcopy(network)
    optimiser = torch.optim.AdamW(network.parameters(), lr=_LEARNING_RATE, weight_decay=1e-3)
    steps = epochs * (len(images) // batch_size)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, _LEARNING_RATE, total_steps=steps)
    hard: list[list[tuple[float, float]]] = [[] for _ in images]
    step = 0
    for epoch in range(epochs):
        if epoch and epoch % _MINED_EVERY == 0:
            hard = [mistakes(averaged, one) for one in images]
        order, total = rng.permutation(len(images)), 0.0
        for first in range(0, len(images) - batch_size + 1, batch_size):
            drawn = [augmented(images[i], rng, hard[i]) for i in order[first : first + batch_size]]
            batch = np.stack([levelled(one.image) for one in drawn]).transpose(0, 3, 1, 2)
            wanted = [targets_of(one.boxes, one.shown) for one in drawn]
            found = network.raw(torch.from_numpy(batch))
            parts = (torch.from_numpy(np.stack(part)) for part in zip(*wanted, strict=True))
            loss = loss_of(found, *parts)
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(network.parameters(), 5.0)
            optimiser.step()
            schedule.step()
            step += 1
            _average(averaged, network, min(_AVERAGED, step / (step + 9.0)))
            total += float(loss.detach())
        report(epoch, total / max(len(images) // batch_size, 1))
    return averaged.eval()


def _average(averaged: nn.Module, network: nn.Module, left: float) -> None:
    """Moves the average towards the network, statistics of its layers included."""
    with torch.no_grad():
        for slow, fast in zip(
            averaged.state_dict().values(), network.state_dict().values(), strict=True
        ):
            if slow.is_floating_point():
                slow.lerp_(fast, 1.0 - left)


def mistakes(network: PeopleNetwork, one: Labelled) -> list[tuple[float, float]]:
    """(x, y) in pixels of an image where the network finds somebody who is not there, or misses
    somebody."""
    small = resampled(one.image, one.metres_per_pixel)
    network.eval()
    with torch.no_grad():
        heat, sizes = network(torch.from_numpy(levelled(small).transpose(2, 0, 1)[None].copy()))
    ratio = np.array(one.image.shape[1::-1]) / small.shape[1::-1]
    found = np.array(peaks(heat[0, 0].numpy(), sizes[0].numpy(), _FALSE)).reshape(-1, 5)
    middles = 0.5 * (found[:, :2] + found[:, 2:4]) * ratio
    least, most = one.boxes[:, None, :2], one.boxes[:, None, 2:]
    inside = ((least <= middles) & (middles <= most)).all(axis=2)  # (boxes, found)
    missed = ~(inside & (found[:, 4] >= _SURE)).any(axis=1) & (one.shown >= SHOWN)
    places = [*middles[~inside.any(axis=0)], *(0.5 * (one.boxes[:, :2] + one.boxes[:, 2:]))[missed]]
    return [(float(x), float(y)) for x, y in places]


def export(network: PeopleNetwork, file: Path) -> None:
    """Writes the network as ONNX: ``image`` (1, 3, H, W) -> ``heat``, ``sizes``."""
    example = torch.zeros(1, 3, 144, 256)
    network = network.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
    sides = {2: "height", 3: "width"}
    torch.onnx.export(
        network, (example,), str(file), input_names=["image"], output_names=["heat", "sizes"],
        dynamic_axes={"image": sides, "heat": sides, "sizes": sides}, dynamo=False,
    )  # fmt: skip
