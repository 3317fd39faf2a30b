"""Seeded generators of input files: MJCF, elevation models, calibrations, images."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from fuzz.fuzz_inputs import FLOOR, NUMBERS, ROOT, Rng, damaged, misspelt, mutate_tree, pick, put
from fuzz.fuzzing import Case

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


def _mutate_mjcf(rng: Rng, text: str) -> str:
    import xml.etree.ElementTree as Tree

    root = Tree.fromstring(text)
    for _ in range(int(pick(rng, (0, 1, 1, 2, 3, 6)))):
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
            node.set(
                pick(
                    rng,
                    (
                        "name",
                        "class",
                        "type",
                        "size",
                        "pos",
                        "file",
                        "mesh",
                        "material",
                        "mass",
                        "quat",
                        "zaxis",
                        "group",
                        "contype",
                        "rgba",
                        "euler",
                        "dclass",
                    ),
                ),
                _other_words(rng, "1 0 0"),
            )
        elif kind == 6:
            node.tag = pick(
                rng,
                (
                    "geom",
                    "body",
                    "site",
                    "joint",
                    "frame",
                    "include",
                    "light",
                    "flexcomp",
                    "composite",
                    "replicate",
                    "attach",
                    "plugin",
                    "camera",
                    "skin",
                    misspelt(rng, node.tag),
                ),
            )
        elif kind == 7:
            node.set(
                "name",
                pick(rng, ("vehicle/quadrotor", "takeoff", "water", "lawn", "", "ü", "world")),
            )
        else:
            pick(rng, parents).append(copy.deepcopy(node))
        if sum(1 for _ in root.iter()) > 400:
            break
    return Tree.tostring(root, encoding="unicode")


def _other_words(rng: Rng, old: str) -> str:
    numbers = old.split()
    at = int(rng.integers(len(numbers) + 1))
    new = str(
        pick(
            rng,
            (*NUMBERS, "x", "", "gone.png", "../x.obj", "1e10", "1e-10", "-5", "300", "takeoff"),
        )
    )
    return " ".join([*numbers[:at], new, *numbers[at + (rng.random() < 0.8) :]])


def mjcf_case(rng: Rng, folder: Path) -> Case:
    """``land FILE.xml``: the scene is compiled with the vehicle in it, and nothing more."""
    try:
        text = _mutate_mjcf(rng, SCENE_XML if rng.random() < 0.85 else FLOOR)
    except (RecursionError, ValueError, TypeError):
        text = SCENE_XML
    name = pick(rng, ("place.xml", "place.xml", "mein haus.xml", "größe.xml", "dir/place.xml"))
    file = put(rng, folder / name, text, 0.15)
    command = pick(
        rng, (("land",), ("land",), ("scenes", "export"), ("control", "margins", "--set"))
    )
    target = f"scene={file}" if command[0] == "control" else str(file)
    rest = ("--quiet", "--no-record") if command[0] == "land" else ()
    return Case(kind="mjcf", arguments=(*command, target, *rest), folder=folder)


# --------------------------------------------------------------------------- images, relief, others


def file_case_of(home: Path) -> Callable[[Rng, Path], Case]:
    """Cases over calibrations, elevation models, images, edge models; ``home`` keeps a valid
    one."""
    makers = (_calibration, _calibration, _relief, _relief, _edge_model, _scene_picture)

    def case(rng: Rng, folder: Path) -> Case:
        return Case(kind="files", arguments=pick(rng, makers)(rng, folder, home), folder=folder)

    return case


CALIBRATION: dict[str, Any] = {
    "camera": {
        "width": 848,
        "height": 480,
        "fx": 617.0,
        "fy": 625.0,
        "cx": 423.5,
        "cy": 239.5,
        "distortion": [0.0, 0.0, 0.0, 0.0, 0.0],
    },
    "camera_from_lidar": {
        "rotation_quat_wxyz": [0.5, -0.5, 0.5, -0.5],
        "translation_m": [0.0, 0.0, 0.1],
    },
    "residuals": {"reprojection_rms_px": 0.1, "plane_rms_m": 0.01},
    "views_used": 12,
}


def _calibration(rng: Rng, folder: Path, _home: Path) -> tuple[str, ...]:
    tree = json.loads(json.dumps(CALIBRATION))
    for _ in range(int(pick(rng, (0, 1, 1, 2)))):
        mutate_tree(rng, tree)
    file = put(rng, folder / "cal.json", json.dumps(tree), 0.25)
    (folder / "floor.xml").write_text(FLOOR)
    target = str(file) if rng.random() < 0.95 else str(folder)
    return (
        "fly",
        str(folder / "floor.xml"),
        "--estimator",
        "gps",
        "--calibration",
        target,
        "--quiet",
    )


def _relief(rng: Rng, folder: Path, home: Path) -> tuple[str, ...]:
    import cv2

    good = home / "hill.tif"
    if not good.exists():
        rows, cols = np.mgrid[:60, :60]
        cv2.imwrite(str(good), (400.0 + 0.02 * (rows - 30) ** 2 + 0.1 * cols).astype(np.float32))
    kind = int(rng.integers(5))
    dem = folder / pick(rng, ("hill.tif", "hügel land.tif"))
    if kind == 0:
        heights = np.full(
            (int(rng.integers(1, 9)), int(rng.integers(1, 9))),
            pick(rng, (np.nan, np.inf, 0.0, 1e30, -9999.0)),
        )
        cv2.imwrite(str(dem), heights.astype(np.float32))
    elif kind == 1:
        cv2.imwrite(str(dem), rng.integers(0, 255, (40, 40, 3)).astype(np.uint8))
    else:
        data = bytearray(good.read_bytes())
        if kind == 2:
            for at in rng.integers(0, len(data), 6):
                data[int(at)] = int(rng.integers(256))
        dem.write_bytes(damaged(rng, bytes(data)) if kind == 3 else bytes(data))
    ortho = folder / "ortho.png"
    options: tuple[str, ...] = ("--window", str(pick(rng, (40, 40, 50, 59, *NUMBERS))))
    if rng.random() < 0.3:
        cv2.imwrite(
            str(ortho), rng.integers(0, 255, (60, int(pick(rng, (60, 60, 30))), 3)).astype(np.uint8)
        )
        if rng.random() < 0.5:
            ortho.write_bytes(damaged(rng, ortho.read_bytes()))
        options += ("--ortho", str(ortho))
    if rng.random() < 0.3:
        options += ("--cell", str(pick(rng, (0.5, 1, 2, *NUMBERS))))
    if rng.random() < 0.2:
        options += ("--centre", str(pick(rng, (30, *NUMBERS))), str(pick(rng, (30, *NUMBERS))))
    if rng.random() < 0.2:
        options += ("--class", str(pick(rng, ("lawn", "water", "feld", ""))))
    return (
        "scenes",
        "import-dem",
        str(dem),
        str(folder / pick(rng, ("out", "out", "a/b/out", "ortho.png"))),
        *options,
    )


def _edge_model(rng: Rng, folder: Path, _home: Path) -> tuple[str, ...]:
    shipped = next((ROOT / "estimator" / "paper").rglob("*.yml.gz"))
    file = folder / pick(rng, ("edges.yml.gz", "edges.yml", "edges"))
    data = shipped.read_bytes()
    small = b"%YAML:1.0\n---\nntrees: 1\n"
    file.write_bytes(damaged(rng, pick(rng, (data, small))))
    (folder / "floor.xml").write_text(FLOOR)
    if rng.random() < 0.4:
        return ("edges", "evaluate", "--model", str(file), "--seeds", "1", "--quiet")
    return (
        "fly",
        str(folder / "floor.xml"),
        "--estimator",
        "paper",
        "--set",
        f"paper.edge_model={file}",
        "--quiet",
    )


def _scene_picture(rng: Rng, folder: Path, _home: Path) -> tuple[str, ...]:
    import cv2

    good = cv2.imencode(".png", rng.integers(0, 255, (16, 16, 3)).astype(np.uint8))[1].tobytes()
    (folder / "turf.png").write_bytes(damaged(rng, good) if rng.random() < 0.8 else good)
    (folder / "m.obj").write_bytes(
        damaged(rng, b"v 0 0 0\nv 4 0 0\nv 0 4 0\nv 0 0 2\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n")
    )
    place = FLOOR.replace(
        "<worldbody>",
        """<asset><texture name="t" type="2d" file="turf.png"/>
        <material name="m" texture="t"/><mesh name="hut" file="m.obj"/></asset><worldbody>
        <geom type="mesh" mesh="hut" pos="9 9 0" material="m"/>""",
    )
    (folder / "place.xml").write_text(place)
    return ("fly", str(folder / "place.xml"), "--estimator", "gps", "--quiet", "--no-record")


def learn_case(rng: Rng, folder: Path) -> Case:
    """``train``, ``evaluate``, ``classify``: folders of images, and files that are no network."""
    for name in ("lawn", "water", pick(rng, ("road", "agricultural", "größe"))):
        for number in range(int(rng.integers(0, 3))):
            file = folder / "data" / name / f"{name}{number:02d}.png"
            file.parent.mkdir(parents=True, exist_ok=True)
            png = _png(rng, pick(rng, ((32, 32, 3), (1, 1, 3), (40, 20), (8, 8, 4))))
            file.write_bytes(damaged(rng, png) if rng.random() < 0.25 else png)
    if rng.random() < 0.3:
        columns = "file,d_land,d_scene,scene,seed,split,height_m,side_m,share"
        text = f"{columns}\nlawn/lawn00.png,lawn,lawn,flat,1,train,9,9,1\n"
        put(rng, folder / "data" / "manifest.csv", text, 0.6)
    (folder / "network.onnx").write_bytes(damaged(rng, b"onnx" * 50))
    png = _png(rng, pick(rng, ((60, 70, 3), (5, 200, 3), (40, 40))))
    (folder / "photo.png").write_bytes(damaged(rng, png) if rng.random() < 0.5 else png)
    where = pick(rng, ("data", "d_land=data", "x=data", "gone", "rendered=data", "data/lawn"))
    network = pick(rng, ("resnet18", "resnet", "mobilenet_v3_large"))
    commands: tuple[tuple[str, ...], ...] = (
        ("train", "--data", where, "--out", "out", "--network", network, "--quiet"),
        ("evaluate", "network.onnx", "--data", where, "--no-cost", "--quiet"),
        ("classify", "photo.png", "--network", "network.onnx", "--out", "out", "--quiet"),
    )
    return Case(kind="learn", arguments=tuple(pick(rng, commands)), folder=folder)


def _png(rng: Rng, shape: tuple[int, ...]) -> bytes:
    import cv2

    return bytes(cv2.imencode(".png", rng.integers(0, 255, shape).astype(np.uint8))[1])
