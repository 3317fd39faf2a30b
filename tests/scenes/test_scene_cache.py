"""Scenes on disk: the same scene as a new one, and never that of another key."""

import os
import pickle
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from touchdown.scenes import cache, compose
from touchdown.scenes.api import (
    NO_GUESTS,
    Guests,
    ImportOptions,
    LowSun,
    RuggedParams,
    Scene,
    TrafficParams,
)
from touchdown.scenes.authoring.ground import varied_materials
from touchdown.scenes.cache import cached_scene

from support.places import bare_scene


@pytest.fixture
def loads(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[Any]:
    """What was generated, by arguments; the cache is empty. Models are small ones."""
    monkeypatch.setenv(cache.DIRECTORY_VARIABLE, str(tmp_path / "scenes"))
    found: list[Any] = []

    def load(*arguments: Any) -> Scene:
        found.append(arguments)
        geoms = "".join(f'<geom size="{n + 1}"/>' for n in range(len(found)))
        model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{geoms}</worldbody></mujoco>")
        return bare_scene(model, name="flat", seed=arguments[1], takeoff_yaw=0.5)

    monkeypatch.setattr(compose, "load_scene", load)
    return found


def entries(tmp_path: Path) -> list[Path]:
    return sorted((tmp_path / "scenes").iterdir(), key=lambda entry: entry.stat().st_mtime)


def test_a_scene_from_the_disk_is_the_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(cache.DIRECTORY_VARIABLE, str(tmp_path))
    new, again = (cached_scene("turf", 3, None, "dusk", ImportOptions()) for _ in range(2))
    assert new.options is None  # which files alone are
    sizes = [mujoco.mj_sizeModel(one.model) for one in (again, new)]
    bytes_of = [np.empty(size, np.uint8) for size in sizes]
    for one, buffer in zip((again, new), bytes_of, strict=True):
        mujoco.mj_saveModel(one.model, None, buffer)
    np.testing.assert_array_equal(*bytes_of)
    rest = [pickle.dumps(replace(one, model=None)) for one in (again, new)]
    assert rest[0] == rest[1]


def test_a_model_that_is_not_saved_whole_is_no_entry(
    loads: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def half(model: mujoco.MjModel, file: str, buffer: None) -> None:
        Path(file).write_bytes(b"x" * (mujoco.mj_sizeModel(model) // 2))

    saving = SimpleNamespace(
        mj_saveModel=half, mj_sizeModel=mujoco.mj_sizeModel, MjModel=mujoco.MjModel
    )
    monkeypatch.setattr(cache, "mujoco", saving)
    assert cached_scene("flat", 1, None, "day").model.ngeom == 1
    assert not entries(tmp_path)


def test_each_key_has_its_own_entry(loads: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    sun = LowSun(elevation_deg=10.0)
    keys: list[Any] = [
        ("flat", 1, None, "day"), ("flat", 2, None, "day"), ("lake", 1, None, "day"),
        ("flat", 1, sun, "day"), ("flat", 1, None, "dusk"),
        ("flat", 1, None, "day", None, None, TrafficParams(people=1)),
        ("flat", 1, None, "day", None, None, None, Guests(intruders=1)),
        ("flat", 1, None, "day", None, None, None, Guests(vehicle="hexarotor")),
    ]  # fmt: skip
    for _ in range(2):
        assert [cached_scene(*key).model.ngeom for key in keys] == [1, 2, 3, 4, 5, 6, 7, 8]
    rest = (None, None, TrafficParams(), NO_GUESTS)  # neither options nor dials nor traffic
    assert loads[:5] == [(*key, *rest) for key in keys[:5]]
    monkeypatch.setattr(cache, "_sources", lambda: "other sources")
    assert cached_scene(*keys[0]).model.ngeom == 9


def test_dials_are_part_of_the_key_of_one_scene(loads: list[Any]) -> None:
    steep = RuggedParams(slope_deg=20.0)
    keys = [("rugged", None), ("rugged", RuggedParams()), ("rugged", steep),
            ("flat", None), ("flat", steep)]  # fmt: skip
    found = [cached_scene(name, 1, None, "day", None, dials).model.ngeom for name, dials in keys]
    assert found == [1, 1, 2, 3, 3]


def test_what_the_sources_hash_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("scenes", "sim"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.py").write_text("1")
    sources = cache._sources.__wrapped__
    monkeypatch.setattr(cache, "__file__", str(tmp_path / "scenes" / "cache.py"))
    found = [sources()]
    for name in ("scenes", "sim"):
        (tmp_path / name / "a.py").write_text("2")
        found.append(sources())
    monkeypatch.setattr(cache, "_LIBRARIES", (SimpleNamespace(__version__="0"),))
    assert len({*found, sources()}) == 4


@pytest.mark.parametrize("name", ["model.mjb", "scene.pickle"])
def test_a_damaged_entry_is_made_anew(loads: list[Any], tmp_path: Path, name: str) -> None:
    cached_scene("flat", 1, None, "day")
    (tmp_path / "scenes" / entries(tmp_path)[0].name / name).write_bytes(b"\x80damaged")
    assert [cached_scene("flat", 1, None, "day").model.ngeom for _ in range(2)] == [2, 2]


def test_the_entry_that_was_used_least_recently_goes_first(
    loads: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for seed in (1, 2, 3):
        cached_scene("flat", seed, None, "day")
        os.utime(entries(tmp_path)[-1], (seed, seed))
    cached_scene("flat", 1, None, "day")
    size = sum(file.stat().st_size for file in entries(tmp_path)[0].iterdir())
    monkeypatch.setenv(cache.SIZE_VARIABLE, str(3.5 * size / 1e9))
    cached_scene("flat", 4, None, "day")
    assert len(entries(tmp_path)) == 3
    for seed in (1, 3, 4):
        cached_scene("flat", seed, None, "day")
    assert [arguments[1] for arguments in loads] == [1, 2, 3, 4]


def test_scenes_of_files_and_of_a_directory_that_others_may_write_to_are_made_anew(
    loads: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cached_scene("flat", 1, None, "day")
    (tmp_path / "scenes").chmod(0o777)
    cached_scene("flat", 1, None, "day")
    monkeypatch.setenv(cache.DIRECTORY_VARIABLE, "off")
    cached_scene("flat", 1, None, "day")
    (tmp_path / "file").touch()
    monkeypatch.setenv(cache.DIRECTORY_VARIABLE, str(tmp_path / "file" / "deeper"))
    cached_scene("flat", 1, None, "day")
    monkeypatch.setenv(cache.DIRECTORY_VARIABLE, str(tmp_path / "scenes"))
    (tmp_path / "scenes").chmod(0o700)
    for _ in range(2):
        cached_scene("./flat.xml", 1, None, "day")
    with varied_materials(np.random.default_rng(1)):
        cached_scene("flat", 1, None, "day")
    assert len(loads) == 7 and len(entries(tmp_path)) == 1
