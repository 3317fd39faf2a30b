"""The detector of people: its images, its targets, its training and its figures."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.people.figures import measured, summary
from touchdown.experiments.people.images import Labelled, read_images, rendered, write_images
from touchdown.experiments.people.learning.network import CROP, export, loss_of, targets_of, train
from touchdown.landing.watch.people import SIZE, STRIDE, PeopleDetector, Person, overlap, peaks

PLACE = """<mujoco><worldbody>
  <light directional="true" dir="0.3 0.3 -1" diffuse="0.6 0.6 0.6"/>
  <geom name="path" type="plane" size="30 30 1" rgba="0.7 0.7 0.7 1"/>
  <site name="takeoff" pos="0 -25 0"/>
</worldbody></mujoco>"""
CROWD = ("traffic.people=10", "traffic.dogs=2", "traffic.bicycles=2", "traffic.radius_m=12")


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> list[Labelled]:
    file = tmp_path_factory.mktemp("place") / "place.xml"
    file.write_text(PLACE)
    return list(rendered(str(file), 1, "overcast", 8, CROWD))


def test_boxes_hold_those_who_are_in_the_picture(found: list[Labelled]) -> None:
    assert sum(len(one.boxes) for one in found) >= 6
    for one in found:
        assert one.image.shape == (SIZE[1], SIZE[0], 3)
        bare = np.median(one.image.reshape(-1, 3), axis=0)
        strange = np.abs(one.image.astype(float) - bare).sum(axis=2) > 150.0
        inside = np.zeros(strange.shape, bool)
        for x0, y0, x1, y1 in one.boxes:
            assert 0 <= x0 < x1 <= SIZE[0] and 0 <= y0 < y1 <= SIZE[1]
            inside[int(y0) : int(np.ceil(y1)), int(x0) : int(np.ceil(x1))] = True
        assert strange[~inside].mean() < 0.002  # nobody outside of boxes
    assert {kind for one in found for kind in one.kinds} <= {"person", "dog", "bicycle"}


def test_images_are_kept_in_files(found: list[Labelled], tmp_path: Path) -> None:
    assert write_images(tmp_path / "some.npz", found) == len(found)
    for kept, one in zip(read_images(tmp_path), found, strict=True):
        assert np.array_equal(kept.image, one.image) and np.array_equal(kept.boxes, one.boxes)
        assert kept.kinds == one.kinds and np.array_equal(kept.metres, one.metres)
    with pytest.raises(ValueError, match="has no images of people"):
        list(read_images(tmp_path / "none"))
    (tmp_path / "a.npz").write_bytes(b"no archive")
    with pytest.raises(ValueError, match=r"a\.npz' holds no images of people"):
        list(read_images(tmp_path))


def test_an_answer_like_its_targets_gives_the_boxes_back() -> None:
    boxes = np.array([[20.0, 12.0, 44.0, 60.0], [100.0, 80.0, 112.0, 92.0]], np.float32)
    wanted = targets_of(boxes)
    assert wanted.heat.shape == (CROP[1] // STRIDE, CROP[0] // STRIDE)
    answer = peaks(wanted.heat, STRIDE * np.exp(wanted.sizes), 0.5)
    assert len(answer) == 2
    for box in boxes:
        assert max(overlap(tuple(box), one) for one in answer) > 0.6
    assert peaks(wanted.heat * 0.3, wanted.sizes, 0.5) == []


def test_the_loss_punishes_misses_false_marks_and_wrong_sizes() -> None:
    import torch

    boxes = np.array([[20.0, 12.0, 44.0, 60.0]], np.float32)
    heat, sizes, middle = (torch.from_numpy(part[None]) for part in targets_of(boxes))
    right = torch.cat([torch.where(middle > 0, 8.0, -8.0)[:, None], sizes], 1)
    least = float(loss_of(right, heat, sizes, middle))
    assert least < 0.01
    for channel, change in ((0, -2.0 * right[:, :1] * middle[:, None]), (1, middle[:, None])):
        wrong = right.clone()
        wrong[:, channel : channel + 1] += change
        assert float(loss_of(wrong, heat, sizes, middle)) > least + 0.05
    wrong = right.clone()
    wrong[:, 0, -1, -1] = 8.0  # far from anybody
    assert float(loss_of(wrong, heat, sizes, middle)) > least + 1.0


def squares(rng: np.random.Generator, count: int) -> list[Labelled]:
    """Red squares are people here, blue ones are not."""
    found = []
    for _ in range(count):
        image = rng.integers(90, 140, (SIZE[1], SIZE[0], 3)).astype(np.uint8)
        boxes = []
        for colour in (0, 0, 2):
            x, y = int(rng.integers(0, SIZE[0] - 24)), int(rng.integers(0, SIZE[1] - 24))
            image[y : y + 24, x : x + 24] = np.eye(3, dtype=np.uint8)[colour] * 220
            if colour == 0:
                boxes.append([x, y, x + 24, y + 24])
        found.append(Labelled(image, np.array(boxes, np.float32), ("person",) * 2,
                              np.full(2, 5.0, np.float32)))  # fmt: skip
    return found


def test_training_finds_what_it_was_shown(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    shown, held = squares(rng, 24), squares(rng, 12)
    losses: list[float] = []
    network = train([one.image for one in shown], [one.boxes for one in shown], 30, 0,
                    lambda _epoch, loss: losses.append(loss), batch_size=8)  # fmt: skip
    assert losses[-1] < 0.3 * losses[0]
    export(network, tmp_path / "people.onnx")
    figures = measured(PeopleDetector(tmp_path / "people.onnx", 0.05), held)
    found, there = figures.recall(0.35)
    assert there == 24 and found >= 20
    assert figures.false_boxes(0.35) <= 50.0


class Answers:
    """A detector with given answers."""

    def __init__(self, *answers: tuple[Person, ...]) -> None:
        self._answers = iter(answers)

    def find(self, image: Any) -> tuple[Person, ...]:
        return next(self._answers)


def test_figures() -> None:
    image = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    boxes = np.array([[10, 10, 20, 30], [100, 100, 120, 120]], np.float32)
    one = Labelled(image, boxes, ("person", "dog"), np.array([3.0, 9.0], np.float32))
    answers = (
        Person(11, 12, 19, 28, 0.9), Person(12, 12, 22, 28, 0.5), Person(200, 50, 210, 60, 0.6),
    )  # fmt: skip
    figures = measured(Answers(answers, ()), [one, one])  # type: ignore[arg-type]
    assert figures.recall(0.8) == (1, 4) and figures.recall(0.8, kind="dog") == (0, 2)
    assert figures.recall(0.95) == (0, 4) and figures.recall(0.0, far_m=4.0) == (2, 2)
    assert figures.false_boxes(0.55) == 50.0 and figures.false_boxes(0.7) == 0.0
    told = {row["what"]: (row["found"], row["there"]) for row in summary(figures, 0.35)["rows"]}
    assert told["person"] == (1, 2) and told["person, 0 to 4 m"] == (1, 2)
    assert told["person, 8 to 12 m"] == (0, 0)
