"""Figures of detected edges: energy beside Canny and the truth, and the points that the estimator
selects by it (the paper's Fig. 4); precision over recall; the table of scores."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import Zou2024Params
from touchdown.estimator.filtering.deskew import screen_scan
from touchdown.estimator.zou2024.depth_field import half_size_energy
from touchdown.estimator.zou2024.lidar_pose import scan_features
from touchdown.estimator.zou2024.projection import inside_image, project
from touchdown.estimator.zou2024.structured_edges.detector import edge_detector
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.config.schema import Config
from touchdown.experiments.edges.dataset import EdgeView, boundaries, edge_views
from touchdown.experiments.edges.train import CANNY_THRESHOLDS, canny_masks
from touchdown.experiments.errors import UsageError, reason_of
from touchdown.experiments.flight.wiring import build_scene, make_world
from touchdown.experiments.scene_tools.posed_views import posed_sensors
from touchdown.scenes.api import Scene
from touchdown.sim.api import LidarScan, SensorRig
from touchdown.sim.frames import Pose

if TYPE_CHECKING:
    from touchdown.sim.posed_sensors import PosedView

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Image = NDArray[np.uint8]

_SHOWN = (("houses", 6), ("houses", 10), ("pools", 1))
"""Held-out scene and number of its image; the scan of the first is shown too"""
_SHOWN_VIEWS = 12
_CANNY_SIGMA, _CANNY_LEVEL = 2.0, 3
_ENERGY_GAIN = 1.0
_CAPTION_PX = 30
_GAP = 4
_INK, _PAPER = (235, 235, 235), 24
_EDGE_RGB, _PLANAR_RGB = (255, 96, 32), (60, 220, 235)
DETECTOR_LABELS = {
    "shipped": "structured edges",
    "gradient": "gradient edges",
    "canny": "Canny at its best",
}


def draw_figures(
    folder: Path, seed: int, model: str, notes: Callable[[str], None]
) -> tuple[Path, Path]:
    """Writes edges.jpg and smoothness.jpg. Raises UsageError where writing fails."""
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"--out: '{folder}' is a file; name a folder")
    detector = edge_detector(model)
    folder.mkdir(parents=True, exist_ok=True)
    comparison, smoothness = folder / "edges.jpg", folder / "smoothness.jpg"
    views = [
        view
        for name in dict.fromkeys(scene for scene, _ in _SHOWN)
        for number, view in enumerate(edge_views([name], [seed], _SHOWN_VIEWS, notes))
        if (name, number) in _SHOWN
    ]
    _write(comparison, comparison_image(detector, views))
    notes("scan and image of one moment")
    _write(smoothness, smoothness_image(views[0], model))
    return comparison, smoothness


def comparison_image(detector: Callable[[Image], Float32], views: Sequence[EdgeView]) -> Image:
    """A row for each view: image, truth, energy, Canny."""
    rows = []
    for place, view in enumerate(views):
        canny = canny_masks(view.rgb, _CANNY_SIGMA)[_CANNY_LEVEL]
        tiles = [
            view.rgb,
            _line_drawing(boundaries(view.segments)),
            energy_colours(detector(view.rgb)),
            _line_drawing(canny),
        ]
        if place == 0:
            words = ("camera", "true boundaries", "structured edges", _canny_words())
            tiles = [_captioned(tile, text) for tile, text in zip(tiles, words, strict=True)]
        rows.append(_beside(tiles))
    return _below(rows)


def smoothness_image(shown: EdgeView, model: str) -> Image:
    """Image, energy, f_c of the returns of one scan, and the points chosen by it."""
    config = load_config(
        None, (f"zou2024.edge_model={model}",),
        scene=shown.scene, seed=shown.seed, profile_default="ideal",
    )  # fmt: skip
    scene = build_scene(config)
    view, found = still_features(config, scene, shown.world_from_body, shown.time_s)
    energy = np.asarray(cv2.resize(energy_colours(found.energy), view.rgb.shape[1::-1]), np.uint8)
    dim = (0.35 * view.rgb).astype(np.uint8)
    known = np.isfinite(found.f_c)
    low, high = np.percentile(np.log(found.f_c[known] + 1e-3), [2.0, 98.0])
    share = (np.log(found.f_c[known] + 1e-3) - low) / max(high - low, 1e-6)
    tint = cv2.applyColorMap(
        (255.0 * np.clip(share, 0.0, 1.0)).astype(np.uint8), cv2.COLORMAP_TURBO
    ).reshape(-1, 3)[:, ::-1]
    smooth, chosen = dim.copy(), dim.copy()
    _dots(smooth, found.pixels[known], tint, 1)
    for mask, colour, radius in ((found.planar, _PLANAR_RGB, 2), (found.edge, _EDGE_RGB, 3)):
        _dots(
            chosen,
            found.pixels[mask],
            np.tile(np.array(colour, np.uint8), (int(mask.sum()), 1)),
            radius,
        )
    counts = (
        f"{int(found.edge.sum())} edge (orange), {int(found.planar.sum())} planar (cyan) points"
    )
    return _below(
        [
            _beside([_captioned(view.rgb, "camera"), _captioned(energy, "edge energy")]),
            _beside(
                [
                    _captioned(smooth, "geodesic f_c of one scan: blue smooth, red across edges"),
                    _captioned(chosen, counts),
                ]
            ),
        ]
    )


def energy_colours(energy: Float32) -> Image:
    """(H, W, 3): black where there is no edge, then violet, orange, and pale yellow."""
    level = (255.0 * np.clip(_ENERGY_GAIN * energy, 0.0, 1.0)).astype(np.uint8)
    return np.ascontiguousarray(cv2.applyColorMap(level, cv2.COLORMAP_INFERNO)[..., ::-1])


def plot_curves(path: Path, report: Mapping[str, Any]) -> None:
    """Draws precision over recall with lines of equal F. Raises UsageError where writing fails."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 5.6), dpi=130)
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    recall = np.linspace(0.01, 1.0, 200)
    for f in np.arange(0.2, 1.0, 0.1):
        with np.errstate(divide="ignore"):
            precision = np.where(2 * recall > f, f * recall / (2 * recall - f), np.nan)
        precision = np.where(precision <= 1.0, precision, np.nan)
        axes.plot(recall, precision, color="0.85", lw=0.8, zorder=0)
        axes.text(0.985, f * 0.985 / (2 * 0.985 - f), f"F {f:.1f}", color="0.6", fontsize=7,
                  ha="right", va="bottom")  # fmt: skip
    for name, colour in zip(report["curves"], ("#c2410c", "#64748b", "#1d4ed8"), strict=True):
        curve, row = report["curves"][name], report["detectors"][name]
        axes.plot(curve["recall"], curve["precision"], color=colour, lw=2.2,
                  label=f"{DETECTOR_LABELS.get(name, name)}: ODS {row['ods']:.3f}")  # fmt: skip
        axes.plot(row["recall"], row["precision"], "o", color=colour, ms=7, mec="white")
    axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="recall", ylabel="precision")
    axes.set_title(f"{report['pictures']} images of held-out scenes", fontsize=10)
    axes.legend(loc="lower left", frameon=False)
    figure.tight_layout()
    try:
        figure.savefig(path)
    except (OSError, ValueError) as error:
        raise UsageError(f"--plot: '{path}' cannot be written: {reason_of(error)}") from error


def _line_drawing(mask: NDArray[np.bool_]) -> Image:
    return np.repeat((230 * mask).astype(np.uint8)[:, :, None], 3, axis=2)


def _captioned(tile: Image, text: str) -> Image:
    strip = np.full((_CAPTION_PX, tile.shape[1], 3), _PAPER, np.uint8)
    cv2.putText(strip, text, (10, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _INK, 1, cv2.LINE_AA)
    return np.vstack([strip, tile])


def _beside(tiles: list[Image]) -> Image:
    bar = np.full((tiles[0].shape[0], _GAP, 3), _PAPER, np.uint8)
    parts = [part for tile in tiles for part in (tile, bar)]
    return np.hstack(parts[:-1])


def _below(rows: list[Image]) -> Image:
    bar = np.full((_GAP, rows[0].shape[1], 3), _PAPER, np.uint8)
    parts = [part for row in rows for part in (row, bar)]
    return np.vstack(parts[:-1])


def _dots(image: Image, pixels: Array, colours: NDArray[np.uint8], radius: int) -> None:
    for (u, v), colour in zip(pixels, colours, strict=True):
        centre = (round(float(u)), round(float(v)))
        cv2.circle(image, centre, radius, tuple(map(int, colour)), -1, cv2.LINE_AA)


def _write(path: Path, image: Image) -> None:
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    for quality in (88, 80, 70, 60):
        done, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
        if done and len(data) <= 300_000:
            break
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise UsageError(f"--out: '{path}' cannot be written: {reason_of(error)}") from error


@dataclass(frozen=True, kw_only=True, slots=True)
class StationaryFeatures:
    """Features of the N returns inside the image."""

    energy: Float32
    """(H/2, W/2) edge energy of the image"""
    pixels: Array
    """(N, 2) in the image"""
    f_c: Array
    """(N,) colour smoothness, Eq. 8"""
    edge: NDArray[np.bool_]
    """(N,) chosen as edge points"""
    planar: NDArray[np.bool_]
    """(N,) chosen as planar points"""


def features_of_stationary_scan(
    scan: LidarScan, rgb: NDArray[np.uint8], rig: SensorRig, params: Zou2024Params
) -> StationaryFeatures:
    """Returns the features of ``scan`` and ``rgb`` (H, W, 3), both taken from the same pose by a
    camera without distortion."""
    pulses = screen_scan(scan, rig.lidar)
    points = scan.points[pulses].astype(np.float64)
    in_camera = (rig.body_from_camera.inverse() @ rig.body_from_lidar).apply(points)
    energy = half_size_energy(rgb, edge_detector(params.edge_model))
    chosen, f_c = scan_features(points, points, in_camera, pulses, energy, rig.camera, params)
    pixels, front = project(in_camera, rig.camera.matrix())
    seen = inside_image(pixels, front, (rig.camera.width, rig.camera.height))
    picked = np.zeros((2, len(points)), bool)
    picked[0, chosen.edges] = True
    picked[1, chosen.planes] = True
    return StationaryFeatures(
        energy=energy, pixels=pixels[seen], f_c=f_c[seen], edge=picked[0, seen],
        planar=picked[1, seen],
    )  # fmt: skip


def still_features(
    config: Config, scene: Scene, world_from_body: Pose, time_s: float
) -> tuple[PosedView, StationaryFeatures]:
    """The view from a pose, and the features that `zou2024` finds in one scan from there."""
    from touchdown.sim.moving import BodyTrack

    world = make_world(config, scene)
    rig = world.rig
    world.close()
    sensors = posed_sensors(config, scene)
    try:
        view = sensors.view(world_from_body, time_s, 0)
    finally:
        sensors.close()
    start = round(time_s * config.sim.tick_hz)
    both_ends_s = sensors.scan_times(start)[[0, -1]]
    scan = sensors.scan(BodyTrack.at_rest(world_from_body, both_ends_s), start)
    return view, features_of_stationary_scan(scan, view.rgb, rig, config.zou2024)


def _canny_words() -> str:
    return f"Canny, blur {_CANNY_SIGMA:.0f} px, threshold {CANNY_THRESHOLDS[_CANNY_LEVEL]:.0f}"
