"""The term flatness (Zou, Sun, Kong 2024, Eqs. 15 to 17): level ground around a site.

It has two forms: ``literal`` follows Eqs. 16 and 17 (kernel centred on the mean angle, sum over the
disc), which rewards the average slope and the point density; ``corrected`` centres the kernel on
level ground and takes the mean per cell."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from touchdown.landing.api import LandingParams, TermLayer
from touchdown.landing.selection.ground.elevation_raster import (
    ElevationRaster,
    PlaneField,
    disc_widths,
)
from touchdown.landing.selection.terms.inputs import Inputs

Float32 = NDArray[np.float32]


def term(site: Inputs) -> TermLayer:
    """Returns the reward of flat ground."""
    share = site.flatness
    return TermLayer(name="flatness", value=site.selector.weight_flatness * share, quantity=share)


def flatness_of(raster: ElevationRaster, planes: PlaneField, params: LandingParams) -> Float32:
    """Returns Eqs. 15 to 17 of a raster with the planes of its cells."""
    angles = np.where(raster.known, normal_angles(planes), np.float32(np.nan))
    form = params.flatness_form
    kernel = flatness_kernel(angles, form=form, sigma_rad=np.deg2rad(params.flatness_sigma_deg))
    return flatness(
        kernel, raster.count, form=form, radius_m=params.clear_radius_m, cell_m=raster.cell_m
    )


def normal_angles(planes: PlaneField) -> Float32:
    """Eq. 15: angle in radians between the surface normal and the vertical."""
    return planes.angle_rad


def flatness_kernel(angles: Float32, *, form: str, sigma_rad: float) -> Float32:
    """Eq. 16: Gaussian of the angle. ``literal``: with mean and standard deviation of all cells;
    ``corrected``: centred on level ground with ``sigma_rad``. Raises ValueError for another
    form."""
    if form == "literal":
        centre, sigma = float(np.nanmean(angles)), max(float(np.nanstd(angles)), 1e-6)
    elif form == "corrected":
        centre, sigma = 0.0, sigma_rad
    else:
        raise ValueError(f"flatness_form is {form!r}: use 'corrected' or 'literal'")
    return np.exp((angles - np.float32(centre)) ** 2 * np.float32(-0.5 / sigma**2))


def flatness(
    kernel: Float32, count: Float32, *, form: str, radius_m: float, cell_m: float
) -> Float32:
    """Eq. 17: the kernel accumulated over the disc of ``radius_m``.

    ``literal``: sum over all returns of the disc, divided by the largest sum; ``corrected``: mean
    over the cells of the disc, unknown ones as 0. NaN where the cell is unknown.
    """
    widths = disc_widths(radius_m / cell_m)
    known = np.isfinite(kernel)
    values = np.where(known, kernel, np.float32(0.0))
    if form == "literal":
        values = values * count
    total, column = np.zeros_like(values), np.empty(values.shape[1] + widths.size - 1, np.float32)
    _disc_sums(values, widths, column, total)
    scale = float(total.max()) if form == "literal" else float((2 * widths + 1).sum())
    cost = np.clip(total / np.float32(max(scale, 1e-9)), np.float32(0.0), np.float32(1.0))
    return np.where(known, cost, np.float32(np.nan))


@numba.njit(cache=True)
def _disc_sums(values: Float32, widths: NDArray[np.int64], column: Float32, sums: Float32) -> None:
    """Adds the values in the disc whose rows reach ``widths`` to each side: of the columns that lie
    ``wide`` from the middle, as high as the rows that are at least as wide."""
    rows, cols = values.shape
    reach = widths.size // 2
    for row in range(rows):
        for col in range(column.size):
            column[col] = 0.0
        middle, out = column[reach:], sums[row]
        for wide in range(reach, -1, -1):
            for k in range(widths.size):
                if widths[k] == wide and 0 <= row + k - reach < rows:
                    source = values[row + k - reach]
                    for col in range(cols):
                        middle[col] += source[col]
            left, right = column[reach - wide :], column[reach + wide :]
            share = np.float32(1.0 if wide else 0.0)
            for col in range(cols):
                out[col] += left[col] + share * right[col]
