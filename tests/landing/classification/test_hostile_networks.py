"""Untrusted networks and checkpoints: checked before and after they are loaded."""

import json
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.landing.classification import weights
from touchdown.landing.classification.engine import OnnxClassifier
from touchdown.landing.classification.labels import D_LAND
from touchdown.landing.classification.weights import INPUT, OUTPUT, NetworkFacts, write_network
from touchdown.sim.files import child

from support.ground_class_support import write_colour_network
from support.hostile_files import sparse

onnx = pytest.importorskip("onnx")
TensorProto, helper, numpy_helper = onnx.TensorProto, onnx.helper, onnx.numpy_helper
SIZE = 16
FACTS = NetworkFacts(network="n", labels="d_land", image_size=SIZE, classes=D_LAND).properties()


def network(
    path: Path, nodes: list[Any], initial: list[Any], facts: dict[str, str] | None = None,
    inputs: str = INPUT,
) -> Path:  # fmt: skip
    """An ONNX file of ``nodes`` from ``inputs`` (N, 3, 16, 16) to the scores."""
    graph = helper.make_graph(
        nodes,
        "g",
        [helper.make_tensor_value_info(inputs, TensorProto.FLOAT, ["batch", 3, SIZE, SIZE])],
        [helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, None)],
        initial,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, FACTS if facts is None else facts)
    write_network(path, model.SerializeToString())
    return path


def _mean(rows: int, columns: int, values: Any = None) -> tuple[list[Any], list[Any]]:
    """Nodes of a mean over the image and a matrix (rows, columns)."""
    matrix = np.ones((rows, columns), np.float32) if values is None else values
    nodes = [
        helper.make_node("GlobalAveragePool", [INPUT], ["pooled"]),
        helper.make_node("Flatten", ["pooled"], ["flat"]),
        helper.make_node("MatMul", ["flat", "matrix"], [OUTPUT]),
    ]
    return nodes, [numpy_helper.from_array(matrix, "matrix")]


def refused(path: Path, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        OnnxClassifier(path)
    text = str(caught.value)
    assert "\n" not in text and "ONNXRuntimeError" not in text and text.isprintable()


@pytest.mark.parametrize(("change", "message"), [
    ({"image_size": "1000000000"}, "image_size 1000000000 in its metadata, not 16 to 512"),
    ({"image_size": "-1"}, "image_size -1"),
    ({"image_size": "1" * 5000}, "no usable metadata"),
    ({"network": "[/x]\x1b[31m"}, "name of its network"),
    ({"network": "n" * 1000}, "name of its network"),
    ({"least_probability": "nan"}, "limits in its metadata"),
    ({"least_probability": "7"}, "limits in its metadata"),
    ({"least_energy": "nan"}, "limits in its metadata"),
    ({"classes": "cat dog"}, "not .1, 2.|classes that are not"),
])  # fmt: skip
def test_metadata_have_limits(tmp_path: Path, change: dict[str, str], message: str) -> None:
    refused(network(tmp_path / "n.onnx", *_mean(3, 7), FACTS | change), message)


def test_a_sound_network_of_this_kind_is_loaded(tmp_path: Path) -> None:
    classifier = OnnxClassifier(network(tmp_path / "n.onnx", *_mean(3, 7)))
    options = classifier._session.get_session_options()
    assert options.graph_optimization_level.name == "ORT_ENABLE_ALL"  # int8 is slow without
    assert classifier.scores(np.zeros((2, SIZE, SIZE, 3), np.uint8)).shape == (2, 7)


def test_networks_of_other_shapes_are_refused(tmp_path: Path) -> None:
    refused(network(tmp_path / "a.onnx", *_mean(3, 5)), r"shape \(1, 5\), not \(1, 7\)")
    refused(network(tmp_path / "b.onnx", *_mean(9, 7)), "cannot be loaded|cannot classify 1 x")
    nan = np.full((3, 7), np.nan, np.float32)
    refused(network(tmp_path / "c.onnx", *_mean(3, 7, nan)), "gives scores that are no numbers")
    nodes = [helper.make_node("Identity", ["x"], [OUTPUT])]
    refused(network(tmp_path / "d.onnx", nodes, [], inputs="x"), r"has the inputs \['x'\]")
    nodes = [helper.make_node("Made_up", [INPUT], [OUTPUT])]
    refused(network(tmp_path / "e.onnx", nodes, []), "cannot be loaded as a network")
    nodes, initial = _mean(3, 7)
    last = nodes[-1]
    del last.output[:]
    last.output.append("mean_of_one")
    one = helper.make_tensor("one", 7, [2], [1, 7])
    check = helper.make_node("Reshape", ["mean_of_one", "one"], [OUTPUT])
    refused(network(tmp_path / "f.onnx", [*nodes, check], [*initial, one]), "cannot classify 2 x")


def test_weights_outside_of_the_file_are_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither beside the file, nor in the current directory, nor anywhere else."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "secret.bin").write_bytes(np.ones((3, 7), np.float32).tobytes())
    for place in ("secret.bin", f"../{tmp_path.name}/secret.bin", str(tmp_path / "secret.bin")):
        nodes, _ = _mean(3, 7)
        outside = TensorProto(name="matrix", data_type=TensorProto.FLOAT, dims=[3, 7])
        outside.data_location = TensorProto.EXTERNAL
        outside.external_data.add(key="location", value=place)
        path = network(tmp_path / "n.onnx", nodes, [outside])
        refused(path, "its weights lie in another file; save it as one file")
        pytest.importorskip("torch")
        from touchdown.landing.classification.learning.checkpoint import read_weights

        with pytest.raises(ValueError, match="in another file; save it as one file"):
            read_weights(path)


def test_weights_of_a_branch_outside_of_the_file_are_not_read(tmp_path: Path) -> None:
    outside = TensorProto(name="matrix", data_type=TensorProto.FLOAT, dims=[3, 7])
    outside.data_location = TensorProto.EXTERNAL
    outside.external_data.add(key="location", value="secret.bin")
    given = [helper.make_tensor_value_info("y", TensorProto.FLOAT, [3, 7])]
    copied = helper.make_node("Identity", ["matrix"], ["y"])
    branch = helper.make_graph([copied], "s", [], given, [outside])
    nodes, _ = _mean(3, 7)
    nodes.insert(0, helper.make_node("If", ["c"], ["w"], then_branch=branch, else_branch=branch))
    nodes[-1].input[1] = "w"
    path = network(tmp_path / "n.onnx", nodes, [numpy_helper.from_array(np.array(True), "c")])
    refused(path, "its weights lie in another file; save it as one file")


def test_a_graph_that_fills_the_memory_is_given_up(tmp_path: Path) -> None:
    nodes, initial = _mean(3, 7)
    shape = np.array([40_000, 40_000, 10], np.int64)
    nodes = [
        helper.make_node("ConstantOfShape", ["shape"], ["ones"]),
        helper.make_node("ReduceSum", ["ones"], ["total"], keepdims=0),
        *nodes[:2],
        helper.make_node("MatMul", ["flat", "matrix"], ["small"]),
        helper.make_node("Add", ["small", "total"], [OUTPUT]),
    ]
    initial.append(numpy_helper.from_array(shape, "shape"))
    refused(network(tmp_path / "n.onnx", nodes, initial),
            "cannot be loaded|cannot classify 1 x|GiB of memory")  # fmt: skip


def test_a_network_that_takes_too_long_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(child, "WAIT_S", 0.0)
    refused(write_colour_network(tmp_path / "n.onnx"), "needs more than 0 s to classify")


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path) -> None:
    path = sparse(tmp_path / "n.onnx", b"onnx", 2 << 30)
    weights.checksum_file(path).write_text("0  n.onnx\n")
    refused(path, "has 2048 MiB, more than 1024 MiB")


class _Code:
    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (Path("was_here"),))


class _Trainer:
    history: list[dict[str, float]]
    best_epoch: int

    def __init__(self, part: Any) -> None:
        self._part = part

    def take_state(self, state: dict[str, Any]) -> None:
        self._part.load_state_dict(state["network"])


def _course(**changes: Any) -> str:
    row = {"epoch": 1, "val_macro_f1": 0.5}
    return json.dumps({"identity": {"epochs": [3]}, "history": [row], "best_epoch": 0} | changes)


def _refused_checkpoint(folder: Path, message: str) -> None:
    from torch import nn

    from touchdown.landing.classification.learning.checkpoint import restore

    with pytest.raises(ValueError, match=message) as caught:
        restore(_Trainer(nn.Linear(2, 2)), folder, {"epochs": [3]})
    assert "\n" not in str(caught.value) and not Path("was_here").exists()


@pytest.mark.parametrize(("content", "message"), [
    ([1, 2, 3], "something else than weights"),
    ({"a": _Code()}, "something else than weights, which is not loaded"),
    ({"a": 1}, "is not the checkpoint of a training"),
    ({"course": "[" * 100_000}, "is not the checkpoint of a training"),
    ({"course": 7}, "is not the checkpoint"),
    ({"course": _course(history="x")}, "is not the checkpoint"),
    ({"course": _course(history=[{}])}, "is not the checkpoint"),
    ({"course": _course(best_epoch=9)}, "is not the checkpoint"),
    ({"course": _course(identity=7)}, "is not the checkpoint"),
    ({"course": _course(identity={"epochs": "x" * 9999})}, r"epochs 'x.*', not .3.; name another"),
    ({"course": _course(identity={})}, "with epochs None, not .3."),
    ({"course": _course()}, "does not hold the state of this training"),
    ({"course": _course(), "network": {"weight": 1.0}}, "does not hold the state of this"),
    ({"course": _course(), "network": {"weight": "wide"}}, "does not hold the state of this"),
])  # fmt: skip
def test_checkpoints_that_hold_something_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: Any, message: str
) -> None:
    torch = pytest.importorskip("torch")
    monkeypatch.chdir(tmp_path)
    if isinstance(content, dict) and content.get("network") == {"weight": "wide"}:
        content = {**content, "network": {"weight": torch.zeros(1).expand(100_000, 100_000)}}
    torch.save(content, tmp_path / "last.pt")
    _refused_checkpoint(tmp_path, message)


def test_checkpoints_that_are_no_archives_of_torch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch = pytest.importorskip("torch")
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "last.pt"
    path.write_bytes(pickle.dumps(_Code()))
    _refused_checkpoint(tmp_path, "cannot be read as a checkpoint: it is none")
    torch.save({"a": torch.zeros(3)}, path)
    with zipfile.ZipFile(path) as archive:
        entry = archive.infolist()[0]
    data = bytearray(path.read_bytes())
    # the size of the first entry in the archive's directory, in 32 bits
    at = data.rfind(b"PK\x01\x02", 0, data.find(entry.filename.encode(), len(data) // 2))
    data[at + 24 : at + 28] = (4_294_967_294).to_bytes(4, "little")
    path.write_bytes(bytes(data))
    _refused_checkpoint(tmp_path, "more than 4096 MiB")


def test_no_training_begins_with_weights_that_are_no_numbers(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    from touchdown.landing.classification.learning.checkpoint import begin_with
    from touchdown.landing.classification.learning.export import export_network
    from touchdown.landing.classification.networks.registry import build_network

    name = "mobilenet_v3_large"
    module = build_network(name, 7, 32)
    facts = NetworkFacts(network=name, labels="d_land", image_size=32, classes=D_LAND)
    with torch.no_grad():
        next(module.parameters()).fill_(float("nan"))
    export_network(tmp_path / "n.onnx", module, 1.0, facts)
    with pytest.raises(ValueError, match="weights that are NaN or infinite; train anew"):
        begin_with(module, name, D_LAND, tmp_path / "n.onnx")
