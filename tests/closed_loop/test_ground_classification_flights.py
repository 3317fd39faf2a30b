"""Landing flights with ground classification, and networks with smaller weights."""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from touchdown.landing.api import (
    GroundClassifier,
    LanderView,
    LandingParams,
    Phase,
    SemanticMapParams,
)
from touchdown.landing.classification.labels import D_LAND
from touchdown.landing.mission.lander import SiteLander
from touchdown.sim.api import Observation
from touchdown.sim.typing import Array

from support.ground_class_support import (
    COLOURS,
    ByColour,
    Paint,
    photograph,
    plain,
    small_rig,
    write_colour_network,
    write_noisy_images,
)
from support.lander_support import ORIGIN, PARAMS, QUICK, Puppet, flat_map, fly

_PICTURE_TICKS = 120
UNMAPPED = dataclasses.replace(PARAMS, semantics=SemanticMapParams(squares=0))
"""without a semantic map: each site is judged by its own patches"""


class Photographer(SiteLander):
    """A lander with images of painted ground at 5 Hz."""

    def __init__(
        self, paint: Paint, classifier: GroundClassifier | None, params: LandingParams = UNMAPPED
    ) -> None:
        self._rig = small_rig()
        super().__init__(self._rig, params, QUICK, classifier)
        self.paint = paint

    def update(self, obs: Observation, estimate: Any, map_view: Any) -> Any:
        if obs.tick % _PICTURE_TICKS == 0:
            image = photograph(self._rig, estimate.odom_from_body, self.paint, obs.time_s)
            obs = dataclasses.replace(obs, images=(image,))
        return super().update(obs, estimate, map_view)


def test_the_class_of_the_site_is_in_the_view() -> None:
    classifier = ByColour()
    lander = Photographer(plain("lawn"), classifier)
    phases, view = fly(Puppet(lander, flat_map()))
    assert phases[-2:] == [Phase.TOUCHDOWN, Phase.DONE] and not view.no_site
    assert view.site_class == "lawn" and view.site_class_probability == pytest.approx(0.97)
    assert classifier.batches == [3, 1]  # from above, and once more from 10 m


def test_a_lake_is_not_landed_on() -> None:
    """Flat water that reflects the LIDAR is refused by class; without classification, chosen."""
    lander = Photographer(plain("water"), ByColour())
    phases, view = fly(Puppet(lander, flat_map()))
    assert view.no_site and Phase.RETURN in phases and view.site_class is None
    named = [site for site in view.candidates if site.class_predicted is not None]
    assert len(named) >= 8 and not any(site.accepted for site in view.candidates)
    assert all("looks like water" in site.reason for site in named)
    assert {site.rule for site in named} == {"unsafe_ground"}
    _, taken = fly(Puppet(Photographer(plain("water"), None), flat_map()))
    assert not taken.no_site and taken.committed_site_world is not None
    assert taken.site_class is None


def test_further_rounds_find_a_site_of_lower_score() -> None:
    """Water but for a corner, on a plane that falls away from it: the best dozen are all wet."""

    def corner(x: Array, y: Array) -> Array:
        dry = (x > 18.0) & (y > 8.0)
        return np.where(dry[..., None], COLOURS["lawn"], COLOURS["water"]).astype(float)

    grid = flat_map()
    grid.intensity[:] = 20.0
    col, row = np.meshgrid(*(ORIGIN[0] + 0.2 * (np.arange(280) + 0.5),) * 2)
    grid.intensity[(col > 18.0) & (row > 8.0)] = 60.0
    few = dataclasses.replace(UNMAPPED, classifier_rounds=1, search_legs=0)
    _, without = fly(Puppet(Photographer(corner, ByColour(), few), grid))
    _, found = fly(Puppet(Photographer(corner, ByColour()), grid))
    assert without.no_site and not found.no_site
    assert found.committed_site_world[0] > 18.0 and found.committed_site_world[1] > 8.0


class _ChangesItsMind(ByColour):
    """Lawn from survey height, water from a lower height."""

    def __init__(self) -> None:
        super().__init__()
        self.low = False

    def classify(self, images: NDArray[np.uint8]) -> Any:
        prediction = super().classify(images)
        if self.low:
            order = np.arange(len(D_LAND))
            lawn, water = D_LAND.index("lawn"), D_LAND.index("water")
            order[[lawn, water]] = water, lawn
            prediction = dataclasses.replace(
                prediction, probabilities=prediction.probabilities[:, order]
            )
        return prediction


@pytest.mark.parametrize(
    ("params", "why"), [(UNMAPPED, "unsure what it is"), (PARAMS, "it looks like water")]
)
def test_second_look_causes_a_go_around(params: LandingParams, why: str) -> None:
    classifier = _ChangesItsMind()
    lander = Photographer(plain("lawn"), classifier, params)
    puppet = Puppet(lander, flat_map())
    notes = []
    for view, _ in puppet.run(200.0):
        classifier.low = view.phase is Phase.DESCEND
        notes.append(view.note)
        if view.phase is Phase.DONE:
            break
    assert view.no_site
    around = next(note for note in notes if note.startswith("going around"))
    assert f"at 10 m: {why}" in around


def test_without_a_classifier_nothing_changes() -> None:
    """The same setpoints to the bit, with and without images, and with one that always agrees up
    to its decision."""

    def setpoints(lander: SiteLander) -> list[tuple[Phase, Array]]:
        steps: Iterator[tuple[LanderView, Any]] = Puppet(lander, flat_map()).run(40.0)
        return [(view.phase, setpoint.position_odom.copy()) for view, setpoint in steps]

    plainly = setpoints(SiteLander(small_rig(), PARAMS, QUICK))
    shown = setpoints(Photographer(plain("water"), None))
    assert len(plainly) == len(shown)
    assert all(a == c and (b == d).all() for (a, b), (c, d) in zip(plainly, shown, strict=True))
    asked = setpoints(Photographer(plain("lawn"), ByColour()))
    decided = [phase for phase, _ in plainly].index(Phase.SELECT)
    assert all((plainly[i][1] == asked[i][1]).all() for i in range(decided))


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_noisy_images(tmp_path_factory.mktemp("pictures"), 40, 2)


@pytest.mark.parametrize("weight_type", ["float16", "int8"])
def test_smaller_weights_give_the_same_classes(
    weight_type: str, images: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("torch")
    pytest.importorskip("onnx")
    from touchdown.experiments.cli import main as cli
    from touchdown.landing.classification.onboard import load_onboard_classifier

    source = write_colour_network(tmp_path / "network.onnx")
    out = tmp_path / "small" / "network.onnx"
    arguments = ["quantize", str(source), "--data", str(images), "--out", str(out), "--quiet"]
    assert cli.main([*arguments, "--type", weight_type, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["top1"] == report["top1_before"] == 1.0
    classifier = load_onboard_classifier(out)
    assert classifier.min_probability == 0.5  # fitted again, without an error
    shown = np.array([np.full((16, 16, 3), colour) for colour in COLOURS.values()], np.uint8)
    before = load_onboard_classifier(source).classify(shown).probabilities
    np.testing.assert_allclose(classifier.classify(shown).probabilities, before, atol=0.03)
    checksum = out.with_name("network.onnx.sha256")
    checksum.write_text(f"{checksum.read_text().split()[0]}  of-another-name.onnx\n")
    assert cli.main(["evaluate", str(out), "--data", str(images), "--no-cost", "--quiet"]) == 0
    assert "images of unsafe ground taken for safe" in " ".join(capsys.readouterr().out.split())
    if weight_type != "float16":
        assert cli.main([*arguments[:1], str(out), *arguments[2:-2], str(tmp_path / "x.onnx")]) == 2
        assert "has no float16 weights" in capsys.readouterr().err
