"""Cases over data sets of images and networks."""

import contextlib
import hashlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fuzz import grounding
from fuzz import picture_formats as pictures
from fuzz.cases import Case
from fuzz.config_kinds import FLOOR
from fuzz.mutations import (
    MARKED,
    TEXTS,
    Rng,
    chance,
    damaged,
    flipped,
    mutate_rows,
    pick,
    put,
    put_special,
)

_COLUMNS = "file,d_land,d_scene,scene,seed,split,height_m,side_m,share"
_CLASSES = ("lawn", "water", "road")
_WORDS = (
    "", "../../x/keep.txt", "/dev/zero", "/etc/passwd", "lawn", "gone.png", "nan", '"', '"a"b',
    "a,b", ".", "data/lawn", *MARKED, "d_land",
)  # fmt: skip
"""for a cell of a manifest"""


def _network(shared: Path) -> Path:
    """The file of a small network, made once."""
    from support.ground_class_support import write_colour_network

    return _once(shared / "network", lambda folder: write_colour_network(folder / "network.onnx"))


def _once(folder: Path, fill: Callable[[Path], Any]) -> Path:
    if not folder.exists():
        partial = folder.with_name(f"{folder.name}.{os.getpid()}")
        partial.mkdir()
        fill(partial)
        partial.rename(folder)
    return folder


def _copy_network(folder: Path, shared: Path) -> None:
    for file in _network(shared).iterdir():
        shutil.copy(file, folder / file.name)
    data = (folder / "network.onnx").read_bytes()
    grounding.SOUND_NETWORKS.add(hashlib.sha256(data).hexdigest())


def _data_set(rng: Rng, folder: Path, changes: bool = False) -> None:
    """Folders of classes with images of all splits."""
    for name in _CLASSES:
        for number in (0, 4, 6, 7):
            file = folder / name / f"{name}{number:02d}.png"
            file.parent.mkdir(parents=True, exist_ok=True)
            if changes and chance(rng, 0.15):
                put(rng, file, pictures.png(rng), 0.4)
            else:
                file.write_bytes(pictures.png(rng, (32, 32), changes=False))


def image_case(rng: Rng, folder: Path, shared: Path) -> Case:
    """PNG and JPEG: photographs to classify, images of a data set."""
    _copy_network(folder, shared)
    make = pick(rng, (pictures.png, pictures.png, pictures.jpeg, pictures.jpeg, pictures.geotiff))
    end = {"png": "png", "jpeg": "jpg", "geotiff": "tif"}[make.__name__]
    if chance(rng, 0.6):
        name = f"{pick(rng, ('photo', 'photo', '[x]', 'größe', 'a b'))}.{end}"
        put(rng, folder / name, make(rng), 0.15)
        command = ("classify", name, "--network", "network.onnx", "--out", "out")
        size = pick(rng, ((), (), ("--window", str(pick(rng, (16, 20, 10**6))))))
        more = pick(rng, ((), ("--json",)))
        return Case(arguments=(*command, *size, *more, "--quiet"), writes=("out",))
    _data_set(rng, folder / "data", changes=True)
    for _ in range(int(pick(rng, (1, 1, 2)))):
        name = pick(rng, _CLASSES)
        put(rng, folder / "data" / name / f"{name}07.{end}", make(rng), 0.15)
    if chance(rng, 0.15):
        put_special(rng, folder / "data" / pick(rng, ("trees", "lawn/lawn50.png", "x")))
    command = (
        "evaluate", "network.onnx", "--data", "data", "--split", pick(rng, ("train", "test")),
    )  # fmt: skip
    return Case(arguments=(*command, "--no-cost", "--quiet", *pick(rng, ((), ("--json",)))))


def csv_case(rng: Rng, folder: Path, shared: Path) -> Case:
    """``manifest.csv`` of a data set."""
    _copy_network(folder, shared)
    _data_set(rng, folder / "data")
    rows = [
        [f"{name}/{name}{number:02d}.png", name, name if name != "road" else "", "flat", "1",
         split, "9.0", "9.0", "1.0"]
        for name in _CLASSES
        for number, split in ((0, "train"), (4, "test"), (6, "val"))
    ]  # fmt: skip
    head = _COLUMNS.split(",")
    for _ in range(int(pick(rng, (0, 1, 1, 2, 3)))):
        mutate_rows(rng, rows if chance(rng, 0.8) else [head], _WORDS)
    mark = pick(rng, (",", ",", ",", ",", ";", "\t"))
    ends = pick(rng, ("\n", "\n", "\r\n", "\r"))
    text = ends.join(mark.join(row) for row in (head, *rows)) + ends
    if chance(rng, 0.05):
        text = text.replace("lawn", '"' + "x" * 200_000, 1)
    put(rng, folder / "data" / "manifest.csv", text, 0.15)
    where = pick(rng, ("rendered=data", "rendered=data", "data", "d_land=data", "x=data"))
    labels: tuple[tuple[str, ...], ...] = (
        ("evaluate", "network.onnx", "--data", where, "--no-cost", "--quiet"),
        ("evaluate", "network.onnx", "--data", where, "--split", "train", "--no-cost", "--quiet"),
        ("quantize", "network.onnx", "--data", where, "--out", "out.onnx", "--type", "float16",
         "--quiet"),
    )  # fmt: skip
    return Case(arguments=pick(rng, labels), writes=("out.onnx", "out.onnx.sha256"))


def onnx_case(rng: Rng, folder: Path, shared: Path) -> Case:
    """A network's file: other metadata, shapes, types, operators; its checksum fits mostly."""
    import onnx

    _copy_network(folder, shared)
    file = folder / "network.onnx"
    model = onnx.load(str(file))
    for _ in range(int(pick(rng, (0, 1, 1, 2, 3)))):
        _change_model(rng, model)
    data = model.SerializeToString()
    if chance(rng, 0.2):
        data = flipped(rng, data) if chance(rng, 0.6) else data[: int(rng.integers(len(data)))]
    if chance(rng, 0.04):
        file.unlink()
        put_special(rng, file)
    else:
        file.write_bytes(data)
    _put_checksum(rng, folder / "network.onnx.sha256", data)
    (folder / "photo.png").write_bytes(pictures.png(rng, (40, 40), changes=False))
    _data_set(rng, folder / "data")
    (folder / "floor.xml").write_text(FLOOR)
    on_data = ("--data", "data", "--quiet")
    commands: tuple[tuple[str, ...], ...] = (
        *[("classify", "photo.png", "--network", "network.onnx", "--out", "out", "--quiet")] * 4,
        *[("evaluate", "network.onnx", "--no-cost", "--split", "train", *on_data)] * 2,
        *[("land", "floor.xml", "--set", "landing.classifier=network.onnx", "--quiet")] * 2,
        ("quantize", "network.onnx", "--out", "new.onnx", "--type", pick(rng, ("int8", "float16")),
         *on_data),
        ("train", "--start-from", "network.onnx", "--network", "resnet18", "--image-size", "32",
         "--out", "out", *on_data),
    )  # fmt: skip
    arguments = pick(rng, commands)
    writes = ("out", "new.onnx", "new.onnx.sha256")
    return Case(arguments=arguments, writes=() if arguments[0] == "land" else writes)


def _put_checksum(rng: Rng, path: Path, data: bytes) -> None:
    line = f"{hashlib.sha256(data).hexdigest()}  network.onnx\n"
    if chance(rng, 0.06):
        line = pick(rng, ("", "0" * 64, line.upper(), "\x1b[31m", "x" * 10_000))
    path.unlink()
    put(rng, path, line, 0.03)


_SCALARS: dict[type, tuple[Any, ...]] = {
    str: ("16", "1000000000", "-1", "nan", "1e999", "9" * 5000, "lawn", "d_scene", "water=nan",
          "lawn=-1", "x=1", "pictures", "scores", "Loop", "If", "Reshape", "NoSuch", "com.evil",
          *(text for text in TEXTS if text.isascii())),
    int: (0, -1, 1, 3, 7, 16, 17, 99, 999, 100_000, 2**31, 2**40, 2**62),
    float: (0.0, -1.0, 1e30, float("nan"), float("inf")),
}  # fmt: skip


def _change_model(rng: Rng, model: Any) -> None:
    """Another value of one field of a message somewhere in the model, or a field less."""
    message = model
    while fields := message.ListFields():
        field, value = pick(rng, fields)
        many = not isinstance(value, str | bytes | int | float) and not hasattr(value, "ListFields")
        at = int(rng.integers(len(value))) if many else 0
        item = value[at] if many else value
        if chance(rng, 0.05):
            message.ClearField(field.name)
            return
        if hasattr(item, "ListFields"):
            message = item
            continue
        new = (
            damaged(rng, item)
            if isinstance(item, bytes)
            else pick(rng, _SCALARS.get(type(item), (0, 1)))
        )
        with contextlib.suppress(ValueError, TypeError):  # an enumeration, or of 32 bits
            if many:
                value[at] = new
            else:
                setattr(message, field.name, new)
        return
