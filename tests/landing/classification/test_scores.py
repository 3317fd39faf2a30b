"""Metrics by hand, class maps of photographs, and the file of a network."""

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.classification import class_map
from touchdown.landing.classification import decision, scores, weights
from touchdown.landing.classification.engine import apply_miss_costs
from touchdown.landing.classification.labels import D_LAND


def test_confusion_recall_and_f1_by_hand() -> None:
    """Of 3 a's two are found, of 2 b's both, one of them claimed from a; there is no c."""
    labels, predicted = np.array([0, 0, 0, 1, 1]), np.array([0, 0, 1, 1, 1])
    counts = scores.confusion(labels, predicted, 3)
    assert counts.tolist() == [[2, 1, 0], [0, 2, 0], [0, 0, 0]]
    np.testing.assert_allclose(scores.recalls(counts), [2 / 3, 1.0, np.nan])
    np.testing.assert_allclose(scores.f1_scores(counts), [0.8, 0.8, np.nan])


def test_loss_is_that_of_the_softmax() -> None:
    given = np.log(np.array([[0.5, 0.25, 0.25], [0.1, 0.8, 0.1]], np.float32))
    assert scores.log_loss(given, np.array([0, 1])) == pytest.approx(-np.log(0.5 * 0.8) / 2)
    shifted = given + np.float32(100.0)
    np.testing.assert_allclose(scores.probabilities(shifted)[1], [0.1, 0.8, 0.1], rtol=1e-4)


def test_calibration_error_by_hand() -> None:
    """Ten claims of 0.9, of which six are right, are off by 0.3."""
    given = np.tile(np.log(np.array([[0.9, 0.1]], np.float32)), (10, 1))
    labels = np.array([0] * 6 + [1] * 4)
    assert scores.calibration_error(given, labels) == pytest.approx(0.3, abs=1e-6)


def test_temperature_undoes_overconfidence() -> None:
    """Scores three times too large; the best temperature is 3."""
    rng = np.random.default_rng([3, 1])
    logits = rng.normal(0.0, 1.5, (4000, 3)).astype(np.float32)
    chance = scores.probabilities(logits)
    labels = (rng.uniform(size=(4000, 1)) > chance.cumsum(axis=1)).sum(axis=1)
    assert scores.fitted_temperature(3.0 * logits, labels) == pytest.approx(3.0, rel=0.1)


def test_summary_leaves_out_classes_that_do_not_occur() -> None:
    given = np.array([[5.0, 0.0, 0.0], [0.0, 5.0, 0.0]], np.float32)
    found = scores.summary(given, np.array([0, 1]), ("a", "b", "c"))
    assert found["macro_f1"] == found["recall"] == found["top1"] == 1.0
    assert found["recall_of"] == {"a": 1.0, "b": 1.0} and found["pictures"] == 2


def test_windows_cover_everything() -> None:
    assert class_map.window_starts(100, 32, 16) == [0, 16, 32, 48, 64, 68]
    assert class_map.window_starts(32, 32, 8) == [0]


def _by_colour(images: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Certain that a window is water as far as it is blue, else lawn."""
    blue = images[..., 2].mean(axis=(1, 2)) / 255.0
    chance = np.zeros((len(images), len(D_LAND)))
    chance[:, D_LAND.index("water")] = blue
    chance[:, D_LAND.index("lawn")] = 1.0 - blue
    return chance


def test_class_map_finds_the_shore() -> None:
    picture = np.zeros((48, 96, 3), np.uint8)
    picture[:, 48:, 2] = 255
    chance = class_map.class_map(picture, 16, 4, _by_colour)
    np.testing.assert_allclose(chance.sum(axis=2), 1.0, rtol=1e-5)
    water = chance[..., D_LAND.index("water")]
    assert (water[:, :36] < 1e-6).all() and (water[:, 60:] > 1.0 - 1e-6).all()
    assert water[24, 47] == pytest.approx(0.5, abs=0.06)


def test_unsure_ground_stays_white() -> None:
    picture = np.zeros((16, 40, 3), np.uint8)
    chance = np.full((16, 40, 7), 0.1, np.float32)
    chance[:, :20, D_LAND.index("water")] = 0.4
    chance[:, 20:, D_LAND.index("lawn")] = 0.9
    numbers = class_map.sure_classes(chance, 0.5)
    drawn = class_map.class_overlay(picture, numbers, D_LAND)
    assert (drawn[0, 0] == 128).all() and (drawn[0, 39] == [60, 100, 40]).all()
    assert drawn.shape[1] == 40 and drawn.shape[0] > 16
    assert class_map.fractions(numbers, D_LAND) == {"lawn": 0.5, "unsure": 0.5}


def _sum(content: bytes) -> str:
    return f"{hashlib.sha256(content).hexdigest()}  n.onnx\n"


def test_checksum_has_the_form_of_sha256sum(tmp_path: Path) -> None:
    weights.write_network(tmp_path / "n.onnx", b"abc")
    assert (tmp_path / "n.onnx.sha256").read_text() == _sum(b"abc")
    assert weights.read_network(tmp_path / "n.onnx") == b"abc"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["n.onnx", "n.onnx.sha256"]


@pytest.mark.parametrize(("content", "checksum", "message"), [
    (None, None, "does not exist"),
    (b"abc", None, "n.onnx.sha256' does not exist"),
    (b"ab", _sum(b"abc"), r"\(2 bytes\) does not have the checksum"),
    (b"abc", "", "does not have the checksum"),
    (b"abc", "0" * 64, "does not have the checksum"),
])  # fmt: skip
def test_files_that_are_refused(
    content: bytes | None, checksum: str | None, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "n.onnx"
    if content is not None:
        path.write_bytes(content)
    if checksum is not None:
        weights.checksum_file(path).write_text(checksum)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        weights.read_network(path)


def test_class_with_a_higher_miss_cost_is_predicted_earlier() -> None:
    """Lawn at 0.85 and water at 0.15 cost 0.15 * 10 and 0.85 to miss: 1.5 of 2.35 for water."""
    found = np.full((2, 7), -50.0, np.float32)
    found[:, D_LAND.index("lawn")] = np.log([0.85, 0.95])
    found[:, D_LAND.index("water")] = np.log([0.15, 0.05])
    plain = weights.NetworkFacts(network="resnet18", labels="d_land", image_size=64, classes=D_LAND)
    dear = dataclasses.replace(plain, miss_costs=(("water", 10.0),))
    np.testing.assert_array_equal(apply_miss_costs(found, plain), found)
    chance = scores.probabilities(apply_miss_costs(found, dear))
    water = chance[:, D_LAND.index("water")]
    np.testing.assert_allclose(water, [1.5 / 2.35, 0.5 / 1.45], rtol=1e-6)
    assert [D_LAND[best] for best in chance.argmax(axis=1)] == ["water", "lawn"]
    assert weights.facts_of(dear.properties(), Path("n")) == dear
    for costs, message in (
        ((("lava", 2.0),), "miss cost of 'lava': the classes are lawn, field"),
        ((("water", 0.0),), "miss cost 0 of 'water': give a number above 0"),
        ((("water", float("inf")),), "miss cost inf of 'water'"),
    ):
        with pytest.raises(ValueError, match=message):
            dataclasses.replace(plain, miss_costs=costs)


def test_file_without_metadata_is_refused_and_an_older_one_has_the_default_limits() -> None:
    limits = decision.Limits(min_probability=0.8125, min_energy=-0.7)
    facts = weights.NetworkFacts(
        network="resnet18", labels="d_land", image_size=64, classes=D_LAND, limits=limits
    )
    kept = facts.properties()
    assert weights.facts_of(kept, Path("n")) == facts
    older = {key: kept[key] for key in kept if not key.startswith("least_")}
    assert weights.facts_of(older, Path("n")).limits == decision.Limits()
    with pytest.raises(ValueError, match="has no usable metadata"):
        weights.facts_of(facts.properties() | {"miss_costs": "water"}, Path("n"))
    with pytest.raises(ValueError, match="has no usable metadata"):
        weights.facts_of({}, Path("n"))
    with pytest.raises(ValueError, match="classes that are not those of 'd_land'"):
        weights.facts_of(facts.properties() | {"classes": "cat dog"}, Path("n"))
