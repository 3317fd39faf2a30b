"""Loads a network's file and classifies images in a child process first, since what a graph needs
does not follow from its size."""

import functools
import re
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.sim.files.child import run_limited

INPUT = "pictures"
_REMEDY = "give a file that `touchdown train` wrote"
NOWHERE = "/nonexistent"
"""Folder in which ONNX Runtime looks for weights outside of a network's file"""
_LARGEST = 4096
"""pixels; the range that is allowed is checked elsewhere"""


@functools.lru_cache(maxsize=32)
def check_loads(path: Path, _sha256: str) -> None:
    """Raises ValueError for a network's file that cannot be loaded or used, or takes more than the
    limits of `sim.files.child`. A content is tried once."""
    reason = run_limited(lambda: _fault_of_file(path), path, "to classify an image", _REMEDY)
    if reason:
        raise ValueError(f"'{path}' {reason}")


def _fault_of_file(path: Path) -> str:
    """The reason why a network's file cannot be loaded or used, "" for none."""
    import onnxruntime

    try:
        session = onnxruntime.InferenceSession(
            path.read_bytes(), session_options(1), providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # onnxruntime's errors share no base class
        return f"cannot be loaded as a network: {plain_reason(error)}"
    return _fault_of(session)


def session_options(threads: int, external: bool = False) -> Any:
    """Returns the options of a session; weights outside of the file are read if ``external``."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    options.enable_cpu_mem_arena = False  # which would keep 90 MB between decisions
    if not external:
        options.add_session_config_entry(
            "session.model_external_initializers_file_folder_path", NOWHERE
        )
    return options


def plain_reason(error: Exception) -> str:
    """The first line of an error of ONNX Runtime without its codes."""
    lines = str(error).splitlines() or [type(error).__name__]
    words = lines[0].split(" : ", 3)
    text = words[3] if len(words) == 4 and words[0].startswith("[ONNX") else lines[0]
    if "xternal data" in text or NOWHERE in text:
        return "its weights lie in another file; save it as one file"
    if "::" in text:  # a place in the sources of ONNX Runtime, then a condition, then the reason
        text = text.rpartition(" was false. ")[2] if " was false. " in text else "it is damaged"
    return re.sub(r"\[\w+\] ?", "", text).strip()  # names of classes of ONNX Runtime


def _fault_of(session: Any) -> str:
    """The reason why a loaded network cannot be used, "" for none."""
    inputs, outputs = session.get_inputs(), session.get_outputs()
    names = [entry.name for entry in inputs]
    if names != [INPUT] or len(outputs) != 1:
        return f"has the inputs {names[:4]} and {len(outputs)} outputs, not '{INPUT}' and one"
    facts = session.get_modelmeta().custom_metadata_map
    try:
        size, classes = int(facts["image_size"]), len(facts["classes"].split())
    except (KeyError, ValueError):
        return ""  # the metadata are checked elsewhere
    if not 1 <= size <= _LARGEST:
        return ""
    for count in (1, 2):  # a network may be made for one number of images alone
        images = np.zeros((count, 3, size, size), np.float32)
        try:
            scores = np.asarray(session.run(None, {INPUT: images})[0])
        except Exception as error:  # onnxruntime's errors share no base class
            return f"cannot classify {count} x {size} x {size} pixels: {plain_reason(error)}"
        if scores.shape != (count, classes) or scores.dtype.kind != "f":
            return f"gives scores of shape {scores.shape}, not ({count}, {classes})"
        if not np.isfinite(scores).all():
            return "gives scores that are no numbers"
    return ""
