"""Scenes of code: MODULE:FUNCTION returns a PyMJCF root, a Composer entity or an MjSpec, which is
written as an MJCF file and read as any other.
"""

import inspect
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from touchdown.experiments.errors import UsageError, reason_of
from touchdown.experiments.external.loading import call, describe_error, external_builder, location
from touchdown.scenes.export import export_spec

KINDS = "a PyMJCF root, a Composer entity or an MjSpec"


@contextmanager
def place_file(name: str, seed: int) -> Iterator[Path]:
    """Yields the MJCF file of the scene ``my_lab.places:bowl`` in a folder of its own, which is
    removed afterwards. ``seed`` goes to the function where it takes a ``seed``, and as a
    ``numpy.random.RandomState`` where it takes a ``random_state``.

    Raises UsageError, one line that names the scene, for a function that is missing, raises, or
    returns something else, and for what the block says of the file (ValueError, OSError).
    """
    made = _called(name, seed)
    with tempfile.TemporaryDirectory(prefix="touchdown-") as folder:
        here = Path(folder).resolve()
        file = here / "place" / f"{name.partition(':')[2]}.xml"
        try:
            with warnings.catch_warnings(record=True) as found:
                _write(made, here, seed).rename(file)
                yield file
        except (ValueError, OSError, RuntimeError, mujoco.FatalError) as error:
            raise UsageError(_told(reason_of(error), file, name)) from error
        for warning in found:
            message = _told(str(warning.message), file, name)
            warnings.warn(message, warning.category, stacklevel=3)


def _told(text: str, file: Path, name: str) -> str:
    """A message on the file as one on the scene."""
    told = " ".join(text.replace(f"'{file}'", str(file)).replace(str(file), "").split())
    return f"scene '{name}': {told.removeprefix(': ').removeprefix(':').strip()}"


def _called(name: str, seed: int) -> Any:
    build: Any = external_builder(name, "scene")
    try:
        parameters = inspect.signature(build).parameters.values()
    except (TypeError, ValueError):
        parameters = ()  # type: ignore[assignment] # not written in Python: a call will show
    offered = {"seed": seed, "random_state": np.random.RandomState(seed % 2**32)}
    taken = {p.name: offered[p.name] for p in parameters if p.name in offered}
    for p in parameters:
        open_ended = p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD)
        if p.default is p.empty and p.name not in taken and not open_ended:
            raise UsageError(
                f"scene '{name}': it needs {p.name}; only seed and random_state are given to it"
            )
    made, error = call(lambda: build(**taken))
    if error is not None:
        where = location(error, name.partition(":")[0])
        raise UsageError(f"scene '{name}' raised {describe_error(error)}{where}") from error
    if not (isinstance(made, mujoco.MjSpec) or _is_root(made) or _is_entity(made)):
        raise UsageError(f"scene '{name}' returned a {type(made).__name__}; return {KINDS}")
    return made


def _is_root(made: Any) -> bool:
    return type(made).__module__.startswith("dm_control.mjcf") and hasattr(made, "worldbody")


def _is_entity(made: Any) -> bool:
    return _is_root(getattr(made, "mjcf_model", None)) and hasattr(made, "iter_entities")


def _write(made: Any, folder: Path, seed: int) -> Path:
    """Writes a scene below ``folder``; returns its MJCF file, in ``folder/place``."""
    place = folder / "place"
    if isinstance(made, mujoco.MjSpec):
        return export_spec(made, place)
    from dm_control import mjcf

    if _is_root(made):
        mjcf.export_with_assets(made, str(place), "scene.xml")
        return place / "scene.xml"
    model, data = _begun(made, np.random.RandomState(seed % 2**32))
    mjcf.export_with_assets(made.mjcf_model, str(folder / "raw"), "scene.xml")
    spec = mujoco.MjSpec.from_file(str(folder / "raw" / "scene.xml"))
    _set_heights(spec, model)
    _set_poses(spec, model, data)
    return export_spec(spec, place)


def _begun(entity: Any, random_state: np.random.RandomState) -> tuple[Any, Any]:
    """MuJoCo's model and data at the beginning of an episode, as ``composer.Environment`` begins
    it."""
    from dm_control import mjcf

    class Undrawn(mjcf.Physics):  # type: ignore[misc]
        """Arenas draw what they change only where there are rendering contexts."""

        contexts = None

    if hasattr(entity, "regenerate"):
        entity.regenerate(random_state)
    entities = list(entity.iter_entities())
    for each in entities:
        each.initialize_episode_mjcf(random_state)
    physics = Undrawn.from_mjcf_model(entity.mjcf_model)
    for each in entities:
        each.after_compile(physics, random_state)
    with physics.reset_context():
        for each in entities:
            each.initialize_episode(physics, random_state)
    return physics.model.ptr, physics.data.ptr


def _set_heights(spec: Any, model: Any) -> None:
    """Gives height fields the heights that arenas write into the compiled model. MuJoCo stretches
    what it compiles to [0, 1]: size and position take that back."""
    for field in spec.hfields:
        if field.file or not field.name:
            continue
        row = model.hfield(field.name)
        heights = np.array(row.data, dtype=np.float32).ravel()
        low, high = float(heights.min()), float(heights.max())
        top = float(field.size[2])
        field.userdata = heights
        field.size[2] = max((high - low) * top, 1e-6)
        for geom in spec.geoms:
            if geom.hfieldname == field.name and geom.name:
                turned = np.zeros(3)
                mujoco.mju_rotVecQuat(
                    turned, np.array([0, 0, low * top]), model.geom(geom.name).quat
                )
                geom.pos = model.geom(geom.name).pos + turned


def _set_poses(spec: Any, model: Any, data: Any) -> None:
    """Puts bodies with a free joint where the episode begins: joints are left out of a scene."""
    for joint in np.flatnonzero(model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)):
        body, start = spec.body(model.body(model.jnt_bodyid[joint]).name), model.jnt_qposadr[joint]
        if body is not None:
            body.pos, body.quat = data.qpos[start : start + 3], data.qpos[start + 3 : start + 7]
