"""The structured edge detector: its file, what it sees, and how it is scored."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from touchdown.estimator.zou2024.structured_edges import (
    SHIPPED_MODEL,
    GradientEdges,
    StructuredEdges,
    check_model,
    edge_detector,
)
from touchdown.experiments.edges.scores import (
    TEST_SCENES,
    Counts,
    counts_of_masks,
    matched_pairs,
    ridges,
    score,
    thinned,
)
from touchdown.experiments.edges.views import boundaries, connected, without_specks


def test_a_damaged_model_is_named_in_one_line(tmp_path: Path) -> None:
    whole = SHIPPED_MODEL.read_bytes()
    cut = tmp_path / "cut.yml.gz"
    cut.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"cut\.yml\.gz' is damaged") as caught:
        StructuredEdges(cut)
    assert "\n" not in str(caught.value)
    text = gzip.decompress(whole).decode()
    faults = {
        "no section thresholds": text.replace("thresholds:", "threshold:"),
        "do not fit together": text.replace("thresholds:\n   - [ ", "thresholds:\n   - [ 0.0, "),
        "no option stride": text.replace("   stride:", "   strode:"),
        "not OpenCV's YAML": "{}",
    }
    for name, changed in faults.items():
        other = tmp_path / "other.yml.gz"
        other.write_bytes(gzip.compress(changed.encode(), 1))
        with pytest.raises(ValueError, match=name):
            check_model(other)
    with pytest.raises(FileNotFoundError, match="does not exist"):
        edge_detector(str(tmp_path / "nowhere.yml.gz"))


def test_the_shipped_model_is_whole_and_small() -> None:
    check_model(SHIPPED_MODEL)
    assert SHIPPED_MODEL.stat().st_size < 6_000_000
    head = gzip.decompress(SHIPPED_MODEL.read_bytes())[:600].decode()
    (trained_on,) = (line for line in head.splitlines() if line.startswith("# scenes: "))
    assert not set(TEST_SCENES) & set(trained_on.split())
    assert isinstance(edge_detector("shipped"), StructuredEdges)
    assert isinstance(edge_detector("gradient"), GradientEdges)


@pytest.mark.parametrize("shape", [(120, 160), (121, 163)])
def test_the_shipped_model_sees_a_step_and_no_flat_ground(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    image = np.empty((*shape, 3))
    image[:] = (70, 100, 55)
    image[:, 80:] = (135, 135, 140)
    rgb = np.clip(image + rng.normal(0.0, 3.0, image.shape), 0, 255).astype(np.uint8)
    energy = edge_detector("shipped")(rgb)
    assert energy.shape == shape
    assert energy[:, 77:83].max(axis=1).min() > 5.0 * energy[:, :60].mean()


def test_segments_are_parted_by_kind_and_by_jumps_of_depth() -> None:
    kind = np.array([[1, 1, 2], [1, 1, 2], [1, 1, 2]], np.int32)
    right, down = np.zeros((3, 2), bool), np.zeros((2, 3), bool)
    assert connected(kind, right, down).max() == 1
    down[1, :2] = True  # the last row of kind 1 lies lower
    parted = connected(kind, right, down)
    assert parted[0, 0] == parted[1, 1] != parted[2, 0] and parted[0, 2] == parted[2, 2]
    edge = boundaries(parted)
    assert edge.tolist() == [[0, 1, 0], [1, 1, 0], [0, 1, 0]]


def test_specks_go_to_what_is_around_them() -> None:
    segments = np.zeros((9, 9), np.int32)
    segments[4, 4] = 1
    segments[:, 8] = 2
    assert np.unique(without_specks(segments, 2)).tolist() == [0, 2]


def test_each_detected_pixel_is_matched_once_and_within_reach() -> None:
    true = np.zeros((240, 424), bool)
    true[100, 50:150] = True  # a tolerance of 0.0075 of 487 px is 3.65 px
    for shift, pairs in ((0, 100), (3, 100), (4, 0)):
        assert matched_pairs(np.roll(true, shift, axis=0), true) == pairs
    doubled = true | np.roll(true, 2, axis=0)
    assert matched_pairs(doubled, true) == 100 and matched_pairs(np.zeros_like(true), true) == 0


def test_scores_are_those_worked_out_by_hand() -> None:
    one = Counts(10, np.array([20, 8]), np.array([10, 6]))
    two = Counts(30, np.array([40, 10]), np.array([20, 10]))
    result = score([one, two])
    # first threshold: 30 of 60 right, 30 of 40 found; second: 16 of 18, 16 of 40
    np.testing.assert_allclose(result.total.precision, [0.5, 16 / 18])
    np.testing.assert_allclose(result.total.recall, [0.75, 0.4])
    assert result.ods == pytest.approx(0.6) and result.best == 0
    # the first image is better at its second (12 / 18 > 20 / 30 is a tie: the first is kept)
    assert result.ois == pytest.approx(2 * 30 / (40 + 60))
    assert Counts(3, np.zeros(1), np.zeros(1)).f[0] == 0.0


def test_ridges_and_thinning_leave_one_line() -> None:
    across = np.exp(-0.5 * ((np.arange(60) - 30.0) / 2.0) ** 2)
    energy = np.tile(across, (60, 1)).astype(np.float32)
    line = ridges(energy)[10:50] > 0.5
    assert (line.sum(axis=1) == 1).all() and line[:, 30].all()
    assert (ridges(energy.T)[:, 10:50] > 0.5)[30].all()
    thick = np.zeros((40, 40), bool)
    thick[18:22, 5:35] = True
    counts = counts_of_masks([thick], thick)
    assert counts.matched[0] == counts.detected[0] == thinned(thick).sum() <= 34
