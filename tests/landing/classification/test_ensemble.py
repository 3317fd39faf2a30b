"""Several networks as one: the pool of known probabilities."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.landing.classification.decision import Limits, energies
from touchdown.landing.classification.engine import OnnxClassifier
from touchdown.landing.classification.labels import D_LAND
from touchdown.landing.classification.scores import probabilities
from touchdown.landing.classification.weights import NetworkFacts, write_network

from support.ground_class_support import write_colour_network

ensemble = pytest.importorskip("touchdown.landing.classification.learning.ensemble")

WATER = D_LAND.index("water")
FIRST = np.array([0.4, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1])
SECOND = np.array([0.1, 0.1, 0.1, 0.1, 0.1, 0.4, 0.1])
SHIFT = np.array([3.0, 2.0])
"""added to all scores of the first and of the second: probabilities do not show it"""
WEIGHTS = (0.75, 0.5)
WHITE = np.full((2, 16, 16, 3), 255, np.uint8)


@pytest.fixture
def both(tmp_path: Path) -> OnnxClassifier:
    """A network that says ``FIRST`` of white light, and one that says ``SECOND``."""
    networks = [
        write_colour_network(
            tmp_path / f"{number}.onnx", miss_costs=(("water", cost),),
            per_colour=np.repeat((np.log(chances) + shift)[:, None] / 3.0, 3, axis=1),
        )
        for number, (chances, shift, cost) in enumerate(
            zip((FIRST, SECOND), SHIFT, (3.0, 10.0), strict=True)
        )
    ]  # fmt: skip
    facts = NetworkFacts(
        network="two", labels="d_land", image_size=16, classes=D_LAND,
        miss_costs=(("water", 2.0),), limits=Limits(min_probability=0.8, min_energy=2.5),
    )  # fmt: skip
    ensemble.write_ensemble(tmp_path / "two.onnx", networks, WEIGHTS, facts)
    loaded = OnnxClassifier(tmp_path / "two.onnx")
    assert loaded.facts == facts
    return loaded


def test_the_pool_is_the_weighted_geometric_mean_with_its_own_costs(both: OnnxClassifier) -> None:
    """Neither what the files of the members say that a miss costs counts, nor how large their
    scores are."""
    found = probabilities(both.scores(WHITE))
    wanted = FIRST ** WEIGHTS[0] * SECOND ** WEIGHTS[1]
    wanted[WATER] *= 2.0
    np.testing.assert_allclose(found, np.tile(wanted / wanted.sum(), (2, 1)), atol=2e-3)
    scores = [np.log(chances)[None].astype(np.float32) for chances in (FIRST, SECOND)]
    pooled = ensemble.pooled(scores, WEIGHTS)[0]
    wanted[WATER] /= 2.0
    np.testing.assert_allclose(np.exp(pooled), wanted, rtol=1e-5)


def test_familiar_is_what_the_first_network_knows(both: OnnxClassifier) -> None:
    """The energy of the first with the costs of the ensemble: ln(1 + 0.1) + 3 for white light, ln 8
    for none."""
    shown = np.stack([WHITE[0], np.zeros_like(WHITE[0])])
    wanted = [np.log(1.1) + SHIFT[0], np.log(8.0)]
    np.testing.assert_allclose(energies(both.scores(shown)), wanted, atol=0.02)


def test_networks_of_different_versions_of_onnx_are_refused(tmp_path: Path) -> None:
    import onnx

    one, two = (write_colour_network(tmp_path / f"{number}.onnx") for number in range(2))
    model: Any = onnx.load(two)
    model.opset_import[0].version = 16
    write_network(two, model.SerializeToString())
    facts = OnnxClassifier(one).facts
    with pytest.raises(ValueError, match="different versions of ONNX"):
        ensemble.write_ensemble(tmp_path / "two.onnx", (one, two), WEIGHTS, facts)


def test_weights_are_those_of_least_loss() -> None:
    """Labels drawn from the sum of two scores of which the second is given at half its size; the
    third says nothing."""
    rng = np.random.default_rng(5)
    first, second, noise = rng.normal(0.0, 1.5, (3, 40_000, len(D_LAND)))
    chances = probabilities((first + second).astype(np.float32))
    labels = (chances.cumsum(axis=1) < rng.uniform(size=(len(chances), 1))).sum(axis=1)
    given = [part.astype(np.float32) for part in (first, 0.5 * second, noise)]
    weights = ensemble.fitted_weights(given, labels.astype(np.int64))
    np.testing.assert_allclose(weights, [1.0, 2.0, 0.0], atol=0.05)
