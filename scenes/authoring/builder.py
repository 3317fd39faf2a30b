"""Collects the geoms, surfaces and shadow casters of a scene under construction."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Array, Surface
from touchdown.scenes.authoring.draft import Picture, fill_texture, size_texture
from touchdown.scenes.authoring.meshes import MeshData
from touchdown.scenes.authoring.relief import HeightField

GEOM = mujoco.mjtGeom
_SHAPES = {
    "box": GEOM.mjGEOM_BOX,
    "ball": GEOM.mjGEOM_SPHERE,
    "ellipsoid": GEOM.mjGEOM_ELLIPSOID,
    "cylinder": GEOM.mjGEOM_CYLINDER,
    "capsule": GEOM.mjGEOM_CAPSULE,
}


@dataclass(frozen=True, kw_only=True, slots=True)
class Caster:
    """A convex body that throws a shadow: (N, 3) world points and the fraction of light it
    stops."""

    points: Array
    opacity: float


@dataclass(kw_only=True, slots=True)
class SceneBuilder:
    """Adds named assets and geoms to an MjSpec."""

    spec: Any
    rng: np.random.Generator
    terrain: HeightField
    """what objects stand on"""
    sun: Array
    """(3,) unit, the direction in which sunlight travels"""
    surfaces: dict[str, Surface] = field(default_factory=dict)
    casters: list[Caster] = field(default_factory=list)
    occupied: list[tuple[Array, float]] = field(default_factory=list)
    """(2,) centre and radius of discs that later random placements avoid"""
    pictures: dict[str, Picture] = field(default_factory=dict)
    """as `SceneDraft.pictures`"""
    _serial: dict[str, int] = field(default_factory=dict)

    def unique(self, stem: str) -> str:
        """Returns ``stem_0``, ``stem_1``, ... at successive calls."""
        number = self._serial.get(stem, 0)
        self._serial[stem] = number + 1
        return f"{stem}_{number}"

    def material(self, name: str, image: NDArray[np.uint8], shine: float = 0.0) -> str:
        """Adds a material with a 2-D texture, (H, W, 3) uint8, top row first. Returns its name."""
        add_texture(self.spec, name, image)
        return add_material(self.spec, name, name, specular=shine, shininess=0.5 * shine)

    def picture(
        self, name: str, shape: tuple[int, ...], draw: Callable[[NDArray[np.uint8]], object]
    ) -> None:
        """Gives the texture ``name`` of the spec a large image of ``shape`` (H, W, 3), top row
        first, which ``draw`` fills when it is needed."""
        size_texture(self.spec.texture(name), shape)
        self.pictures[name] = Picture(shape, draw)

    def mesh(self, name: str, data: MeshData) -> str:
        """Adds a mesh asset. Returns its name."""
        mesh = self.spec.add_mesh(name=name)
        mesh.uservert = data.vertices.ravel()
        mesh.userface = data.faces.ravel()
        mesh.usertexcoord = data.uv.ravel()
        mesh.userfacetexcoord = data.faces.ravel()
        if data.normals is not None:
            length = np.linalg.norm(data.normals, axis=1, keepdims=True)
            mesh.usernormal = (data.normals / np.maximum(length, 1e-12)).ravel()
            mesh.userfacenormal = data.faces.ravel()
        # Static meshes need no true inertia; the shell's exists for thin and open meshes as well.
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        return name

    def geom(self, stem: str, surface: Surface, body: Any = None, **attributes: Any) -> Any:
        """Adds a geom with its surface to the world, or to ``body``.

        One attribute gives its shape: ``mesh`` a name, ``box`` or ``ellipsoid`` half axes, ``ball``
        a radius, ``capsule`` and ``cylinder`` a radius, beside ``fromto`` or with half a length.
        ``heading`` turns it about +z, radians. The others are MuJoCo's; without a ``name`` it gets
        the next one of the stem.
        """
        name = attributes.pop("name", "") or self.unique(stem)
        self.surfaces[name] = surface
        for shape in _SHAPES.keys() & attributes.keys():
            attributes |= {"type": _SHAPES[shape], "size": np.zeros(3)}
            size = np.atleast_1d(attributes.pop(shape))
            attributes["size"][: len(size)] = size
        if "mesh" in attributes:
            attributes |= {"type": GEOM.mjGEOM_MESH, "meshname": attributes.pop("mesh")}
        if "heading" in attributes:
            attributes["quat"] = quat_z(attributes.pop("heading"))
        return (body or self.spec.worldbody).add_geom(name=name, **attributes)

    def on_ground(self, xy_m: Array, above_m: float = 0.0) -> Array:
        """(3,) world point ``above_m`` over the ground at (2,)."""
        z = self.terrain.point(*xy_m)
        return np.array([*xy_m, z + above_m if above_m else z])

    def cast(self, points: Array, opacity: float = 1.0) -> None:
        """Registers a convex shadow caster, (N, 3) world points."""
        self.casters.append(Caster(points=np.asarray(points, np.float64), opacity=opacity))

    def cast_box(self, size: tuple[float, float], heights: Sequence[float], heading: float,
                 origin: Array, opacity: float = 1.0) -> None:  # fmt: skip
        """Registers a box as a caster: half sides along and across ``heading``, heights over
        ``origin`` (3,)."""
        points = [[x, y, z] for x in (-size[0], size[0]) for y in (-size[1], size[1])
                  for z in heights]  # fmt: skip
        self.cast(turned(np.array(points, np.float64), heading, origin), opacity)

    def stand(
        self, stem: str, surface: Surface, parts: list[MeshData], xy_m: Array, heading: float,
        **looks: Any,
    ) -> None:  # fmt: skip
        """Adds a mesh of its own on the ground at ``xy_m``, with the shadow of its hull."""
        data, origin = MeshData.join(parts), self.on_ground(xy_m)
        mesh = self.mesh(self.unique(stem), data)
        self.geom(stem, surface, mesh=mesh, pos=origin, heading=heading, **looks)
        self.cast(turned(data.vertices, heading, origin))

    def claim(self, xy_m: Array, radius_m: float) -> None:
        """Reserves a disc against later random placements."""
        self.occupied.append((np.asarray(xy_m, np.float64), radius_m))

    def claim_line(self, start_m: Array, end_m: Array, count: int) -> None:
        """Reserves ``count`` discs of 1 m from one end of a segment to the other."""
        for fraction in np.linspace(0.0, 1.0, count):
            self.claim(start_m + fraction * (end_m - start_m), 1.0)

    def is_free(self, xy_m: Array, radius_m: float) -> bool:
        """True if a disc overlaps no reserved one."""
        if not self.occupied:
            return True
        centres, radii = (np.array(column) for column in zip(*self.occupied, strict=True))
        away = np.hypot(*(xy_m - centres).T)
        return bool((away > radii + radius_m).all())


def add_texture(spec: Any, name: str, image: NDArray[np.uint8]) -> None:
    """Adds a 2-D texture from memory, (H, W, 3) uint8, top row first."""
    texture = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, nchannel=3)
    fill_texture(texture, image)


def add_material(spec: Any, name: str, texture: str, **looks: Any) -> str:
    """Adds a material with a texture, without shine unless ``looks`` has some. Returns its name."""
    material = spec.add_material(name=name, **{"specular": 0.0, "shininess": 0.0} | looks)
    textures = list(material.textures)
    textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = texture
    material.textures = textures
    return name


def quat_z(angle: float) -> list[float]:
    """Returns the quaternion wxyz of a turn about +z."""
    return [float(np.cos(0.5 * angle)), 0.0, 0.0, float(np.sin(0.5 * angle))]


def quat_zy(yaw: float, pitch: float) -> list[float]:
    """Returns the quaternion wxyz of a turn about +y by ``pitch``, then about +z by ``yaw``."""
    cy, sy, cp, sp = np.cos(yaw / 2), np.sin(yaw / 2), np.cos(pitch / 2), np.sin(pitch / 2)
    return [float(cy * cp), float(-sy * sp), float(cy * sp), float(sy * cp)]


def turned(points: Array, angle: float, origin: Array) -> Array:
    """Returns (N, 3) local points turned about +z and moved to ``origin`` (3,)."""
    c, s = np.cos(angle), np.sin(angle)
    return points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + origin
