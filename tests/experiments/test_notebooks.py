"""The notebooks run, and are committed with outputs as a fresh run gives them."""

import os
import sys
from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")

FOLDER = Path(__file__).parents[2] / "docs" / "notebooks"
LOW = (
    '"survey.height_m": 8.0, "survey.min_height_m": 8.0, "survey.leg_length_m": 6.0, '
    '"survey.duration_s": 4.0, "landing.site_recheck": False, '
    '"camera.width": 320, "camera.height": 180'
)
NAMES = sorted(path.stem for path in FOLDER.glob("*.ipynb"))


def outputs(notebook: "nbformat.NotebookNode") -> list[list[str]]:
    """Kinds of what each cell of code gives: text, or the type of a picture."""
    return [
        sorted({kind for out in cell.outputs for kind in out.get("data", {"text": 0})})
        for cell in notebook.cells
        if cell.cell_type == "code"
    ]


@pytest.mark.parametrize("name", [
    "first_flight",
    *(pytest.param(name, marks=pytest.mark.slow) for name in NAMES if name != "first_flight"),
])  # fmt: skip
def test_a_notebook_runs_and_gives_what_it_shows(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first flight is flown low, with small images and on the truth: no estimator works."""
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", 4)
    shown = outputs(notebook)
    if name == "first_flight":
        cell = next(cell for cell in notebook.cells if "seed=3," in cell.source)
        cell.source = cell.source.replace("seed=3,", 'seed=3, estimator="oracle",')
        assert '"record": False' in cell.source
        cell.source = cell.source.replace('"record": False', f'"record": False, {LOW}')
    paths = [str(Path(sys.executable).parent), os.environ["PATH"]]
    monkeypatch.setenv("PATH", os.pathsep.join(paths))
    monkeypatch.setenv("PYTHONPATH", str(FOLDER.parents[1] / "src"))
    kernel = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(
        notebook, timeout=600, kernel_name="python3", resources=kernel
    ).execute()
    assert outputs(notebook) == shown and ["image/png"] in [
        [k for k in kinds if k != "text/plain"] for kinds in shown
    ]


def test_notebooks_are_small() -> None:
    assert sum((FOLDER / f"{name}.ipynb").stat().st_size for name in NAMES) < 1_500_000
