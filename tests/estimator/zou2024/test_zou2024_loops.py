"""Loop closure of `zou2024`: words, memory, the filter over hypotheses, and verification."""

import numpy as np
import pytest

from touchdown.estimator.zou2024.closures import KINDS, Closures, hop_covariance
from touchdown.estimator.zou2024.place_recognition import (
    LoopFilter,
    Memory,
    MemoryLimits,
    Vocabulary,
    likelihood,
)
from touchdown.estimator.zou2024.visual_map import BRISK, SIFT, Features
from touchdown.sim.frames import Pose, rotation_from_yaw

from support.zou2024_flight import features_of

COMMON = 8
"""descriptors of a place that half of the others show, too"""


def shown(place: int, others: int = 0) -> tuple[Features, Features]:
    """What a place shows: 30 descriptors of each kind of its own, of which the last
    ``others`` are those of no other image, and some that are common."""
    own, odd = np.random.default_rng(place), np.random.default_rng(5000 + place + others)
    common = own.permutation(2 * COMMON)[:COMMON]
    found = []
    for size in (128, 64):
        rows = own.integers(0, 256, (30, size))
        rows[30 - others :] = odd.integers(0, 256, (others, size))
        every = np.random.default_rng(9999).integers(0, 256, (2 * COMMON, size))
        found.append(features_of(np.concatenate([rows, every[common]])))
    return found[0], found[1]


def described(place: int, others: int = 0) -> tuple[np.ndarray, ...]:
    return tuple(found.descriptors for found in shown(place, others))


def limits(short_term: int = 3, words: int = 5000) -> MemoryLimits:
    return MemoryLimits(short_term, words, 38, 0.6)


@pytest.mark.parametrize("kind", [SIFT, BRISK])
def test_words_are_shared_by_the_like_bounded_and_forgotten(kind: int) -> None:
    rng = np.random.default_rng(5)
    size = 128 if kind == SIFT else 64
    descriptors = rng.integers(0, 256, (30, size)).astype(np.uint8)
    vocabulary = Vocabulary(size, kind == BRISK, 40)
    assert vocabulary.assign(descriptors).tolist() == list(range(30))
    near = descriptors.copy()
    near[:, 0] ^= 1
    assert vocabulary.assign(near[::-1]).tolist() == list(range(29, -1, -1))
    # halfway between two words is a word of its own
    between = descriptors[:1].copy()
    between[0, size // 2 :] = descriptors[1, size // 2 :]
    assert vocabulary.assign(between).tolist() == [30]
    more = vocabulary.assign(rng.integers(0, 256, (30, size)).astype(np.uint8))
    assert len(vocabulary) == 40 and more.max() < 40
    vocabulary.forget(np.arange(5, 25))
    assert vocabulary.assign(near[4:5]).tolist() == [4] and len(vocabulary) == 20
    assert vocabulary.assign(near[7:8]).tolist() == [5]
    assert len(vocabulary.assign(np.zeros((0, size), np.uint8))) == 0


def test_scores_are_term_frequency_times_inverse_document_frequency() -> None:
    """Place 0 seen again by half: 30 of its 76 words, which one of two places shows."""
    memory = Memory(limits(short_term=1), KINDS)
    for place in range(2):
        memory.add(place, described(place))
    assert memory.working == [0]
    _, words = memory.add(2, described(0, others=15))
    assert memory.working == [0, 1]
    mutual = len(np.intersect1d(memory.locations[0].words, memory.locations[1].words))
    expected = (30 + 16 - mutual) / 76 * np.log10(3 / 2)  # what all three show is nothing
    np.testing.assert_allclose(memory.scores(words), [expected, 0.0], atol=1e-12)


def test_the_posterior_over_three_locations() -> None:
    """Worked by hand: scores of mean 0.2 and standard deviation 0.1732 in a chain of three."""
    scores = np.array([0.1, 0.1, 0.4])
    np.testing.assert_allclose(
        likelihood(scores), [2.1547005, 1.0, 1.0, 1.1339746], rtol=1e-7
    )  # the virtual place: 0.2 / 0.1732 + 1; the last one: (0.4 - 0.1732) / 0.2
    np.testing.assert_array_equal(likelihood(np.array([0.0, 0.3, 0.0])), [2.0, 1.0, 1.0, 1.0])
    chain = np.abs(np.subtract.outer(np.arange(3.0), np.arange(3.0)))
    loops = LoopFilter()
    assert loops.update([3, 5, 7], chain, scores) == 7
    assert loops.new == pytest.approx(0.948883882, rel=1e-8)  # 1.93923 of 2.04370
    assert loops.update([3, 5, 7], chain, scores) == 7
    assert loops.new == pytest.approx(0.926377561, rel=1e-8)
    assert loops._known[3] == pytest.approx(0.023007047, rel=1e-7)
    assert loops._known[5] == pytest.approx(0.024260644, rel=1e-7)
    # nothing is known without candidates
    assert loops.update([], np.zeros((0, 0)), np.zeros(0)) is None and loops.new == 1.0


def test_a_revisit_is_found_and_one_similar_image_is_not() -> None:
    closures = Closures(0.1, 0.01, limits())
    route = [*range(30), 12, *range(30, 36), *range(5, 12)]
    found = [
        closures.ask(number, shown(place, others=22 if number == 30 else 5), 0.11)
        for number, place in enumerate(route)
    ]
    # that number 30 shows a quarter of place 12 is chance
    assert found[:37] == [None] * 37 and found[37:] == route[37:]


def test_memory_is_bounded_and_retrieves_neighbours() -> None:
    memory = Memory(limits(words=600), KINDS)
    for number in range(120):
        memory.add(number, described(number - (number == 7)))  # number 6 is seen twice
        memory.manage(None)
        assert max(map(len, memory.vocabularies)) <= 600
        memory.remove(number - 60)
    # the short-term memory and the newest of the rest, in all (600 - 16) / 30 places
    assert memory._short == [117, 118, 119] and len(memory.locations) == 60
    assert memory.working == [*range(101, 117)]
    assert sum(len(where) for where in memory._shown.values()) == 2 * (COMMON + 30) * 19
    assert all(len(v._used) == 600 + 3 * 38 for v in memory.vocabularies)
    # 80 and its neighbours come back with their words
    memory.manage(80)
    assert memory.working[:3] != [79, 80, 81]
    memory.manage(80)
    assert memory.working[:3] == [79, 80, 81] and max(map(len, memory.vocabularies)) <= 600
    _, words = memory.add(200, described(81))
    assert memory.working[int(np.argmax(memory.scores(words)))] == 81


def test_what_is_seen_again_weighs_more_and_stays() -> None:
    memory = Memory(limits(words=300), KINDS)
    for number, place in enumerate([0, 1, 1, 2, 3]):
        known, _ = memory.add(number, described(place))
        assert known == number - (number == 2)
    assert [place.weight for place in memory.locations.values()] == [0, 1, 0, 0]
    assert memory.locations[3].neighbours == {1, 4} and len(memory.vocabularies[0]) == 136
    for number in range(5, 15):
        memory.add(number, described(number))
        memory.manage(None)
    assert memory.working[0] == 1 and memory.working[1] > 5
    memory.connect(1, 14)
    assert [memory.locations[n].weight for n in (1, 14)] == [0, 1]
    assert 14 not in memory.working and memory.locations[14].neighbours == {1, 13}
    memory.remove(13)
    assert [memory.locations[n].neighbours for n in (12, 14)] == [{11, 14}, {1, 12}]
    assert memory.links()[0, -1] == 3.0  # 1 - 14 - 12 - 11


def test_a_hop_errs_by_what_the_filter_s_covariance_grew_by() -> None:
    """A heading error of the source swings the target aside; to that the hop adds its own."""
    north = rotation_from_yaw(np.pi / 2)
    source, target = (
        Pose(north, np.array([1.0, 2.0, 12.0])),
        Pose(north, np.array([1.0, 8.0, 12.0])),
    )
    before = np.diag([0.0, 0.0, 0.01, 0.2, 0.3, 0.4]) ** 2
    grown = np.diag([0.004, 0.005, 0.002, 0.05, 0.03, 0.02]) ** 2
    now = before + grown
    now[3, 3] += (6.0 * 0.01) ** 2
    now[3, 2] = now[2, 3] = -6.0 * 0.01**2
    hop = hop_covariance(before, now, source, target)
    expected = np.diag([0.004, 0.005, 0.002, 0.03, 0.05, 0.02]) ** 2  # forward is north
    np.testing.assert_allclose(hop, expected, atol=1e-12)
    # what was learnt meanwhile does not make it negative
    less = hop_covariance(before, 0.5 * before, source, source)
    np.testing.assert_allclose(np.sqrt(np.diag(less)), np.repeat([2e-5, 1e-3], 3))
