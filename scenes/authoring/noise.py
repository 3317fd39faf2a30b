"""Seeded value noise on rasters, the raw material of terrain and textures."""

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Float32


def smooth_noise(rng: np.random.Generator, shape: tuple[int, int], cells: float) -> Float32:
    """Noise of about unit variance whose features are ``cells`` raster cells across.

    shape: (rows, cols). Returns float32 (rows, cols), zero mean over the ensemble.
    """
    coarse = (int(np.ceil(shape[0] / cells)) + 4, int(np.ceil(shape[1] / cells)) + 4)
    seeds = rng.standard_normal(coarse, dtype=np.float32)
    # Cubic interpolation of independent nodes loses variance between the nodes: 1.5 restores it.
    offset = rng.uniform(0.0, 1.0, 2) + 1.0
    matrix = np.array([[1.0 / cells, 0.0, offset[0]], [0.0, 1.0 / cells, offset[1]]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return 1.5 * cv2.warpAffine(
        seeds, matrix, (shape[1], shape[0]), flags=flags, borderMode=cv2.BORDER_REFLECT
    )


def fractal_noise(
    rng: np.random.Generator, shape: tuple[int, int], cells: float, octaves: int, gain: float = 0.5
) -> Float32:
    """Sum of ``octaves`` of `smooth_noise`, each half as wide and ``gain`` times as strong;
    divided by the sum's standard deviation. Returns float32 (rows, cols)."""
    total = np.zeros(shape, np.float32)
    power = 0.0
    for octave in range(octaves):
        amplitude = gain**octave
        total += np.float32(amplitude) * smooth_noise(rng, shape, max(cells / 2**octave, 1.0))
        power += amplitude**2
    return total / np.float32(np.sqrt(power))


def tileable_noise(
    rng: np.random.Generator, size: int, exponent: float, low_cut: float = 1.0
) -> Float32:
    """Periodic noise with the amplitude spectrum ``|k|**-exponent`` above ``low_cut`` cycles per
    tile, zero mean, unit variance. Returns float32 (size, size)."""
    white = np.fft.rfft2(rng.standard_normal((size, size)))
    white *= _amplitudes(size, exponent, low_cut)
    field = np.fft.irfft2(white, s=(size, size))
    return ((field - field.mean()) / field.std()).astype(np.float32)


@lru_cache(maxsize=4)
def _amplitudes(size: int, exponent: float, low_cut: float) -> NDArray[np.float64]:
    rows = np.fft.fftfreq(size, 1.0 / size)[:, None]
    cols = np.fft.rfftfreq(size, 1.0 / size)[None, :]
    radius = np.hypot(rows, cols)
    return np.where(radius >= low_cut, np.maximum(radius, 1.0) ** -exponent, 0.0)
