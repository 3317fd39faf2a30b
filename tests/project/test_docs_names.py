"""Checks of names on the pages: files, modules, code, keys and their defaults."""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import importlib
import json
import re
from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.config.loading import load_config
from touchdown.experiments.io.results import columns

from support.docs_support import FOLDERS, PAGES, ROOT, inline_of, name_of, rows_of

SENSOR_KEYS = (
    "wind",
    "lidar",
    "dust",
    "camera",
    "lamp",
    "imu",
    "gps",
    "barometer",
    "magnetometer",
    "rangefinder",
    "calibration_error",
    "vehicle_error",
    "start",
)

# ------------------------------------------------------------------------------------------ names


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_files_that_are_named_exist(page: Path) -> None:
    for code in inline_of(page):
        if re.fullmatch(rf"({'|'.join(FOLDERS)}|tests)/[\w/.]*", code):
            assert (ROOT / code).exists(), f"{name_of(page)}: {code}"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_modules_in_tables_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for folder in re.findall(r"^\| module of `(\w+)/`", text, re.MULTILINE):
        for cells in rows_of(name_of(page), f"module of `{folder}/`"):
            for module in re.findall(r"`([\w/]+(?:\.py)?/?)`", cells[0]):
                assert (ROOT / folder / module).exists(), f"{name_of(page)}: {folder}/{module}"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_dotted_names_are_keys_or_can_be_imported(page: Path) -> None:
    """Keys of the configuration, keys of a run's result, or names in the code."""
    keys = load_config(profile="ideal").model_dump()
    results = " ".join(f'"{part}"' for column in columns() for part in column.split("."))
    for code in inline_of(page):
        if not re.fullmatch(r"[a-z_]+(\.\w+)+", code) or code.split(".")[-1] in ("py", "md"):
            continue
        if code.startswith("touchdown."):
            assert _importable(code), f"{name_of(page)}: {code} is not in the code"
            continue
        section, _, key = code.partition(".")
        if f'"{key}"' in results:
            continue
        if section in FOLDERS and key not in (keys.get(section) or {}):
            assert _importable(code), f"{name_of(page)}: {code} is neither a key nor in the code"
        elif isinstance(keys.get(section), dict) and section != "external":  # any key goes there
            assert key in keys[section], f"{name_of(page)}: {code} is no key"


def _importable(dotted: str) -> bool:
    parts = dotted.split(".")
    for count in range(len(parts), 0, -1):
        with contextlib.suppress(ImportError):
            found: Any = importlib.import_module(".".join(parts[:count]))
            for part in parts[count:]:
                fields = getattr(found, "__dataclass_fields__", {})
                if part not in fields and not hasattr(found, part):
                    return False
                found = getattr(found, part, None)
            return True
    return False


def test_scenes_are_listed() -> None:
    from touchdown.scenes.registry import scene_names

    listed = [row[0].strip("`") for row in rows_of("docs/scenes.md", "scene")]
    assert sorted(listed) == scene_names()


# --------------------------------------------------------------------------------- keys, defaults


def _value(cell: str) -> Any:
    cell = cell.strip("`")
    if cell == "none":
        return None
    try:
        return json.loads(cell)
    except json.JSONDecodeError:
        return cell


def test_sensor_keys_and_defaults() -> None:
    """Every key of the sensors is on the page, with its default."""
    config = load_config(profile="ideal").model_dump(mode="json")
    listed: dict[str, Any] = {}
    for cells in rows_of("docs/sensors.md", "key"):
        keys = re.findall(r"`([\w.]+)`", cells[0])
        values = [cells[1]] if len(keys) == 1 else cells[1].split(", ")
        listed |= {key: _value(value) for key, value in zip(keys, values, strict=True)}
    actual = {f"{s}.{key}": value for s in SENSOR_KEYS for key, value in config[s].items()}
    assert listed == actual


def test_lidar_presets() -> None:
    from touchdown.sim.lidar.patterns.livox import PATTERNS

    rows = {row[0].strip("`"): row[1:] for row in rows_of("docs/sensors.md", "preset")}
    for name, p in PATTERNS.items():
        limits = zip(p.range_limits_m, p.range_reflectivities, strict=True)
        assert rows[name] == [
            f"{p.point_rate_hz:,}".replace(",", " "),
            "{:g}° x {:g}°".format(*p.field_of_view_deg),
            ", ".join(f"{metres:g} m at {100.0 * share:g} %" for metres, share in limits),
            "{:g}° x {:g}°".format(*p.divergence_deg),
        ]


def test_gps_presets() -> None:
    from touchdown.sim.navigation.gps import PRESETS

    rows = {row[0].strip("`"): row[1:] for row in rows_of("docs/sensors.md", "preset")}
    for name, model in PRESETS.items():
        if model.receives:
            spread = [float(cell.removesuffix(" m")) for cell in rows[name][:2]]
            assert spread == pytest.approx([model.sigma_xy_m, model.sigma_z_m], rel=5e-3)
        else:
            assert rows[name][-1] == "no fix ever"


def test_classes_and_reflectivities_of_the_ground() -> None:
    from touchdown.scenes.api import LAND_CLASSES, RISKY_CLASSES, SAFE_CLASSES, UNSAFE_CLASSES
    from touchdown.scenes.authoring.ground import Canvas, Ground

    on_ground: dict[str, set[float]] = {name: set() for name in LAND_CLASSES}
    for material in Ground:
        canvas = Canvas.of_size(1.0, 8)
        canvas.material[:] = int(material)
        raster = canvas.raster("ground")
        name = LAND_CLASSES[int(raster.class_id[0, 0])]
        on_ground[name].add(round(float(raster.reflectivity[0, 0]), 2))
    verdicts = {"safe": SAFE_CLASSES, "risky": RISKY_CLASSES, "unsafe": UNSAFE_CLASSES}
    rows = {row[0].strip("`"): row[1:] for row in rows_of("docs/scenes.md", "class")}
    assert set(rows) == {*LAND_CLASSES, "other"}
    for name in LAND_CLASSES:
        assert name in verdicts[rows[name][0]]
        listed = {float(number) for number in re.findall(r"\d\.\d+", rows[name][1])}
        assert on_ground[name] <= listed
        assert name not in ("lawn", "field", "path", "road") or listed == on_ground[name]


def test_classes_of_files_by_others() -> None:
    from touchdown.scenes.importers.mjcf import REFLECTIVITY_905NM

    rows = {
        row[0].strip("`"): row[1] for row in rows_of("docs/your-own-place.md", "name begins with")
    }
    assert {name: float(value) for name, value in rows.items()} == {
        "anything else" if name == "other" else name: value
        for name, value in REFLECTIVITY_905NM.items()
    }


def test_options_of_the_environments() -> None:
    pytest.importorskip("gymnasium")
    from touchdown.experiments.environments.landing_task import TaskOptions

    listed = {
        row[0].strip("`"): ast.literal_eval(row[1].strip("`"))
        for row in rows_of("docs/environments.md", "option")
    }
    assert listed == {f.name: f.default for f in dataclasses.fields(TaskOptions)}


def test_sensors_of_the_environments() -> None:
    pytest.importorskip("gymnasium")
    from touchdown.experiments.environments.observations import SENSORS, ObservationBuffer

    observations = ObservationBuffer(tuple(SENSORS), privileged=True, camera_pixels=(84, 84))
    listed = {row[0].strip("`"): row[1] for row in rows_of("docs/environments.md", "name")}
    shapes = {name: str(bounds.shape) for name, bounds in observations.bounds.items()}
    assert listed == shapes | {"camera": "(H, W, 3)"}
