"""What sensors see: images, LIDAR patterns and intensities, terrain, and the wind."""

import json
import zipfile
from pathlib import Path

import cv2
import numpy as np

from touchdown.experiments.config.loading import load_config
from touchdown.experiments.flight.wiring import build_scene
from touchdown.experiments.gap.card import Curves, first_file
from touchdown.experiments.scene_tools.posed_views import hover_view, posed_sensors, random_view
from touchdown.scenes.importers.geotiff import read_heights
from touchdown.scenes.truth.static_surface import static_surface
from touchdown.sim.api import WindParams
from touchdown.sim.lidar.patterns import PATTERNS
from touchdown.sim.typing import Array
from touchdown.sim.wind import Wind

_SCENES = ("crossroad", "lake", "houses", "forest")
_VIEWS = 3
_SIDE_PX = 448
_PERIODS_PX = np.geomspace(3.0, 96.0, 18)
_QUANTILES = np.array([10.0, 25.0, 50.0, 75.0, 90.0, 97.0])
_PLOT_M, _CELL_M = 96, 1.0
_WAVES_M = np.geomspace(3.0, 40.0, 12)
_BRIGHT = np.array([10.0, 25.0, 50.0, 75.0, 90.0, 95.0, 99.0])
_SEEN_S = np.array([0.05, 0.1, 0.2, 0.5, 1.0, 1.5])
_PATTERN_CELLS = 120
_REDUCED = np.geomspace(0.02, 2.0, 12)
_WIND_M, _WIND_S, _WIND_STEP_S = 30.0, 3000.0, 0.05


def _photographs(data: Path) -> list[Array]:
    """Grey images (H, W) of the folder ``caliterra``."""
    files = sorted((data / "caliterra").glob("*.jpg"))
    return [np.asarray(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), float) for file in files]


def _drawn() -> list[Array]:
    """Grey images of the camera in `field`, from 25 to 40 m over four scenes."""
    found = []
    for scene_name in _SCENES:
        config = load_config(scene=scene_name, seed=1, profile="field")
        scene = build_scene(config)
        sensors = posed_sensors(config, scene)
        rng = np.random.default_rng(1)
        views = [random_view(sensors, scene, rng, k, (25.0, 40.0)) for k in range(_VIEWS)]
        sensors.close()
        found += [np.asarray(cv2.cvtColor(v.rgb, cv2.COLOR_RGB2GRAY), float) for v in views]
    return found


def _middle(image: Array) -> Array:
    row, col = ((size - _SIDE_PX) // 2 for size in image.shape)
    return image[row : row + _SIDE_PX, col : col + _SIDE_PX]


def texture(data: Path) -> Curves | None:
    """log10 of the share of an image's variance per octave, by period."""
    photographs = _photographs(data)
    if not photographs:
        return None
    both = [
        np.array([radial_spectrum(_middle(one), 1.0, _PERIODS_PX, relative=True) for one in images])
        for images in (photographs, _drawn())
    ]
    return Curves(_mids(_PERIODS_PX), *both)


def edges(data: Path) -> Curves | None:
    """log10 of quantiles of the grey gradient, over the image's standard deviation."""
    photographs = _photographs(data)
    if not photographs:
        return None

    def quantiles(image: Array) -> Array:
        part = _middle(image)
        down, across = np.gradient(part)
        return np.log10(np.percentile(np.hypot(down, across), _QUANTILES) / part.std() + 1e-3)

    both = [np.array([quantiles(one) for one in images]) for images in (photographs, _drawn())]
    return Curves(_QUANTILES, *both)


def radial_spectrum(plot: Array, cell: float, periods: Array, *, relative: bool = False) -> Array:
    """(P - 1,) log10 of the variance of a square (N, N), without its mean plane, in each band of
    ``periods`` (P,) ascending, in units of ``cell``; ``relative``: over the whole variance."""
    size = len(plot)
    row, col = np.mgrid[:size, :size] / size - 0.5
    plane = np.column_stack([row.ravel(), col.ravel(), np.ones(size * size)])
    fit = plane @ np.linalg.lstsq(plane, plot.ravel(), rcond=None)[0]
    rest = plot - fit.reshape(plot.shape)
    window = np.outer(np.hanning(size), np.hanning(size))
    power = np.abs(np.fft.fft2(rest * window)) ** 2 / (np.sum(window**2) * size * size)
    along = np.fft.fftfreq(size, cell)
    frequency = np.hypot(along[:, None], along[None, :])
    edges_hz = 1.0 / periods[::-1]
    total, _ = np.histogram(frequency, edges_hz, weights=power)
    found = total[::-1] / (rest.var() if relative else 1.0)
    return np.asarray(np.log10(np.maximum(found, 1e-12)))


def _mids(edges_of: Array) -> Array:
    return np.asarray(np.sqrt(edges_of[1:] * edges_of[:-1]))


def terrain(data: Path) -> Curves | None:
    """log10 of the variance of the surface in bands of wavelength, m^2: trees and roofs are in."""
    files = sorted((data / "dem").glob("*.tif")) if (data / "dem").is_dir() else []
    plots = [plot for file in files for plot in _plots(read_heights(file).heights_m)]
    if not plots:
        return None
    recorded = [radial_spectrum(plot, _CELL_M, _WAVES_M) for plot in plots]
    simulated = []
    for name in _SCENES:
        scene = build_scene(load_config(scene=name, seed=1))
        low, high = scene.bounds_xy_m
        start = 0.5 * (low + high) - 0.5 * _PLOT_M
        x, y = np.meshgrid(*(start[k] + np.arange(_PLOT_M) * _CELL_M for k in range(2)))
        heights = static_surface(scene).cast(np.column_stack([x.ravel(), y.ravel()])).height_m
        simulated.append(radial_spectrum(heights.reshape(x.shape), _CELL_M, _WAVES_M))
    return Curves(_mids(_WAVES_M), np.array(recorded), np.array(simulated))


def _plots(heights: Array) -> list[Array]:
    rows, cols = (size // _PLOT_M for size in heights.shape)
    cut = [
        heights[r * _PLOT_M : (r + 1) * _PLOT_M, c * _PLOT_M : (c + 1) * _PLOT_M]
        for r in range(rows) for c in range(cols)
    ]  # fmt: skip
    return [plot for plot in cut if np.isfinite(plot).all()]


def intensities(data: Path) -> Curves | None:
    """log10 of one plus quantiles of the intensity of a LIDAR's returns."""
    file = first_file(data, "livox/statistics.json")
    if file is None:
        return None
    clouds = [one["intensity"]["pct"] for one in json.loads(file.read_text(encoding="utf-8"))]
    recorded = [[levels[f"{q:.0f}"] for q in _BRIGHT] for levels in clouds if levels["99"] > 0.0]
    simulated = []
    for name in _SCENES:
        config = load_config(scene=name, seed=1, profile="field")
        seen = hover_view(config, build_scene(config), 30.0, 0.5).intensity
        simulated.append(np.percentile(seen, _BRIGHT))
    return Curves(_BRIGHT, np.log10(1.0 + np.array(recorded)), np.log10(1.0 + np.array(simulated)))


def patterns(data: Path) -> Curves | None:
    """Share of the field of view's cells that a LIDAR has hit after a time; three LIDARs."""
    wheel = next(iter(sorted(data.glob("mujoco_lidar-*.whl"))), None)
    if wheel is None:
        return None
    both: tuple[list[Array], list[Array]] = ([], [])
    with zipfile.ZipFile(wheel) as archive:
        for name in ("horizon", "avia", "mid360"):
            rate = PATTERNS[name].point_rate_hz  # type: ignore[index]
            with archive.open(f"mujoco_lidar/scan_mode/{name}.npy") as file:
                angles = np.load(file)[: round(_SEEN_S[-1] * rate)]
            own = PATTERNS[name].directions(0, len(angles))  # type: ignore[index]
            if name != "mid360":  # its boresight is x there and z here
                own = own[:, [2, 0, 1]]
            ours = np.column_stack([np.arctan2(own[:, 1], own[:, 0]), np.arcsin(own[:, 2])])
            turned = np.column_stack(
                [np.mod(angles[:, 0] + np.pi, 2 * np.pi) - np.pi, angles[:, 1]]
            )
            low, high = np.percentile(turned, 0.1, axis=0), np.percentile(turned, 99.9, axis=0)
            for kept, one in zip(both, (turned, ours), strict=True):
                cell = np.floor((one - low) / (high - low) * _PATTERN_CELLS).astype(int)
                inside = ((cell >= 0) & (cell < _PATTERN_CELLS)).all(axis=1)
                flat = np.where(inside, cell[:, 0] * _PATTERN_CELLS + cell[:, 1], -1)
                kept.append(np.array([
                    len(np.unique(flat[: round(s * rate)])) / _PATTERN_CELLS**2 for s in _SEEN_S
                ]))  # fmt: skip
    return Curves(np.tile(_SEEN_S, 3), np.concatenate(both[0])[None], np.concatenate(both[1])[None])


def gusts(_data: Path, *, short_waves: bool = False) -> Curves | None:
    """log10 of f S(f) / u*^2 of the wind along its mean, over the reduced frequency f z / U; the
    other is Kaimal's neutral spectrum (Q. J. R. Meteorol. Soc. 98, 1972)."""
    from scipy.signal import welch

    simulated = []
    for seed in range(4):
        wind = Wind(WindParams(short_waves=short_waves), seed)
        speed = wind.mean_speed(_WIND_M)
        count = round(_WIND_S / _WIND_STEP_S)
        along = np.array([
            wind.step(_WIND_STEP_S, _WIND_M, speed) @ wind.mean_direction for _ in range(count)
        ])  # fmt: skip
        frequency, density = welch(along, 1.0 / _WIND_STEP_S, nperseg=8192)
        at = _REDUCED * speed / _WIND_M
        simulated.append(
            np.log10(at * np.interp(at, frequency, density) / (0.4 * wind.friction) ** 2)
        )
    kaimal = np.log10(105.0 * _REDUCED / (1.0 + 33.0 * _REDUCED) ** (5.0 / 3.0))
    return Curves(_REDUCED, kaimal[None], np.array(simulated))
