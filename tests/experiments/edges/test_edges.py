"""The structured edge detector: its features, its training, its file, and how it is scored."""

import gzip
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from touchdown.estimator.zou2024.structured_edges.detector import (
    SHIPPED_MODEL,
    GradientEdges,
    StructuredEdges,
    check_model,
    edge_detector,
)
from touchdown.experiments.cli.main import cli
from touchdown.experiments.edges import forest, model_file
from touchdown.experiments.edges.dataset import boundaries, connected, without_specks
from touchdown.experiments.edges.score import (
    Counts,
    counts_of_masks,
    f_measure,
    matched_pairs,
    ridges,
    score,
    thinned,
)
from touchdown.experiments.edges.train import TEST_SCENES, TRAIN_SCENES, TRAIN_SEEDS

SMALL = forest.ForestParams(trees=2, trees_evaluated=1, patches_per_tree=1500, images_share=1.0)


def _random_tree(rng: np.random.Generator, paired: bool) -> forest.Tree:
    """Three splits, four leaves with some pixels each."""
    child, feature = np.zeros(7, np.int32), np.zeros(7, np.int32)
    child[:3] = (2, 4, 6)
    child[1], child[2] = 4, 6
    feature[:3] = rng.integers(0, forest.REGULAR_FEATURES, 3)
    if paired:
        feature[:3] += forest.REGULAR_FEATURES
    threshold = np.zeros(7, np.float32)
    threshold[:3] = rng.normal(0.0 if paired else 0.3, 0.05, 3)
    none = np.zeros(0, np.int32)
    leaves = [np.sort(rng.permutation(256)[:20]).astype(np.int32) for _ in range(4)]
    return forest.Tree(child, feature, threshold, [none, none, none, *leaves])


def _leaf(tree: forest.Tree, regular: np.ndarray, paired: np.ndarray, y: int, x: int) -> np.ndarray:
    table, node = forest.feature_table(), 0
    while tree.child[node]:
        y1, x1, y2, x2, channel = table[tree.feature[node]]
        if y2 < 0:
            value = regular[y + y1, x + x1, channel]
        else:
            value = paired[y + y1, x + x1, channel] - paired[y + y2, x + x2, channel]
        node = int(tree.child[node]) - int(value < tree.threshold[node])
    return tree.leaf_bins[node]


def test_opencv_reads_a_forest_as_it_was_written(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    trees = [_random_tree(rng, paired=number % 2 == 1) for number in range(4)]
    path = tmp_path / "small.yml.gz"
    model_file.write_model(path, trees, forest.ForestParams(trees=4, trees_evaluated=2, stride=2))
    check_model(path)
    rgb = cv2.GaussianBlur(rng.integers(0, 256, (48, 64, 3)).astype(np.uint8), (0, 0), 1.5)
    regular, paired = forest.channel_features(rgb)
    votes = np.zeros(rgb.shape[:2], np.float32)
    for i in range(16):
        for j in range(24):
            for k in range(2):
                leaf = _leaf(trees[((i + j) % 4 + k) % 4], regular, paired, i, j)
                for place in leaf:
                    votes[2 * i + place // 16, 2 * j + place % 16] += 2.0 * 4.0 / 256.0 / 2.0
    kernel = np.array([0.25, 0.5, 0.25], np.float32)
    expected = cv2.sepFilter2D(votes, -1, kernel, kernel)
    detector = cv2.ximgproc.createStructuredEdgeDetection(str(path))
    found = detector.detectEdges(rgb.astype(np.float32) / 255.0)
    assert expected.max() > 0.1
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_features_are_counted_along_columns_first() -> None:
    table = forest.feature_table()
    assert len(table) == 16 * 16 * 13 + 300 * 13 and table[1].tolist() == [1, 0, -1, -1, 0]
    assert table[16].tolist() == [0, 1, -1, -1, 0] and table[256].tolist() == [0, 0, -1, -1, 1]
    # pairs of a grid at the whole parts of k 19 / 6 - 1.5: 1, 4, 8, 11, 14
    assert table[forest.REGULAR_FEATURES].tolist() == [1, 1, 4, 1, 0]
    assert table[-1].tolist() == [11, 14, 14, 14, 12]


def test_a_split_is_the_one_worked_out_by_hand() -> None:
    values = np.array([4.0, 1.0, 3.0, 2.0], np.float32)
    gain, threshold = forest.best_split(values, np.array([True, False, True, False]))
    assert (gain, threshold) == (0.5, 2.5)
    # one of four on the wrong side: 0.375 before; 3/4 of the 4/9 in the left leaf after
    gain, threshold = forest.best_split(values, np.array([False, False, True, False]))
    assert gain == pytest.approx(0.375 - 0.5 * 0.5) and threshold == 2.5
    assert forest.best_split(np.ones(4, np.float32), np.array([True, False, True, False]))[0] == 0.0


def test_the_first_component_parts_two_kinds_of_patches() -> None:
    one, other = np.array([1, 1, 0, 0], np.float32), np.array([0, 0, 1, 1], np.float32)
    samples = np.stack([one] * 6 + [other] * 4)
    mean, direction = forest.first_component(samples)
    side = (samples - mean) @ direction > 0.0
    assert len(set(side[:6])) == 1 and len(set(side[6:])) == 1 and side[0] != side[6]
    assert not forest.first_component(np.stack([one] * 5))[1].any()


def _striped(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """An image (96, 128, 3) of two halves, parted along a line, and its segments."""
    rows, cols = np.mgrid[:96, :128]
    angle, at = rng.uniform(0, np.pi), rng.uniform(-15, 15)
    side = (rows - 48) * np.sin(angle) + (cols - 64) * np.cos(angle) > at
    colours = np.array([[60, 90, 50], [150, 140, 130]])
    image = colours[side.astype(int)] + rng.normal(0.0, 12.0, (96, 128, 3))
    return np.clip(image, 0, 255).astype(np.uint8), side.astype(np.int32)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    rng = np.random.default_rng(1)
    pairs = [_striped(rng) for _ in range(8)]
    images = forest.TrainingImages.of([rgb for rgb, _ in pairs], [seg for _, seg in pairs])
    folder = tmp_path_factory.mktemp("edges")
    paths = folder / "one.yml.gz", folder / "two.yml.gz"
    for path in paths:
        model_file.write_model(path, forest.grow_forest(images, SMALL, seed=5), SMALL)
    return paths


def test_training_finds_the_boundary_and_repeats_itself(trained: tuple[Path, Path]) -> None:
    one, two = trained
    assert one.read_bytes() == two.read_bytes()
    rgb, segments = _striped(np.random.default_rng(2))
    energy = StructuredEdges(one)(rgb)
    assert energy.shape == (96, 128) and energy.dtype == np.float32
    assert energy.min() >= 0.0 and energy.max() <= 1.0
    near = cv2.dilate(boundaries(segments).astype(np.uint8), np.ones((5, 5))) > 0
    far = cv2.dilate(near.astype(np.uint8), np.ones((9, 9))) == 0
    assert energy[near].mean() > 5.0 * energy[far].mean()


def test_a_damaged_model_is_named_in_one_line(trained: tuple[Path, Path], tmp_path: Path) -> None:
    whole = trained[0].read_bytes()
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
        other.write_bytes(gzip.compress(changed.encode()))
        with pytest.raises(ValueError, match=name):
            check_model(other)
    with pytest.raises(FileNotFoundError, match="does not exist"):
        edge_detector(str(tmp_path / "nowhere.yml.gz"))


def test_the_shipped_model_is_whole_and_small() -> None:
    check_model(SHIPPED_MODEL)
    assert SHIPPED_MODEL.stat().st_size < 6_000_000
    head = gzip.decompress(SHIPPED_MODEL.read_bytes())[:600].decode()
    assert "# scenes: " + " ".join(TRAIN_SCENES) in head
    assert not set(TEST_SCENES) & set(TRAIN_SCENES) and min(TRAIN_SEEDS) >= 100
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
    np.testing.assert_allclose(result.precision, [0.5, 16 / 18])
    np.testing.assert_allclose(result.recall, [0.75, 0.4])
    assert result.ods == pytest.approx(0.6) and result.best == 0
    # the first image is better at its second (12 / 18 > 20 / 30 is a tie: the first is kept)
    assert result.ois == pytest.approx(2 * 30 / (40 + 60))
    assert f_measure(np.zeros(1), np.zeros(1))[0] == 0.0


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


def test_a_bad_target_is_a_usage_error(tmp_path: Path) -> None:
    for out in (tmp_path / "none" / "edges.yml.gz", tmp_path / "edges.npz"):
        result = CliRunner().invoke(cli, ["edges", "train", "--out", str(out), "--quiet"])
        assert "must be named" in str(result.exception) or "does not exist" in str(result.exception)
