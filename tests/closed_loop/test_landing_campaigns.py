"""The landing campaigns: their contents, and the safety of the commanded site."""

from pathlib import Path

import numpy as np
import pytest

from touchdown.experiments.campaign.plan import Plan, config_for, load_plan
from touchdown.experiments.config.schema import Config
from touchdown.experiments.errors import UsageError
from touchdown.experiments.flight.wiring import build_scene

from support.worlds import load_ideal_config as load_config

ROOT = Path(__file__).parents[2]


def configs_of(plan: Plan) -> list[Config]:
    return [config_for(run.values, run.run_id) for run in plan.runs]


def test_commanded_site_is_safe_with_clearance() -> None:
    """By the true map, as stated in the campaign's file."""
    from touchdown.scenes.api import LAND_CLASSES
    from touchdown.scenes.truth.maps import truth_maps

    config = configs_of(load_plan(ROOT / "configs" / "commanded_site.toml"))[0]
    scene = build_scene(config)
    spot = np.array(config.landing.site_xy_m)
    maps = truth_maps(scene, 0.1, np.array([spot - 5.0, spot + 5.0]))
    y, x = (np.indices(maps.safe.shape) + 0.5) * maps.cell_m - 5.0
    assert maps.safe[np.hypot(x, y) < 4.9].all()
    assert {LAND_CLASSES[i] for i in np.unique(maps.class_id[np.hypot(x, y) < 1.0])} == {"field"}
    assert np.hypot(*(spot - scene.takeoff_xy_m)) == pytest.approx(42.5, abs=0.5)


def test_scene_seed_is_separate_from_the_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    loaded: list[tuple[str, int]] = []
    monkeypatch.setattr(
        "touchdown.scenes.cache.cached_scene", lambda *location: loaded.append(location[:2])
    )
    build_scene(load_config(None, ["scene_seed=7"], scene="turf", seed=3))
    build_scene(load_config(None, [], scene="turf", seed=3))
    assert loaded == [("turf", 7), ("turf", 3)]
    with pytest.raises(UsageError, match="scene_seed = -1"):
        load_config(None, ["scene_seed=-1"])
