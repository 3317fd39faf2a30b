"""Rendered images of scenes, and scenes exported as MJCF."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.config.loading import load_config
from touchdown.experiments.config.schema import Config
from touchdown.experiments.drawing.contact_sheet import contact_sheet, thumbnails
from touchdown.experiments.errors import UsageError
from touchdown.experiments.external.places import place_file
from touchdown.experiments.flight.survey_fit import fit_survey
from touchdown.experiments.flight.wiring import build_scene
from touchdown.experiments.scene_tools.views import VIEWS, SceneViews, write_image
from touchdown.scenes.api import Image, Light, Scene, names_function
from touchdown.scenes.compose import spec_of_scene
from touchdown.scenes.export import export_spec
from touchdown.scenes.registry import scene_names
from touchdown.sim.api import VehicleModel

CONTACT_SHEET = "contact_sheet.png"
PICTURE_SUFFIXES = (".png", ".jpg")


def render_view(
    name: str, seed: int, view: str, out: Path, light: Light = "day", overrides: Sequence[str] = ()
) -> None:
    """Writes one view (`experiments.scene_tools.views.VIEWS`) of a scene, a map with ticks around
    it. Raises UsageError before anything is written."""
    if out.suffix.lower() not in PICTURE_SUFFIXES:
        raise UsageError(f"--out {out} must end in {' or '.join(PICTURE_SUFFIXES)}")
    views = _views(name, seed, light, overrides)
    image = views.draw(view)
    _make_folder(out.parent)
    write_image(out, views.framed(view, image))


def render_all_views(
    name: str, seed: int, out_dir: Path, light: Light = "day", overrides: Sequence[str] = ()
) -> dict[str, Image]:
    """Writes every view of a scene to ``out_dir/VIEW.png``, maps with ticks around them, and
    returns them by name, without ticks. ``overrides``: ``key=value`` each, such as dials of
    ``rugged``. Raises as `render_view`."""
    views = _views(name, seed, light, overrides)
    _make_folder(out_dir)
    images: dict[str, Image] = {}
    for view in VIEWS:
        images[view] = views.draw(view)
        write_image(out_dir / f"{view}.png", views.framed(view, images[view]))
    return images


def render_every_scene(
    seed: int, out: Path, progress: Callable[[str], None], light: Light = "day"
) -> Path:
    """Writes every view of every named scene to ``out/SCENE/VIEW.png`` and the contact sheet of
    them all, whose path is returned. ``progress`` is called with each name."""
    sheet = {}
    for name in scene_names():
        progress(name)
        sheet[name] = thumbnails(render_all_views(name, seed, out / name, light))
    path = out / CONTACT_SHEET
    write_image(path, contact_sheet(sheet))
    return path


def export_scene_files(name: str, seed: int, out: Path) -> Path:
    """Writes ``scene.xml`` and its assets into a new or empty directory and returns the file.
    Raises UsageError before anything is written."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UsageError(f"--out {out} exists; name a new directory")
    scene = load_configured_scene(load_config(scene=name, seed=seed, profile_default="ideal"))
    _make_folder(out)
    if names_function(name):
        with place_file(name, seed) as file:
            return export_spec(spec_of_scene(replace(scene, source=str(file))), out)
    return export_spec(spec_of_scene(scene), out)


def load_configured_scene(config: Config) -> Scene:
    """The scene of a configuration. Raises UsageError for a bad name or file; later errors pass
    unchanged."""
    try:
        return build_scene(config)
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from error


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--out: folder '{folder}' cannot be made: {error.strerror}") from error


def _views(name: str, seed: int, light: Light, overrides: Sequence[str] = ()) -> SceneViews:
    config = load_config(None, overrides, scene=name, seed=seed, light=light,
                         profile_default="ideal")  # fmt: skip
    scene = load_configured_scene(config)
    if (fit := fit_survey(config, scene)) is not None:  # the legs that would be flown
        config = config.model_copy(update={"survey": fit.survey})
    return SceneViews(scene, config)


def vehicle_portrait(scene: Scene) -> tuple[NDArray[np.uint8], VehicleModel]:
    """(H, W, 3) RGB of the vehicle on the ground, and its model."""
    from touchdown.scenes.render import render_vehicle
    from touchdown.sim.airframe.vehicle import vehicle_model

    return render_vehicle(scene), vehicle_model(scene.model)
