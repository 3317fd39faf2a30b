"""Images of painted ground, classifiers by colour, and the file of a small network."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.io.images import write_png
from touchdown.landing.api import Candidate, GroundPrediction
from touchdown.landing.classification.decision import Limits
from touchdown.landing.classification.labels import D_LAND, SCHEMES
from touchdown.landing.classification.weights import INPUT, OUTPUT, NetworkFacts, write_network
from touchdown.sim.api import CameraImage, SensorRig
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array, Image

from support.landing_support import make_rig

Paint = Callable[[Array, Array], Array]
"""x and y (...) to colours (..., 3)"""

COLOURS = {"lawn": (40, 200, 40), "water": (40, 40, 200), "road": (200, 40, 40)}


def chances(**given: float) -> Array:
    """Probabilities of the named classes, the rest shared by the others."""
    left = (1.0 - sum(given.values())) / (len(D_LAND) - len(given))
    return np.array([given.get(name, left) for name in D_LAND])


def site_at(x: float, y: float) -> Candidate:
    """A site on level ground that is accepted."""
    return Candidate(
        position_odom=np.array([x, y, 0.0]), c_sum=0.5,
        slope_deg=0.0, roughness_m=0.0, clearance_m=3.0, accepted=True, reason="landable",
        rule="lower_value",
    )  # fmt: skip


def west_is_water(x: Array, y: Array) -> Array:
    return np.where((x < 0.0)[..., None], COLOURS["water"], COLOURS["lawn"]).astype(float)


def small_rig() -> SensorRig:
    """A camera of a quarter of the usual resolution."""
    rig = make_rig()
    camera = dataclasses.replace(
        rig.camera, width=212, height=120, fx=154.25, fy=154.25, cx=105.5, cy=59.5
    )
    return dataclasses.replace(rig, camera=camera)


def plain(name: str) -> Paint:
    """One colour, mottled: an image without contrast is a defect."""
    colour = np.array(COLOURS[name], np.float32)
    return lambda x, y: colour + 8.0 * np.sin(2.1 * x + 1.7 * y)[..., None]


@functools.cache
def _beams(
    width: int, height: int, focal: tuple[float, float], centre: tuple[float, float]
) -> NDArray[np.float32]:
    col, row = np.meshgrid(np.arange(width), np.arange(height))
    across, down = (col - centre[0]) / focal[0], (row - centre[1]) / focal[1]
    return np.stack([across, down, np.ones(col.shape)], -1).astype(np.float32)


def photograph(
    rig: SensorRig, world_from_body: Pose, paint: Paint, time_s: float, noise: float = 1.0
) -> CameraImage:
    """Image of level ground at z = 0 by a camera without distortion, with noise (levels), since a
    repeated image is a defect."""
    camera, lens = world_from_body @ rig.body_from_camera, rig.camera
    ways = _beams(lens.width, lens.height, (lens.fx, lens.fy), (lens.cx, lens.cy)) @ np.asarray(
        camera.rotation.T, np.float32
    )
    reach = -float(camera.translation[2]) / ways[..., 2]
    x, y = (float(camera.translation[i]) + reach * ways[..., i] for i in (0, 1))
    tick = round(600 * time_s)
    levels = paint(x, y) + np.random.default_rng(tick).normal(0.0, noise, (*x.shape, 3))
    rgb = np.rint(np.clip(levels, 0, 255)).astype(np.uint8)
    return CameraImage(tick=tick, time_s=time_s, rgb=rgb)


class ByColour:
    """Classifies by colour with the given probability; counts its batches."""

    image_size = 16
    min_probability = 0.9

    def __init__(self, sure: float = 0.97, in_distribution: bool = True) -> None:
        self.sure, self.in_distribution = sure, in_distribution
        self.batches: list[int] = []

    def classify(self, images: Image) -> GroundPrediction:
        self.batches.append(len(images))
        names = list(COLOURS)
        mean = images.mean(axis=(1, 2))
        probabilities = np.full((len(images), len(D_LAND)), (1.0 - self.sure) / (len(D_LAND) - 1))
        for chance, colour in zip(probabilities, mean, strict=True):
            nearest = min(names, key=lambda name: float(np.abs(colour - COLOURS[name]).sum()))
            chance[D_LAND.index(nearest)] = self.sure
        return GroundPrediction(
            probabilities=probabilities,
            in_distribution=np.full(len(images), self.in_distribution, np.bool_),
        )


def write_colour_network(
    path: Path, *, size: int = 16, limits: Limits | None = None, labels: str = "d_land",
    per_colour: Array | None = None, miss_costs: tuple[tuple[str, float], ...] = (),
) -> Path:  # fmt: skip
    """A network of one filter of 1 x 1 and a mean, float16: lawn where it is green, water where it
    is blue, road where it is red; or with the scores ``per_colour`` (C, 3) of full light in red,
    green and blue."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    classes = SCHEMES[labels]
    filters = np.zeros((len(classes), 3, 1, 1), np.float16)
    for name, channel in (("road", 0), ("lawn", 1), ("water", 2)):
        filters[D_LAND.index(name), channel] = 12.0
    if per_colour is not None:
        filters[..., 0, 0] = per_colour
    nodes = [
        helper.make_node("Cast", ["filters"], ["wide"], to=TensorProto.FLOAT),
        helper.make_node("Conv", [INPUT, "wide"], ["seen"], kernel_shape=[1, 1]),
        helper.make_node("GlobalAveragePool", ["seen"], ["pooled"]),
        helper.make_node("Flatten", ["pooled"], [OUTPUT]),
    ]
    graph = helper.make_graph(
        nodes,
        "by colour",
        [helper.make_tensor_value_info(INPUT, TensorProto.FLOAT, ["batch", 3, size, size])],
        [helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, ["batch", len(classes)])],
        [numpy_helper.from_array(filters, "filters")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    facts = NetworkFacts(
        network="by colour", labels=labels, image_size=size, classes=classes,
        limits=limits or Limits(), miss_costs=miss_costs,
    )  # fmt: skip
    helper.set_model_props(model, facts.properties())
    onnx.checker.check_model(model)
    write_network(path, model.SerializeToString())
    return path


def write_noisy_images(folder: Path, count: int, seed: int) -> Path:
    """``count`` noisy images for each class of ``COLOURS``."""
    rng = np.random.default_rng([8, seed])
    for name, colour in COLOURS.items():
        (folder / name).mkdir()
        for number in range(count):
            image = np.clip(rng.normal(colour, 25.0, (16, 16, 3)), 0, 255).astype(np.uint8)
            write_png(folder / name / f"{number}.png", image)
    return folder


def write_plain_images(folder: Path, size: int) -> Path:
    """Eight images of one colour for each class of ``COLOURS``."""
    for name, colour in COLOURS.items():
        (folder / name).mkdir(parents=True)
        for number in range(8):
            image = np.full((size, size, 3), colour, np.uint8)
            write_png(folder / name / f"{name}{number:02d}.png", image)
    return folder
