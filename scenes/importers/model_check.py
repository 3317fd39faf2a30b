"""Checks of a compiled scene: numbers that no place on Earth has, and geoms that no sensor sees."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from touchdown.sim.files.opening import printable

FARTHEST_M = 1e8
"""Ten times the greatest northing of a map projection"""
MAX_TRIANGLES = 10_000_000
"""that a LIDAR scan is cast on; each geom counts for itself"""
_KINDS = {
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "site": mujoco.mjtObj.mjOBJ_SITE,
    "cam": mujoco.mjtObj.mjOBJ_CAMERA,
    "light": mujoco.mjtObj.mjOBJ_LIGHT,
    "mat": mujoco.mjtObj.mjOBJ_MATERIAL,
    "mesh": mujoco.mjtObj.mjOBJ_MESH,
    "hfield": mujoco.mjtObj.mjOBJ_HFIELD,
}
_DERIVED = ("geom_aabb", "geom_rbound", "geom_bvh")
_WORDS = {"cam": "camera", "mat": "material", "hfield": "height field"}


def check_model(model: Any, data: Any, path: Path) -> None:
    """Raises ValueError for a number that is NaN or infinite, for what lies or reaches beyond
    `FARTHEST_M`, for shapes of plug-ins, for height fields of one row or column and for more
    triangles than `MAX_TRIANGLES`."""
    # Geoms first: boxes around them follow from their own numbers.
    for name in sorted(dir(model), key=lambda name: (not name.startswith("geom_"), name)):
        if name in _DERIVED:
            continue
        values = getattr(model, name, None)
        if isinstance(values, np.ndarray) and values.dtype.kind == "f":
            bad = ~np.isfinite(values)
            if bad.any():
                raise ValueError(
                    f"{path}: {_element(model, name, bad)} has a number that is NaN or infinite "
                    f"({name}); correct it"
                )
    sizes = np.where(model.geom_type[:, None] == mujoco.mjtGeom.mjGEOM_MESH, 0.0, model.geom_size)
    for name, values in (
        ("geom_xpos", data.geom_xpos),
        ("geom_size", sizes),
        ("site_xpos", data.site_xpos),
        ("body_xpos", data.xpos),
        ("mesh_vert", model.mesh_vert),
        ("hfield_size", model.hfield_size),
    ):
        far = ~(np.abs(values) <= FARTHEST_M)
        if far.any():
            raise ValueError(
                f"{path}: {_element(model, name, far)} lies or reaches farther than "
                f"{FARTHEST_M:.0e} m; give lengths in metres"
            )
    formless = (model.geom_type == mujoco.mjtGeom.mjGEOM_SDF) & (
        (model.geom_plugin >= 0) | (model.geom_dataid < 0)
    )
    if formless.any():
        raise ValueError(
            f"{path}: {_element(model, 'geom_', formless)} is a signed distance field without a "
            'mesh, which a LIDAR scan cannot see; give its shape as a mesh (type="mesh")'
        )
    thin = np.minimum(model.hfield_nrow, model.hfield_ncol) < 2
    if thin.any():
        raise ValueError(
            f"{path}: {_element(model, 'hfield_nrow', thin)} has fewer than 2 rows or columns: it "
            "spans no ground; give it 2 or more of both"
        )
    _check_triangles(model, path)


def _check_triangles(model: Any, path: Path) -> None:
    meshes = np.isin(model.geom_type, (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_SDF))
    fields = model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD
    count = int(model.mesh_facenum[model.geom_dataid[meshes]].sum())
    cells = model.hfield_nrow.astype(np.int64) * model.hfield_ncol
    count += 2 * int(cells[model.geom_dataid[fields]].sum())
    if count > MAX_TRIANGLES:
        raise ValueError(
            f"{path}: its geoms have {count} triangles, more than {MAX_TRIANGLES}; simplify the "
            "meshes and height fields, or use them fewer times"
        )


def _element(model: Any, array: str, bad: np.ndarray) -> str:
    """The element of the first bad row of an array such as ``geom_pos``, with its name."""
    prefix = array.partition("_")[0]
    row = int(np.argmax(bad.reshape(len(bad), -1).any(axis=1)))
    if prefix not in _KINDS:
        return "it"
    word = _WORDS.get(prefix, prefix)
    if array == "hfield_data":
        row = int(np.searchsorted(model.hfield_adr, row, side="right")) - 1
    elif array.startswith("mesh_") and len(bad) != model.nmesh:
        row = int(np.searchsorted(model.mesh_vertadr, row, side="right")) - 1
    name = mujoco.mj_id2name(model, _KINDS[prefix], row)
    return f"{word} '{printable(name)}'" if name else f"an unnamed {word} (number {row})"
