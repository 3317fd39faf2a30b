"""Terrains and an arena of dm_control, surveyed and landed on."""

import sys
from pathlib import Path

import pytest

import touchdown

from support.docs_support import ROOT, blocks_of

pytest.importorskip("dm_control")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hollow", "walls", "blocks"])
def test_scenes_of_the_page_are_landed_on(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Short flights of `livo`, whose network does not know the photograph of grass."""
    module = tmp_path / "terrains_of_dm_control.py"
    module.write_text(blocks_of(ROOT / "docs" / "your-own-place.md", "python")[0])
    monkeypatch.syspath_prepend(tmp_path)
    sys.modules.pop(module.stem, None)
    rules = {"preset": "short", "landing.classifier": "off", "record": False}
    result = touchdown.land(f"{module.stem}:{name}", overrides=rules, progress=False)
    assert (result.outcome, result.landing.ground_safe) == ("LANDED", True)
    assert result.position_error_m.max < 0.5 and len(result.scene_sha) == 12
