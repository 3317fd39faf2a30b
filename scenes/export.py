"""Writes a scene as files that MuJoCo's own viewer opens."""

import os
import shutil
import struct
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np

ASSETS = "assets"


def export_spec(spec: Any, out_dir: Path) -> Path:
    """Writes a mujoco.MjSpec as ``scene.xml`` with its textures, height fields and meshes under
    ``assets/``; its buffers are replaced by file names. Returns the path of the MJCF file."""
    with _whole(Path(out_dir)) as folder:
        _write(spec, folder)
    return Path(out_dir) / "scene.xml"


@contextmanager
def _whole(out_dir: Path) -> Iterator[Path]:
    """Yields a temporary folder that becomes ``out_dir`` on success, if that is new or empty."""
    if out_dir.is_dir() and any(out_dir.iterdir()):
        yield out_dir
        return
    partial = out_dir.with_name(f".{out_dir.name}.partial-{os.getpid()}")
    try:
        partial.mkdir(parents=True)
        yield partial
        os.replace(partial, out_dir)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _write(spec: Any, out_dir: Path) -> None:
    assets = out_dir / ASSETS
    assets.mkdir(parents=True, exist_ok=True)
    for texture in spec.textures:
        if len(texture.data):
            _write_texture(texture, assets)
    for hfield in spec.hfields:
        if len(hfield.userdata):
            _write_hfield(hfield, assets)
    for element in [*spec.textures, *spec.hfields, *spec.meshes]:
        _copy_file(spec, element, assets)
    spec.texturedir = spec.meshdir = str(assets.resolve())
    root = ET.fromstring(spec.to_xml())
    compiler = root.find("compiler")
    if compiler is None:
        compiler = ET.SubElement(root, "compiler")
    for kind in ("texturedir", "meshdir", "assetdir"):
        compiler.attrib.pop(kind, None)
    compiler.set("assetdir", ASSETS)
    ET.indent(root)
    text = ET.tostring(root, encoding="unicode")
    (out_dir / "scene.xml").write_text(text, encoding="utf-8")


def _copy_file(spec: Any, element: Any, assets: Path) -> None:
    """Copies a file that the scene refers to beside the exported MJCF."""
    if not element.file or (assets / element.file).is_file():
        return
    for folder in (spec.texturedir, spec.meshdir, ""):
        source = Path(spec.modelfiledir) / folder / element.file
        if source.is_file():
            element.file = source.name
            if source.resolve() != (assets / source.name).resolve():
                shutil.copyfile(source, assets / source.name)
            return
    raise FileNotFoundError(f"asset '{element.file}' of '{element.name}' not found")


def _file_stem(name: str) -> str:
    return name.replace("/", "_")


def _write_texture(texture: Any, assets: Path) -> None:
    """Writes a PNG and refers to it in place of the buffer."""
    pixels = np.frombuffer(bytes(texture.data), np.uint8)
    image = pixels.reshape(texture.height, texture.width, texture.nchannel)
    name = f"{_file_stem(texture.name)}.png"
    ok, encoded = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not ok:
        raise ValueError(f"texture '{texture.name}' cannot be written as PNG")
    (assets / name).write_bytes(encoded.tobytes())
    texture.data = b""
    texture.file = name


def _write_hfield(hfield: Any, assets: Path) -> None:
    """MuJoCo's binary format: int32 rows, int32 columns, float32 data row by row."""
    data = np.asarray(hfield.userdata, np.float32)
    name = f"{_file_stem(hfield.name)}.bin"
    header = struct.pack("<ii", hfield.nrow, hfield.ncol)
    (assets / name).write_bytes(header + data.astype("<f4").tobytes())
    hfield.userdata = np.zeros(0, np.float32)
    hfield.file = name
