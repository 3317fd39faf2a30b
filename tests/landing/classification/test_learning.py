"""Training that can be stopped, and begins where another ended."""

import copy
import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from touchdown.landing.api import LabelledImages
from touchdown.landing.classification import weights
from touchdown.landing.classification.labels import D_LAND

from support.ground_class_support import write_colour_network
from support.labelled_images_support import coloured


def test_rare_classes_are_drawn_more_often(torch: Any) -> None:
    from touchdown.landing.classification.learning.training import balanced_order

    pictures = coloured(100, 1)
    labels = np.array([0] * 81 + [1] * 19, np.int64)
    source = np.array([0] * 81 + [0] * 18 + [1], np.int64)
    uneven = LabelledImages(
        images=pictures.images, labels=labels, classes=D_LAND, source=source, sources=("a", "b")
    )
    draws = np.bincount(balanced_order(uneven, 0, 0), minlength=100)
    weight = np.array([9.0, np.sqrt(18.0), 1.0])
    expected = 100 * weight / weight.sum()
    assert draws.sum() == 100
    drawn = [draws[:81].sum(), draws[81:99].sum(), draws[99]]
    np.testing.assert_allclose(drawn, expected, atol=1.0)
    assert draws[:81].max() <= np.ceil(expected[0] / 81)
    again = balanced_order(uneven, 0, 0)
    assert (balanced_order(uneven, 0, 0) == again).all()
    assert (balanced_order(uneven, 0, 1) != again).any()


def test_learning_rate_rises_and_falls(torch: Any) -> None:
    from touchdown.landing.classification.learning.training import schedule

    assert [schedule(step, 100) for step in (0, 4, 5)] == pytest.approx([0.2, 1.0, 1.0])
    assert schedule(52, 100) == pytest.approx(0.5, abs=0.01) and schedule(99, 100) < 1e-3


def test_a_stopped_training_ends_as_one_that_was_not(torch: Any, tmp_path: Path) -> None:
    from touchdown.landing.classification.learning.training import Trainer, TrainParams

    plan: Any = {
        "network": "mobilenet_v3_large", "image_size": 48, "epochs": 3, "seed": 4,
    }  # fmt: skip
    params = TrainParams(**plan, batch_size=12)
    train, val, cpu = coloured(36, 1, 48), coloured(12, 2, 48), torch.device("cpu")

    def trainer(folder: str) -> Trainer:
        (tmp_path / folder).mkdir(exist_ok=True)
        return Trainer(params, train, val, tmp_path / folder, cpu)

    whole = trainer("whole")
    while not whole.finished:
        whole.run_epoch(lambda done, total, note: None)
    for _ in range(3):
        pieces = trainer("pieces")
        pieces.run_epoch(lambda done, total, note: None)
    assert pieces.finished and pieces.history == whole.history
    state, other = whole.network.state_dict(), pieces.network.state_dict()
    assert all(bool((state[name] == other[name]).all()) for name in state)
    assert whole.history[-1]["train_loss"] < whole.history[0]["train_loss"]
    with pytest.raises(ValueError, match="holds a training with other images"):
        Trainer(params, val, train, tmp_path / "whole", cpu)
    longer = TrainParams(**(plan | {"epochs": 4}), batch_size=12)
    assert not Trainer(longer, train, val, tmp_path / "whole", cpu).finished
    changed = TrainParams(**plan, batch_size=8)
    with pytest.raises(ValueError, match="a training with batch_size 12, not 8"):
        Trainer(changed, train, val, tmp_path / "whole", cpu)
    (tmp_path / "whole" / "last.pt").write_bytes(b"PK broken")
    with pytest.raises(ValueError, match="cannot be read as a checkpoint"):
        trainer("whole")


def test_of_epochs_alike_the_last_is_kept(
    torch: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from touchdown.landing.classification.learning import training

    params = training.TrainParams(
        network="mobilenet_v3_large", image_size=32, epochs=5, batch_size=12
    )
    train, val, cpu = coloured(12, 1, 32), coloured(6, 2, 32), torch.device("cpu")
    trainer = training.Trainer(params, train, val, tmp_path, cpu)
    real, found = training.scores.summary, [0.8, 0.9, 0.8998, 0.8994, 0.85]
    kept = []
    for score in found:
        changed = {"macro_f1": score}
        monkeypatch.setattr(training.scores, "summary", lambda *a, s=changed: real(*a) | s)
        trainer.run_epoch(lambda done, total, note: None)
        kept.append(trainer.best_epoch)
    assert kept == [0, 1, 2, 2, 2]


def test_a_training_may_begin_with_the_weights_of_another(torch: Any, tmp_path: Path) -> None:
    from touchdown.landing.classification.learning.export import export_network
    from touchdown.landing.classification.learning.training import Trainer, TrainParams
    from touchdown.landing.classification.networks.registry import build_network

    train, val, cpu = coloured(12, 1), coloured(6, 2), torch.device("cpu")
    torch.manual_seed(3)
    before = build_network("mobilenet_v3_large", len(train.classes), 32)
    for mean in (v for n, v in before.state_dict().items() if n.endswith("running_mean")):
        mean.uniform_(-1.0, 1.0)
    facts = weights.NetworkFacts(
        network="mobilenet_v3_large", labels="d_land", image_size=32, classes=train.classes
    )
    file, out = tmp_path / "first" / "network.onnx", tmp_path / "out"
    file.parent.mkdir()
    export_network(file, before, 2.5, facts)
    out.mkdir()
    params = TrainParams(network="mobilenet_v3_large", image_size=32, epochs=1, batch_size=6)
    trainer = Trainer(params, train, val, out, cpu, start=file.parent)
    given = before.state_dict()
    for name, value in trainer.network.state_dict().items():
        # float16 keeps eleven bits of what is not too small for it
        assert torch.allclose(value.float(), given[name].float(), rtol=2.0**-11, atol=1e-7), name
    trainer.run_epoch(lambda done, total, note: None)
    assert Trainer(params, train, val, out, cpu, start=file).finished
    with pytest.raises(ValueError, match="a training with other weights to begin with"):
        Trainer(params, train, val, out, cpu)
    other = TrainParams(network="resnet18", image_size=32, epochs=1, batch_size=6)
    with pytest.raises(ValueError, match="holds weights of another network"):
        Trainer(other, train, val, tmp_path, cpu, start=file)
    for missing in ("none", "none.onnx"):
        with pytest.raises(FileNotFoundError, match="does not exist; name a network"):
            Trainer(params, train, val, tmp_path, cpu, start=tmp_path / missing)


def test_what_is_no_class_is_learnt_as_none(torch: Any) -> None:
    """Hendrycks et al. (2019): all classes alike; a known class by itself."""
    from touchdown.landing.classification.learning.training import class_targets

    targets = class_targets(torch.tensor([1, -1]), 4)
    torch.testing.assert_close(targets, torch.tensor([[0.0, 1.0, 0.0, 0.0], [0.25] * 4]))


def test_textures_are_those_of_the_class(torch: Any, tmp_path: Path) -> None:
    """Grey pictures of three classes, and textures of two: red of the first, blue of the second."""
    from touchdown.landing.classification.learning.training import Trainer, TrainParams

    images = np.full((9, 32, 32, 3), 100, np.uint8)
    images[6:] = [[[200, 10, 10]]], [[[200, 10, 10]]], [[[10, 10, 200]]]
    train = LabelledImages(
        images=images, labels=np.array([0, 1, 2, 0, 1, 2, 0, 0, 1]), classes=("a", "b", "c"),
        source=np.array([0] * 6 + [1] * 3), sources=("rendered", "textures"),
    )  # fmt: skip
    val = coloured(6, 2)
    for fraction in (0.0, 1.0):
        folder = tmp_path / str(fraction)
        folder.mkdir()
        params = TrainParams(network="mobilenet_v3_large", image_size=32, textures=fraction)
        trainer = Trainer(params, train, val, folder, torch.device("cpu"))
        grey = torch.full((3, 3, 32, 32), 0.4)
        found = trainer._textured(grey, np.array([0, 1, 2]), torch.Generator().manual_seed(1))
        hues = [tuple((255.0 * one.mean(dim=(1, 2))).round().int().tolist()) for one in found]
        kept = (102, 102, 102)
        assert hues == ([kept] * 3 if fraction == 0.0 else [(200, 10, 10), (10, 10, 200), kept])


def test_each_variation_reaches_the_images_of_a_step(torch: Any, tmp_path: Path) -> None:
    """The same first epoch but for one variation: another loss."""
    from touchdown.landing.classification.learning.training import Trainer, TrainParams

    plain = coloured(12, 1)
    train = dataclasses.replace(plain, sources=("textures",))
    losses = {}
    for name in ("", "markings", "colours", "textures", "weather"):
        folder = tmp_path / f"with {name}"
        folder.mkdir()
        options: dict[str, Any] = {name: 1.0} if name else {}
        params = TrainParams(
            network="mobilenet_v3_large", image_size=32, epochs=1, batch_size=12, **options
        )
        trainer = Trainer(params, train, coloured(6, 2), folder, torch.device("cpu"))
        losses[name] = trainer.run_epoch(lambda done, total, note: None)["train_loss"]
    assert len({round(loss, 9) for loss in losses.values()}) == len(losses), losses


def test_frozen_layers_keep_their_weights_and_statistics(torch: Any, tmp_path: Path) -> None:
    from touchdown.landing.classification.learning.training import Trainer, TrainParams

    train, val, cpu = coloured(12, 1), coloured(6, 2), torch.device("cpu")
    params = TrainParams(
        network="efficientnet_lite0", image_size=32, epochs=1, batch_size=6, frozen=6, weather=1.0
    )
    trainer = Trainer(params, train, val, tmp_path, cpu)
    before = copy.deepcopy(trainer.network.state_dict())
    trainer.run_epoch(lambda done, total, note: None)
    for name, value in trainer.network.state_dict().items():
        kept = int(name.split(".")[0]) < 6
        assert torch.equal(value, before[name]) is kept, name


def test_weights_for_imagenet_go_where_they_belong(
    torch: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first filters take half as much of inputs twice as wide; the last layer has classes of
    its own. Padding is more at the far edge: one bright pixel in the near corner is seen by the
    first filter's first column, not its second."""
    from touchdown.landing.classification.networks import mobile
    from touchdown.landing.classification.networks.registry import build_network, load_pretrained

    torch.manual_seed(1)
    theirs = build_network("efficientnet_lite0", 1000, 64)
    torch.save(theirs.state_dict(), tmp_path / "weights.pth")
    monkeypatch.setattr(mobile, "imagenet_file", lambda: tmp_path / "weights.pth")
    ours: Any = build_network("efficientnet_lite0", 7, 64)
    own = ours[-1].weight.clone()
    load_pretrained(ours, "efficientnet_lite0")
    images = torch.rand(2, 3, 64, 64)
    with torch.no_grad():
        features = [net.eval()[:2](x) for net, x in ((ours, 2.0 * images), (theirs, images))]
    torch.testing.assert_close(*features)
    assert float(features[0].std()) > 0.01
    assert torch.equal(ours[-1].weight, own)
    with pytest.raises(ValueError, match="no weights for ImageNet of resnet18"):
        load_pretrained(ours, "resnet18")
    stem = ours[0]
    with torch.no_grad():
        stem[1].weight[:] = torch.arange(9.0).reshape(3, 3)
        corner = torch.zeros(1, 3, 8, 8)
        corner[0, :, 0, 0] = 1.0
        seen = stem[1](stem[0](corner))[0, 0, 0, 0]
    assert float(seen) == 0.0


pytest.importorskip("onnx")

FIRST = np.array([0.4, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1])
SECOND = np.array([0.1, 0.1, 0.1, 0.1, 0.1, 0.4, 0.1])


def test_teachers_give_the_mean_of_their_scores_without_costs(torch: Any, tmp_path: Path) -> None:
    """Scores of white light are the sum of those of three colours."""
    from touchdown.landing.classification.learning.ensemble import Teachers

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
    from touchdown.landing.classification.learning.ensemble import taught

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
