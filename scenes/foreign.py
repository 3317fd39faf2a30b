"""Scenes by other people: any MJCF file."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from scenes.api import LAND_CLASSES, Surface
from scenes.draft import SceneDraft

REFLECTIVITY_905NM = {
    "lawn": 0.45,
    "field": 0.25,
    "path": 0.30,
    "road": 0.15,
    "building": 0.35,
    "water": 0.03,
    "trees": 0.40,
    "other": 0.30,
}
"""Typical diffuse reflectivity at 905 nm by class (vegetation is bright in the near infrared)."""
DEFAULT_SURFACE = Surface(land_class="other", reflectivity=REFLECTIVITY_905NM["other"])
_HALF_BOUNDS_M = 60.0


def surface_of_name(name: str) -> Surface | None:
    """The surface of a material's or geom's name that begins with a land class (``lawn_2``,
    ``roadway``; ``water`` also sets the water flag, ``trees`` a porosity of 0.35); else None."""
    for land_class in LAND_CLASSES:
        if name.lower().startswith(land_class):
            return Surface(
                land_class=land_class,
                reflectivity=REFLECTIVITY_905NM[land_class],
                porosity=0.35 if land_class == "trees" else 0.0,
                water=land_class == "water",
            )
    return None


def read_mjcf(path: Path) -> SceneDraft:
    """A place from an MJCF file. The take-off spot is the site or body named ``takeoff``, else
    the origin; classes follow from names (`surface_of_name`), other geoms are class ``other``
    with reflectivity 0.30, and one warning says so.

    Raises FileNotFoundError, or ValueError for a file that MuJoCo cannot read.
    """
    if not path.is_file():
        raise FileNotFoundError(f"scene file not found: {path}")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        model = spec.copy().compile()
    except (ValueError, mujoco.FatalError) as error:
        raise ValueError(
            f"{path}: not a valid MJCF file: {' '.join(str(error).split())}"
        ) from error
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    xy, yaw = _takeoff(model, data)
    return SceneDraft(
        spec=spec,
        takeoff_xy_m=xy,
        takeoff_yaw=yaw,
        bounds_xy_m=_bounds(model, data, xy),
        surfaces=_surfaces(spec, path),
        ground=None,
    )


def _takeoff(model: Any, data: Any) -> tuple[np.ndarray, float]:
    for kind, positions, matrices in (
        (mujoco.mjtObj.mjOBJ_SITE, data.site_xpos, data.site_xmat),
        (mujoco.mjtObj.mjOBJ_BODY, data.xpos, data.xmat),
    ):
        index = mujoco.mj_name2id(model, kind, "takeoff")
        if index >= 0:
            rotation = matrices[index].reshape(3, 3)
            return positions[index, :2].copy(), float(np.arctan2(rotation[1, 0], rotation[0, 0]))
    return np.zeros(2), 0.0


def _surfaces(spec: Any, path: Path) -> dict[str, Surface]:
    surfaces: dict[str, Surface] = {}
    unknown: list[str] = []
    taken = {geom.name for geom in spec.geoms if geom.name}
    for index, geom in enumerate(spec.geoms):
        if not geom.name:
            stem = geom.material or "geom"
            name = f"{stem}_{index}"
            geom.name = name if name not in taken else f"{name}_unnamed"
        found = surface_of_name(geom.material or "") or surface_of_name(geom.name)
        if found is None:
            unknown.append(geom.name)
        surfaces[geom.name] = found or DEFAULT_SURFACE
    if unknown:
        names = ", ".join(unknown[:4]) + (" ..." if len(unknown) > 4 else "")
        warnings.warn(
            f"{path}: {len(unknown)} geoms have no known class ({names}): they count as 'other' "
            f"with reflectivity {DEFAULT_SURFACE.reflectivity}; begin a material's or geom's name "
            f"with one of {', '.join(LAND_CLASSES)}",
            stacklevel=3,
        )
    return surfaces


def _bounds(model: Any, data: Any, takeoff_xy_m: np.ndarray) -> np.ndarray:
    """The horizontal box around all finite geoms, cut to 120 m around the take-off spot; that
    whole square where an infinite plane lies below."""
    window = np.stack([takeoff_xy_m - _HALF_BOUNDS_M, takeoff_xy_m + _HALF_BOUNDS_M])
    planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    if bool((planes & (model.geom_size[:, :2] == 0.0).any(axis=1)).any()) or model.ngeom == 0:
        return window
    centres = model.geom_aabb[:, :3]
    half = np.where(planes[:, None], model.geom_size * [1.0, 1.0, 0.0], model.geom_aabb[:, 3:])
    rotations = data.geom_xmat.reshape(-1, 3, 3)
    world = np.einsum("nij,nj->ni", rotations, centres) + data.geom_xpos
    reach = np.einsum("nij,nj->ni", np.abs(rotations), half)
    low, high = (world - reach).min(axis=0)[:2], (world + reach).max(axis=0)[:2]
    return np.stack([np.maximum(low, window[0]), np.minimum(high, window[1])])
