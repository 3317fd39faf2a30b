"""`touchdown query`: closed to all but the runs, one line for what is wrong, JSON for any type."""

import csv
import hashlib
import io
import json
import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.campaign import results_table
from touchdown.experiments.campaign.results_table import load_rows, refresh
from touchdown.experiments.cli import main as cli
from touchdown.experiments.errors import UsageError
from touchdown.experiments.reporting.sql import connect

from support.command import Says
from support.report_support import write_run

Query = Callable[..., Any]


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two runs; the current directory is that of the tests' files."""
    monkeypatch.chdir(tmp_path)
    for seed in (0, 1):
        write_run(tmp_path / "runs", "crossroad", "livo", seed)
    return tmp_path / "runs"


@pytest.fixture
def ask(runs: Path, says: Says) -> Query:
    """Rows of a query as JSON."""

    def rows(sql: str) -> list[dict[str, Any]]:
        printed = says(0, "query", runs, sql, "--json").out
        found: list[dict[str, Any]] = json.loads(printed, parse_constant=pytest.fail)["rows"]
        return found

    return rows


@pytest.fixture
def refused(runs: Path, says: Says) -> Query:
    """The one line of a refused query."""

    def line(sql: str, *options: str) -> str:
        captured = says(2, "query", runs, sql, *options)
        assert captured.out == "" and captured.err.count("\n") == 1
        assert captured.err.startswith(f"touchdown: error: query of '{runs}': ") or options
        assert "Error:" not in captured.err and "Exception" not in captured.err
        return str(captured.err)

    return line


def _fingerprint(folder: Path) -> dict[str, str]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(p): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


TARGET = "runs/crossroad-livo-s0/result.json"


@pytest.mark.parametrize("sql", [
    f"copy runs to '{TARGET}'", f"explain analyze copy runs to '{TARGET}'",
    "copy runs from 'secret.csv'", "export database 'copied'", "import database 'copied'",
    "attach 'other.db'", "attach ':memory:' as other", "from 'secret.csv'",
    "from read_csv('secret.csv')", "select * from read_text('secret.csv')",
    "select * from read_blob('/dev/zero')",
    "select * from read_parquet('https://example.invalid/x.parquet')", "select * from glob('*')",
    "from sniff_csv('secret.csv')", "from query('copy runs to ''x.csv''')", "install httpfs",
    "load httpfs", "load './evil.so'", "set enable_external_access = true",
    "reset enable_external_access", "set lock_configuration = false", "pragma enable_profiling",
    "pragma database_list",
    "call enable_logging(storage := 'file', storage_path := 'log')",
    "create persistent secret key (type s3)", "create table other as select 1", "delete from runs",
    "drop table runs", "checkpoint", "from secret", "from Path",
])  # fmt: skip
def test_a_query_reads_the_runs_alone(runs: Path, refused: Query, sql: str) -> None:
    (runs.parent / "secret.csv").write_text("word\nabracadabra\n")
    before = _fingerprint(runs.parent)
    assert "abracadabra" not in refused(sql) and _fingerprint(runs.parent) == before


def test_a_connection_for_python_is_closed_too(runs: Path) -> None:
    import duckdb

    connection = connect(runs)
    assert connection.execute("select count(*) from runs").fetchall() == [(2,)]
    with pytest.raises(duckdb.PermissionException):
        connection.execute(f"copy runs to '{TARGET}'")
    with pytest.raises(duckdb.InvalidInputException):
        connection.execute("set enable_external_access = true")


@pytest.mark.parametrize(("sql", "words"), [
    ("select nonsense from runs", "nonsense"), ("selec 1", "selec"),
    ("", "it is empty; give one, such as 'select run_id, outcome from runs'"),
    (" -- nothing", "it is empty"), ("select 1; select 2", "2 statements; give one at a time"),
    ("select '\x1b[31mred'::int", r"\x1b[31mred"),
    ("select 'left\u202eright'::int", r"left\u202eright"),
    ("from range(2000000)", "more than 1000000 rows; add `limit`"),
    ("select list(a.range) from range(100000) a, range(100000) b", "of memory"),
    ("select repeat('x', 3000000000)", "more than 1 GiB of memory; select, join"),
    ("select repeat('x', 5000) from range(2000000)", "more than 1 GiB of memory"),
    ("copy runs to 'x.csv'", "the kind COPY does not read runs; give one that does: SELECT"),
    ("from 'x.csv'", "a query reads `runs` alone: redirect the output of --csv or --json"),
    ("select error('one\n\nLINE 1: two\nlines') from runs", ": one"),
])  # fmt: skip
def test_a_wrong_query_is_one_line_with_a_remedy(refused: Query, sql: str, words: str) -> None:
    line = refused(sql)
    assert words in line and line.strip().isprintable()


def test_columns_of_one_name_are_no_json_object(refused: Query, says: Says, runs: Path) -> None:
    assert "two columns are called 'a'" in refused("select 1 a, 2 a", "--json")
    assert says(0, "query", runs, "select 1 a, 2 a", "--csv").out == "a,a\n1,2\n"


def test_values_of_any_type_are_json(ask: Query) -> None:
    (row,) = ask(
        "select timestamptz '2026-01-02 03:04:05.5+01' moment,"
        " timestamp '2026-01-02 03:04:05' local,"
        " date '2026-01-02' today, time '03:04:05' clock, interval '1 day 2 hours' span,"
        " 1.25 exact, 'nan'::double nan, '-inf'::double low,"
        " uuid '00000000-0000-0000-0000-00000000000a' id,"
        " '\\x00\\xFF'::blob raw, 170141183460469231731687303715884105727 large,"
        " 18446744073709551615::ubigint wide, true yes, null nothing,"
        " [1.5, 2.5] exacts, ['nan'::double, 1] numbers, {'a': 1, 'when': date '2026-01-02'} part,"
        " map {'key': 7} pairs, 'b'::enum('a', 'b') choice, '101'::bit bits, [1, 2]::int[2] fixed,"
        " [{'t': timestamptz '2026-01-02 00:00:00+00'}] nested, union_value(k := 1) either,"
        " '{\"a\": 1}'::json doc, date '0044-03-15 (BC)' ides, timestamp 'infinity' never"
    )
    assert row == {
        "moment": "2026-01-02 02:04:05.5+00", "local": "2026-01-02 03:04:05", "today": "2026-01-02",
        "clock": "03:04:05", "span": "1 day 02:00:00", "exact": 1.25, "nan": None, "low": None,
        "id": "00000000-0000-0000-0000-00000000000a", "raw": r"\x00\xFF", "large": 2**127 - 1,
        "wide": 2**64 - 1, "yes": True, "nothing": None, "exacts": [1.5, 2.5],
        "numbers": [None, 1.0], "part": {"a": 1, "when": "2026-01-02"}, "pairs": {"key": 7},
        "choice": "b", "bits": "101", "fixed": [1, 2], "nested": [{"t": "2026-01-02 00:00:00+00"}],
        "either": {"k": 1}, "doc": {"a": 1}, "ides": "0044-03-15 (BC)", "never": "infinity",
    }  # fmt: skip


@pytest.mark.parametrize("sql", [
    "describe runs", "summarize runs", "show tables", "explain select 1", "values (1)",
    "with x as (select 1 as a) select a from x -- the end", "from runs select seed;",
    "pivot runs on scene using count(*) group by seed",
])  # fmt: skip
def test_statements_that_read(ask: Query, sql: str) -> None:
    assert ask(sql)
    assert ask("select sum(seed + 9007199254740993) as s from runs") == [{"s": 2**54 + 3}]


def test_csv_keeps_what_it_quotes(runs: Path, says: Says) -> None:
    sql = "select 'a,\"b\"' as x, chr(27) as y"
    rows = list(csv.reader(io.StringIO(says(0, "query", runs, sql, "--csv").out)))
    assert rows == [["x", "y"], ['a,"b"', "\x1b"]]


def test_a_table_is_literal(runs: Path, says: Says) -> None:
    sql = "select '[bold]x[/y]' as \"[/z]\", ':smile:' as s, chr(27) || chr(8238) as c"
    out = says(0, "query", runs, sql).out
    assert all(word in out for word in ("[bold]x[/y]", "[/z]", ":smile:", r"\x1b\u202e"))
    assert "\x1b" not in out


def test_ctrl_c_ends_an_endless_query(runs: Path) -> None:
    ended = threading.Event()

    def press() -> None:
        while not ended.wait(1.0):  # Python drops one that comes while it frees an object
            os.kill(os.getpid(), signal.SIGINT)

    before = signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # processes of xdist have none
    threading.Thread(target=press).start()
    endless = "select sum(a.range % 7) from range(100000000000) a"
    try:
        assert cli.main(["query", str(runs), endless]) == 130
    finally:
        ended.set()
        signal.signal(signal.SIGINT, before)


def test_a_run_is_named_by_its_directory_from_inside_of_it(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = next(runs.iterdir())
    monkeypatch.chdir(run)
    (row,) = load_rows(Path())
    assert row["run_id"] == run.name and results_table.run_path(Path(), row) == Path()


@pytest.fixture
def campaign(runs: Path) -> Path:
    """A campaign with two rows and no results.parquet yet."""
    home = runs.parent / "campaign"
    for row in load_rows(runs):
        folder = home / "runs" / row["run_id"]
        folder.mkdir(parents=True)
        results_table.write_table([row], folder / "row.parquet")
        (folder / "result.json").write_text("{}")
    (home / "campaign.json").write_text("{}")
    return home


def test_a_read_only_campaign_is_read_without_a_cache(
    campaign: Path, monkeypatch: pytest.MonkeyPatch, says: Says
) -> None:
    def refuse(*_arguments: object, **_options: object) -> None:
        raise OSError(30, "Read-only file system", str(campaign / "results.parquet"))

    before = _fingerprint(campaign)
    monkeypatch.setattr(results_table, "write_table", refuse)
    printed = says(0, "query", campaign, "select count(*) as n from runs", "--json").out
    assert json.loads(printed)["rows"] == [{"n": 2}]
    assert _fingerprint(campaign) == before
    with pytest.raises(UsageError, match=r"results.parquet' cannot be written: Read-only"):
        refresh(campaign, must_write=True)
