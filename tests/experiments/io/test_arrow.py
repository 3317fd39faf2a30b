"""Arrow leaves pandas alone."""

import pytest

from support.command import lines_of


def test_tables_of_runs_do_not_load_pandas() -> None:
    pytest.importorskip("pandas")
    table = "table_of([{'run_id': 'a', 'seed': 1}])"
    start = "import sys; from touchdown.experiments.campaign.results_table import table_of"
    script = f"{start}; t = {table}; print('pandas' in sys.modules); print(len(t.to_pandas()))"
    assert lines_of(script) == ["False", "1"]
