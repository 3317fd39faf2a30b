"""Things followed over scans, of which no scan tells where the ground was free before."""

import numpy as np
import pytest

from touchdown.landing.watch.surface import CELL_M, Layers
from touchdown.landing.watch.tracks import Memory, Thing, Track, Tracks, things_in
from touchdown.sim.typing import Array

SIZE, SCAN_S = 100, 0.1
_NONE = np.zeros((SIZE, SIZE), bool)
_LEVEL = np.zeros((SIZE, SIZE), np.float32)
_UNKNOWN = np.full_like(_LEVEL, np.nan)
UNSEEN = Layers(*(_NONE,) * 5, *(_UNKNOWN,) * 5)


def followed(
    path: Array, came: float = 0.0, known: int = 0, height_m: float = 1.6, sure: bool = True
) -> Track:
    """``known``: number of the last scans in which it has not come."""
    tracks = Tracks()
    for i, at in enumerate(path):
        cells = at + np.array([[0.0, 0.0], [0.2, 0.0], [0.4, 0.0]])
        new = came if i < len(path) - known else 0.0
        thing = Thing(at, cells, 1.6, np.full(3, 1.6), height_m, appeared=0.0, came=new, sure=sure)
        tracks.update([thing], i * SCAN_S, UNSEEN, np.zeros(2))
    return tracks.tracks[0]


def way(mps: float, scans: int = 6, off_m: float = 0.0) -> Array:
    """Straight on; every other place is beside it."""
    path = np.column_stack([14.0 - mps * SCAN_S * np.arange(scans), np.full(scans, 10.0)])
    path[1::2, 1] += off_m
    return path


@pytest.mark.parametrize(
    ("mps", "off_m", "runs"), [(5.0, 0.0, True), (4.9, 0.2, False), (1.8, 0.0, False)]
)
def test_who_is_fast_moves_wherever_he_comes_from(mps: float, off_m: float, runs: bool) -> None:
    velocity = followed(way(mps, off_m=off_m)).velocity
    np.testing.assert_allclose(velocity, [-mps, 0.0] if runs else [0.0, 0.0], atol=1e-6)


@pytest.mark.parametrize(("off_m", "moves"), [(0.0, True), (0.5, False)])
def test_who_walks_goes_straight_on(off_m: float, moves: bool) -> None:
    velocity = followed(way(1.9, 13, off_m), came=1.0).velocity
    assert velocity[0] == pytest.approx(-1.9 if moves else 0.0, abs=1e-6)


@pytest.mark.parametrize(
    ("scans", "off_m", "came", "moves", "one"),
    [(6, 0.05, 1.0, True, True), (6, 0.15, 1.0, False, True), (6, 0.3, 1.0, False, False),
     (13, 0.45, 0.0, False, False)],
)  # fmt: skip
def test_what_is_followed_is_one_thing_and_moves_if_it_is_straighter(
    scans: int, off_m: float, came: float, moves: bool, one: bool
) -> None:
    track = followed(way(0.2 * scans, scans, off_m), came)
    assert (track.velocity.any(), track.drift.any()) == (moves, one)


@pytest.mark.parametrize(("known", "moves"), [(1, True), (2, False)])
def test_who_walks_is_where_the_ground_was_free(known: int, moves: bool) -> None:
    assert followed(way(1.2), came=1.0, known=known).moves is moves


def test_who_is_not_surely_there_has_not_come() -> None:
    assert [followed(way(1.2), came=1.0, sure=s).moves for s in (True, False)] == [True, False]


def test_what_is_as_low_as_plants_does_not_walk() -> None:
    assert [followed(way(1.2), came=1.0, height_m=h).moves for h in (0.3, 0.4)] == [False, True]


def test_scans_tell_that_nobody_is_as_high_as_he_would_be() -> None:
    high = np.full_like(_LEVEL, 0.02)
    high[50:52, 50:52] = 0.4
    high[60, 60] = 0.5
    high[70:90, 70:90] = -np.inf
    seen = np.isfinite(high).astype(np.float32)
    memory = Memory()
    memory.add(0.0, Layers(*(_NONE,) * 5, seen, seen, _LEVEL, _LEVEL, high))
    low = [memory.is_low(0.5, np.array([at, at])) for at in (30, 51, 56, 80, 2, 97)]
    assert low == [True, True, False, False, False, False]
    assert not memory.is_low(1.0, np.array([30, 30]))
    memory.move((10, 0))
    assert memory.is_low(0.5, np.array([60, 60])) and not memory.is_low(0.5, np.array([60, 70]))


def test_among_plants_nothing_is_free() -> None:
    """A meadow of 0.3 m beside a bare half, and a bush that only one scan meets."""
    memory = Memory()
    for scan in range(6):
        high = np.full_like(_LEVEL, 0.02)
        high[:, :50] = 0.3
        high[40, 60] = 0.5 if scan == 2 else 0.02
        seen = np.ones_like(_LEVEL)
        seen[60:, 60:] = float(scan < 2)
        free = (high < 0.15) & (seen > 0.0)
        memory.add(0.1 * scan, Layers(*(_NONE,) * 4, free, seen, seen, _LEVEL, _LEVEL, high))
    assert memory.was_free(0.5) is None
    was_free = memory.was_free(1.1)
    assert was_free is not None and was_free[50, 60] and not was_free[50, 30]
    assert not was_free[39:42, 59:62].any() and was_free[40, 62]
    assert not was_free[70, 70]  # seen too seldom


@pytest.mark.parametrize(
    ("scans", "mps", "off_m", "known", "goes"),
    [(8, 1.8, 0.1, 5, True), (6, 1.9, 0.0, 2, False), (8, 1.6, 0.0, 5, False),
     (8, 1.8, 0.5, 5, False), (8, 1.8, 0.1, 6, False), (13, 2.2, 0.45, 0, False)],
)  # fmt: skip
def test_who_goes_on_straight_moves_though_plants_hide_him(
    scans: int, mps: float, off_m: float, known: int, goes: bool
) -> None:
    assert followed(way(mps, scans, off_m), came=1.0, known=known).moves is goes


def follow(tracks: Tracks, seen: dict[int, list[tuple[float, float]]]) -> None:
    """Shows things at places (m) in scans, by the number of each."""
    for scan, places in seen.items():
        things = [
            Thing(np.array(at), np.array(at) + np.array([[0.0, 0.0], [0.2, 0.0]]), 0.5,
                  np.full(2, 0.5), 0.5, appeared=0.0, came=1.0, sure=True)
            for at in places
        ]  # fmt: skip
        tracks.update(things, scan * SCAN_S, UNSEEN, np.zeros(2))


def test_who_walks_is_found_again_after_a_scan_without_him() -> None:
    tracks, scans = Tracks(), [n for n in range(11) if n not in (6, 7, 9)]
    follow(tracks, {n: [(15.0 - 2.6 * SCAN_S * n, 10.0)] for n in scans})
    (track,) = tracks.tracks
    assert track.seen == len(scans) and track.moves


def test_a_thing_belongs_to_the_track_that_expects_it_nearest() -> None:
    tracks = Tracks()
    follow(tracks, {n: [(10.0, 10.0)] for n in range(5)})
    follow(tracks, {5: [(10.0, 10.0), (11.0, 10.0)], 6: [(10.3, 10.0)]})
    assert sorted(track.seen for track in tracks.tracks) == [1, 7]


def test_a_short_way_is_no_run() -> None:
    assert not followed(way(3.8)).moves


def test_a_thing_is_as_high_as_it_stands_above_the_ground() -> None:
    """On a hill, 1.7 m high; where most returns are is its middle."""
    tall, ground = _NONE.copy(), np.full((SIZE, SIZE), 5.0, np.float32)
    returns, high = np.zeros((SIZE, SIZE), np.float32), np.full_like(ground, 5.02)
    tall[40, 20:23] = True
    returns[40, 20:23], high[40, 20:23] = [10.0, 10.0, 20.0], [6.0, 6.7, 6.5]
    corner = np.array([-7.0, 3.0])
    was_free, higher = _NONE.copy(), _NONE.copy()
    was_free[40, 20] = higher[40, 20:22] = True
    layers = Layers(tall, tall, tall, _NONE, ~tall, returns, returns, ground, ground, high)
    (thing,) = things_in(layers, corner, was_free, higher)
    assert thing.height_m == pytest.approx(1.7) and thing.top == pytest.approx(6.7)
    assert thing.appeared == pytest.approx(1.0 / 3.0)
    assert thing.came == pytest.approx(2.0 / 3.0)
    np.testing.assert_allclose(thing.middle, corner + CELL_M * np.array([21.75, 40.5]))
    gone = layers._replace(newest=_NONE)  # only the scan before the last has seen it
    assert not things_in(gone, corner, was_free, higher)


@pytest.mark.parametrize(("sure", "counted"), [(True, 3), (False, 0)])
def test_what_is_only_higher_than_before_has_not_appeared(sure: bool, counted: int) -> None:
    """A bush that swings; only who goes on counts."""
    tracks, at = Tracks(), np.array([10.0, 10.0])
    for scan in range(3):
        thing = Thing(at, at[None], 1.0, np.ones(1), 0.5, appeared=1.0, came=1.0, sure=sure)
        (track,) = tracks.update([thing], scan * SCAN_S, UNSEEN, np.zeros(2))
    assert track.appeared == counted


def test_who_comes_is_higher_than_all_that_was_there_before() -> None:
    memory, seen = Memory(), np.ones_like(_LEVEL)
    for scan in range(6):
        high = np.full_like(_LEVEL, 0.06)
        high[40, 20] = 0.4 if scan == 2 else 0.06
        high[50, 50] = 0.06 if scan < 2 else -np.inf
        seen[50, 50] = float(scan < 2)
        memory.add(0.1 * scan, Layers(*(_NONE,) * 5, seen, seen, _LEVEL, _LEVEL, high))

    def higher(row: int, col: int, top_m: float, time_s: float = 1.1) -> bool:
        high = np.full_like(_LEVEL, 0.06)
        high[row, col] = top_m
        layers = Layers(*(_NONE,) * 5, seen, seen, _LEVEL, _LEVEL, high)
        return bool(memory.higher(time_s, layers)[row, col])

    assert [higher(30, 30, top) for top in (0.2, 0.22, 1.7)] == [False, True, True]
    assert [higher(41, 21, top) for top in (0.5, 0.6)] == [False, True]  # beside the bush
    assert not higher(50, 50, 0.5)  # seen too seldom
    assert not higher(30, 30, 0.5, time_s=0.5)  # too soon


def test_what_is_higher_than_before_is_a_thing_that_is_not_sure() -> None:
    higher, returns = _NONE.copy(), np.full_like(_LEVEL, 4.0)
    higher[40, 20:22] = True
    low = Layers(_NONE, _NONE, higher, ~_NONE, _NONE, returns, returns, *(_LEVEL,) * 3)
    found = [
        len(things_in(low._replace(high=_LEVEL + top), np.zeros(2), None, higher))
        for top in (0.19, 0.31, 0.99, 1.1)
    ]
    assert found == [0, 1, 1, 0]
    layers = low._replace(high=_LEVEL + np.float32(0.4))
    (thing,) = things_in(layers, np.zeros(2), None, higher)
    assert not thing.sure and len(thing.cells) == 2 and thing.came == 1.0
    assert not things_in(layers._replace(steep=_NONE), np.zeros(2), None, higher)
    tall = layers._replace(tall=higher)
    assert not things_in(tall, np.zeros(2), None, _NONE)[0].sure  # two scans show it
    alone = tall._replace(alone=higher)
    assert things_in(alone, np.zeros(2), None, _NONE)[0].sure
    few = alone._replace(fresh=0.5 * returns)
    assert not things_in(few, np.zeros(2), None, _NONE)[0].sure
