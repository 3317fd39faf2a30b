"""The detector of people: its images, its targets, its training and its figures."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.people.figures import measured, summary
from touchdown.experiments.people.images import Labelled, read_images, rendered, write_images
from touchdown.experiments.people.learning.network import (
    CROP,
    augmented,
    clutter,
    export,
    loss_of,
    mistakes,
    targets_of,
    train,
)
from touchdown.landing.watch.people import (
    LEAST,
    LEAST_WIDTH,
    PIXEL_M,
    SHIPPED,
    STRIDE,
    PeopleDetector,
    Person,
    levelled,
    overlap,
    peaks,
    resampled,
)

PLACE = """<mujoco><worldbody>
  <light directional="true" dir="0.3 0.3 -1" diffuse="0.6 0.6 0.6"/>
  <geom name="path" type="plane" size="30 30 1" rgba="0.7 0.7 0.7 1"/>
  <site name="takeoff" pos="0 -25 0"/>
</worldbody></mujoco>"""
CROWD = (
    "traffic.people=10",
    "traffic.cars=0",
    "traffic.dogs=2",
    "traffic.bicycles=2",
    "traffic.radius_m=12",
)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> list[Labelled]:
    file = tmp_path_factory.mktemp("place") / "place.xml"
    file.write_text(PLACE)
    return list(rendered(str(file), 1, "overcast", 12, CROWD))


def test_boxes_hold_those_who_are_in_the_picture(found: list[Labelled]) -> None:
    assert sum(len(one.boxes) for one in found) >= 6
    for one in found:
        rows, cols = one.image.shape[:2]
        bare = np.median(one.image.reshape(-1, 3), axis=0)
        strange = np.abs(one.image.astype(float) - bare).sum(axis=2) > 150.0
        inside = np.zeros(strange.shape, bool)
        for x0, y0, x1, y1 in one.boxes:
            assert 0 <= x0 < x1 <= cols and 0 <= y0 < y1 <= rows
            inside[int(y0) : int(np.ceil(y1)), int(x0) : int(np.ceil(x1))] = True
        assert strange[~inside].mean() < 0.002  # nobody outside of boxes
    kinds = {kind for one in found for kind in one.kinds}
    assert any(kind.startswith("person ") for kind in kinds)
    assert {kind.split()[0] for kind in kinds} <= {"person", "dog", "bicycle"}


def test_images_know_their_scale_and_how_much_of_everybody_they_show(found: list[Labelled]) -> None:
    parts = []
    for one in found:
        rows, cols = one.image.shape[:2]
        assert cols / rows == pytest.approx(848 / 480, rel=0.01)
        assert cols >= 2 * LEAST_WIDTH and one.metres_per_pixel <= 0.027
        for (x0, y0, x1, y1), kind, shown in zip(one.boxes, one.kinds, one.shown, strict=True):
            within = x0 > 0 and y0 > 0 and x1 < cols and y1 < rows
            parts.append((within, shown))
            if within and shown > 0.9 and kind.startswith("person"):
                tall = float(np.hypot(x1 - x0, y1 - y0)) * one.metres_per_pixel
                assert 0.3 < tall < 4.0
    assert max(shown for within, shown in parts if within) > 0.99
    assert min(shown for _, shown in parts) < 0.5


def test_images_are_kept_in_files(found: list[Labelled], tmp_path: Path) -> None:
    assert write_images(tmp_path / "some-1-dusk.npz", found) == len(found)
    for kept, one in zip(read_images(tmp_path), found, strict=True):
        assert np.array_equal(kept.image, one.image) and np.array_equal(kept.boxes, one.boxes)
        assert kept.kinds == one.kinds and np.array_equal(kept.metres, one.metres)
        assert kept.metres_per_pixel == one.metres_per_pixel and kept.light == "dusk"
        assert np.array_equal(kept.shown, one.shown)
    with pytest.raises(ValueError, match="has no images of people"):
        list(read_images(tmp_path / "none"))
    (tmp_path / "a.npz").write_bytes(b"no archive")
    with pytest.raises(ValueError, match=r"a\.npz' holds no images of people"):
        list(read_images(tmp_path))


BOXES = np.array([[20.0, 12.0, 44.0, 60.0], [100.0, 80.0, 112.0, 92.0]], np.float32)


def test_an_answer_like_its_targets_gives_the_boxes_back() -> None:
    wanted = targets_of(BOXES, np.ones(2, np.float32))
    assert wanted.heat.shape == (CROP // STRIDE, CROP // STRIDE) and wanted.asked.all()
    answer = peaks(wanted.heat, STRIDE * np.exp(wanted.sizes), 0.5)
    assert len(answer) == 2
    for box in BOXES:
        assert max(overlap(tuple(box), one) for one in answer) > 0.6
    assert peaks(wanted.heat * 0.3, wanted.sizes, 0.5) == []


def test_nothing_is_asked_of_whom_hardly_anything_is_shown() -> None:
    wanted = targets_of(BOXES, np.array([1.0, 0.1], np.float32))
    assert wanted.middle.sum() == 1 and wanted.heat[21, 26] < 1e-3
    assert not wanted.asked[20:23, 25:28].any() and wanted.asked.sum() == wanted.asked.size - 9


def test_the_loss_punishes_misses_false_marks_and_wrong_sizes() -> None:
    import torch

    wanted = targets_of(BOXES[:1], np.ones(1, np.float32))
    heat, sizes, middle, asked = (torch.from_numpy(part[None]) for part in wanted)
    right = torch.cat([torch.where(middle > 0, 8.0, -8.0)[:, None], sizes], 1)
    least = float(loss_of(right, heat, sizes, middle, asked))
    assert least < 0.01
    for channel, change in ((0, -2.0 * right[:, :1] * middle[:, None]), (1, middle[:, None])):
        wrong = right.clone()
        wrong[:, channel : channel + 1] += change
        assert float(loss_of(wrong, heat, sizes, middle, asked)) > least + 0.05
    wrong = right.clone()
    wrong[:, 0, -1, -1] = 8.0  # far from anybody
    assert float(loss_of(wrong, heat, sizes, middle, asked)) > least + 1.0
    asked[:, -1, -1] = 0.0
    assert float(loss_of(wrong, heat, sizes, middle, asked)) == pytest.approx(least, abs=1e-3)


def test_images_of_all_heights_come_to_one_scale_and_brightness() -> None:
    image = np.full((480, 848, 3), 40, np.uint8)
    assert resampled(image, 2.0 * PIXEL_M).shape == image.shape
    assert resampled(image, 0.5 * PIXEL_M).shape == (240, 416, 3)
    assert resampled(image, 0.0).shape == (80, LEAST_WIDTH, 3)
    for values in (image, image + 60):
        assert abs(float(levelled(values).mean())) < 1e-3
    assert float(levelled(image * 0).mean()) == pytest.approx(-0.4)


def squares(rng: np.random.Generator, count: int) -> list[Labelled]:
    """Red squares are people here, blue ones are not."""
    found = []
    for _ in range(count):
        image = rng.integers(90, 140, (160, 240, 3)).astype(np.uint8)
        boxes = []
        for colour, (left, right) in zip((0, 0, 2), ((0, 50), (80, 130), (160, 210)), strict=True):
            x, y = int(rng.integers(left, right)), int(rng.integers(0, 130))
            image[y : y + 24, x : x + 24] = np.eye(3, dtype=np.uint8)[colour] * 220
            if colour == 0:
                boxes.append([x, y, x + 24, y + 24])
        found.append(Labelled(image, PIXEL_M, np.array(boxes, np.float32), ("person walks",) * 2,
                              np.full(2, 5.0, np.float32), np.ones(2, np.float32)))  # fmt: skip
    return found


def test_squares_keep_boxes_about_who_is_in_them() -> None:
    rng = np.random.default_rng(3)
    (one,) = squares(rng, 1)
    seen = 0
    for _ in range(40):
        sample = augmented(one, rng)
        assert sample.image.shape == (CROP, CROP, 3)
        for (x0, y0, x1, y1), part in zip(sample.boxes.astype(int), sample.shown, strict=True):
            inside = sample.image[y0 + 2 : y1 - 2, x0 + 2 : x1 - 2].reshape(-1, 3).astype(float)
            if part > 0.5:
                seen += 1
                red = np.median(inside, axis=0)
                assert red.max() - red.min() > 60
    assert seen > 20
    far = Labelled(np.tile(one.image, (4, 4, 1)), PIXEL_M, one.boxes, one.kinds, one.metres,
                   np.zeros(2, np.float32))  # fmt: skip
    far.image[500:520, 800:820] = 255
    near = sum((augmented(far, rng, [(810.0, 510.0)]).image.min(axis=2) > 180).any()
               for _ in range(60))  # fmt: skip
    assert near >= 8


def test_training_finds_what_it_was_shown(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    shown, held = squares(rng, 16), squares(rng, 12)
    losses: list[float] = []
    network = train(shown, 35, 0, lambda _epoch, loss: losses.append(loss), batch_size=8)
    assert losses[-1] < 0.3 * losses[0]
    train(shown[:3], 1, 0, lambda _epoch, loss: losses.append(loss))
    assert losses[-1] > 0.0, "fewer images than a batch has"
    empty = Labelled(held[0].image, PIXEL_M, held[0].boxes[:0], (), held[0].metres[:0],
                     held[0].shown[:0])  # fmt: skip
    assert len(mistakes(network, empty)) == len(mistakes(network, held[0])) + 2
    unseen = replace(held[0], boxes=held[0].boxes[:1] * 0.0 + [200, 100, 210, 110], kinds=("dog",),
                     shown=held[0].shown[:1])  # fmt: skip
    assert (205.0, 105.0) in mistakes(network, unseen)
    export(network, tmp_path / "people.onnx")
    detector = PeopleDetector(tmp_path / "people.onnx", 0.05)
    for image in (held[1].image, held[2].image):
        upright, turned = detector.find(image, PIXEL_M), detector.find(image[::-1, ::-1], PIXEL_M)
        assert [one.score for one in upright] == pytest.approx([one.score for one in turned])
    figures = measured(detector, held)
    found, there = figures.recall(0.35)
    assert there == 24 and found >= 20
    assert figures.false_boxes(0.35) <= 50.0


def test_the_shipped_network_finds_people(found: list[Labelled]) -> None:
    assert SHIPPED.stat().st_size <= 1_000_000
    figures = measured(PeopleDetector(SHIPPED), found)
    there, all_of_them = figures.recall(LEAST, lambda one: one.kind.startswith("person"))
    assert all_of_them >= 4 and there >= 0.75 * all_of_them
    assert figures.false_boxes(LEAST) <= 20.0


class Answers:
    """A detector with given answers."""

    def __init__(self, *answers: tuple[Person, ...]) -> None:
        self._answers = iter(answers)

    def find(self, image: Any, metres_per_pixel: float) -> tuple[Person, ...]:
        return next(self._answers)


def test_figures() -> None:
    image = np.zeros((240, 424, 3), np.uint8)
    boxes = np.array([[10, 10, 20, 30], [100, 100, 120, 120], [200, 50, 204, 56], [0, 200, 9, 209]],
                     np.float32)  # fmt: skip
    one = Labelled(
        image, 0.04, boxes, ("person sits", "dog", "person runs", "person runs"),
        np.array([3.0, 9.0, 9.0, 20.0], np.float32), np.array([1.0, 1.0, 0.1, 1.0], np.float32),
        "night",
    )  # fmt: skip
    answers = (
        Person(11, 12, 19, 28, 0.9), Person(12, 12, 22, 28, 0.5), Person(300, 50, 310, 60, 0.6),
        Person(200, 50, 204, 56, 0.99),
    )  # fmt: skip
    figures = measured(Answers(answers, ()), [one, one])  # type: ignore[arg-type]
    assert figures.recall(0.8) == (1, 4)
    assert figures.recall(0.8, lambda who: who.kind == "dog") == (0, 2)
    assert figures.recall(0.95) == (0, 4) and figures.recall(0.0, lambda w: w.metres < 4) == (2, 2)
    assert figures.false_boxes(0.55) == 50.0 and figures.false_boxes(0.7) == 0.0
    told = summary(figures, 0.35)
    rows = {row["what"]: (row["found"], row["there"]) for row in told["rows"]}
    assert rows["person"] == (1, 2) and rows["person, 0 to 4 m"] == (1, 2)
    assert rows["person sits"] == (1, 2) and rows["dog"] == (0, 2)
    assert rows["person, night"] == (1, 2) and "person, 8 to 12 m" not in rows
    assert told["worst_ms"] >= told["ms"] > 0.0


def test_clutter_lies_beside_people() -> None:
    rng = np.random.default_rng(5)
    boxes = np.array([[60.0, 60.0, 100.0, 100.0]], np.float32)
    drawn = np.zeros((CROP, CROP), bool)
    for _ in range(30):
        image = np.full((CROP, CROP, 3), 120, np.uint8)
        clutter(image, boxes, rng)
        drawn |= (image != 120).any(axis=2)
    assert drawn.mean() > 0.1 and not drawn[60:100, 60:100].any()
