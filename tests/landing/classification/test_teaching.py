"""Teachers of a training, and their share in what is learnt."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from touchdown.landing.classification.labels import D_LAND

from support.ground_class_support import write_colour_network
from support.labelled_images_support import coloured

pytest.importorskip("onnx")

FIRST = np.array([0.4, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1])
SECOND = np.array([0.1, 0.1, 0.1, 0.1, 0.1, 0.4, 0.1])


def test_teachers_give_the_mean_of_their_scores_without_costs(torch: Any, tmp_path: Path) -> None:
    """Scores of white light are the sum of those of three colours."""
    from touchdown.landing.classification.learning.teaching import Teachers

    files = [
        write_colour_network(
            tmp_path / f"{size}.onnx", size=size, miss_costs=(("water", 5.0),),
            per_colour=np.repeat(np.log(chances)[:, None] / 3.0, 3, axis=1),
        )
        for size, chances in ((16, FIRST), (32, SECOND))
    ]  # fmt: skip
    found = Teachers(files, D_LAND, 1).probabilities(torch.ones(2, 3, 32, 32)).numpy()
    expected = np.sqrt(FIRST * SECOND)
    np.testing.assert_allclose(found, np.tile(expected / expected.sum(), (2, 1)), rtol=1e-4)
    with pytest.raises(ValueError, match=r"16\.onnx' predicts lawn, .*; name a teacher of the"):
        Teachers(files, ("sand", "rock"), 1)


def test_only_images_of_a_class_are_taught(torch: Any) -> None:
    from touchdown.landing.classification.learning.teaching import taught

    targets = torch.tensor([[1.0, 0.0], [0.5, 0.5]])
    given = torch.tensor([[0.2, 0.8], [0.0, 1.0]])
    found = taught(targets, torch.tensor([True, False]), given, 0.75)
    torch.testing.assert_close(found, torch.tensor([[0.4, 0.6], [0.5, 0.5]]))


def test_what_is_taught_is_learnt(torch: Any, tmp_path: Path) -> None:
    """A teacher that knows the labels changes nothing, one that knows nothing does."""
    from touchdown.landing.classification.learning.training import (
        Trainer,
        TrainParams,
        balanced_order,
        class_targets,
    )

    train, val, cpu = coloured(12, 1), coloured(6, 2), torch.device("cpu")
    plan: dict[str, Any] = {"network": "mobilenet_v3_large", "image_size": 32, "batch_size": 12}
    labels = torch.from_numpy(train.labels[balanced_order(train, 0, 0)])
    known = class_targets(labels, len(train.classes))
    seen: list[Any] = []

    def teacher(answer: Any, number: int) -> Any:
        return SimpleNamespace(
            probabilities=lambda images: (seen.append(images), answer)[1], fingerprint=[number]
        )

    knows, knows_nothing = teacher(known, 1), teacher(torch.full_like(known, 1.0 / 7.0), 2)
    loss = {}
    for name, share, teachers in (
        ("alone", 0.0, None), ("knows", 0.6, knows), ("nothing", 0.6, knows_nothing)
    ):  # fmt: skip
        (tmp_path / name).mkdir()
        params = TrainParams(**plan, taught=share)
        trainer = Trainer(params, train, val, tmp_path / name, cpu, teachers=teachers)
        loss[name] = trainer.run_epoch(lambda *_: None)["train_loss"]
    assert loss["knows"] == pytest.approx(loss["alone"], rel=1e-6)
    assert abs(loss["nothing"] - loss["alone"]) > 1e-4
    assert seen[0].shape == (12, 3, 32, 32) and seen[0].min() >= 0.0 and seen[0].max() <= 1.0
    with pytest.raises(ValueError, match="holds a training with other teachers"):
        Trainer(params, train, val, tmp_path / "knows", cpu, teachers=knows_nothing)
    with pytest.raises(ValueError, match="taught: give teachers, and their share"):
        Trainer(params, train, val, tmp_path, cpu)
