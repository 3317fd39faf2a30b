"""Limits on MJCF files, checked from their text and the headers of their assets.

MuJoCo expands replicas, attached models and grids while it reads, and opens every file that is
named: what would take hours, all memory, or never end is refused before.
"""

from __future__ import annotations

import math
import os
import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.parsers import expat

from touchdown.sim.files.inflating import check_png
from touchdown.sim.files.opening import MIB, check_file, printable

MAX_TEXT_BYTES = 32 * MIB
"""of one MJCF file"""
MAX_FILES = 200
"""MJCF files that one scene is made of"""
MAX_DEPTH = 400
MAX_MODELS_DEEP = 5
"""attached models within attached models"""
MAX_OF_TAG = {"geom": 10_000, "body": 10_000, "site": 10_000, "camera": 1_000, "light": 1_000}
MAX_MOVING = 2_000
"""joints, sensors, actuators and the like together"""
MAX_ELEMENTS = 200_000
MAX_CELLS = 1 << 22
"""of all height fields together"""
MAX_TEXELS, MAX_TEXTURE_SIDE = 1 << 27, 16_384
"""of all textures together, and pixels along a side"""
MAX_MESH_BYTES = 256 * MIB
"""of all mesh files together"""
MAX_MESH_PARAM = 1_000
"""resolution of a built-in mesh"""
_MOVING = frozenset((
    "joint", "freejoint", "motor", "position", "velocity", "intvelocity", "damper", "cylinder",
    "muscle", "adhesion", "dcmotor", "general", "key", "exclude", "pair", "spatial", "fixed",
    "weld", "connect", "tendon", "flex",
))  # fmt: skip
_SENSOR_SECTION, _DEFAULT_NAME = "sensor", "MuJoCo Model"
_TEXTURE_FILES = (
    "file", "fileright", "fileleft", "fileup", "filedown", "filefront", "fileback",
)  # fmt: skip
_PLUGIN_PARENTS = ("extension", "actuator", "sensor", "default")
"""Where a plug-in drives no geom and no body: these elements are left out of a scene."""


_JOIN = "join small ones to meshes, or cut out the part around the take-off"
_LEAVE_OUT = "leave out what a scene does not need"
_LIMITS = (
    ("geom", MAX_OF_TAG["geom"], "geoms", _JOIN),
    ("body", MAX_OF_TAG["body"], "bodies", _JOIN),
    ("site", MAX_OF_TAG["site"], "sites", _LEAVE_OUT),
    ("camera", MAX_OF_TAG["camera"], "cameras", _LEAVE_OUT),
    ("light", MAX_OF_TAG["light"], "lights", _LEAVE_OUT),
    ("all", MAX_ELEMENTS, "elements", _LEAVE_OUT),
    ("moving", MAX_MOVING, "joints, sensors and actuators", _LEAVE_OUT),
    ("cells", MAX_CELLS, "cells of height fields", "make them coarser"),
    ("texels", MAX_TEXELS, "pixels of textures", "scale them down"),
    ("mesh MiB", MAX_MESH_BYTES // MIB, "MiB of meshes", "simplify them (decimate)"),
)
"""What is counted, the most of it, its words in a message, the remedy"""
_OF_SPEC = {
    "geom": ("geoms",), "body": ("bodies",), "site": ("sites",), "camera": ("cameras",),
    "light": ("lights",),
    "moving": ("sensors", "actuators", "tendons"),
}  # fmt: skip
"""Lists of a read file that hold what is counted; soft bodies have joints that no text names"""

_GRIDS = {
    "cells": ("height field", "cells", MAX_CELLS),
    "texels": ("texture", "pixels", MAX_TEXELS),
}
Census = Counter[str]
"""Counts of a file once MuJoCo has expanded it: elements by tag, "all" of them, "moving" ones,
"mesh bytes", "cells" of height fields and "texels" of textures"""
_ASSETS = ("mesh bytes", "cells", "texels")
"""What all copies of a model share"""


@dataclass(frozen=True, slots=True)
class _Asset:
    kind: str
    name: str
    file: str
    folder: Path


def check_mjcf(path: Path) -> Census:
    """Returns the counts of an MJCF file with its includes, attached models and assets.

    Raises FileNotFoundError for a missing file, ValueError for text that is no XML, a DOCTYPE, a
    file that contains itself, a file that is none (a folder, a pipe, a device), a PNG that inflates
    to more than its size needs and for more than the limits of this module. Missing assets pass:
    MuJoCo names them.
    """
    return _Model(path, path, (), [0]).census


def check_spec(spec: Any, path: Path) -> None:
    """Raises ValueError where what MuJoCo itself has read (MjSpec) is beyond the limits: its reader
    of XML is another than that of `check_mjcf`."""
    census = Counter({
        tag: sum(len(getattr(spec, kind)) for kind in kinds) for tag, kinds in _OF_SPEC.items()
    })  # fmt: skip
    census["mesh bytes"] = sum(4 * len(mesh.uservert) for mesh in spec.meshes)
    census["cells"] = sum(max(0, field.nrow) * max(0, field.ncol) for field in spec.hfields)
    census["texels"] = sum(max(0, one.width) * max(0, one.height) for one in spec.textures)
    _check(census, path)


def _check(census: Census, scene: Path) -> None:
    counts = census + Counter({"mesh MiB": -(-census["mesh bytes"] // MIB)})
    for key, most, what, remedy in _LIMITS:
        if counts[key] > most:
            raise ValueError(f"{scene}: it has {counts[key]} {what}, more than {most}; {remedy}")


class _Model:
    """One MJCF file with what it includes."""

    def __init__(
        self, path: Path, scene: Path, within: tuple[Path, ...], files_read: list[int]
    ) -> None:
        self.census: Census = Counter()
        self.name = _DEFAULT_NAME
        self._path, self._scene, self._files_read = path, scene, files_read
        self._within = (*within, path.resolve())
        self._folders: set[str] = {""}
        self._assets: list[_Asset] = []
        self._models: dict[str, Census] = {}
        self._attached: list[tuple[str, int]] = []
        self._depth, self._included = 0, {path.resolve()}
        self._tags: list[str] = []
        self._weights = [1]
        self._read(path)
        _check(self.census, scene)
        for model, weight in self._attached:
            self._add(self._models.get(model, Counter()), weight)
        for asset in self._assets:
            self._measure(asset)
        _check(self.census, scene)

    def _fail(self, text: str) -> ValueError:
        return ValueError(f"{self._scene}: {text}")

    # ------------------------------------------------------------------------------------ reading

    def _read(self, path: Path) -> None:
        """Counts the elements of one file."""
        self._files_read[0] += 1
        if self._files_read[0] > MAX_FILES:
            raise self._fail(f"it is made of more than {MAX_FILES} files; join them")
        check_file(path, "an MJCF file", MAX_TEXT_BYTES)
        data = path.read_bytes()
        try:
            data.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            raise self._fail(
                f"not a valid MJCF file: '{path.name}' is not UTF-8 text (byte {error.start}); "
                "save it as UTF-8"
            ) from None
        parser = expat.ParserCreate("utf-8")
        parser.StartElementHandler = lambda tag, attributes: self._start(
            tag.lower(), attributes, path
        )
        parser.EndElementHandler = lambda _tag: self._end()
        parser.StartDoctypeDeclHandler = self._refuse_doctype
        try:
            parser.Parse(data, True)
        except expat.ExpatError as error:
            raise self._fail(
                f"not a valid MJCF file: '{path.name}' is not XML: {error}; correct it there, "
                "or, if MuJoCo opens it, save it anew (mujoco.mj_saveLastXML)"
            ) from None

    def _refuse_doctype(self, *_declared: object) -> None:
        # MuJoCo's reader sees its end elsewhere, and hence another document.
        raise self._fail("it has a DOCTYPE, which MJCF has not; remove it, write entities as text")

    def _start(self, tag: str, attributes: Mapping[str, str], path: Path) -> None:
        parent = self._tags[-1] if self._tags else ""
        if not self._tags and tag not in ("mujoco", "mujocoinclude"):
            raise self._fail(
                f"not a valid MJCF file: the root of '{path.name}' is <{printable(tag)}>, not "
                "<mujoco>; convert it first (MuJoCo's compile program turns URDF into MJCF)"
            )
        if not self._tags and not self._depth:
            self.name = attributes.get("model", _DEFAULT_NAME)
        self._tags.append(tag)
        if len(self._tags) + self._depth > MAX_DEPTH:
            raise self._fail(f"its elements are nested more than {MAX_DEPTH} deep; flatten it")
        if tag == "replicate":
            self._weights.append(self._weights[-1] * max(1, _whole(attributes.get("count"))))
        else:
            self._weights.append(self._weights[-1])
        self._count(tag, parent, attributes)
        self._take(tag, parent, attributes, path)

    def _end(self) -> None:
        self._tags.pop()
        self._weights.pop()

    def _count(self, tag: str, parent: str, attributes: Mapping[str, str]) -> None:
        weight, counts = self._weights[-1], self.census
        counts["all"] += weight
        if tag in ("flexcomp", "composite"):
            counts["body"] += weight * math.prod(
                max(1, _whole(word)) for word in attributes.get("count", "10 10 10").split()[:3]
            )
        elif tag in MAX_OF_TAG and parent != "default":
            counts[tag] += weight
        elif tag in _MOVING or parent == _SENSOR_SECTION:
            counts["moving"] += weight

    def _take(self, tag: str, parent: str, attributes: Mapping[str, str], path: Path) -> None:
        """Notes what an element names: files, models, sizes."""
        file, name = attributes.get("file", ""), attributes.get("name", "")
        if tag == "include" and file:
            self._include(file, path)
        elif tag == "compiler":
            self._folders |= {attributes.get(key, "") for key in ("meshdir", "texturedir",
                                                                  "assetdir")}  # fmt: skip
        elif tag == "model" and file:
            self._model(name, file, path)
        elif tag == "attach":
            self._attached.append((attributes.get("model", ""), self._weights[-1]))
        elif tag == "plugin" and parent not in _PLUGIN_PARENTS:
            raise self._fail(
                f"a <{parent}> needs the MuJoCo plug-in "
                f"'{printable(attributes.get('plugin') or attributes.get('instance', ''))}', which "
                "no sensor of a flight sees; give its shape as a mesh file (OBJ or STL)"
            )
        elif tag in ("mesh", "skin", "flex", "flexcomp", "texture", "hfield"):
            self._asset(tag, name, attributes, path)

    def _asset(self, tag: str, name: str, attributes: Mapping[str, str], path: Path) -> None:
        files = [attributes[key] for key in _TEXTURE_FILES if attributes.get(key)]
        kind = {"texture": "texture", "hfield": "height field"}.get(tag, "mesh")
        self._assets += [_Asset(kind, name, file, path.parent) for file in files]
        if kind == "mesh":  # vertices in the file itself
            self.census["mesh bytes"] += sum(map(len, attributes.values()))
        if tag == "hfield" and not files:
            self._add_grid(
                "cells", name, _whole(attributes.get("ncol")), _whole(attributes.get("nrow"))
            )
        elif tag == "texture" and not files:
            width, height = (_whole(attributes.get(key)) for key in ("width", "height"))
            flat = attributes.get("type", "cube").strip() == "2d"
            # MuJoCo makes the faces of a cube squares.
            self._add_grid("texels", name, width, height if flat else width, 1 if flat else 6)
        elif tag == "mesh" and attributes.get("builtin"):
            largest = max((_whole(word) for word in attributes.get("params", "").split()),
                          default=0)  # fmt: skip
            if largest > MAX_MESH_PARAM:
                raise self._fail(
                    f"mesh '{printable(name)}' has a resolution of {largest}, more than "
                    f"{MAX_MESH_PARAM}; make it coarser"
                )

    # -------------------------------------------------------------------------------------- files

    def _include(self, file: str, path: Path) -> None:
        for target in self._found("include", file, path.parent):
            if target.resolve() in self._included:
                raise self._fail(f"'{printable(file)}' is included twice, or includes itself")
            self._included.add(target.resolve())
            tags, self._tags, self._depth = self._tags, [], self._depth + len(self._tags)
            weights, self._weights = self._weights, [self._weights[-1]]
            self._read(target)
            self._tags, self._weights, self._depth = tags, weights, self._depth - len(tags)
            return

    def _model(self, name: str, file: str, path: Path) -> None:
        for target in self._found("model", file, path.parent):
            if target.resolve() in self._within:
                raise self._fail(f"the model '{printable(file)}' contains itself")
            if len(self._within) >= MAX_MODELS_DEEP:
                raise self._fail(
                    f"models are attached within one another more than {MAX_MODELS_DEEP} deep; "
                    "flatten it"
                )
            nested = _Model(target, self._scene, self._within, self._files_read)
            name = name or nested.name
            self._models[name] = self._models.get(name, Counter()) | nested.census
            return

    def _add(self, other: Census, weight: int) -> None:
        for key, count in other.items():
            self.census[key] += count if key in _ASSETS else weight * count
        _check(self.census, self._scene)

    def _found(
        self, kind: str, file: str, folder: Path, within: tuple[str, ...] = ("",)
    ) -> Iterator[Path]:
        """Yields the paths at which MuJoCo may look for a file and where one is. Raises ValueError
        for what is no regular file."""
        for base in (self._path.parent, folder):
            for below in within:
                for name in dict.fromkeys((file, os.path.basename(file.replace("\\", "/")))):
                    target = Path(os.path.normpath(base / below / name))
                    if not name or "\0" in name or not target.exists():
                        continue
                    try:
                        check_file(target, f"the file of a {kind}")
                    except ValueError as error:
                        raise self._fail(f"{kind} '{printable(file)}': {error}") from None
                    yield target

    def _measure(self, asset: _Asset) -> None:
        """Adds the size of an asset's file by its header, of the largest that MuJoCo may open."""
        before, largest = self.census.copy(), self.census.copy()
        for target in self._found(
            asset.kind, asset.file, asset.folder, tuple(sorted(self._folders))
        ):
            self.census = before.copy()
            self._measure_file(asset, target)
            largest |= self.census
        self.census = largest

    def _measure_file(self, asset: _Asset, target: Path) -> None:
        with target.open("rb") as file:
            head = file.read(32)
            if head.startswith(b"\x89PNG") and len(head) >= 24:
                width, height = struct.unpack(">II", head[16:24])
                key = "cells" if asset.kind == "height field" else "texels"
                self._add_grid(key, asset.name, width, height)
                file.seek(0)
                try:
                    check_png(file, MAX_TEXELS)
                except ValueError as error:
                    raise self._fail(
                        f"{asset.kind} '{printable(asset.name)}': '{printable(asset.file)}' {error}"
                    ) from None
            elif asset.kind == "height field" and target.suffix == ".bin" and len(head) >= 8:
                rows, cols = struct.unpack("<ii", head[:8])
                self._add_grid("cells", asset.name, cols, rows)
            else:
                self.census["mesh bytes"] += target.stat().st_size

    def _add_grid(self, key: str, name: str, width: int, height: int, faces: int = 1) -> None:
        """Adds the cells of a height field or the texels of a texture."""
        self.census[key] += faces * max(0, width) * max(0, height)
        what, unit, most = _GRIDS[key]
        limit = f"{most} with all others together"
        if key == "texels" and max(width, height) > MAX_TEXTURE_SIDE:
            limit = f"{MAX_TEXTURE_SIDE} along a side"
        elif self.census[key] <= most:
            return
        raise self._fail(
            f"{what} '{printable(name)}' has {width} x {height} {unit}, more than {limit}; make it "
            "coarser, or cut out the part around the take-off"
        )


def _whole(word: str | None) -> int:
    """Returns an integer attribute, 0 where it is none: MuJoCo refuses it with its own words."""
    try:
        return int(float(word or "0"))
    except (ValueError, OverflowError):
        return 0
