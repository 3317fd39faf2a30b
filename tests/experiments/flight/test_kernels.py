"""The kernels that are compiled ahead."""

from pathlib import Path

import numpy as np

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
        assert ", ".join(map(spelled, read_line(line)[1])) == line.partition(" ")[2]
    (line,) = (line for line in lines if line.startswith("controller.pid:_pid_output "))
    compile_lines([line])
    kernel = read_line(line)[0]
    known = len(kernel.overloads)
    kernel(*5 * (np.zeros(3),))
    assert 0 < len(kernel.overloads) == known
