"""A worker of a campaign that flies ten times holds as much memory as after its second flight."""

from pathlib import Path

import pytest

from touchdown.experiments.campaign.executor import LocalEngine
from touchdown.experiments.campaign.results_table import load_rows
from touchdown.experiments.campaign.session import fly_campaign

from support.campaign_flights import make_plan

FLIGHTS = """
name = "memory of a worker"
mode = "fly"
record = "none"
[axes]
scene = ["crossroad"]
seeds = "0-4"
light = ["night", "day"]
[base]
profile = "field"
survey = { legs = 1, leg_length_m = 12.0, duration_s = 5.0, height_m = 22.0 }
camera = { width = 212, height = 120 }
[limits]
retries = 0
"""


@pytest.mark.slow
def test_the_tenth_flight_leaves_as_much_as_the_second(tmp_path: Path) -> None:
    fly_campaign(make_plan(tmp_path, FLIGHTS), tmp_path / "out", LocalEngine(1))
    rows = sorted(load_rows(tmp_path / "out"), key=lambda row: str(row["started_utc"]))
    held_mb = [row["worker_memory_mb"] for row in rows]
    print(*(f"{mb:.0f}" for mb in held_mb), "MB")
    assert len(held_mb) == 10
    assert held_mb[-1] <= 1.1 * held_mb[1]
