"""Training of structured forests for edges (Dollar and Zitnick 2015), arrays in, arrays out.

Every tree sends a patch of channel features to a leaf that holds the boundaries of a 16 x 16 patch.
A node cannot compute the impurity of segmentations, so that at each one they are mapped to a vector
that states for random pairs of pixels if they share a segment, and from that, by the sign of its
first principal component, to one of two classes (section 3.2 of the paper). Splits maximise the
decrease of the Gini impurity of these classes over a random choice of features.

The features are those of OpenCV's ``ximgproc.RFFeatureGetter``: three colour channels, and gradient
magnitude and four orientations at two scales; their values on a 16 x 16 grid, and differences of
pairs on a 5 x 5 grid. ``model_file`` writes a forest for OpenCV's detector.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from zlib import crc32

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import ndimage

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]
Bytes = NDArray[np.uint8]

PATCH, INNER, SHRINK = 32, 16, 2
ORIENTATIONS, CHANNELS = 4, 13
GRID = 5
NORMALISATION_RADIUS, GRADIENT_SMOOTHING = 4, 0
REGULAR_SMOOTHING, PAIR_SMOOTHING = 2, 8
CELLS = PATCH // SHRINK
REGULAR_FEATURES = CELLS * CELLS * CHANNELS
PAIRS = GRID * GRID * (GRID * GRID - 1) // 2
FEATURES = REGULAR_FEATURES + PAIRS * CHANNELS

_PIXEL_PAIRS = 256
_COMPONENT_SAMPLES = 200
_COMPONENT_ROUNDS = 8
_LEAST_GAIN = 1e-6


@dataclass(frozen=True, kw_only=True, slots=True)
class ForestParams:
    """Parameters of the growth of a forest."""

    trees: int = 4
    trees_evaluated: int = 2
    """per patch; patches take turns among the trees"""
    stride: int = 4
    """pixels between patches"""
    patches_per_tree: int = 500_000
    """half of them with a boundary near the middle"""
    images_share: float = 0.6
    """of the images that each tree sees"""
    feature_share: float = 0.25
    """of the features that each tree may use"""
    features_per_node: int = 48
    split_samples: int = 800
    """patches of a node by which its split is chosen"""
    smallest_leaf: int = 8
    deepest: int = 40


@dataclass(frozen=True, slots=True)
class Tree:
    """Nodes (N,): ``child`` is the number of the right child, one more than that of the left, and 0
    in leaves; a patch goes left where its feature is less than the threshold. ``leaf_bins`` holds,
    for every node, the boundary pixels (row * INNER + column) that the leaf puts down."""

    child: Int32
    feature: Int32
    threshold: Float32
    leaf_bins: list[Int32]


def channel_features(rgb: Bytes) -> tuple[Float32, Float32]:
    """The channels of an image (H, W, 3): regular and pair features, each (H/2 + 8, W/2 + 8, 13)
    float32, padded as the detector pads."""
    pad = (PATCH - INNER) // 2
    source = cv2.copyMakeBorder(
        rgb.astype(np.float32) / 255.0, pad, pad, pad, pad, cv2.BORDER_REFLECT
    )
    shape = (source.shape[0] // SHRINK, source.shape[1] // SHRINK, CHANNELS)
    channels = np.zeros(shape, np.float32)
    cv2.ximgproc.createRFFeatureGetter().getFeatures(
        source, channels, NORMALISATION_RADIUS, GRADIENT_SMOOTHING, SHRINK, CHANNELS, ORIENTATIONS
    )
    return (
        _triangle_filtered(channels, round(REGULAR_SMOOTHING / SHRINK)),
        _triangle_filtered(channels, round(PAIR_SMOOTHING / SHRINK)),
    )


def _triangle_filtered(channels: Float32, radius: int) -> Float32:
    """Convolved with a triangle of this radius along both axes."""
    rise = np.arange(1, radius + 2, dtype=np.float32)
    kernel = np.concatenate([rise, rise[-2::-1]]) / np.float32((radius + 1) ** 2)
    return np.asarray(cv2.sepFilter2D(channels, -1, kernel, kernel), np.float32)


def feature_table() -> Int32:
    """(FEATURES, 5) int32 of rows y1, x1, y2, x2, channel in cells of a patch; y2 is -1 for a
    regular feature. In the order of OpenCV's detector, which counts along columns first."""
    table = np.empty((FEATURES, 5), np.int32)
    number = np.arange(REGULAR_FEATURES)
    within = number % CELLS**2
    table[:REGULAR_FEATURES, 0] = within % CELLS
    table[:REGULAR_FEATURES, 1] = within // CELLS
    table[:REGULAR_FEATURES, 2:4] = -1
    table[:REGULAR_FEATURES, 4] = number // CELLS**2
    half = round(CELLS / (2 * GRID))
    step = np.arange(1, GRID + 1) * (CELLS + 2 * half - 1) / (GRID + 1)
    place = (step - half + 0.5).astype(np.int32)
    first, second = np.triu_indices(GRID * GRID, 1)
    pairs = np.column_stack(
        [place[first % GRID], place[first // GRID], place[second % GRID], place[second // GRID]]
    )
    table[REGULAR_FEATURES:, :4] = np.tile(pairs, (CHANNELS, 1))
    table[REGULAR_FEATURES:, 4] = np.repeat(np.arange(CHANNELS), PAIRS)
    return table


_Y1, _X1, _Y2, _X2, _CHANNEL = range(5)
"""columns of ``feature_table``"""


@njit(cache=True)
def _values(
    regular: Float32, paired: Float32, patches: Int32, chosen: NDArray[np.int64], row: Int32
) -> Float32:
    """(M,) values of the feature ``row`` of ``feature_table`` for the chosen patches."""
    out = np.empty(chosen.shape[0], np.float32)
    for i in range(chosen.shape[0]):
        image, y, x = patches[chosen[i], 0], patches[chosen[i], 1], patches[chosen[i], 2]
        if row[_Y2] < 0:
            out[i] = regular[image, y + row[_Y1], x + row[_X1], row[_CHANNEL]]
        else:
            first = paired[image, y + row[_Y1], x + row[_X1], row[_CHANNEL]]
            out[i] = first - paired[image, y + row[_Y2], x + row[_X2], row[_CHANNEL]]
    return out


@njit(cache=True)
def same_segment(
    segments: Int32, patches: Int32, chosen: NDArray[np.int64], pairs: Int32
) -> Float32:
    """(M, K) of the chosen patches and pairs (K, 2) of pixels: 1 where both share a segment."""
    out = np.empty((chosen.shape[0], pairs.shape[0]), np.float32)
    for i in range(chosen.shape[0]):
        image, y, x = patches[chosen[i], 0], patches[chosen[i], 1], patches[chosen[i], 2]
        top, left = SHRINK * y, SHRINK * x
        for k in range(pairs.shape[0]):
            a, b = pairs[k, 0], pairs[k, 1]
            one = segments[image, top + a // INNER, left + a % INNER]
            two = segments[image, top + b // INNER, left + b % INNER]
            out[i, k] = 1.0 if one == two else 0.0
    return out


def first_component(samples: Float32) -> tuple[Float32, Float32]:
    """Mean (K,) and first principal direction (K,) of samples (M, K), by power iteration; a zero
    direction where all samples are alike."""
    mean = samples.mean(axis=0)
    centred = samples - mean
    spread = (centred * centred).sum(axis=1)
    direction = centred[int(spread.argmax())].copy()
    for _ in range(_COMPONENT_ROUNDS):
        direction = centred.T @ (centred @ direction)
        norm = float(np.sqrt(direction @ direction))
        if norm < 1e-9:
            return mean, np.zeros_like(mean)
        direction /= np.float32(norm)
    return mean, direction


@njit(cache=True)
def best_split(values: Float32, classes: NDArray[np.bool_]) -> tuple[float, float]:
    """Decrease of the Gini impurity (of two classes) by the best threshold on (M,) values, and that
    threshold; a decrease of 0 where nothing parts them."""
    count = values.shape[0]
    order = np.argsort(values)
    total = 0
    for i in range(count):
        total += classes[i]
    share = total / count
    before = 2.0 * share * (1.0 - share)
    best, threshold, left = 0.0, 0.0, 0
    for i in range(count - 1):
        left += classes[order[i]]
        low, high = values[order[i]], values[order[i + 1]]
        if not low < high:
            continue
        n = i + 1
        p, q = left / n, (total - left) / (count - n)
        after = (n * 2.0 * p * (1.0 - p) + (count - n) * 2.0 * q * (1.0 - q)) / count
        if before - after > best:
            middle = np.float32(0.5) * (low + high)
            best, threshold = before - after, middle if middle > low else high
    return best, threshold


@njit(cache=True)
def _search(
    regular: Float32,
    paired: Float32,
    patches: Int32,
    chosen: NDArray[np.int64],
    classes: NDArray[np.bool_],
    table: Int32,
    candidates: NDArray[np.int64],
) -> tuple[int, float, float]:
    """The candidate feature that parts the classes best, its threshold and gain."""
    feature, threshold, gain = -1, 0.0, 0.0
    for candidate in candidates:
        values = _values(regular, paired, patches, chosen, table[candidate])
        decrease, at = best_split(values, classes)
        if decrease > gain:
            feature, threshold, gain = candidate, at, decrease
    return feature, threshold, gain


@dataclass(frozen=True, slots=True)
class TrainingImages:
    """Images of one size: features (I, h, w, 13), segments and boundaries (I, H, W)."""

    regular: Float32
    paired: Float32
    segments: Int32
    edges: NDArray[np.bool_]

    @classmethod
    def of(cls, rgb: Sequence[Bytes], segments: Sequence[Int32]) -> TrainingImages:
        channels = [channel_features(image) for image in rgb]
        return cls(
            np.stack([regular for regular, _ in channels]),
            np.stack([paired for _, paired in channels]),
            np.stack(segments),
            np.stack([segment_edges(numbers) for numbers in segments]),
        )


def sample_patches(edges: NDArray[np.bool_], count: int, rng: np.random.Generator) -> Int32:
    """(N, 3) int32 of image, row and column in cells of patches: half with a boundary within half
    their inner width of the middle, half without, as far as there are so many."""
    height, width = edges.shape[1:]
    rows = np.arange((height - INNER) // SHRINK + 1)
    cols = np.arange((width - INNER) // SHRINK + 1)
    per_image = count // (2 * len(edges))
    chosen = []
    for image, edge in enumerate(edges):
        distance = ndimage.distance_transform_edt(~edge) if edge.any() else np.full(edge.shape, 1e9)
        middle = distance[SHRINK * rows[:, None] + INNER // 2, SHRINK * cols + INNER // 2]
        for of_kind in (middle < INNER // 2, middle >= INNER // 2):
            at = np.argwhere(of_kind)
            places = at[rng.permutation(len(at))[:per_image]]
            chosen.append(np.column_stack([np.full(len(places), image), places]))
    return np.ascontiguousarray(np.concatenate(chosen), dtype=np.int32)


def segment_edges(segments: Int32) -> NDArray[np.bool_]:
    """(H, W): pixels whose right or lower neighbour, if there is one, is of another segment."""
    edge = np.zeros(segments.shape, bool)
    edge[:, :-1] |= segments[:, :-1] != segments[:, 1:]
    edge[:-1] |= segments[:-1] != segments[1:]
    return edge


def grow_tree(images: TrainingImages, params: ForestParams, rng: np.random.Generator) -> Tree:
    """One tree from patches drawn of all ``images``."""
    patches = sample_patches(images.edges, params.patches_per_tree, rng)
    table = feature_table()
    usable = rng.permutation(FEATURES)[: round(params.feature_share * FEATURES)]
    child, feature, threshold = [0], [0], [0.0]
    leaf_bins: list[Int32] = [np.zeros(0, np.int32)]
    waiting = [(0, np.arange(len(patches)), 0)]
    while waiting:
        node, members, depth = waiting.pop()
        split = None
        if len(members) >= 2 * params.smallest_leaf and depth < params.deepest:
            split = _split(images, patches, members, table, usable, params, rng)
        if split is None:
            leaf_bins[node] = _leaf(images, patches, members, rng)
            continue
        feature[node], threshold[node], goes_left = split
        child[node] = len(child) + 1
        for side in (members[goes_left], members[~goes_left]):
            waiting.append((len(child), side, depth + 1))
            child.append(0)
            feature.append(0)
            threshold.append(0.0)
            leaf_bins.append(np.zeros(0, np.int32))
    return Tree(
        np.array(child, np.int32),
        np.array(feature, np.int32),
        np.array(threshold, np.float32),
        leaf_bins,
    )


def _split(
    images: TrainingImages,
    patches: Int32,
    members: NDArray[np.int64],
    table: Int32,
    usable: NDArray[np.int64],
    params: ForestParams,
    rng: np.random.Generator,
) -> tuple[int, float, NDArray[np.bool_]] | None:
    """Feature, threshold and who goes left; None where no split leaves enough on either side."""
    judged = members
    if len(members) > params.split_samples:
        judged = members[rng.integers(0, len(members), params.split_samples)]
    pairs = _pixel_pairs(rng)
    alike = same_segment(images.segments, patches, judged, pairs)
    mean, direction = first_component(alike[:_COMPONENT_SAMPLES])
    classes = (alike - mean) @ direction > 0.0
    if classes.all() or not classes.any():
        return None
    candidates = usable[rng.integers(0, len(usable), params.features_per_node)]
    feature, threshold, gain = _search(
        images.regular, images.paired, patches, judged, classes, table, candidates
    )
    if gain < _LEAST_GAIN:
        return None
    values = _values(images.regular, images.paired, patches, members, table[feature])
    goes_left = values < np.float32(threshold)
    left = int(goes_left.sum())
    if min(left, len(members) - left) < params.smallest_leaf:
        return None
    return feature, threshold, goes_left


def _pixel_pairs(rng: np.random.Generator) -> Int32:
    """(K, 2) different pixels of a patch each."""
    first = rng.integers(0, INNER**2, _PIXEL_PAIRS)
    second = (first + rng.integers(1, INNER**2, _PIXEL_PAIRS)) % INNER**2
    return np.column_stack([first, second]).astype(np.int32)


def _leaf(
    images: TrainingImages, patches: Int32, members: NDArray[np.int64], rng: np.random.Generator
) -> Int32:
    """Boundary pixels of the medoid: the patch whose segmentation is nearest to the mean of all."""
    judged = members[:_COMPONENT_SAMPLES]
    alike = same_segment(images.segments, patches, judged, _pixel_pairs(rng))
    distance = ((alike - alike.mean(axis=0)) ** 2).sum(axis=1)
    image, y, x = patches[judged[int(distance.argmin())]]
    top, left = SHRINK * int(y), SHRINK * int(x)
    # of the patch alone: what lies just outside would put lines into leaves of plain ground
    inner = images.segments[image, top : top + INNER, left : left + INNER]
    return np.flatnonzero(segment_edges(inner)).astype(np.int32)


def grow_forest(
    images: TrainingImages,
    params: ForestParams,
    seed: int,
    progress: Callable[[int, int], None] = lambda tree, nodes: None,
) -> list[Tree]:
    """All trees, each from a random share of the images; a pure function of its arguments."""
    trees = []
    for number in range(params.trees):
        rng = np.random.default_rng([seed, crc32(b"structured forest"), number])
        some = np.sort(
            rng.permutation(len(images.edges))[
                : max(1, round(params.images_share * len(images.edges)))
            ]
        )
        part = TrainingImages(
            images.regular[some], images.paired[some], images.segments[some], images.edges[some]
        )
        trees.append(grow_tree(part, params, rng))
        progress(number + 1, len(trees[-1].child))
    return trees
