"""The kernels that are compiled ahead."""

from pathlib import Path

import numpy as np
from numba import types

from touchdown.experiments.flight.kernels import (
    LIST,
    LIST_ZOU2024,
    compile_lines,
    read_line,
    spelled,
)


def test_a_listed_kernel_is_not_compiled_again() -> None:
    lists = (LIST, LIST_ZOU2024, Path(__file__).parents[2] / "kernels.txt")
    lines, *others = (file.read_text(encoding="utf-8").splitlines() for file in lists)
    for line in (*lines, *(line for other in others for line in other)):
        kernel, arguments = read_line(line)
        assert ", ".join(map(spelled, arguments)) == line.partition(" ")[2]
        assert len(arguments) == kernel.py_func.__code__.co_argcount, line
        for kind in arguments:
            if isinstance(kind, types.BaseNamedTuple):
                assert len(kind) == len(kind.instance_class._fields), line
    (line,) = (line for line in lines if line.startswith("controller.pid:_pid_output "))
    compile_lines([line])
    kernel = read_line(line)[0]
    known = len(kernel.overloads)
    kernel(*5 * (np.zeros(3),))
    assert 0 < len(kernel.overloads) == known


def test_a_line_of_other_arguments_is_told_and_the_rest_is_compiled() -> None:
    lines = LIST.read_text(encoding="utf-8").splitlines()
    (line,) = (line for line in lines if line.startswith("controller.pid:_pid_output "))
    place = line.partition(" ")[0]
    gone = "controller.pid:_no_such_kernel"
    compiled = read_line(line)[0]
    compiled.overloads.clear()
    stale = [f"{place} float64", f"{gone} float64", f"{place} no_such_type"]
    assert compile_lines([*stale, line]) == [place, gone, place]
    assert len(compiled.overloads) == 1
