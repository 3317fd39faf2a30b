"""`touchdown edges`: scores and figures of the structured edge detector of
`estimator.zou2024.structured_edges`, on scenes that it was not trained on.

Precision, recall and F follow the Berkeley benchmark (Martin, Fowlkes and Malik 2004; Arbelaez et
al. 2011). Detections and boundaries are thinned to lines of one pixel and matched one to one, each
pair no further apart than 0.0075 of the image's diagonal. The number of pairs is that of a maximum
matching (Hopcroft and Karp); the benchmark's own, of least total distance with outliers, differs
from it by little.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_bipartite_matching

from touchdown.estimator.filtering.deskew import screen_scan
from touchdown.estimator.zou2024.depth_field import half_size_energy
from touchdown.estimator.zou2024.lidar_pose import scan_features
from touchdown.estimator.zou2024.structured_edges import edge_detector
from touchdown.estimator.zou2024.visual_map import inside_image, project
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.edges.views import EdgeView, Notes, edge_views
from touchdown.experiments.errors import UsageError, reason_of
from touchdown.experiments.flight.wiring import build_scene, make_world
from touchdown.experiments.scene_tools.posed_views import posed_sensors
from touchdown.sim.typing import Array, Float32, Image, Mask

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TEST_SCENES = ("houses", "pools")
"""held-out scenes, which no training image shows"""
TEST_VIEWS = 4
"""images of each scene and seed"""
CANNY_SIGMAS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0)
"""blur, in pixels, before Canny"""
CANNY_THRESHOLDS = np.geomspace(40.0, 400.0, 8)
_CANNY_LOW = 0.4
"""low threshold as a fraction of the high one, as in Matlab"""
TOLERANCE = 0.0075
"""Fraction of the image's diagonal"""
THRESHOLDS = (np.arange(1, 36) / 36.0) ** 2
"""denser where the energy of faint edges lies"""
_NMS_RADIUS = 2
_RECALLS = np.linspace(0.0, 1.0, 101)
_SHOWN_SCENE, _SHOWN_NUMBER = "houses", 6
"""held-out scene and number of its image that are drawn"""
_TILE_IN, _DPI = 4.0, 110
DETECTOR_LABELS = {
    "shipped": "structured edges",
    "gradient": "gradient edges",
    "canny": "Canny at its best",
}


@dataclass(frozen=True, slots=True)
class Counts:
    """Counts at (T,) thresholds, of one image or the sum of several: ``true`` (one number) and
    ``detected`` pixels, and the pairs that were ``matched``."""

    true: int
    detected: NDArray[np.int64]
    matched: NDArray[np.int64]

    @property
    def precision(self) -> Array:
        """(T,), 1 where nothing is detected."""
        return np.where(self.detected > 0, self.matched / np.maximum(self.detected, 1), 1.0)

    @property
    def recall(self) -> Array:
        """(T,)"""
        return self.matched / max(self.true, 1)

    @property
    def f(self) -> Array:
        """(T,) harmonic mean of precision and recall; 0 where both are."""
        return np.asarray(2.0 * self.matched / np.maximum(self.true + self.detected, 1))


@dataclass(frozen=True, kw_only=True, slots=True)
class Score:
    """Score of a set of images. ``ods``: best F at one threshold for all, whose index is ``best``;
    ``ois``: F with the best threshold for each; ``ap``: average precision."""

    ods: float
    ois: float
    ap: float
    best: int
    total: Counts


def thinned(mask: Mask) -> Mask:
    """Lines of one pixel's width (Zhang and Suen 1984)."""
    return np.asarray(cv2.ximgproc.thinning(mask.astype(np.uint8) * 255) > 0)


def ridges(energy: Float32) -> Float32:
    """Energy where it is greatest across the edge, 0 elsewhere; (H, W).

    The direction across is that of the strongest second derivative of the smoothed energy.
    """
    smooth = cv2.GaussianBlur(energy, (0, 0), 2.0)
    dxx = cv2.Sobel(smooth, cv2.CV_32F, 2, 0, ksize=5)
    dyy = cv2.Sobel(smooth, cv2.CV_32F, 0, 2, ksize=5)
    dxy = cv2.Sobel(smooth, cv2.CV_32F, 1, 1, ksize=5)
    # the eigenvector of the most negative curvature of the Hessian
    angle = 0.5 * np.arctan2(-2.0 * dxy, dyy - dxx)
    rows, cols = np.indices(energy.shape, np.float32)
    across_x, across_y = np.cos(angle), np.sin(angle)
    greatest = np.ones(energy.shape, bool)
    for distance in (*range(-_NMS_RADIUS, 0), *range(1, _NMS_RADIUS + 1)):
        x, y = cols + distance * across_x, rows + distance * across_y
        beside = cv2.remap(energy, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        greatest &= energy >= beside
    return np.where(greatest, energy, np.float32(0.0)).astype(np.float32)


def matched_pairs(detected: Mask, true: Mask) -> int:
    """Size of a maximum one-to-one matching of detected and true pixels within the tolerance."""
    height, width = true.shape
    radius = TOLERANCE * float(np.hypot(height, width))
    rows, cols = np.nonzero(detected)
    number = np.full((height, width), -1, np.int64)
    number[true] = np.arange(int(true.sum()))
    if not len(rows) or not true.any():
        return 0
    reach = int(radius)
    sources, targets = [], []
    offsets = range(-reach, reach + 1)
    for dy, dx in itertools.product(offsets, offsets):
        if dx * dx + dy * dy > radius * radius:
            continue
        y, x = rows + dy, cols + dx
        inside = np.flatnonzero((y >= 0) & (y < height) & (x >= 0) & (x < width))
        there = number[y[inside], x[inside]]
        sources.append(inside[there >= 0])
        targets.append(there[there >= 0])
    links = (np.concatenate(sources), np.concatenate(targets))
    graph = csr_array((np.ones(len(links[0]), np.int8), links), shape=(len(rows), int(true.sum())))
    return int((maximum_bipartite_matching(graph, perm_type="column") >= 0).sum())


def counts_of_masks(masks: Sequence[Mask], true: Mask) -> Counts:
    """Counts of one mask per threshold; all are thinned here."""
    target = thinned(true)
    lines = [thinned(mask) for mask in masks]
    return Counts(
        int(target.sum()),
        np.array([int(line.sum()) for line in lines]),
        np.array([matched_pairs(line, target) for line in lines]),
    )


def score(counts: Sequence[Counts]) -> Score:
    """Score over all images, whose counts are of the same thresholds in ascending order."""
    total = Counts(
        sum(c.true for c in counts),
        np.sum([c.detected for c in counts], axis=0),
        np.sum([c.matched for c in counts], axis=0),
    )
    best = int(total.f.argmax())
    own = [int(c.f.argmax()) for c in counts]
    each = Counts(
        total.true,
        np.array([sum(c.detected[k] for c, k in zip(counts, own, strict=True))]),
        np.array([sum(c.matched[k] for c, k in zip(counts, own, strict=True))]),
    )
    return Score(
        ods=float(total.f[best]),
        ois=float(each.f[0]),
        ap=_average_precision(total.precision, total.recall),
        best=best,
        total=total,
    )


def _average_precision(precision: Array, recall: Array) -> float:
    """Area below precision over recall, no precision beyond the greatest recall."""
    order = np.argsort(recall, kind="stable")
    along = np.interp(
        _RECALLS, recall[order], precision[order], left=precision[order][0], right=0.0
    )
    return float(along.mean())


def canny_masks(rgb: Image, sigma: float) -> list[Mask]:
    """(H, W) edges by Canny at every one of `CANNY_THRESHOLDS`, of the blurred image. At each
    pixel the colour channel with the strongest gradient counts, which finds more than grey does."""
    blurred = cv2.GaussianBlur(rgb, (0, 0), sigma)
    return [
        np.asarray(cv2.Canny(blurred, _CANNY_LOW * high, high, L2gradient=True) > 0)
        for high in CANNY_THRESHOLDS
    ]


def evaluate(model: str, seeds: int, notes: Notes) -> dict[str, Any]:
    """Scores of ``model``, of gradient edges and of Canny on the test scenes with seeds from 0 on.
    Canny has the blur that gives the best F on the test images themselves; the structured detector
    is not tuned on them."""
    detectors = {name: edge_detector(name) for name in (model, "gradient")}
    views = list(edge_views(TEST_SCENES, range(seeds), TEST_VIEWS, notes))
    scores = {}
    for name, detect in detectors.items():
        notes(f"scoring {DETECTOR_LABELS.get(name, name)}")
        scores[name] = _score(views, (_cut(detect(view.rgb)) for view in views))
    by_sigma = {}
    for sigma in CANNY_SIGMAS:
        notes(f"scoring Canny, blur {sigma:.1f} px")
        by_sigma[sigma] = _score(views, (canny_masks(view.rgb, sigma) for view in views))
    blur = max(by_sigma, key=lambda sigma: by_sigma[sigma].ods)
    scores["canny"] = by_sigma[blur]
    return {
        "pictures": len(views),
        "detectors": {name: _row(found) for name, found in scores.items()},
        "canny_setting": {
            "sigma_px": blur,
            "threshold": float(CANNY_THRESHOLDS[scores["canny"].best]),
        },
        "ods_above_canny": scores[model].ods - scores["canny"].ods,
        "curves": {
            name: {
                "precision": found.total.precision.tolist(),
                "recall": found.total.recall.tolist(),
            }
            for name, found in scores.items()
        },
    }


def _score(views: Sequence[EdgeView], masks: Iterable[list[Mask]]) -> Score:
    return score(
        [counts_of_masks(of, view.boundaries) for of, view in zip(masks, views, strict=True)]
    )


def _cut(energy: Float32) -> list[Mask]:
    """An energy in [0, 1], cut at every threshold after non-maximum suppression."""
    ridge = ridges(energy)
    return [ridge >= threshold for threshold in THRESHOLDS]


def _row(found: Score) -> dict[str, float]:
    return {
        "ods": found.ods,
        "ois": found.ois,
        "ap": found.ap,
        "precision": float(found.total.precision[found.best]),
        "recall": float(found.total.recall[found.best]),
    }


def plot_curves(path: Path, report: Mapping[str, Any]) -> None:
    """Draws precision over recall with lines of equal F. Raises UsageError where writing fails."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 5.6), dpi=_DPI, layout="tight")
    axes = figure.add_subplot()
    recall = np.linspace(0.01, 1.0, 200)
    for f in np.arange(0.2, 1.0, 0.1):
        beyond = recall[2.0 * recall - f >= f * recall]  # precision is at most 1
        axes.plot(beyond, f * beyond / (2.0 * beyond - f), color="0.85", lw=0.8, zorder=0)
        axes.text(0.985, f / (2.0 - f), f"F {f:.1f}", color="0.6", fontsize=7, ha="right")
    for name, curve in report["curves"].items():
        row = report["detectors"][name]
        label = f"{DETECTOR_LABELS.get(name, name)}: ODS {row['ods']:.3f}"
        (line,) = axes.plot(curve["recall"], curve["precision"], lw=2.2, label=label)
        axes.plot(row["recall"], row["precision"], "o", color=line.get_color(), mec="white")
    axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="recall", ylabel="precision")
    axes.set_title(f"{report['pictures']} images of held-out scenes", fontsize=10)
    axes.legend(loc="lower left", frameon=False)
    _write(path, figure, "--plot")


def draw_figure(folder: Path, seed: int, model: str, notes: Notes) -> Path:
    """Writes smoothness.jpg, the paper's Fig. 4: image, edge energy, f_c (Eq. 8) of the returns of
    one scan from the same pose, and the points that `zou2024` chooses by it. Raises UsageError
    where writing fails."""
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"--out: '{folder}' is a file; name a folder")
    edge_detector(model)  # a bad model is refused before anything is made
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "smoothness.jpg"
    *_, shown = edge_views([_SHOWN_SCENE], [seed], _SHOWN_NUMBER + 1, notes)
    notes("scan and image of one moment")
    _write(path, _smoothness(shown, seed, model), "--out")
    return path


def _smoothness(shown: EdgeView, seed: int, model: str) -> Figure:
    """The figure of `draw_figure`, by a camera without distortion at the pose of a view."""
    from matplotlib.figure import Figure

    from touchdown.sim.moving import BodyTrack

    config = load_config(scene=_SHOWN_SCENE, seed=seed, profile_default="ideal")
    scene = build_scene(config)
    world = make_world(config, scene)
    rig = world.rig
    world.close()
    sensors = posed_sensors(config, scene)
    try:
        rgb = sensors.view(shown.world_from_body, shown.time_s, 0).rgb
    finally:
        sensors.close()
    start = round(shown.time_s * config.sim.tick_hz)
    both_ends_s = sensors.scan_times(start)[[0, -1]]
    scan = sensors.scan(BodyTrack.at_rest(shown.world_from_body, both_ends_s), start)
    pulses = screen_scan(scan, rig.lidar)
    points = scan.points[pulses].astype(np.float64)
    in_camera = (rig.body_from_camera.inverse() @ rig.body_from_lidar).apply(points)
    energy = half_size_energy(rgb, edge_detector(model))
    chosen, f_c = scan_features(
        points, points, in_camera, pulses, energy, rig.camera, config.zou2024
    )
    pixels, front = project(in_camera, rig.camera.matrix())
    seen = inside_image(pixels, front, (rig.camera.width, rig.camera.height))
    figure = Figure(figsize=(2 * _TILE_IN, 1.2 * _TILE_IN), dpi=_DPI, layout="tight")
    camera, edges, smooth, points_of = figure.subplots(2, 2).ravel()
    dim = (0.35 * rgb).astype(np.uint8)
    _show(camera, rgb, "camera")
    _show(edges, energy, "edge energy")
    _show(smooth, dim, "geodesic f_c of one scan: blue smooth, red across edges")
    known = seen & np.isfinite(f_c)
    level = np.log(f_c[known] + 1e-3)
    low, high = np.percentile(level, [2.0, 98.0])
    smooth.scatter(*pixels[known].T, s=1, c=level, cmap="turbo", vmin=low, vmax=high)
    edge, planar = (of[seen[of]] for of in (chosen.edges, chosen.planes))
    _show(points_of, dim, f"{len(edge)} edge (orange), {len(planar)} planar (cyan) points")
    points_of.scatter(*pixels[planar].T, s=5, c="#3cdceb")
    points_of.scatter(*pixels[edge].T, s=10, c="#ff6020")
    return figure


def _show(axes: Axes, tile: NDArray[Any], title: str) -> None:
    """Shows an image (H, W, 3), or an energy (H, W), black where it is 0."""
    axes.imshow(tile, cmap="inferno", vmin=0, vmax=1)
    axes.set_title(title, fontsize=9)
    axes.set_axis_off()


def _write(path: Path, figure: Figure, option: str) -> None:
    try:
        figure.savefig(path)
    except (OSError, ValueError) as error:
        raise UsageError(f"{option}: '{path}' cannot be written: {reason_of(error)}") from error
