"""Cases over MJCF files, their meshes, textures and height fields, and elevation models."""

import copy
import struct
import xml.etree.ElementTree as Tree
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from fuzz import picture_formats as pictures
from fuzz.cases import Case
from fuzz.config_kinds import FLOOR
from fuzz.mutations import (
    MARKED,
    NUMBERS,
    Rng,
    chance,
    damaged,
    encoded,
    misspelt,
    pick,
    put,
    put_special,
)

SCENE_XML = """<mujoco model="place">
  <option timestep="0.002" gravity="0 0 -9.81"/>
  <compiler angle="degree" autolimits="true"/>
  <default><geom friction="1 0.1 0.1"/>
    <default class="road"><geom rgba="1 0 0 1"/></default></default>
  <asset><texture name="t" type="2d" builtin="checker" width="16" height="16" rgb1="1 1 1"/>
    <material name="lawn" texture="t" texrepeat="4 4"/>
    <mesh name="m" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/>
    <hfield name="h" nrow="3" ncol="3" size="40 40 1 1" elevation="0 0 0 0 1 0 0 0 0"/></asset>
  <worldbody>
    <light pos="0 0 9" dir="0 0 -1"/>
    <geom name="field" type="hfield" hfield="h" pos="0 0 -1"/>
    <geom name="lawn_1" type="box" size="30 30 0.5" pos="0 0 -0.5" material="lawn"/>
    <geom class="road" type="capsule" fromto="9 0 1 9 0 3" size="0.2"/>
    <frame pos="4 4 0"><geom name="hut" type="cylinder" size="1 1"/></frame>
    <body name="arm" pos="5 0 1" euler="0 0 90"><joint name="hinge" type="hinge" axis="0 0 1"/>
      <geom name="building" type="mesh" mesh="m"/><site name="tip" pos="0 0 1"/>
      <body name="ball" pos="1 0 0"><joint type="ball"/>
        <geom type="sphere" size="0.2"/></body></body>
    <body name="free" pos="-5 0 2"><freejoint/>
      <geom type="ellipsoid" size=".1 .2 .3" mass="1"/></body>
    <site name="takeoff" pos="0 3 0"/>
    <camera name="c" pos="0 0 5" fovy="45"/>
  </worldbody>
  <contact><exclude body1="arm" body2="ball"/></contact>
  <equality><weld body1="arm" body2="ball"/></equality>
  <actuator><motor joint="hinge" gear="1"/></actuator>
  <sensor><jointpos joint="hinge"/></sensor>
</mujoco>"""

_KEYS = (
    "name", "class", "type", "size", "pos", "file", "mesh", "material", "mass", "quat", "zaxis",
    "group", "contype", "rgba", "euler", "dclass", "scale", "nrow", "count", "hfield", "fromto",
)  # fmt: skip
_TAGS = (
    "geom", "body", "site", "joint", "frame", "include", "light", "flexcomp", "composite",
    "replicate", "attach", "plugin", "camera", "skin", "model", "keyframe", "numeric", "key",
)  # fmt: skip
_NAMES = ("vehicle/quadrotor", "takeoff", "water", "lawn", "", "ü", "world", *MARKED)
_WORDS = (
    *NUMBERS, "x", "", "gone.png", "../x.obj", "1e10", "1e-10", "-5", "300", "takeoff", "sdf",
    "500000 4000000 60", "place.xml", *(text for text in MARKED if text != "\0"),
)  # fmt: skip


def _xml_safe(word: Any) -> str:
    """What an XML writer can hold: others are for `_raw_trouble`."""
    return "".join(c for c in str(word) if c >= " " and not "\ud800" <= c <= "\udfff")


def _mutate_mjcf(rng: Rng, text: str) -> str:
    root = Tree.fromstring(text)
    for _ in range(int(pick(rng, (0, 1, 1, 1, 2, 3)))):
        parents = [node for node in root.iter() if len(node)]
        parent = pick(rng, parents)
        node = pick(rng, parent)
        kind = int(rng.integers(9))
        if kind == 0:
            parent.remove(node)
        elif kind == 1:
            parent.insert(int(rng.integers(len(parent) + 1)), copy.deepcopy(node))
        elif kind == 2 and node.attrib:
            del node.attrib[pick(rng, node.attrib)]
        elif kind in (3, 4) and node.attrib:
            key = pick(rng, node.attrib)
            node.set(key, _other_words(rng, node.attrib[key]))
        elif kind == 5:
            node.set(pick(rng, _KEYS), _other_words(rng, "1 0 0"))
        elif kind == 6:
            node.tag = pick(rng, (*_TAGS, "geom", "body", _tag(misspelt(rng, node.tag))))
        elif kind == 7:
            node.set("name", _xml_safe(pick(rng, _NAMES)))
        else:
            pick(rng, parents).append(copy.deepcopy(node))
        if sum(1 for _ in root.iter()) > 400 or not len(root):
            break
    return Tree.tostring(root, encoding="unicode")


def _tag(word: str) -> str:
    return "".join(c for c in word if c.isalnum()) or "x"


def _other_words(rng: Rng, old: str) -> str:
    numbers = old.split()
    at = int(rng.integers(len(numbers) + 1))
    new = _xml_safe(pick(rng, _WORDS))
    return " ".join([*numbers[:at], new, *numbers[at + chance(rng, 0.8) :]])


def _raw_trouble(rng: Rng, text: str) -> str:
    """Files that are well formed and hard to swallow, beside those of
    tests/scenes/test_hostile_mjcf.py."""
    huge = pick(rng, (1000, 100_000, 2**31 - 1))
    more = pick(rng, (
        '<body><geom size="1"/>' * 300 + "</body>" * 300,
        f'<composite type="cable" count="{huge} 1 1" size="1"><geom size=".1"/></composite>',
        '<frame pos="500000 4000000 60"><geom size="1"/></frame>',
    ))  # fmt: skip
    old, new = pick(rng, (
        ("<mujoco", "<extension><plugin plugin='os.system'/></extension><mujoco"),
        ("<mujoco", '<?xml version="1.0" encoding="UTF-16"?><mujoco'),
        ("<mujoco", '<mujoco xmlns="http://x"'),
        ("building", "x" * 1_000_000),
        ("building", pick(rng, MARKED)),
        ("takeoff", pick(rng, MARKED)),
        ('pos="0 3 0"', 'pos="500000 4000000 60"'),
        ('size="30 30 0.5"', 'size="3e5 3e5 0.5"'),
        ('angle="degree"', 'angle="degree" meshdir="/" texturedir="../../.."'),
        ('size="40 40 1 1"', f'size="{pick(rng, ("1e-9 40 1 1", "40 40 1e9 1"))}"'),
    ))  # fmt: skip
    whole = ("<mujoco>" * 5000, "<mujocoinclude/>")
    inside = text.replace("<worldbody>", f"<worldbody>{more}", 1)
    return str(pick(rng, (inside, text.replace(old, new), inside.replace(old, new), *whole[:1],
                          pick(rng, whole))))  # fmt: skip


def mjcf_case(rng: Rng, folder: Path, _shared: Path) -> Case:
    """A scene from an MJCF file: compiled with the vehicle in it, checked, exported."""
    text = SCENE_XML if chance(rng, 0.85) else FLOOR
    text = _raw_trouble(rng, text) if chance(rng, 0.1) else _mutate_mjcf(rng, text)
    name = pick(rng, ("place.xml", "place.xml", "mein haus.xml", "größe.xml", "[x]/place.xml"))
    put(rng, folder / name, text, 0.12)
    return _scene_command(rng, name)


def _scene_command(rng: Rng, name: str) -> Case:
    commands: tuple[tuple[str, ...], ...] = (
        *[("fly", name, "--estimator", "gps", "--quiet", "--no-record", "--out", "out")] * 5,
        ("land", name, "--quiet", "--no-record", "--set", "landing.classifier=off"),
        ("scenes", "export", name, "--out", "out"),
        ("scenes", "check", name),
        ("scenes", "render", name, "--out", "out.png", "--view", pick(rng, ("height", "above"))),
        ("control", "margins", "--set", f"scene={name}"),
    )
    return Case(arguments=pick(rng, commands), writes=("out", "out.png"))


def asset_case(rng: Rng, folder: Path, _shared: Path) -> Case:
    """A scene with a mesh, a texture or a height field from a damaged file."""
    kind, maker = pick(rng, _ASSETS)
    name, data = maker(rng)
    if chance(rng, 0.1):
        name = pick(rng, ("[x].png", "x.PNG", "m.stl", "m.obj", "t.png", "h.bin", "a.dae", "noext"))
    target = folder / name
    if chance(rng, 0.06):
        put_special(rng, target)
    else:
        target.write_bytes(damaged(rng, data) if chance(rng, 0.2) else data)
    asset, geom = {
        "mesh": (f'<mesh name="a" file="{name}"/>', '<geom type="mesh" mesh="a" pos="9 9 0"/>'),
        "hfield": (
            f'<hfield name="a" file="{name}" size="30 30 2 1"/>',
            '<geom name="field" type="hfield" hfield="a" pos="0 0 -1"/>',
        ),
        "texture": (
            f'<texture name="t" type="2d" file="{name}"/><material name="a" texture="t"/>',
            '<geom type="box" size="1 1 1" pos="9 9 0" material="a"/>',
        ),
        "cube": (f'<texture name="t" type="skybox" file="{name}"/>', ""),
        "skin": ("", ""),
    }[kind]
    if kind == "skin":
        asset = f'</asset><deformable><skin name="a" file="{name}"/></deformable><asset>'
    place = FLOOR.replace("<worldbody>", f"<asset>{asset}</asset><worldbody>{geom}")
    (folder / "place.xml").write_text(place)
    return _scene_command(rng, "place.xml")


_Maker = Callable[[Rng], tuple[str, bytes]]
_OBJ_LINES = (
    "mtllib ../x.mtl", "o [/x]", "vt 0 0", "g \x1b[31m", "s off", "f 1 2", "f 1 2 3 4 5", "call x",
    "v 1e400 0 0",
)  # fmt: skip


def _obj(rng: Rng) -> tuple[str, bytes]:
    lines = ["v 0 0 0", "v 4 0 0", "v 0 4 0", "v 0 0 2", "f 1 3 2", "f 1 2 4", "f 2 3 4", "f 3 1 4"]
    for _ in range(int(pick(rng, (0, 1, 1, 2, 4)))):
        at = int(rng.integers(len(lines)))
        words = lines[at].split()
        words[int(rng.integers(len(words)))] = str(pick(rng, (*NUMBERS, "x", "1/1/1", "1//2", "")))
        lines[at] = " ".join(words)
        if chance(rng, 0.3):
            lines.insert(at, pick(rng, _OBJ_LINES))
    if chance(rng, 0.03):
        lines += ["f 1 2 3"] * 300_000
    return "m.obj", encoded("\n".join(lines) + "\n")


_CORNERS = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 2]], "<f4")
_FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], "<i4")
_FIRST_FOUR = (0, 4, 8, 12)
_BINARY: dict[str, tuple[bytes, tuple[int, ...]]] = {
    "m.stl": (
        b"solid".ljust(80) + struct.pack("<I", 4)
        + b"".join(struct.pack("<12fH", 0, 0, 0, *_CORNERS[face].ravel(), 0) for face in _FACES),
        (80,),
    ),
    "m.msh": (struct.pack("<4i", 4, 0, 0, 4) + _CORNERS.tobytes() + _FACES.tobytes(), _FIRST_FOUR),
    "h.bin": (struct.pack("<2i", 4, 4) + np.linspace(0, 1, 16, dtype="<f4").tobytes(), (0, 4)),
    "s.skn": (struct.pack("<4i", 3, 0, 0, 0) + bytes(400), _FIRST_FOUR),
}  # fmt: skip
"""Valid files, and where their counts stand."""


def _binary(name: str) -> _Maker:
    def make(rng: Rng) -> tuple[str, bytes]:
        valid, counts = _BINARY[name]
        data = bytearray(valid)
        for _ in range(int(pick(rng, (0, 1, 1, 2)))):
            if chance(rng, 0.5):
                odd = (-1, 0, 1, 3, 5, 99, 70_000, 200_001, 10**8, 2**31 - 1)
                struct.pack_into("<i", data, pick(rng, counts), pick(rng, odd))
            else:
                with np.errstate(over="ignore"):
                    number = np.float32(float(pick(rng, NUMBERS)))
                struct.pack_into("<f", data, 4 * int(rng.integers(len(data) // 4)), number)
        return name, bytes(data)

    return make


def _png(rng: Rng) -> tuple[str, bytes]:
    # MuJoCo's textures are square
    side = int(pick(rng, (16, 16, 32)))
    return "t.png", pictures.png(rng, (side, side) if chance(rng, 0.8) else None)


_ASSETS: tuple[tuple[str, _Maker], ...] = (
    ("mesh", _obj), ("mesh", _binary("m.stl")), ("mesh", _binary("m.msh")),
    ("hfield", _binary("h.bin")), ("hfield", _png), ("texture", _png), ("texture", _png),
    ("cube", _png), ("skin", _binary("s.skn")),
)  # fmt: skip


def geotiff_case(rng: Rng, folder: Path, _shared: Path) -> Case:
    """``scenes import-dem``: an elevation model, with or without an aerial image."""
    dem = pick(rng, ("hill.tif", "hill.tif", "hügel land.tif", "[x].tif"))
    put(rng, folder / dem, pictures.geotiff(rng), 0.2)
    options: tuple[str, ...] = ("--window", str(pick(rng, (100, 100, 118, *NUMBERS))))
    if chance(rng, 0.7):
        options = ("--window", "100")
    if chance(rng, 0.3):
        ortho = pick(rng, ("ortho.png", "ortho.jpg", "ortho.tif"))
        data = {"png": pictures.png, "jpg": pictures.jpeg, "tif": pictures.geotiff}[ortho[-3:]]
        put(rng, folder / ortho, data(rng), 0.2)
        options += ("--ortho", ortho)
    if chance(rng, 0.2):
        options += ("--cell", str(pick(rng, (0.5, 1, 2, *NUMBERS))))
    if chance(rng, 0.15):
        options += ("--centre", str(pick(rng, (60, *NUMBERS))), str(pick(rng, (60, *NUMBERS))))
    if chance(rng, 0.1):
        options += ("--class", str(pick(rng, ("lawn", "water", "feld", ""))))
    out = dem if chance(rng, 0.04) else pick(rng, ("out", "out", "a/b/out"))
    return Case(arguments=("scenes", "import-dem", dem, out, *options), writes=(out,))
