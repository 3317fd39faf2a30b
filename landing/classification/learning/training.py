"""Training a network on labelled images: AdamW, cosine schedule, averaged weights, early stop."""

import copy
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from touchdown.landing.api import LabelledImages
from touchdown.landing.classification import scores
from touchdown.landing.classification.learning import checkpoint
from touchdown.landing.classification.learning.augment import (
    as_input,
    augmented,
    colour_spreads,
    recoloured,
    textured,
    weathered,
)
from touchdown.landing.classification.learning.ensemble import Teachers, taught
from touchdown.landing.classification.networks.registry import build_network, check_network

Progress = Callable[[int, int, str], None]
TEXTURES = "textures"
"""name of the data set of photographed textures"""
_AVERAGE = 0.998
"""fraction of the previous average that the averaged weights keep at each step"""
_LARGEST_GRADIENT = 1.0
_WARM_UP = 0.05
"""fraction of all steps in which the learning rate rises from 0"""
_ALIKE = 3e-4
"""macro F1 below the best that counts as the best: of two such epochs the later one, at a lower
rate of learning, is kept; it is surer of what it knows"""
_MAY_CHANGE = ("epochs", "patience", "miss_costs", "left_out")
"""parameters that may change when a training resumes: they affect the length of the schedule and
the written file only, or the images, which are compared themselves"""
_WEIGHT_DECAY, _LABEL_SMOOTHING = 0.05, 0.05
_TAUGHT = 0.7
"""weight of the teachers' probabilities in the targets (chosen, not fitted)"""


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainParams:
    """Parameters of a training."""

    network: str = "resnet50_cbam"
    labels: str = "d_land"
    image_size: int = 96
    epochs: int = 30
    batch_size: int = 64
    learning_rate: float = 1e-3
    variation: float = 1.0
    """strength of the augmentation (`augment.augmented`)"""
    markings: float = 0.0
    """fraction of images with lines painted on them (`augment.marked`)"""
    colours: float = 0.0
    """fraction of images of built or bare ground and water of another colour
    (`augment.recoloured`)"""
    textures: float = 0.0
    """fraction of images that take on a photographed texture of their class (`augment.textured`)"""
    weather: float = 0.0
    """fraction of `augment.weathered`, relative to its own"""
    teachers: tuple[str, ...] = ()
    """files of networks or ensembles, whose mean is learnt, too (`ensemble.Teachers`)"""
    frozen: int = 0
    """first layers of the network that keep their initial weights"""
    left_out: tuple[str, ...] = ()
    """sources whose photographs are all for the test"""
    miss_costs: tuple[tuple[str, float], ...] = ()
    """as ``NetworkFacts.miss_costs``; they do not affect the training itself"""
    patience: int = 8
    """epochs of macro F1 below the best on the validation images before training ends"""
    seed: int = 0


@dataclass(frozen=True, slots=True)
class Trained:
    """A network at its best epoch."""

    network: nn.Module
    temperature: float
    history: list[dict[str, float]]
    best_epoch: int
    scores: NDArray[np.float32]
    """(N, C) calibrated scores of the validation images"""


def chosen_device(name: str) -> torch.device:
    """Returns the device; ``auto`` is a GPU where there is one. Raises ValueError for a device that
    this machine does not have."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name not in ("cpu", "cuda"):
        raise ValueError(f"unknown device '{name}': give auto, cpu or cuda")
    if name == "cuda" and not torch.cuda.is_available():
        raise ValueError("device 'cuda': torch finds no GPU here; give auto or cpu")
    return torch.device(name)


class Trainer:
    """A training that can be interrupted after any epoch and resumed.

    Every random number is keyed by seed, epoch and step: an interrupted training ends with the same
    weights, on a CPU to the bit. Raises ValueError for an unknown network, images that are too
    small, or a folder of another training.
    """

    def __init__(
        self,
        params: TrainParams,
        train: LabelledImages,
        val: LabelledImages,
        folder: Path,
        device: torch.device,
        *,
        start: Path | None = None,
    ) -> None:
        """``start``: folder of another training of this network, or a network's file, with the
        initial weights."""
        check_network(params.network, params.image_size)
        self.params, self._train, self._val = params, train, val
        self._folder, self._device = folder, device
        files = [Path(name) for name in params.teachers]
        self._teachers = Teachers(files, train.classes, torch.get_num_threads())
        of_textures = train.source == (
            train.sources.index(TEXTURES) if TEXTURES in train.sources else -1
        )
        self._textures = {
            int(number): np.flatnonzero(of_textures & (train.labels == number))
            for number in np.unique(train.labels[of_textures])
        }
        self.steps = max(1, math.ceil(len(train.labels) / params.batch_size))
        torch.manual_seed(params.seed)
        self.network = build_network(params.network, len(train.classes), params.image_size)
        if start is not None:
            checkpoint.begin_with(self.network, params.network, train.classes, start)
        self._still = list(self.network.children())[: params.frozen]
        for layer in self._still:
            layer.requires_grad_(False)
        self.network.to(device)
        # as tensor cores want them, and the vector units of a processor
        nn.utils.convert_conv2d_weight_memory_format(self.network, torch.channels_last)
        self._average = copy.deepcopy(self.network).eval().requires_grad_(False)
        self._best = copy.deepcopy(self._average)
        self._optimizer = _optimizer(self.network, params)
        self.history: list[dict[str, float]] = []
        self.best_epoch = -1
        self._identity = asdict(params) | {
            "data": _fingerprint(train, val),
            "start": None if start is None else checkpoint.fingerprint(start),
            "teachers": self._teachers.fingerprint,
        }
        for name in _MAY_CHANGE:
            del self._identity[name]
        checkpoint.restore(self, folder, self._identity)

    @property
    def finished(self) -> bool:
        done = len(self.history)
        if done >= self.params.epochs:
            return True
        return done - 1 - self.best_epoch >= self.params.patience

    def write(self) -> None:
        """Writes the checkpoint: all that the next epoch and the result depend on."""
        state = {name: part.state_dict() for name, part in self._parts().items()}
        checkpoint.write(self, self._folder, self._identity, state)

    def take_state(self, state: dict[str, Any]) -> None:
        """Takes over the weights of a checkpoint. Raises ValueError for NaN and infinite ones."""
        if not checkpoint.finite(state["best"]):
            raise ValueError("weights that are NaN or infinite")
        for name, part in self._parts().items():
            part.load_state_dict(state[name])

    def _parts(self) -> dict[str, Any]:
        return {
            "network": self.network,
            "average": self._average,
            "best": self._best,
            "optimizer": self._optimizer,
        }

    def run_epoch(self, progress: Progress) -> dict[str, float]:
        """Trains for one epoch, validates the averaged weights, writes the checkpoint."""
        epoch = len(self.history)
        draws = balanced_order(self._train, self.params.seed, epoch)
        # dropout draws from torch's own generator
        torch.manual_seed(self._key("dropout", epoch))
        generator = torch.Generator().manual_seed(self._key("augment", epoch))
        self.network.train()
        for layer in self._still:
            layer.eval()
        total = 0.0
        for step in range(self.steps):
            # Two images at least: of one, batch norm may find nothing to divide by.
            first = min(step * self.params.batch_size, max(0, len(draws) - 2))
            batch = draws[first : (step + 1) * self.params.batch_size]
            total += self._step(epoch * self.steps + step, batch, generator)
            progress(step + 1, self.steps, f"epoch {epoch + 1} of {self.params.epochs}")
        with _autocast(self._device, self.params.network):
            seen = predict(self._average, self._val.images, self._device)
        found = scores.summary(seen, self._val.labels, self._val.classes)
        row = {
            "epoch": epoch + 1,
            "learning_rate": self._rate((epoch + 1) * self.steps - 1),
            "train_loss": total / self.steps,
            **{f"val_{key}": found[key] for key in ("loss", "macro_f1", "recall", "top1", "ece")},
        }
        best = max((r["val_macro_f1"] for r in self.history), default=-1.0)
        self.history.append(row)
        if row["val_macro_f1"] >= best - _ALIKE:
            self.best_epoch = epoch
            self._best.load_state_dict(self._average.state_dict())
        self.write()
        return row

    def best(self) -> Trained:
        """Returns the averaged weights of the best epoch, with their fitted temperature."""
        network = copy.deepcopy(self._best)
        found = predict(network, self._val.images, self._device)
        temperature = scores.fitted_temperature(found, self._val.labels)
        calibrated = (found / temperature).astype(np.float32)
        return Trained(network.cpu(), temperature, self.history, self.best_epoch, calibrated)

    def _step(self, step: int, batch: NDArray[np.int64], generator: torch.Generator) -> float:
        for group in self._optimizer.param_groups:
            group["lr"] = self._rate(step)
        images = as_input(torch.from_numpy(self._train.images[batch]).to(self._device))
        labels = torch.from_numpy(self._train.labels[batch]).to(self._device)
        if self.params.colours > 0.0:
            spreads = colour_spreads(self._train.classes)[labels.cpu()]
            images = recoloured(images, spreads, generator, self.params.colours)
        if self.params.textures > 0.0:
            images = self._textured(images, batch, generator)
        images = augmented(images, generator, self.params.variation, self.params.markings)
        if self.params.weather > 0.0:
            images = weathered(images, generator, self.params.weather)
        targets = class_targets(labels, len(self._train.classes))
        if self.params.teachers:
            given = self._teachers.probabilities(images)
            targets = taught(targets, labels >= 0, given, _TAUGHT)
        with _autocast(self._device, self.params.network):
            loss = functional.cross_entropy(
                self.network(normalised(images)), targets, label_smoothing=_LABEL_SMOOTHING
            )
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), _LARGEST_GRADIENT)
        self._optimizer.step()
        _follow(self._average, self.network, min(_AVERAGE, (1.0 + step) / (10.0 + step)))
        return float(loss.detach())

    def _textured(
        self, images: Tensor, batch: NDArray[np.int64], generator: torch.Generator
    ) -> Tensor:
        """Gives ``textures`` of the images those of their class."""
        train = self._train
        drawn = torch.rand(2, len(batch), generator=generator, dtype=torch.float64).numpy()
        for number in np.unique(train.labels[batch]):
            known = self._textures.get(int(number))
            rows = np.flatnonzero(
                (train.labels[batch] == number) & (drawn[0] < self.params.textures)
            )
            if known is None or not len(rows):
                continue
            partners = known[(drawn[1, rows] * len(known)).astype(np.int64)]
            given = as_input(torch.from_numpy(train.images[partners]).to(self._device))
            images[rows] = textured(images[rows], given, generator)
        return images

    def _rate(self, step: int) -> float:
        return self.params.learning_rate * schedule(step, self.params.epochs * self.steps)

    def _key(self, name: str, epoch: int) -> int:
        sequence = np.random.SeedSequence([self.params.seed, crc32(name.encode()), epoch])
        return int(sequence.generate_state(1, np.uint64)[0] >> np.uint64(1))


def schedule(step: int, steps: int) -> float:
    """Returns the factor of the learning rate: linear rise, then decay along half a cosine."""
    warm = max(1, round(_WARM_UP * steps))
    if step < warm:
        return (step + 1) / warm
    return 0.5 * (1.0 + math.cos(math.pi * (step - warm) / max(1, steps - warm)))


def class_targets(labels: Tensor, classes: int) -> Tensor:
    """Returns class probabilities (B, C) of labels (B,): one class, or for ``NO_LABEL`` all alike,
    so that what is none of the classes is not taken for one (Hendrycks et al., ICLR 2019)."""
    known = functional.one_hot(labels.clamp(min=0), classes).float()
    return torch.where((labels >= 0)[:, None], known, 1.0 / classes)


def balanced_order(pictures: LabelledImages, seed: int, epoch: int) -> NDArray[np.int64]:
    """Returns the image numbers (N,) of an epoch, in random order.

    An image is drawn with a weight of the inverse root of the number of images of its class in its
    data set, by systematic resampling."""
    group = (pictures.labels + 1) * len(pictures.sources) + pictures.source
    weights = 1.0 / np.sqrt(np.bincount(group)[group])
    count = len(weights)
    rng = np.random.default_rng([seed, crc32(b"training order"), epoch])
    edges = np.cumsum(weights) / weights.sum()
    comb = (np.arange(count) + rng.uniform()) / count
    chosen = np.minimum(np.searchsorted(edges, comb), count - 1)
    return np.asarray(rng.permutation(chosen), np.int64)


def normalised(images: Tensor) -> Tensor:
    """Returns images in [0, 1] as the normalised input of the networks."""
    return (images - 0.5) / 0.25


def predict(
    network: nn.Module, images: NDArray[np.uint8], device: torch.device, batch: int = 64
) -> NDArray[np.float32]:
    """Returns scores (N, C) float32 of images (N, S, S, 3)."""
    network.eval()
    parts = []
    with torch.inference_mode():
        for first in range(0, len(images), batch):
            part = torch.from_numpy(images[first : first + batch]).to(device)
            parts.append(network(normalised(as_input(part))).float().cpu().numpy())
    return np.concatenate(parts)


def _optimizer(network: nn.Module, params: TrainParams) -> torch.optim.AdamW:
    """Returns AdamW with weight decay for matrices and filters, not for biases and norms."""
    learnt = [p for p in network.parameters() if p.requires_grad]
    large = [p for p in learnt if p.ndim >= 2]
    small = [p for p in learnt if p.ndim < 2]
    groups = [
        {"params": large, "weight_decay": _WEIGHT_DECAY},
        {"params": small, "weight_decay": 0.0},
    ]
    return torch.optim.AdamW(groups, lr=params.learning_rate, fused=True)


def _autocast(device: torch.device, network: str) -> torch.autocast:
    """Returns the context of mixed precision: bfloat16 where the GPU or processor supports it, but
    on a processor not for a network of single-channel filters, whose gradients take three times as
    long in it."""
    if device.type == "cuda":
        able = torch.cuda.is_bf16_supported()
    else:
        features = torch.cpu.get_capabilities()
        able = bool(features.get("avx512_bf16") or features.get("amx_bf16"))
        able = able and network != "efficientnet_lite0"
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=able)


@torch.no_grad()
def _follow(average: nn.Module, network: nn.Module, keep: float) -> None:
    """Updates average = keep average + (1 - keep) network, running means of the norms included."""
    for mean, now in zip(average.state_dict().values(), network.state_dict().values(), strict=True):
        if mean.is_floating_point():
            mean.lerp_(now, 1.0 - keep)
        else:
            mean.copy_(now)


def _fingerprint(*sets: LabelledImages) -> int:
    value = 0
    for pictures in sets:
        for array in (pictures.images, pictures.labels, pictures.source):
            value = crc32(np.ascontiguousarray(array).data, value)
    return value
