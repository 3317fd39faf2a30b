"""Several networks as one classifier: the pool of known probabilities, limits, refusals."""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from touchdown.landing.api import LandingParams
from touchdown.landing.classification import engine, ensemble, onboard
from touchdown.landing.classification.decision import Limits, energies
from touchdown.landing.classification.ensemble import EnsembleClassifier, write_ensemble
from touchdown.landing.classification.labels import D_LAND
from touchdown.landing.classification.scores import probabilities
from touchdown.landing.classification.site_check import SiteClassCheck
from touchdown.landing.classification.weights import NetworkFacts, write_network

from support.ground_class_support import small_rig, write_colour_network

pytest.importorskip("onnx")

Array = NDArray[np.float64]
WATER = D_LAND.index("water")
FIRST = np.array([0.4, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1])
SECOND = np.array([0.1, 0.1, 0.1, 0.1, 0.1, 0.4, 0.1])
SHIFT = np.array([[3.0], [2.0]])
"""added to all scores of the first and of the second: probabilities do not show it"""
WEIGHTS = (0.75, 0.5)
WHITE = np.full((2, 32, 32, 3), 255, np.uint8)


def _per_colour(chances: Array, shift: float) -> Array:
    """Scores of white light whose softmax is ``chances``; a third from each colour."""
    return np.repeat((np.log(chances) + shift)[:, None] / 3.0, 3, axis=1)


def two(folder: Path, *, sizes: tuple[int, int] = (16, 32), **changes: Any) -> Path:
    """An ensemble of a network that says ``FIRST`` of white light, and one that says ``SECOND``."""
    networks = [
        write_colour_network(
            folder / f"{number}.onnx", size=size, per_colour=_per_colour(chances, shift),
            miss_costs=(("water", cost),), limits=Limits(min_energy=energy),
        )
        for number, (size, chances, shift, cost, energy) in enumerate(
            zip(sizes, (FIRST, SECOND), SHIFT[:, 0], (3.0, 10.0), (2.5, -99.0), strict=True)
        )
    ]  # fmt: skip
    facts = NetworkFacts(
        **{
            "network": "two", "labels": "d_land", "image_size": max(sizes), "classes": D_LAND,
            "miss_costs": (("water", 2.0),), "limits": Limits(min_probability=0.8, min_energy=2.5),
        } | changes
    )  # fmt: skip
    write_ensemble(folder / "two.json", networks, WEIGHTS, facts)
    return folder / "two.json"


def test_the_pool_is_the_weighted_geometric_mean_with_its_own_costs(tmp_path: Path) -> None:
    """Neither what the files of the members say that a miss costs counts, nor how large their
    scores are; their images are half as wide."""
    found = probabilities(EnsembleClassifier(two(tmp_path)).scores(WHITE))
    wanted = FIRST ** WEIGHTS[0] * SECOND ** WEIGHTS[1]
    wanted[WATER] *= 2.0
    np.testing.assert_allclose(found, np.tile(wanted / wanted.sum(), (2, 1)), atol=2e-3)


def test_images_are_averaged_down_to_the_size_of_a_member() -> None:
    squares = np.zeros((1, 32, 32, 3), np.uint8)
    squares[:, ::2, ::2] = 200
    np.testing.assert_array_equal(ensemble.scaled(squares, 16), np.full((1, 16, 16, 3), 50))
    assert ensemble.scaled(squares, 32) is squares


@pytest.mark.parametrize("shape", [(2, 16, 16, 3), (32, 32, 3)])
def test_other_images_are_refused(shape: tuple[int, ...], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"\(N, 32, 32, 3\) uint8 needed"):
        EnsembleClassifier(two(tmp_path)).scores(np.zeros(shape, np.uint8))


def test_familiar_is_what_the_first_network_knows(tmp_path: Path) -> None:
    """The energy of the first with the costs of the ensemble: ln(1 + 0.1) + 3 for white light, ln 8
    for none."""
    both = EnsembleClassifier(two(tmp_path))
    energy = energies(both.scores(WHITE))
    np.testing.assert_allclose(energy, np.full(2, np.log(1.1) + SHIFT[0, 0]), atol=0.02)
    known = onboard.OnnxGroundClassifier(tmp_path / "two.json")
    shown = np.stack([WHITE[0], np.zeros_like(WHITE[0])])
    own = engine.miss_cost_logs(both.facts) - engine.miss_cost_logs(both.first.facts)
    alone = energies(both.first.scores(ensemble.scaled(shown, 16)) + own) >= 2.8
    assert alone.tolist() == known.classify(shown).in_distribution.tolist() == [True, False]


def test_the_semantic_map_is_by_the_first_network_alone(tmp_path: Path) -> None:
    two(tmp_path)
    both = onboard.OnnxGroundClassifier(tmp_path / "two.json")
    alone = onboard.OnnxGroundClassifier(tmp_path / "0.onnx")
    check = SiteClassCheck(both, small_rig(), LandingParams())
    assert check._semantics is not None
    quick = check._semantics._classifier
    assert (quick.image_size, both.image_size) == (16, 32)
    shown = np.full((1, 16, 16, 3), 255, np.uint8)
    wanted = alone.classify(shown).probabilities
    np.testing.assert_array_equal(quick.classify(shown).probabilities, wanted)
    assert both.classify(WHITE[:1]).probabilities[0].argmax() == WATER != wanted[0].argmax()
    assert both.min_probability == 0.8 and both.description()["network"] == "two"
    assert onboard.for_map(alone) is alone


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


def refused(file: Path, text: str, error: type[Exception] = ValueError) -> None:
    with pytest.raises(error, match=text) as caught:
        EnsembleClassifier(file)
    assert "\n" not in str(caught.value)


def test_members_of_other_classes_are_refused(tmp_path: Path) -> None:
    file = two(tmp_path)
    write_colour_network(tmp_path / "1.onnx", labels="d_scene")
    refused(file, "'1.onnx' is not the network that the ensemble was fitted to")
    table = json.loads(file.read_text())
    table["members"][1]["sha256"] = hashlib.sha256((tmp_path / "1.onnx").read_bytes()).hexdigest()
    write_network(file, json.dumps(table).encode())
    refused(file, "'1.onnx' predicts the classes of 'd_scene', the ensemble those of 'd_land'")


@pytest.mark.parametrize(("where", "value", "text"), [
    (("members", 0, "file"), "../0.onnx", "not a file in its folder"),
    (("members", 0, "file"), "/etc/passwd", "not a file in its folder"),
    (("members", 0, "weight"), 1e9, "a weight is not 0 to 4"),
    (("members", 0, "weight"), "nan", "a weight is not 0 to 4"),
    (("members",), [], "has 0 networks"),
    (("members",), None, "something is missing"),
    (("members",), [1], "something is missing"),
    (("facts", "least_probability"), "7", "limits in its metadata"),
    (("facts",), {}, "no usable metadata"),
    (("facts",), 1, "something is missing"),
])  # fmt: skip
def test_damaged_ensembles_are_refused(
    where: tuple[Any, ...], value: Any, text: str, tmp_path: Path
) -> None:
    file = two(tmp_path)
    table = json.loads(file.read_text())
    entry = table
    for key in where[:-1]:
        entry = entry[key]
    entry[where[-1]] = value
    write_network(file, json.dumps(table).encode())
    refused(file, text)


def test_files_that_are_no_ensembles_are_refused(tmp_path: Path) -> None:
    file = two(tmp_path)
    content = file.read_bytes()
    for wrong in (b"[" * 20_000, b"\xff", b"{}", b"x" * 70_000):
        write_network(file, wrong)
        refused(file, "is no ensemble of `touchdown ensemble`")
    file.write_bytes(content)
    refused(file, "does not have the checksum")
    write_network(file, content)
    (tmp_path / "1.onnx").unlink()
    refused(file, r"1\.onnx' .*name a network", FileNotFoundError)
