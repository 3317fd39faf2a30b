"""What a worker of fake flights takes on this machine."""

import pytest

from touchdown.experiments.campaign.results_table import load_rows

from support.campaign_flights import axes, fly, make_plan


@pytest.fixture(scope="session")
def base_gb(tmp_path_factory: pytest.TempPathFactory) -> float:
    """Memory of a worker that has imported what a flight needs, as limits count it, GB."""
    folder = tmp_path_factory.mktemp("base")
    text = axes(scene=["flat"], estimator=["fake:good"], seeds="0-1")  # rows are written, too
    fly(make_plan(folder, text), folder / "out")
    return max(float(row["worker_memory_mb"]) for row in load_rows(folder / "out")) / 1e3
