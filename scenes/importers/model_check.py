"""Limits of MJCF files of other people: of their texts, of what MuJoCo reads, of what it compiles.

What MuJoCo itself needs for a file is limited by the process that reads it (`sim.files.child`).
"""

import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from touchdown.sim.files.opening import MIB, check_file, printable

MAX_TEXT_BYTES = 32 * MIB
"""of one MJCF file"""
MAX_FILES = 200
"""MJCF files that one scene is made of"""
_JOIN = "join small ones to meshes, or cut out the part around the take-off"
_LEAVE_OUT = "leave out what a scene does not need"
MAX_ELEMENTS: Mapping[str, tuple[int, str]] = {
    "geoms": (10_000, _JOIN), "bodies": (10_000, _JOIN), "sites": (10_000, _LEAVE_OUT),
    "cameras": (1_000, _LEAVE_OUT), "lights": (1_000, _LEAVE_OUT), "joints": (2_000, _LEAVE_OUT),
    "sensors": (2_000, _LEAVE_OUT), "actuators": (2_000, _LEAVE_OUT),
    "tendons": (2_000, _LEAVE_OUT),
}  # fmt: skip
"""of each kind, with replicas and attached models, and what to do about more"""
MAX_CELLS = 1 << 22
"""of all height fields together"""
MAX_TEXELS, MAX_TEXTURE_SIDE = 1 << 27, 16_384
"""of all textures together, and pixels along a side"""
FARTHEST_M = 1e8
"""Ten times the maximum northing of a map projection"""
MAX_TRIANGLES = 10_000_000
"""that a LIDAR scan is cast on; each geom counts for itself"""
_NAMED_FILE = re.compile(r"""\bfile\w*\s*=\s*(?:"([^"]*)"|'([^']*)')""")
_KINDS = {
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "site": mujoco.mjtObj.mjOBJ_SITE,
    "cam": mujoco.mjtObj.mjOBJ_CAMERA,
    "light": mujoco.mjtObj.mjOBJ_LIGHT,
    "mat": mujoco.mjtObj.mjOBJ_MATERIAL,
    "mesh": mujoco.mjtObj.mjOBJ_MESH,
    "hfield": mujoco.mjtObj.mjOBJ_HFIELD,
    "tex": mujoco.mjtObj.mjOBJ_TEXTURE,
}
_READABLE: Mapping[str, tuple[str, ...]] = {
    "mesh": (".obj", ".stl", ".msh"), "texture": (".png", ".ktx"), "height field": (".png", ".bin"),
}  # fmt: skip
_DERIVED = ("geom_aabb", "geom_rbound", "geom_bvh")
_WORDS = {"cam": "camera", "mat": "material", "hfield": "height field", "tex": "texture"}


def check_texts(path: Path) -> None:
    """Reads the MJCF file ``path`` and those that it names. Raises ValueError for too many or too
    large ones, for text that is not UTF-8, and for a file that is none, such as a pipe, which would
    be waited for without end. Missing files pass: MuJoCo names them."""
    waiting, seen = [path], set[Path]()
    while waiting:
        file = waiting.pop()
        if file.resolve() in seen:
            continue
        seen.add(file.resolve())
        if len(seen) > MAX_FILES:
            raise ValueError(f"{path}: it is made of more than {MAX_FILES} files; join them")
        check_file(file, "an MJCF file", MAX_TEXT_BYTES)
        try:
            text = file.read_text(encoding="utf-8-sig")
        except UnicodeDecodeError as error:
            raise ValueError(
                f"{path}: not a valid MJCF file: '{file.name}' is not UTF-8 text (byte "
                f"{error.start}); save it as UTF-8"
            ) from None
        for match in _NAMED_FILE.finditer(text):
            name = match[1] or match[2]
            target = path.parent / name if name else path
            if os.path.exists(target):
                check_file(target, f"{path}: a file of the scene,")
                waiting += [target] if target.suffix.lower() == ".xml" else []


def check_spec(spec: Any, path: Path) -> None:
    """Raises ValueError for what MuJoCo has read (MjSpec) beyond `MAX_ELEMENTS`, for shapes of
    plug-ins, and for assets that are no regular files."""
    for kind, (maximum, remedy) in MAX_ELEMENTS.items():
        if (count := len(getattr(spec, kind))) > maximum:
            raise ValueError(f"{path}: it has {count} {kind}, more than {maximum}; {remedy}")
    for kind in ("geoms", "bodies", "meshes"):
        for element in getattr(spec, kind):
            if element.plugin.active:
                name = printable(element.plugin.plugin_name or element.plugin.name)
                raise ValueError(
                    f"{path}: one of its {kind} needs the MuJoCo plug-in '{name}', which no sensor "
                    "of a flight sees; give its shape as a mesh file (OBJ or STL)"
                )
    for _, _, target in _assets(spec):
        if os.path.exists(target):
            check_file(target, f"{path}: an asset,")


def blame_asset(spec: Any, path: Path) -> None:
    """Raises for the first asset whose file is missing or of a kind that MuJoCo cannot read."""
    for kind, name, target in _assets(spec):
        if not target.is_file():
            raise FileNotFoundError(
                f"{path}: {kind} '{name}' needs the file '{target.name}', which is not in "
                f"{target.parent}"
            )
        if kind in _READABLE and target.suffix.lower() not in _READABLE[kind]:
            raise ValueError(
                f"{path}: MuJoCo cannot read '{target.name}' of {kind} '{name}'; convert it to "
                f"{' or '.join(_READABLE[kind])}"
            )


def _assets(spec: Any) -> Iterator[tuple[str, str, Path]]:
    """Kind, name and file of each asset."""
    base = Path(spec.modelfiledir)
    for kind, elements, folder in (
        ("mesh", spec.meshes, spec.meshdir),
        ("texture", spec.textures, spec.texturedir),
        ("height field", spec.hfields, spec.meshdir),
        ("skin", spec.skins, spec.meshdir),
    ):
        for element in elements:
            for file in (element.file, *getattr(element, "cubefiles", ())):
                if file:
                    yield kind, element.name, base / folder / file


def check_model(model: Any, data: Any, path: Path) -> None:
    """Raises ValueError for a number that is NaN or infinite, for what lies or reaches beyond
    `FARTHEST_M`, for height fields of one row or column
    or beyond `MAX_CELLS`, for textures beyond `MAX_TEXELS` and `MAX_TEXTURE_SIDE` and for more
    triangles than `MAX_TRIANGLES`."""
    _check_grids(model, path)
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
    thin = np.minimum(model.hfield_nrow, model.hfield_ncol) < 2
    if thin.any():
        raise ValueError(
            f"{path}: {_element(model, 'hfield_nrow', thin)} has fewer than 2 rows or columns: it "
            "spans no ground; give it 2 or more of both"
        )
    _check_triangles(model, path)


def _check_grids(model: Any, path: Path) -> None:
    for prefix, columns, rows, maximum, unit in (
        ("hfield", model.hfield_ncol, model.hfield_nrow, MAX_CELLS, "cells"),
        ("tex", model.tex_width, model.tex_height, MAX_TEXELS, "pixels"),
    ):
        sizes = columns.astype(np.int64) * rows
        limit, bad = f"{maximum} with all others together", np.cumsum(sizes) > maximum
        if prefix == "tex":
            flat = model.tex_type == mujoco.mjtTexture.mjTEXTURE_2D
            wide = np.where(flat, np.maximum(columns, rows), columns) > MAX_TEXTURE_SIDE
            if wide.any():  # the six faces of a cube stand below one another
                limit, bad = f"{MAX_TEXTURE_SIDE} along a side", wide
        if bad.any():
            index = int(np.argmax(bad))
            raise ValueError(
                f"{path}: {_element(model, prefix, bad)} has {columns[index]} x {rows[index]} "
                f"{unit}, more than {limit}; make it coarser, or cut out the part around the "
                "take-off"
            )


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
