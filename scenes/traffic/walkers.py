"""Bodies of people, dogs, bicycles and cars: mocap bodies whose limbs swing as they go.

Proportions are those of Drillis and Contini ("Body segment parameters", New York University, 1966).
Reflectivities at 905 nm: skin 0.6, cloth 0.2 to 0.7 whatever its colour, since dyes are
transparent to the near infrared; rubber and paint 0.05 to 0.3.
"""

import math
from typing import Any, NamedTuple

import mujoco
import numpy as np

from touchdown.scenes.api import Array, Limb, MovingBody, Surface

GEOM = mujoco.mjtGeom
SKINS = ((0.91, 0.75, 0.64), (0.78, 0.58, 0.44), (0.55, 0.38, 0.27), (0.33, 0.22, 0.16))
CLOTHES = (
    (0.13, 0.15, 0.20), (0.75, 0.12, 0.12), (0.90, 0.88, 0.82), (0.16, 0.30, 0.55),
    (0.88, 0.72, 0.16), (0.22, 0.42, 0.24), (0.55, 0.55, 0.57), (0.85, 0.45, 0.15),
    (0.45, 0.20, 0.45), (0.36, 0.27, 0.19),
)  # fmt: skip
HAIRS = ((0.08, 0.06, 0.05), (0.30, 0.18, 0.10), (0.70, 0.55, 0.30), (0.60, 0.60, 0.60))
FURS = ((0.12, 0.10, 0.09), (0.55, 0.40, 0.24), (0.82, 0.76, 0.66), (0.35, 0.22, 0.13))
_SKIN = Surface(land_class="other", reflectivity=0.6)
_RUBBER = Surface(land_class="other", reflectivity=0.08)
_SPOKES = Surface(land_class="other", reflectivity=0.15, porosity=0.85)


class Speeds(NamedTuple):
    """Least and greatest speed, m/s."""

    least: float
    greatest: float


WALK, RUN, TROT, RIDE, DRIVE = (
    Speeds(1.0, 1.7), Speeds(2.5, 3.5), Speeds(1.2, 3.0), Speeds(3.0, 5.0), Speeds(4.0, 8.0)
)  # fmt: skip


class Part(NamedTuple):
    """A mocap body of a walker."""

    body_name: str
    limb: Limb | None


class _Figure:
    """Adds mocap bodies and geoms of one walker to a spec."""

    def __init__(self, spec: Any, surfaces: dict[str, Surface], name: str) -> None:
        self._spec, self._surfaces, self._name = spec, surfaces, name
        self.parts: list[Part] = []
        self._count = 0
        self._body: Any = None
        self._lift_m = 0.0

    def body(self, limb: Limb | None = None, lift_m: float = 0.0) -> None:
        """Begins the next body; the first bears the walker's name. ``lift_m``: of its geoms."""
        self._lift_m = lift_m
        name = f"{self._name}/{len(self.parts)}" if self.parts else self._name
        self._body = self._spec.worldbody.add_body(name=name, mocap=True)
        self.parts.append(Part(name, limb))

    def add(self, kind: Any, rgb: tuple[float, ...], surface: Surface, **shape: Any) -> None:
        """Adds a geom, which may be touched."""
        name = f"{self._name}/geom_{self._count}"
        self._count += 1
        size = np.zeros(3)
        given = np.atleast_1d(shape.pop("size"))
        size[: len(given)] = given
        for key in shape.keys() & {"pos", "fromto"}:
            shape[key] = [v + self._lift_m * (i % 3 == 2) for i, v in enumerate(shape[key])]
        rgba = [*rgb, *([1.0] if len(rgb) == 3 else [])]
        self._surfaces[name] = surface
        self._body.add_geom(
            name=name, type=kind, size=size, rgba=rgba, contype=1, conaffinity=0, **shape
        )

    def rod(self, rgb: tuple[float, ...], surface: Surface, radius: float, *ends: float) -> None:
        """Adds a capsule from ``ends[:3]`` to ``ends[3:]``."""
        self.add(GEOM.mjGEOM_CAPSULE, rgb, surface, size=radius, fromto=list(ends))

    def egg(
        self, rgb: tuple[float, ...], surface: Surface, half: tuple[float, ...], *pos: float
    ) -> None:
        """Adds an ellipsoid."""
        self.add(GEOM.mjGEOM_ELLIPSOID, rgb, surface, size=np.array(half), pos=list(pos))


class _Dress(NamedTuple):
    skin: tuple[float, ...]
    hair: tuple[float, ...]
    top: tuple[float, ...]
    trousers: tuple[float, ...]
    cloth: Surface
    extra: int
    """0: nothing, 1: a rucksack, 2: a hat, 3: a long coat"""


def _dressed(rng: np.random.Generator) -> _Dress:
    top, trousers = (CLOTHES[int(rng.integers(len(CLOTHES)))] for _ in range(2))
    cloth = Surface(land_class="other", reflectivity=float(rng.uniform(0.2, 0.7)))
    skin, hair = SKINS[int(rng.integers(len(SKINS)))], HAIRS[int(rng.integers(len(HAIRS)))]
    return _Dress(skin, hair, top, trousers, cloth, int(rng.integers(4)))


def person(
    spec: Any, surfaces: dict[str, Surface], name: str, rng: np.random.Generator, *,
    sits: bool = False, stride_m: float = 1.45,
) -> list[Part]:  # fmt: skip
    """Adds a clothed person of 1.1 m to 1.95 m, x ahead, feet at z = 0; or one who sits on the
    ground."""
    tall = float(np.clip(rng.normal(1.72, 0.12), 1.1, 1.95))
    dress, figure = _dressed(rng), _Figure(spec, surfaces, name)
    hip, drop = 0.53 * tall, (0.53 * tall - 0.12 if sits else 0.0)
    figure.body(lift_m=-drop)
    _torso(figure, dress, tall)
    swing = 0.0 if sits else 26.0
    for side, phase in ((1.0, 0.0), (-1.0, 180.0)):
        joint = np.array([0.0, side * 0.055 * tall, hip - drop])
        figure.body(Limb(joint_m=joint, swing_deg=swing, stride_m=stride_m, phase_deg=phase,
                         bend_deg=-85.0 if sits else 0.0))  # fmt: skip
        _leg(figure, dress, hip, tall)
        joint = np.array([0.0, side * 0.125 * tall, 0.80 * tall - drop])
        figure.body(Limb(joint_m=joint, swing_deg=0.8 * swing, stride_m=stride_m,
                         phase_deg=phase + 180.0, bend_deg=-20.0 if sits else -4.0))  # fmt: skip
        figure.rod(dress.top, dress.cloth, 0.028 * tall, 0, 0, 0, 0, 0, -0.17 * tall)
        figure.rod(dress.skin, _SKIN, 0.022 * tall, 0, 0, -0.18 * tall, 0.05, 0, -0.33 * tall)
    return figure.parts


def _torso(figure: _Figure, dress: _Dress, tall: float) -> None:
    cloth = dress.cloth
    figure.egg(dress.trousers, cloth, (0.062 * tall, 0.095 * tall, 0.075 * tall), 0, 0, 0.53 * tall)
    figure.egg(dress.top, cloth, (0.068 * tall, 0.112 * tall, 0.17 * tall), 0, 0, 0.69 * tall)
    figure.rod(
        dress.top, cloth, 0.04 * tall, 0, -0.09 * tall, 0.8 * tall, 0, 0.09 * tall, 0.8 * tall
    )
    figure.rod(dress.skin, _SKIN, 0.03 * tall, 0, 0, 0.82 * tall, 0, 0, 0.87 * tall)
    figure.egg(dress.skin, _SKIN, (0.1, 0.08, 0.115), 0.01, 0, tall - 0.115)
    figure.egg(dress.hair, cloth, (0.105, 0.088, 0.10), -0.015, 0, tall - 0.09)
    if dress.extra == 1:
        figure.add(GEOM.mjGEOM_BOX, dress.trousers, cloth, size=[0.07, 0.13, 0.2],
                   pos=[-0.068 * tall - 0.06, 0, 0.7 * tall])  # fmt: skip
    elif dress.extra == 2:
        figure.add(GEOM.mjGEOM_CYLINDER, dress.top, cloth, size=[0.17, 0.012],
                   pos=[0, 0, tall - 0.05])  # fmt: skip
    elif dress.extra == 3:
        figure.egg(dress.top, cloth, (0.075 * tall, 0.11 * tall, 0.2 * tall), 0, 0, 0.5 * tall)


def _leg(figure: _Figure, dress: _Dress, hip: float, tall: float) -> None:
    figure.rod(dress.trousers, dress.cloth, 0.045 * tall, 0, 0, -0.02, 0, 0, -0.48 * hip)
    figure.rod(dress.trousers, dress.cloth, 0.033 * tall, 0, 0, -0.5 * hip, -0.01, 0, 0.08 - hip)
    figure.add(GEOM.mjGEOM_BOX, (0.1, 0.09, 0.09), _RUBBER, size=[0.13, 0.045, 0.035],
               pos=[0.05, 0, 0.035 - hip])  # fmt: skip


def dog(spec: Any, surfaces: dict[str, Surface], name: str, rng: np.random.Generator) -> list[Part]:
    """Adds a dog, 0.35 m to 0.65 m high at the shoulder."""
    high = float(rng.uniform(0.35, 0.65))
    fur, figure = FURS[int(rng.integers(len(FURS)))], _Figure(spec, surfaces, name)
    coat = Surface(land_class="other", reflectivity=float(rng.uniform(0.3, 0.6)))
    figure.body()
    figure.rod(fur, coat, 0.22 * high, -0.45 * high, 0, 0.8 * high, 0.45 * high, 0, 0.83 * high)
    figure.rod(fur, coat, 0.12 * high, 0.5 * high, 0, 0.9 * high, 0.75 * high, 0, 1.15 * high)
    figure.egg(fur, coat, (0.24 * high, 0.13 * high, 0.14 * high), 0.92 * high, 0, 1.18 * high)
    figure.rod(fur, coat, 0.05 * high, -0.6 * high, 0, 0.9 * high, -0.95 * high, 0, 1.1 * high)
    for x in (0.42, -0.42):
        for side in (1.0, -1.0):
            joint = np.array([x * high, side * 0.13 * high, 0.72 * high])
            phase = 0.0 if (x > 0) == (side > 0) else 180.0
            figure.body(Limb(joint_m=joint, swing_deg=28.0, stride_m=1.6 * high, phase_deg=phase))
            figure.rod(fur, coat, 0.07 * high, 0, 0, 0, 0, 0, -0.66 * high)
    return figure.parts


def bicycle(
    spec: Any, surfaces: dict[str, Surface], name: str, rng: np.random.Generator
) -> list[Part]:
    """Adds a bicycle with its rider."""
    dress, figure = _dressed(rng), _Figure(spec, surfaces, name)
    paint = CLOTHES[int(rng.integers(len(CLOTHES)))]
    steel = Surface(land_class="other", reflectivity=0.25)
    side_on = [math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0]
    figure.body()
    for x in (0.52, -0.52):
        figure.add(GEOM.mjGEOM_CYLINDER, (0.2, 0.2, 0.2, 0.45), _SPOKES, size=[0.33, 0.02],
                   pos=[x, 0, 0.35], quat=side_on)  # fmt: skip
        for angle in np.arange(12) * math.pi / 6:
            ends = [(x + 0.33 * math.cos(a), 0.0, 0.35 + 0.33 * math.sin(a))
                    for a in (angle, angle + math.pi / 6)]  # fmt: skip
            figure.rod((0.06, 0.06, 0.06), _RUBBER, 0.02, *ends[0], *ends[1])
    for tube in ((-0.52, 0, 0.35, -0.1, 0, 0.35), (-0.1, 0, 0.35, -0.22, 0, 0.9),
                 (-0.2, 0, 0.85, 0.4, 0, 0.85), (-0.1, 0, 0.35, 0.4, 0, 0.82),
                 (0.52, 0, 0.35, 0.38, 0, 0.98), (0.38, -0.25, 1.0, 0.38, 0.25, 1.0)):  # fmt: skip
        figure.rod(paint, steel, 0.02, *tube)
    figure.egg(dress.trousers, dress.cloth, (0.14, 0.16, 0.12), -0.2, 0, 0.98)
    figure.rod(dress.top, dress.cloth, 0.14, -0.15, 0, 1.05, 0.1, 0, 1.42)
    figure.egg(dress.skin, _SKIN, (0.1, 0.08, 0.115), 0.2, 0, 1.66)
    figure.egg(dress.hair, dress.cloth, (0.12, 0.1, 0.1), 0.18, 0, 1.7)
    for side in (1.0, -1.0):
        figure.rod(dress.top, dress.cloth, 0.05, 0.1, side * 0.19, 1.4, 0.38, side * 0.22, 1.03)
    for side, phase in ((1.0, 0.0), (-1.0, 180.0)):
        joint = np.array([-0.18, side * 0.1, 0.95])
        figure.body(Limb(joint_m=joint, swing_deg=22.0, stride_m=5.0, phase_deg=phase,
                         bend_deg=-32.0))  # fmt: skip
        figure.rod(dress.trousers, dress.cloth, 0.07, 0, 0, 0, 0, 0, -0.4)
        figure.rod(dress.trousers, dress.cloth, 0.05, 0, 0, -0.4, -0.25, 0, -0.7)
    return figure.parts


def car(spec: Any, surfaces: dict[str, Surface], name: str, rng: np.random.Generator) -> list[Part]:
    """Adds a car of the shapes of `scenes.props.cars`."""
    from touchdown.scenes.authoring.builder import SceneBuilder
    from touchdown.scenes.authoring.relief import HeightField
    from touchdown.scenes.props.cars import CAR_SURFACE, PAINTS, SHAPES, car_atlas, car_mesh

    level = HeightField(heights_m=np.zeros((2, 2)), half_m=1.0)
    builder = SceneBuilder(spec=spec, rng=rng, terrain=level, sun=np.array([0.0, 0.0, -1.0]))
    shape = SHAPES[list(SHAPES)[int(rng.integers(len(SHAPES)))]]
    mesh = builder.mesh(f"{name}/mesh", car_mesh(shape))
    paint = PAINTS[int(rng.integers(len(PAINTS)))]
    material = builder.material(f"{name}/paint", car_atlas(rng, shape, paint), shine=0.35)
    figure = _Figure(spec, surfaces, name)
    figure.body()
    builder.geom("", CAR_SURFACE, body=spec.body(name), name=f"{name}/geom_0", mesh=mesh,
                 material=material)  # fmt: skip
    surfaces[f"{name}/geom_0"] = CAR_SURFACE
    return figure.parts


def bodies(
    parts: list[Part], path_world: Array, *, alive: bool = True, **motion: Any
) -> list[MovingBody]:
    """The moving bodies of a walker whose origin goes along ``path_world`` (K, 3); ``motion``: the
    other fields of `MovingBody`."""
    return [
        MovingBody(body_name=part.body_name, path_world=path_world, limb=part.limb,
                   walker=parts[0].body_name, alive=alive, **motion)
        for part in parts
    ]  # fmt: skip
