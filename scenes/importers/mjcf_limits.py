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
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from touchdown.scenes.importers.files import MIB, check_file, printable

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
_SENSOR_SECTION = "sensor"
_TEXTURE_FILES = (
    "file", "fileright", "fileleft", "fileup", "filedown", "filefront", "fileback",
)  # fmt: skip
_PLUGIN_PARENTS = ("extension", "actuator", "sensor", "default")
"""Where a plug-in drives no geom and no body: these elements are left out of a scene."""


@dataclass(slots=True)
class Census:
    """Counts of a file once MuJoCo has expanded it."""

    elements: Counter[str] = field(default_factory=Counter)
    mesh_bytes: int = 0
    cells: int = 0
    texels: int = 0


@dataclass(frozen=True, slots=True)
class _Asset:
    kind: str
    name: str
    file: str
    folder: Path


def check_mjcf(path: Path) -> Census:
    """Returns the counts of an MJCF file with its includes, attached models and assets.

    Raises FileNotFoundError for a missing file, ValueError for text that is no XML, a file that
    contains itself, a file that is none (a folder, a pipe, a device) and for more than the limits
    of this module. Missing assets pass: MuJoCo names them.
    """
    return _Model(path, path, (), [0]).census


class _Model:
    """One MJCF file with what it includes."""

    def __init__(
        self, path: Path, scene: Path, within: tuple[Path, ...], files_read: list[int]
    ) -> None:
        self.census = Census()
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
        self._check_counts()
        for name, weight in self._attached:
            self._add(self._models.get(name, Census()), weight)
        for asset in self._assets:
            self._measure(asset)
        self._check()

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
        parser.EntityDeclHandler = self._refuse_entity
        try:
            parser.Parse(data, True)
        except expat.ExpatError as error:
            raise self._fail(f"not a valid MJCF file: '{path.name}' is not XML: {error}") from None

    def _refuse_entity(self, *_entity: object) -> None:
        raise self._fail("it declares XML entities, which MJCF has not; write their text instead")

    def _start(self, tag: str, attributes: Mapping[str, str], path: Path) -> None:
        parent = self._tags[-1] if self._tags else ""
        if not self._tags and tag not in ("mujoco", "mujocoinclude"):
            raise self._fail(
                f"not a valid MJCF file: the root of '{path.name}' is <{printable(tag)}>, not "
                "<mujoco>; convert it first (MuJoCo's compile program turns URDF into MJCF)"
            )
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
        weight, counts = self._weights[-1], self.census.elements
        counts["all"] += weight
        if tag in ("flexcomp", "composite"):
            counts["body"] += weight * math.prod(
                max(1, _whole(word)) for word in attributes.get("count", "10 10 10").split()[:3]
            )
        elif tag in MAX_OF_TAG and parent != "default":
            counts[tag] += weight
        elif tag in _MOVING or parent == _SENSOR_SECTION:
            counts["moving"] += weight

    def _check_counts(self) -> None:
        counts = self.census.elements
        for tag, most in (*MAX_OF_TAG.items(), ("all", MAX_ELEMENTS), ("moving", MAX_MOVING)):
            if counts[tag] > most:
                what = {
                    "all": "elements",
                    "moving": "joints, sensors and actuators",
                    "body": "bodies",
                }.get(tag, f"{tag}s")
                remedy = (
                    "join small ones to meshes, or cut out the part around the take-off"
                    if tag in ("geom", "body")
                    else "leave out what a scene does not need"
                )
                raise self._fail(f"it has {counts[tag]} {what}, more than {most}; {remedy}")

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
        elif tag in ("mesh", "skin", "flexcomp", "texture", "hfield"):
            self._asset(tag, name, attributes, path)

    def _asset(self, tag: str, name: str, attributes: Mapping[str, str], path: Path) -> None:
        files = [attributes[key] for key in _TEXTURE_FILES if attributes.get(key)]
        kind = {"texture": "texture", "hfield": "height field"}.get(tag, "mesh")
        self._assets += [_Asset(kind, name, file, path.parent) for file in files]
        if tag == "hfield" and not files:
            self._add_cells(name, _whole(attributes.get("ncol")), _whole(attributes.get("nrow")))
        elif tag == "texture" and not files:
            width, height = (_whole(attributes.get(key)) for key in ("width", "height"))
            flat = attributes.get("type", "cube").strip() == "2d"
            # MuJoCo makes the faces of a cube squares.
            self._add_texels(name, width, height if flat else width, 1 if flat else 6)
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
        for target in self._candidates(file, path.parent, ("",)):
            self._must_be_file("include", file, target)
            if target.resolve() in self._included:
                raise self._fail(f"'{printable(file)}' is included twice, or includes itself")
            self._included.add(target.resolve())
            tags, self._tags, self._depth = self._tags, [], self._depth + len(self._tags)
            weights, self._weights = self._weights, [self._weights[-1]]
            self._read(target)
            self._tags, self._weights, self._depth = tags, weights, self._depth - len(tags)
            return

    def _model(self, name: str, file: str, path: Path) -> None:
        for target in self._candidates(file, path.parent, ("",)):
            self._must_be_file("model", file, target)
            if target.resolve() in self._within:
                raise self._fail(f"the model '{printable(file)}' contains itself")
            if len(self._within) >= MAX_MODELS_DEEP:
                raise self._fail(
                    f"models are attached within one another more than {MAX_MODELS_DEEP} deep; "
                    "flatten it"
                )
            nested = _Model(target, self._scene, self._within, self._files_read)
            self._models[name] = nested.census
            self._models.setdefault("", nested.census)
            return

    def _add(self, other: Census, weight: int) -> None:
        for tag, count in other.elements.items():
            self.census.elements[tag] += weight * count
        # Assets of a model are shared by all of its copies.
        self.census.mesh_bytes += other.mesh_bytes
        self.census.cells += other.cells
        self.census.texels += other.texels
        self._check_counts()

    def _candidates(self, file: str, folder: Path, within: tuple[str, ...]) -> Iterator[Path]:
        """Yields the paths at which MuJoCo may look for a file and where something is."""
        seen = set()
        for base in (self._path.parent, folder):
            for below in within:
                for name in (file, os.path.basename(file.replace("\\", "/"))):
                    target = Path(os.path.normpath(base / below / name)) if name else base
                    if name and "\0" not in name and target not in seen and target.exists():
                        seen.add(target)
                        yield target

    def _must_be_file(self, kind: str, file: str, target: Path) -> None:
        try:
            check_file(target, f"the file of a {kind}")
        except ValueError as error:
            raise self._fail(f"{kind} '{printable(file)}': {error}") from None

    def _measure(self, asset: _Asset) -> None:
        """Adds the size of an asset's file by its header."""
        for target in self._candidates(asset.file, asset.folder, tuple(sorted(self._folders))):
            self._must_be_file(asset.kind, asset.file, target)
            with target.open("rb") as file:
                head = file.read(32)
            if head.startswith(b"\x89PNG") and len(head) >= 24:
                width, height = struct.unpack(">II", head[16:24])
                if asset.kind == "height field":
                    self._add_cells(asset.name, width, height)
                else:
                    self._add_texels(asset.name, width, height, 1)
            elif asset.kind == "height field" and target.suffix == ".bin" and len(head) >= 8:
                rows, cols = struct.unpack("<ii", head[:8])
                self._add_cells(asset.name, cols, rows)
            else:
                self.census.mesh_bytes += target.stat().st_size
            return

    def _add_cells(self, name: str, cols: int, rows: int) -> None:
        self.census.cells += max(0, cols) * max(0, rows)
        if self.census.cells > MAX_CELLS:
            raise self._fail(
                f"height field '{printable(name)}' has {cols} x {rows} cells, more than "
                f"{MAX_CELLS} with all others together; make it coarser, or cut out the part "
                "around the take-off"
            )

    def _add_texels(self, name: str, width: int, height: int, faces: int) -> None:
        self.census.texels += faces * max(0, width) * max(0, height)
        large = max(width, height) > MAX_TEXTURE_SIDE
        if large or self.census.texels > MAX_TEXELS:
            limit = (
                f"{MAX_TEXTURE_SIDE} along a side"
                if large
                else f"{MAX_TEXELS} with all others together"
            )
            raise self._fail(
                f"texture '{printable(name)}' has {width} x {height} pixels, more than {limit}; "
                "scale it down"
            )

    def _check(self) -> None:
        if self.census.mesh_bytes > MAX_MESH_BYTES:
            raise self._fail(
                f"its meshes have {self.census.mesh_bytes / MIB:.0f} MiB, more than "
                f"{MAX_MESH_BYTES / MIB:.0f} MiB; simplify them (decimate)"
            )


def _whole(word: str | None) -> int:
    """Returns an integer attribute, 0 where it is none: MuJoCo refuses it with its own words."""
    try:
        return int(float(word or "0"))
    except (ValueError, OverflowError):
        return 0
