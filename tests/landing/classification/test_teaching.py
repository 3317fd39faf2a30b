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


def test_what_is_taught_is_learnt(
    torch: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that knows the labels changes nothing, one that knows nothing does, by its weight."""
    from touchdown.landing.classification.learning import training

    train, val, cpu = coloured(12, 1), coloured(6, 2), torch.device("cpu")
    labels = torch.from_numpy(train.labels[training.balanced_order(train, 0, 0)])
    known = training.class_targets(labels, len(train.classes))
    answers = {"knows": known, "nothing": torch.full_like(known, 1.0 / known.shape[1])}
    seen: list[Any] = []

    def made(files: list[Path], classes: tuple[str, ...], threads: int) -> Any:
        assert classes == train.classes and threads == 1
        names = [file.name for file in files]
        return SimpleNamespace(
            probabilities=lambda images: (seen.append(images), answers[names[0]])[1],
            fingerprint=names,
        )

    monkeypatch.setattr(training, "Teachers", made)

    def trainer(folder: str, weight: float, *teachers: str) -> Any:
        monkeypatch.setattr(training, "_TAUGHT", weight)
        (tmp_path / folder).mkdir(exist_ok=True)
        params = training.TrainParams(
            network="mobilenet_v3_large", image_size=32, batch_size=12, teachers=teachers,
        )  # fmt: skip
        return training.Trainer(params, train, val, tmp_path / folder, cpu)

    loss = {
        name: trainer(name, weight, *teachers).run_epoch(lambda *_: None)["train_loss"]
        for name, weight, teachers in (
            ("alone", 0.8, ()), ("knows", 0.8, ["knows"]),
            ("little", 0.2, ["nothing"]), ("nothing", 0.8, ["nothing"]),
        )
    }  # fmt: skip
    assert loss["knows"] == pytest.approx(loss["alone"], rel=1e-6)
    change = loss["nothing"] - loss["alone"]
    assert abs(change) > 1e-4
    assert loss["little"] - loss["alone"] == pytest.approx(0.25 * change, rel=0.02)
    assert seen[0].shape == (12, 3, 32, 32) and seen[0].min() >= 0.0 and seen[0].max() <= 1.0
    with pytest.raises(ValueError, match="holds a training with other teachers"):
        trainer("knows", 0.8, "nothing")
