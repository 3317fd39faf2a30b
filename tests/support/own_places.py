"""Eight scenes as other people make them, whose names say nothing of classes: each function writes
its files below a folder and returns the MJCF file that is flown."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray

from touchdown.scenes.importers.dem import import_dem
from touchdown.sim.typing import Image

PHOTOGRAPHS = Path(__file__).parents[2] / "sim/camera/photographs"
CUT = Path(__file__).with_name("dem_cut.npz")
"""160 x 160 heights, cm above the lowest, cells of 1 m, row 0 in the north: a part of the sample
model of github.com/NCALM-UH/CODEM (Apache-2.0)"""
CHECKER = (
    '<texture name="sky" type="skybox" builtin="gradient" rgb1=".3 .5 .7" rgb2="0 0 0" width="512" '
    'height="3072"/><texture name="grid" type="2d" builtin="checker" rgb1=".1 .2 .3" '
    'rgb2=".2 .3 .4" width="300" height="300" mark="edge" markrgb=".8 .8 .8"/>'
    '<material name="grid" texture="grid" texuniform="true" texrepeat="1 1" reflectance=".2"/>'
)
ROBOT = """
<body name="torso" pos="0 0 .6"><freejoint/>
  <geom type="capsule" fromto="-.3 0 0 .3 0 0" size=".12"/>
  <body pos=".25 .15 -.1"><joint type="hinge" axis="0 1 0"/><geom type="capsule"
    fromto="0 0 0 0 0 -.35" size=".05"/></body>
  <body pos="-.25 -.15 -.1"><joint type="hinge" axis="0 1 0"/><geom type="capsule"
    fromto="0 0 0 0 0 -.35" size=".05"/></body></body>
"""


def boxes(folder: Path) -> Path:
    """A plane in MuJoCo's default colour with boxes."""
    return _write(folder, '<geom type="plane" size="100 100 1"/>' + _heaps(3, 9))


def checker(folder: Path) -> Path:
    """The checker floor of MuJoCo's examples around a robot at the origin."""
    floor = '<geom name="floor" type="plane" size="0 0 .05" material="grid"/>'
    return _write(folder, f"{floor}{ROBOT}{_heaps(5, 5)}", CHECKER)


def mesh(folder: Path) -> Path:
    """A mesh of rolling ground, 150 m wide, with rocks."""
    axis = np.linspace(-75.0, 75.0, 76)
    x, y = np.meshgrid(axis, axis)
    z = 1.6 * np.sin(x / 17.0) * np.cos(y / 21.0) + 0.8 * np.sin((x + y) / 11.0)
    z *= np.clip(np.hypot(x - 28.0, y - 18.0) / 16.0 - 0.6, 0.05, 1.0)
    lines = [f"v {a:.3f} {b:.3f} {c:.3f}" for a, b, c in zip(x.flat, y.flat, z.flat, strict=True)]
    lines += [f"v {a} {b} -6" for a, b in ((-75, -75), (75, -75), (75, 75), (-75, 75))]
    for row in range(75):
        for col in range(75):
            k = row * 76 + col + 1
            lines += [f"f {k} {k + 1} {k + 77}", f"f {k} {k + 77} {k + 76}"]
    base = 76 * 76 + 1
    lines += [f"f {base} {base + 2} {base + 1}", f"f {base} {base + 3} {base + 2}"]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "ground.obj").write_text("\n".join(lines) + "\n", encoding="utf-8")
    asset = '<mesh name="ground" file="ground.obj" inertia="shell"/>'
    body = '<geom type="mesh" mesh="ground" rgba=".45 .38 .28 1"/>'
    rocks = "".join(
        f'<geom type="ellipsoid" pos="{a} {b} {0.3}" size="{s} {0.7 * s} {0.6 * s}" '
        'rgba=".4 .4 .4 1"/>'
        for a, b, s in ((20, 8, 1.6), (9, 22, 2.2), (44, 30, 1.3), (31, -6, 1.8))
    )
    return _write(folder, body + rocks, asset)


def terrain(folder: Path) -> Path:
    """The arena of dm_control's quadruped in its task escape: a rough height field of 60 m on a
    checker, with the robot on it."""
    folder.mkdir(parents=True, exist_ok=True)
    axis = np.linspace(-1.0, 1.0, 201)
    x, y = np.meshgrid(axis, axis)
    radius = np.clip(np.hypot(x, y), 0.04, 1.0)
    bowl = 0.5 - 0.5 * np.cos(np.pi * radius)
    rng = np.random.default_rng(4)
    bumps = cv2.resize(rng.uniform(0.5, 1.0, (20, 20)), (201, 201), interpolation=cv2.INTER_CUBIC)
    _png(folder / "terrain.png", (bowl * bumps)[::-1])
    asset = CHECKER + '<hfield name="terrain" file="terrain.png" size="30 30 5 .1"/>'
    body = (
        '<geom name="floor" type="plane" size="15 15 .5" material="grid"/>'
        '<geom name="terrain" type="hfield" hfield="terrain" rgba=".2 .3 .4 1" pos="0 0 -.01"/>'
    )
    return _write(folder, body + ROBOT, asset)


def model(folder: Path) -> Path:
    """An elevation model with an aerial photograph, as `touchdown scenes import-dem` writes it."""
    folder.mkdir(parents=True, exist_ok=True)
    heights = np.load(CUT)["heights_cm"].astype(np.float32) / 100.0
    shape = {"width": heights.shape[1], "height": heights.shape[0], "count": 1}
    place = {"transform": Affine(1.0, 0.0, 627100.0, 0.0, -1.0, 4323800.0), "crs": "EPSG:32616"}
    with rasterio.open(
        folder / "hill.tif", "w", driver="GTiff", dtype="float32", **shape, **place
    ) as tif:
        tif.write(heights, 1)
    photograph = orthophoto(heights.shape[0], 0.1)
    cv2.imwrite(str(folder / "hill.png"), photograph[..., ::-1])
    return import_dem(folder / "hill.tif", folder / "hill", ortho=folder / "hill.png")


def orthophoto(side_m: int, pixel_m: float) -> Image:
    """(P, P, 3) RGB: meadow, a field of soil and a road, of photographs from close by."""
    size = round(side_m / pixel_m)
    rng = np.random.default_rng(8)
    tone = cv2.resize(rng.normal(1.0, 0.06, (24, 24)), (size, size), interpolation=cv2.INTER_CUBIC)
    row, col = np.mgrid[:size, :size] * pixel_m
    image = _ground("meadow", size, pixel_m, rng)
    soil = (col > 0.62 * side_m + 4.0 * np.sin(row / 13.0)) & (row < 0.45 * side_m)
    road = np.abs(row - 0.72 * side_m - 0.12 * col + 3.0 * np.sin(col / 17.0)) < 2.6
    for mask, name in ((soil, "soil"), (road, "asphalt")):
        image[mask] = _ground(name, size, pixel_m, rng)[mask]
    return np.clip(image * tone[..., None], 0, 255).astype(np.uint8)


def rooftop(folder: Path) -> Path:
    """A flat roof 14 m high with plant on it, among lower ones, over a plane; takes off there."""
    roof = '<body name="block" pos="24 14 0"><geom type="box" size="34 26 7" pos="0 0 7" '
    roof += 'rgba=".62 .61 .58 1"/>'
    for a, b, sx, sy in ((0, 26, 34, 0.2), (0, -26, 34, 0.2), (34, 0, 0.2, 26), (-34, 0, 0.2, 26)):
        roof += f'<geom type="box" size="{sx} {sy} .55" pos="{a} {b} 14.5" rgba=".7 .7 .68 1"/>'
    for a, b in ((8, 6), (13, 6), (18, 6), (-12, 14)):  # chillers on their frames
        roof += f'<geom type="box" size="1.6 1 .9" pos="{a} {b} 15.1" rgba=".8 .8 .82 1"/>'
        roof += f'<geom type="cylinder" size=".5 .1" pos="{a} {b} 16.1" rgba=".2 .2 .2 1"/>'
    for k in range(6):  # a row of solar panels
        roof += f'<geom type="box" size="1 .5 .03" pos="{-22 + 2.4 * k} -14 14.45" '
        roof += 'euler="20 0 0" rgba=".08 .1 .2 1"/>'
    roof += '<geom type="box" size="2.5 2 1.6" pos="-2 -4 15.6" rgba=".66 .5 .42 1"/>'  # stairs
    roof += '<geom type="capsule" fromto="-6 10 14.3 20 10 14.3" size=".15" rgba=".6 .6 .6 1"/>'
    roof += "</body>"
    street = '<geom type="plane" size="120 120 1" rgba=".35 .35 .36 1"/>'
    for a, b, h in ((-40, 10, 4), (80, 20, 5), (30, 62, 3.5), (20, -40, 6)):
        street += f'<geom type="box" size="12 14 {h}" pos="{a} {b} {h}" rgba=".6 .4 .35 1"/>'
    return _write(folder, street + roof + '<site name="takeoff" pos="-4 -7 14"/>')


def yard(folder: Path) -> Path:
    """A walled yard of 60 m with a photograph of grass as its floor, a shed, a car and trees."""
    folder.mkdir(parents=True, exist_ok=True)
    picture = cv2.imread(str(PHOTOGRAPHS / "grass.jpg"))
    cv2.imwrite(str(folder / "floor.png"), cv2.resize(picture, (512, 512)))
    asset = (
        '<texture name="floor" type="2d" file="floor.png"/>'
        '<material name="floor" texture="floor" texuniform="true" texrepeat=".5 .5"/>'
    )
    body = '<geom type="box" size="30 30 .5" pos="0 0 -.5" material="floor"/>'
    for a, b, sx, sy in ((0, 30, 30, 0.2), (0, -30, 30, 0.2), (30, 0, 0.2, 30), (-30, 0, 0.2, 30)):
        body += f'<geom type="box" size="{sx} {sy} 1.2" pos="{a} {b} 1.2" rgba=".6 .5 .45 1"/>'
    body += '<geom type="box" size="3 4 1.5" pos="-20 18 1.5" rgba=".5 .3 .2 1"/>'
    body += '<geom type="box" size="2.2 .9 .7" pos="16 -20 .7" rgba=".7 .1 .1 1"/>'
    for a, b in ((20, 20), (14, 24), (-24, -16)):
        body += f'<geom type="cylinder" size=".2 1.2" pos="{a} {b} 1.2" rgba=".4 .3 .2 1"/>'
        body += f'<geom type="sphere" size="2.2" pos="{a} {b} 4" rgba=".15 .35 .12 1"/>'
    return _write(folder, body, asset)


def surveyed(folder: Path) -> Path:
    """A place in map coordinates, whose materials are named in words."""
    asset = '<material name="green grass" rgba=".3 .42 .2 1"/><material name="brick"/>'
    asset += '<material name="tarmac" rgba=".2 .2 .2 1"/>'
    body = '<geom type="box" size="100 90 2" pos="0 0 -2" material="green grass"/>'
    body += '<geom type="box" size="3 90 .02" pos="38 0 .02" material="tarmac"/>'
    for a, b, h in ((16, 24, 3), (52, -12, 3.5), (55, 40, 2.5)):
        body += f'<geom type="box" size="5 4 {h}" pos="{a} {b} {h}" material="brick"/>'
    frame = f'<frame pos="448262.4 5411932.7 238">{body}<site name="takeoff"/></frame>'
    return _write(folder, frame, asset)


PLACES: dict[str, Callable[[Path], Path]] = {
    one.__name__: one for one in (boxes, checker, mesh, terrain, model, rooftop, yard, surveyed)
}


def _heaps(seed: int, count: int) -> str:
    """Boxes of all sizes on the ground, away from the origin."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        x, y = rng.uniform((6.0, -15.0), (60.0, 55.0))
        sx, sy, sz = rng.uniform(0.3, 3.0, 3)
        colour = " ".join(f"{value:.2f}" for value in rng.uniform(0.2, 0.8, 3))
        found.append(
            f'<geom type="box" size="{sx:.2f} {sy:.2f} {sz:.2f}" pos="{x:.2f} {y:.2f} {sz:.2f}" '
            f'rgba="{colour} 1"/>'
        )
    return "".join(found)


def _ground(name: str, size: int, pixel_m: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """A photograph of 1.5 m, repeated at ``pixel_m``, under clouds of light and dark."""
    side = round(1.5 / pixel_m)
    picture = cv2.imread(str(PHOTOGRAPHS / f"{name}.jpg"))[..., ::-1]
    tile = cv2.resize(picture, (side, side), interpolation=cv2.INTER_AREA)
    times = -(-size // side)
    clouds = cv2.resize(rng.normal(1.0, 0.12, (size // 8, size // 8)), (size, size))
    return (np.tile(tile, (times, times, 1))[:size, :size] * clouds[..., None]).astype(np.float32)


def _png(path: Path, heights: NDArray[np.float64]) -> None:
    """Heights as MuJoCo reads them: grey from 0 to 255."""
    span = heights - heights.min()
    cv2.imwrite(str(path), np.round(255.0 * span / span.max()).astype(np.uint8))


def _write(folder: Path, body: str, asset: str = "") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "place.xml"
    path.write_text(
        f"<mujoco><asset>{asset}</asset><worldbody>{body}</worldbody></mujoco>", encoding="utf-8"
    )
    return path
