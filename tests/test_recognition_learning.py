"""Training that can be stopped, and the file of a network."""

from __future__ import annotations

import copy
import dataclasses
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from experiments import cli
from experiments.patch_dataset import COLUMNS, MANIFEST
from experiments.picture_files import read_picture
from landing.api import LabelledPictures
from landing.recognition import weights
from landing.recognition.labels import D_LAND

# --------------------------------------------------------------------------------------- learning


@pytest.fixture
def torch() -> Any:
    module: Any = pytest.importorskip("torch")
    module.set_num_threads(1)
    return module


def _coloured(count: int, seed: int, size: int = 32) -> LabelledPictures:
    """Lawn is green, water is blue, buildings are red; with noise."""
    rng = np.random.default_rng([seed, 11])
    kinds = {"lawn": 1, "water": 2, "building": 0}
    names = [list(kinds)[number % 3] for number in range(count)]
    images = rng.integers(60, 120, (count, size, size, 3))
    for image, name in zip(images, names, strict=True):
        image[..., kinds[name]] += 80
    return LabelledPictures(
        images=images.astype(np.uint8),
        labels=np.array([D_LAND.index(name) for name in names], np.int64),
        classes=D_LAND,
        source=np.zeros(count, np.int64),
        sources=("made up",),
    )


def test_rare_classes_are_drawn_more_often(torch: Any) -> None:
    from landing.recognition.learning.training import balanced_order

    pictures = _coloured(100, 1)
    labels = np.array([0] * 81 + [1] * 19, np.int64)
    source = np.array([0] * 81 + [0] * 18 + [1], np.int64)
    uneven = LabelledPictures(
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
    from landing.recognition.learning.training import schedule

    assert [schedule(step, 100) for step in (0, 4, 5)] == pytest.approx([0.2, 1.0, 1.0])
    assert schedule(52, 100) == pytest.approx(0.5, abs=0.01)
    assert schedule(99, 100) < 1e-3


def test_pictures_grow(torch: Any) -> None:
    from landing.recognition.learning.training import TrainParams, check_growth, size_of_epoch

    params = TrainParams(image_size=96, first_size=48, epochs=8)
    check_growth(params)
    sizes = [size_of_epoch(params, epoch) for epoch in range(8)]
    assert sizes == [48, 48, 64, 64, 80, 80, 96, 96]
    assert {size_of_epoch(TrainParams(epochs=8), epoch) for epoch in range(8)} == {96}
    for wrong, message in (
        ({"first_size": 128}, "is more than image_size 96"),
        ({"first_size": 48, "network": "inception_v4"}, "at least 75 pixels, not 48"),
        ({"first_size": 48, "network": "vgg19"}, "one size only"),
    ):
        with pytest.raises(ValueError, match=message):
            check_growth(TrainParams(**wrong))


def test_variations_keep_the_kind_of_picture(torch: Any) -> None:
    from landing.recognition.learning.augment import as_input, augmented

    images = as_input(torch.from_numpy(_coloured(12, 2).images))
    results = [augmented(images, torch.Generator().manual_seed(s)) for s in (1, 1, 2)]
    assert results[0].shape == images.shape
    assert float(results[0].min()) >= 0.0 and float(results[0].max()) <= 1.0
    assert bool((results[0] == results[1]).all()) and bool((results[0] != results[2]).any())


def test_without_strength_pictures_are_only_moved(torch: Any) -> None:
    from landing.recognition.learning.augment import augmented

    plain = torch.rand(4, 3, 1, 1, generator=torch.Generator().manual_seed(5)).expand(4, 3, 16, 16)
    varied = augmented(plain, torch.Generator().manual_seed(3), 0.0)
    np.testing.assert_allclose(varied, plain, atol=1e-6)
    assert float((augmented(plain, torch.Generator().manual_seed(3)) - plain).abs().max()) > 0.05


def test_lines_are_painted_on_a_share_of_the_pictures(torch: Any) -> None:
    from landing.recognition.learning.augment import augmented, marked

    plain = torch.full((400, 3, 48, 48), 0.3)
    painted = marked(plain, torch.Generator().manual_seed(5), 0.25)
    changed = ((painted - plain).abs().amax(dim=1) > 0.02).float().mean(dim=(1, 2))
    count = int((changed > 0.0).sum())
    assert 70 <= count <= 130, "a quarter, four deviations of a binomial count to either side"
    some = changed[changed > 0.0]
    assert float(some.max()) < 0.5, "a line is at most a quarter as wide as its period, and an edge"
    assert float(some.mean()) > 0.01
    assert float(painted.min()) >= 0.0 and float(painted.max()) <= 1.0
    assert torch.equal(marked(plain, torch.Generator().manual_seed(5), 0.0), plain)
    without, none = (
        augmented(plain[:4], torch.Generator().manual_seed(7), 1.0, *markings)
        for markings in ((), (0.0,))
    )
    assert torch.equal(without, none)


def test_paint_has_one_colour(torch: Any) -> None:
    """Of each picture, what was added is a multiple of one colour: paint has no picture in it."""
    from landing.recognition.learning.augment import marked

    plain = torch.full((30, 3, 48, 48), 0.5)
    added = (marked(plain, torch.Generator().manual_seed(1), 1.0) - plain).flatten(2)
    for one in added:
        spread = torch.linalg.svdvals(one)
        assert float(spread[1]) <= 1e-4 * max(1.0, float(spread[0]))


def test_blended_pictures_have_blended_classes(torch: Any) -> None:
    """Pictures as bright as their class is high: what is left of a class is left of its light."""
    from landing.recognition.learning.augment import blended

    generator = torch.Generator().manual_seed(3)
    classes = torch.arange(8)
    images = classes.float()[:, None, None, None].expand(8, 3, 4, 4)
    targets = torch.nn.functional.one_hot(classes, 8).float()
    mixed, chances = blended(images, targets, generator, 0.4)
    torch.testing.assert_close(chances.sum(dim=1), torch.ones(8))
    torch.testing.assert_close(mixed[:, 0, 0, 0], chances @ classes.float())
    assert bool((chances[classes, classes] >= 0.5).all()) and bool((chances < 1.0).any())


@pytest.mark.parametrize("strength", [0.2, 1.0])
def test_shares_of_blended_pictures_are_beta_distributed(torch: Any, strength: float) -> None:
    """Beta(a, a): mean 1/2, variance 1 / (8 a + 4)."""
    from landing.recognition.learning.augment import _beta

    generator = torch.Generator().manual_seed(4)
    draws = np.array([_beta(strength, generator) for _ in range(4000)])
    assert draws.mean() == pytest.approx(0.5, abs=0.025)
    assert draws.var() == pytest.approx(1.0 / (8.0 * strength + 4.0), rel=0.06)


def test_a_turn_of_a_plain_picture_changes_nothing(torch: Any) -> None:
    from landing.recognition.learning.augment import _moved

    images = torch.full((4, 3, 16, 16), 0.25)
    moved = _moved(images, torch.Generator().manual_seed(3))
    np.testing.assert_allclose(moved, 0.25, rtol=1e-6)


def test_a_stopped_training_ends_as_one_that_was_not(torch: Any, tmp_path: Path) -> None:
    from landing.recognition.learning.training import Trainer, TrainParams

    plan: Any = {
        "network": "mobilenet_v3_large", "image_size": 48, "first_size": 32, "epochs": 3, "seed": 4,
    }  # fmt: skip
    params = TrainParams(**plan, batch_size=12)
    train, val, cpu = _coloured(36, 1, 48), _coloured(12, 2, 48), torch.device("cpu")

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
    with pytest.raises(ValueError, match="holds a training with other pictures"):
        Trainer(params, val, train, tmp_path / "whole", cpu)
    longer = TrainParams(**(plan | {"epochs": 4}), batch_size=12)
    assert not Trainer(longer, train, val, tmp_path / "whole", cpu).finished
    changed = TrainParams(**plan, batch_size=8)
    with pytest.raises(ValueError, match="a training with batch_size 12, not 8"):
        Trainer(changed, train, val, tmp_path / "whole", cpu)
    (tmp_path / "whole" / "last.pt").write_bytes(b"PK broken")
    with pytest.raises(ValueError, match="is no checkpoint that can be read"):
        trainer("whole")


def test_a_training_may_begin_with_the_weights_of_another(torch: Any, tmp_path: Path) -> None:
    from landing.recognition.learning.training import Trainer, TrainParams

    train, val, cpu = _coloured(12, 1), _coloured(6, 2), torch.device("cpu")
    params = TrainParams(network="mobilenet_v3_large", image_size=32, epochs=1, batch_size=6)
    first, second = tmp_path / "first", tmp_path / "second"
    first.mkdir()
    second.mkdir()
    Trainer(params, train, val, first, cpu).run_epoch(lambda done, total, note: None)
    best = torch.load(first / "best.pt", weights_only=True)
    trainer = Trainer(params, train, val, second, cpu, start=first)
    assert all(bool((value == best[n]).all()) for n, value in trainer.network.state_dict().items())
    trainer.run_epoch(lambda done, total, note: None)
    with pytest.raises(ValueError, match="a training with other weights to begin with"):
        Trainer(params, train, val, second, cpu)
    other = TrainParams(network="resnet18", image_size=32, epochs=1, batch_size=6)
    with pytest.raises(ValueError, match="holds weights of another network"):
        Trainer(other, train, val, second, cpu, start=first)
    with pytest.raises(ValueError, match="is no checkpoint that can be read"):
        Trainer(params, train, val, second, cpu, start=tmp_path / "none")


def test_a_training_may_begin_with_the_weights_of_a_file(torch: Any, tmp_path: Path) -> None:
    from landing.recognition.learning.export import export_network
    from landing.recognition.learning.training import Trainer, TrainParams
    from landing.recognition.networks.registry import build_network

    train, val, cpu = _coloured(12, 1), _coloured(6, 2), torch.device("cpu")
    torch.manual_seed(3)
    before = build_network("mobilenet_v3_large", len(train.classes), 32)
    for mean in (v for n, v in before.state_dict().items() if n.endswith("running_mean")):
        mean.uniform_(-1.0, 1.0)
    facts = weights.NetworkFacts(
        network="mobilenet_v3_large", labels="d_land", image_size=32, classes=train.classes
    )
    file, out = tmp_path / "network.onnx", tmp_path / "out"
    export_network(file, before, 2.5, facts)
    out.mkdir()
    params = TrainParams(network="mobilenet_v3_large", image_size=32, epochs=1, batch_size=6)
    trainer = Trainer(params, train, val, out, cpu, start=file)
    given = before.state_dict()
    trainer_began = copy.deepcopy(trainer.network.state_dict())
    for name, value in trainer.network.state_dict().items():
        # float16 keeps eleven bits of what is not too small for it
        assert torch.allclose(value.float(), given[name].float(), rtol=2.0**-11, atol=1e-7), name
    trainer.run_epoch(lambda done, total, note: None)
    assert Trainer(params, train, val, out, cpu, start=file).finished
    ended = Trainer(params, train, val, out, cpu, start=file).best().network.state_dict()
    half = dataclasses.replace(params, start_share=0.5)
    between = Trainer(half, train, val, out, cpu, start=file).best().network.state_dict()
    for name, value in between.items():
        if value.is_floating_point():
            mean = 0.5 * (trainer_began[name] + ended[name])
            assert torch.allclose(value, mean, rtol=1e-5, atol=1e-6), name
    with pytest.raises(ValueError, match="there are no weights to begin with"):
        Trainer(half, train, val, tmp_path, cpu)
    other = TrainParams(network="resnet18", image_size=32, epochs=1, batch_size=6)
    with pytest.raises(ValueError, match="holds weights of another network"):
        Trainer(other, train, val, tmp_path, cpu, start=file)
    with pytest.raises(FileNotFoundError, match="does not exist; name a network"):
        Trainer(params, train, val, tmp_path, cpu, start=tmp_path / "none.onnx")


@pytest.mark.skipif(sys.platform != "linux", reason="a setting of glibc")
def test_memory_is_used_again() -> None:
    """A second array of 64 MB has no page (4 kB) that the system would have to zero."""
    script = (
        "import resource, numpy as np\n"
        "from experiments.recognition_train import keep_freed_memory\n"
        "keep_freed_memory()\n"
        "faults = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_minflt\n"
        "def more():\n"
        "    before = faults()\n"
        "    np.ones(8_000_000)\n"
        "    return faults() - before\n"
        "print(more(), more())\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    first, second = map(int, done.stdout.split())
    assert second < 100 < first


def test_a_device_that_is_not_here(torch: Any) -> None:
    from landing.recognition.learning.training import chosen_device

    with pytest.raises(ValueError, match="unknown device 'tpu'"):
        chosen_device("tpu")
    if not torch.cuda.is_available():
        assert chosen_device("auto").type == "cpu"
        with pytest.raises(ValueError, match="finds no GPU here"):
            chosen_device("cuda")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders of coloured pictures."""
    home = tmp_path_factory.mktemp("coloured")
    pictures = _coloured(90, 5, 40)
    for number, (image, label) in enumerate(zip(pictures.images, pictures.labels, strict=True)):
        path = home / D_LAND[label]
        path.mkdir(exist_ok=True)
        cv2.imwrite(str(path / f"{number}.png"), image[..., ::-1])
    return home


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory, folder: Path) -> Path:
    """The network of a short training by the command."""
    for name in ("torch", "onnx", "onnxruntime"):
        pytest.importorskip(name)
    out = tmp_path_factory.mktemp("trained")
    arguments = ["train", "--network", "mobilenet_v3_large", "--data", str(folder), "--out",
                 str(out), "--epochs", "2", "--image-size", "32", "--threads", "1", "--quiet",
                 "--json"]  # fmt: skip
    assert cli.main(arguments) == 0
    return out / "network.onnx"


def test_training_leaves_its_files(trained: Path) -> None:
    names = {path.name for path in trained.parent.iterdir()}
    assert names == {
        "network.onnx", "network.onnx.sha256", "curves.csv", "curves.rrd", "training.json",
        "last.pt", "best.pt",
    }  # fmt: skip
    report = json.loads((trained.parent / "training.json").read_text())
    assert report["epochs"] == 2 and report["parameters"]["network"] == "mobilenet_v3_large"
    curves = (trained.parent / "curves.csv").read_text().splitlines()
    assert len(curves) == 3 and curves[0].startswith("epoch,learning_rate,train_loss,val_loss")


def test_both_engines_read_the_same_file(trained: Path) -> None:
    from landing.recognition.footprint import load_classifier

    engines = [load_classifier(trained, name) for name in ("onnx", "torch")]
    images = _coloured(6, 8).images
    first, second = (engine.scores(images) for engine in engines)
    assert engines[0].facts == engines[1].facts and first.shape == (6, 7)
    np.testing.assert_allclose(first, second, atol=1e-4)
    with pytest.raises(ValueError, match=r"\(N, 32, 32, 3\) uint8 needed"):
        engines[0].scores(images[:, :16])


def test_weights_are_float16_and_the_rest_of_training_is_kept(trained: Path, torch: Any) -> None:
    """2 bytes a weight, and what torch reads back is its own weight, rounded."""
    from landing.recognition.learning.export import TorchClassifier

    count = 4_210_008
    assert 2 * count < trained.stat().st_size < 2.2 * count
    best = torch.load(trained.parent / "best.pt", weights_only=True)
    read = TorchClassifier(trained)._module.network.state_dict()
    for name, own in best.items():
        if own.ndim >= 2:
            assert bool((read[name] == own.half().float()).all()), name
        elif own.is_floating_point():
            assert bool((read[name] == own).all()), name


def test_evaluating_by_command(
    trained: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["evaluate", str(trained), "--data", str(folder), "--quiet", "--json"]
    assert cli.main(arguments) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["pictures"] == sum(map(sum, report["confusion"]))
    assert report["top1"] == report["hits"] / report["pictures"]
    assert report["rom_mb"] == trained.stat().st_size / 1e6
    assert report["peak_ram_mb"] > 20.0 and report["image_ms"] > 0.0
    assert list(report["by_source"]) == ["d_land"]
    assert cli.main([*arguments[:-1], "--no-cost", "--engine", "torch"]) == 0
    assert "what it is, and what it was taken for" in capsys.readouterr().out


def test_rendered_pictures_are_scored_by_scene(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [("lake", 4), ("lake", 9), ("pools", 0), ("flat", 4)]
    lines = [",".join(COLUMNS)]
    for number, (scene, seed) in enumerate(rows):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((32, 32, 3), 40 * number, np.uint8))
        lines.append(f"{number}.png,lawn,pond,{scene},{seed},test,20.0,6.0,1.000")
    (tmp_path / MANIFEST).write_text("\n".join(lines) + "\n")
    arguments = ["evaluate", str(trained), "--data", str(tmp_path), "--no-cost", "--quiet"]
    assert cli.main([*arguments, "--json"]) == 0
    by_scene = json.loads(capsys.readouterr().out)["by_scene"]
    assert {name: row["pictures"] for name, row in by_scene.items()} == {
        "flat": 1, "lake": 2, "pools": 1, "scenes trained on": 3, "scenes never trained on": 1
    }  # fmt: skip
    assert cli.main(arguments) == 0
    assert "scenes never trained on" in capsys.readouterr().out


def test_classifying_by_command(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photograph = tmp_path / "photograph.png"
    cv2.imwrite(str(photograph), np.full((60, 90, 3), 90, np.uint8))
    out = tmp_path / "classes"
    arguments = ["classify", str(photograph), "--network", str(trained), "--out", str(out)]
    assert cli.main([*arguments, "--json", "--quiet"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["pictures"]
    assert sum(row["shares"].values()) == pytest.approx(1.0) and row["window_px"] == 32
    assert read_picture(out / "photograph-classes.png").shape[1] == 90
    assert cli.main([*arguments, "--window", "64"]) == 2
    assert "64 pixels do not fit into a picture of 90 x 60" in capsys.readouterr().err


@pytest.mark.parametrize("change", [lambda content: content[:-100], lambda content: b"x" + content])
def test_broken_networks_are_told_in_one_line(
    change: Any, trained: Path, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = tmp_path / "network.onnx"
    broken.write_bytes(change(trained.read_bytes()))
    weights.checksum_file(broken).write_bytes(weights.checksum_file(trained).read_bytes())
    assert cli.main(["evaluate", str(broken), "--data", str(folder), "--quiet"]) == 2
    told = capsys.readouterr().err
    assert "is cut short or changed" in told and told.count("\n") == 1
    for engine in ("onnx", "torch"):
        weights.write_network(broken, b"no network at all")
        assert cli.main(["evaluate", str(broken), "--data", str(folder), "--engine", engine]) == 2
        told = capsys.readouterr().err
        assert "is no network that can be loaded" in told and told.count("\n") == 1


def test_commands_say_what_is_missing(
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Without torch the other commands work, and this one says what to install."""
    for name in [n for n in sys.modules if n.startswith("landing.recognition.learning")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    arguments = ["train", "--data", str(folder), "--out", str(tmp_path / "out")]
    assert cli.main(arguments) == 2
    told = capsys.readouterr().err
    assert "this needs torch: install it with pip install 'touchdown[train]'" in told
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--network", "resnet51"], "unknown network 'resnet51': did you mean"),
        (["--data", "nowhere"], "'nowhere' is no folder"),
        (["--device", "tpu"], "unknown device 'tpu'"),
        (["--network", "inception_v4", "--image-size", "64"], "at least 75 pixels"),
    ],
)
def test_training_refuses(
    arguments: list[str],
    message: str,
    torch: Any,
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip("onnx")
    out = tmp_path / "out"
    command = ["train", "--out", str(out), "--data", str(folder), "--quiet", *arguments]
    assert cli.main(command) == 2
    told = capsys.readouterr().err
    assert message in told and told.count("\n") == 1 and not out.exists()
