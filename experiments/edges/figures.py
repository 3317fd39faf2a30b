"""Figures of detected edges: energy beside Canny and the truth, the points that the estimator
selects by it (the paper's Fig. 4), and precision over recall."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from touchdown.estimator.filtering.deskew import screen_scan
from touchdown.estimator.zou2024.depth_field import half_size_energy
from touchdown.estimator.zou2024.lidar_pose import scan_features
from touchdown.estimator.zou2024.pnp import inside_image, project
from touchdown.estimator.zou2024.structured_edges import edge_detector
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.edges.dataset import EdgeView, boundaries, edge_views
from touchdown.experiments.edges.evaluate import CANNY_THRESHOLDS, canny_masks
from touchdown.experiments.errors import UsageError, reason_of
from touchdown.experiments.flight.wiring import build_scene, make_world
from touchdown.experiments.scene_tools.posed_views import posed_sensors

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Image = NDArray[np.uint8]

_SHOWN = (("houses", 6), ("houses", 10), ("pools", 1))
"""held-out scene and number of its image; the scan of the first is shown too"""
_SHOWN_VIEWS = 12
_CANNY_SIGMA, _CANNY_LEVEL = 2.0, 3
_TILE_IN, _DPI = 4.0, 110
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
    _write(comparison, _comparison(detector, views), "--out")
    notes("scan and image of one moment")
    _write(smoothness, _smoothness(views[0], model), "--out")
    return comparison, smoothness


def _comparison(detector: Callable[[Image], Float32], views: Sequence[EdgeView]) -> Figure:
    """A row for each view: image, truth, energy, Canny."""
    threshold = CANNY_THRESHOLDS[_CANNY_LEVEL]
    canny = f"Canny, blur {_CANNY_SIGMA:.0f} px, threshold {threshold:.0f}"
    heads = ("camera", "true boundaries", "structured edges", canny)
    figure = _figure(len(views), len(heads))
    for row, view in enumerate(views):
        tiles: tuple[NDArray[Any], ...] = (
            view.rgb,
            boundaries(view.segments),
            detector(view.rgb),
            canny_masks(view.rgb, _CANNY_SIGMA)[_CANNY_LEVEL],
        )
        for column, (tile, head) in enumerate(zip(tiles, heads, strict=True)):
            axes = figure.axes[row * len(heads) + column]
            _show(axes, tile, head if row == 0 else "")
    return figure


def _smoothness(shown: EdgeView, model: str) -> Figure:
    """Image, energy, f_c of the returns of one scan, and the points chosen by it."""
    found = still_features(shown, model)
    figure = _figure(2, 2)
    camera, energy, smooth, chosen = figure.axes
    _show(camera, found.rgb, "camera")
    _show(energy, found.energy, "edge energy")
    dim = (0.35 * found.rgb).astype(np.uint8)
    _show(smooth, dim, "geodesic f_c of one scan: blue smooth, red across edges")
    known = np.isfinite(found.f_c)
    level = np.log(found.f_c[known] + 1e-3)
    low, high = np.percentile(level, [2.0, 98.0])
    u, v = found.pixels.T
    smooth.scatter(u[known], v[known], s=1, c=level, cmap="turbo", vmin=low, vmax=high)
    counts = (int(found.edge.sum()), int(found.planar.sum()))
    _show(chosen, dim, "{} edge (orange), {} planar (cyan) points".format(*counts))
    chosen.scatter(u[found.planar], v[found.planar], s=5, c="#3cdceb")
    chosen.scatter(u[found.edge], v[found.edge], s=10, c="#ff6020")
    return figure


def plot_curves(path: Path, report: Mapping[str, Any]) -> None:
    """Draws precision over recall with lines of equal F. Raises UsageError where writing fails."""
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


def _figure(rows: int, columns: int) -> Figure:
    figure = Figure(figsize=(columns * _TILE_IN, rows * 0.6 * _TILE_IN), dpi=_DPI, layout="tight")
    figure.subplots(rows, columns)
    return figure


def _show(axes: Axes, tile: NDArray[Any], title: str) -> None:
    """Shows an image (H, W, 3), or an energy or a mask (H, W), black where it is 0."""
    axes.imshow(tile, cmap="inferno" if tile.dtype == np.float32 else "gray", vmin=0, vmax=1)
    axes.set_title(title, fontsize=9)
    axes.set_axis_off()


def _write(path: Path, figure: Figure, option: str) -> None:
    try:
        figure.savefig(path)
    except (OSError, ValueError) as error:
        raise UsageError(f"{option}: '{path}' cannot be written: {reason_of(error)}") from error


class StillFeatures(NamedTuple):
    """What `zou2024` finds in one scan and one image from the same pose; N returns lie in it."""

    rgb: Image
    """(H, W, 3)"""
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


def still_features(shown: EdgeView, model: str) -> StillFeatures:
    """Returns the features of a scan from the pose of a view, by a camera without distortion."""
    from touchdown.sim.moving import BodyTrack

    config = load_config(
        None, (f"zou2024.edge_model={model}",),
        scene=shown.scene, seed=shown.seed, profile_default="ideal",
    )  # fmt: skip
    scene, params = build_scene(config), config.zou2024
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
    energy = half_size_energy(rgb, edge_detector(params.edge_model))
    chosen, f_c = scan_features(points, points, in_camera, pulses, energy, rig.camera, params)
    pixels, front = project(in_camera, rig.camera.matrix())
    seen = inside_image(pixels, front, (rig.camera.width, rig.camera.height))
    edge, planar = (np.isin(np.flatnonzero(seen), of) for of in (chosen.edges, chosen.planes))
    return StillFeatures(rgb, energy, pixels[seen], f_c[seen], edge, planar)
