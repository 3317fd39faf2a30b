"""The examples of every slot fly: a short landing each."""

from pathlib import Path

import pytest

from touchdown.experiments.config.loading import load_config
from touchdown.experiments.flight.run import fly

ROOT = Path(__file__).parents[2]
EXAMPLES = {
    "selector": "flat_disc", "lander": "straight_in", "controller": "lqr", "mapper": "plain_map",
    "classifier": "colours", "watch": "bare_ground",
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kind", EXAMPLES)
def test_an_example_lands_and_the_result_names_it(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    name = f"{EXAMPLES[kind]}:build"
    config = load_config(None, ["preset=short", "sim.threads=1"], scene="flat", **{kind: name})
    result = fly(config, None)
    assert result.is_success, (result.outcome, result.reason)
    assert result.parts is not None and result.parts_sha is not None
    assert result.parts.model_dump(exclude_none=True) == {kind: name}
    assert len(getattr(result.parts_sha, kind)) == 12
    if kind == "selector":
        assert result.choice is not None and result.choice.selector == name
        assert [term.name for term in result.choice.candidates[0].terms] == ["disc", "distance"]
