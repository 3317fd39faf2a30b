"""Cases over trajectories and sensor logs, and over SQL."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

from fuzz.cases import Case
from fuzz.mutations import (
    NUMBERS,
    TEXTS,
    Rng,
    chance,
    damaged,
    flipped,
    mutate_tree,
    pick,
    put,
)
from fuzz.run_kinds import POSES, write_run

# ------------------------------------------------------------------------------------- trajectories


def tum_case(rng: Rng, folder: Path, shared: Path) -> Case:
    """``truth.tum``, ``estimate.tum``, ``reference.tum``."""

    def other(text: str) -> str:
        return _other_tum(rng, text)

    run = "runs/flat-gps-s0"
    logged = chance(rng, 0.3)
    write_run(rng, folder / run, tum=other)
    commands = [
        ("export", run, "--format", "tum", "--out", "rep", "--poses", pick(rng, POSES)),
        ("export", run, "--format", "tum", "--out", "rep", "--judged"),
        ("export", run, "--format", "csv", "--out", "rep"),
        ("report", "runs"),
        ("report", "runs", "--out", "rep"),
    ]
    if logged:
        source = logged_run(shared)
        for name in ("sensors.mcap", "result.json", "config.json"):
            shutil.copy(source / name, folder / run / name)
        truth = (source / "truth.tum").read_text()
        _replace(rng, folder / run / "truth.tum", other(truth))
        commands = [
            ("fly", "--replay", run, "--estimator", "gps", "--out", "out", "--quiet"),
            ("export", run, "--format", "mcap", "--out", "rep", "--poses", pick(rng, POSES[:2])),
            ("export", run, "--format", "ply", "--points", "scans", "--out", "rep.ply"),
        ]
    return Case(arguments=pick(rng, commands), writes=("rep", "rep.ply", "out"))


def _replace(rng: Rng, path: Path, data: str | bytes, share: float = 0.0) -> None:
    path.unlink(missing_ok=True)
    put(rng, path, data, share)


def _other_tum(rng: Rng, text: str) -> str:
    rows = [line.split() for line in text.split("\n") if line]
    for _ in range(int(pick(rng, (1, 1, 2, 4)))):
        if not rows:
            break
        at = int(rng.integers(len(rows)))
        column = int(rng.integers(8))
        kind = int(rng.integers(10))
        if kind < 3 and column < len(rows[at]):
            rows[at][column] = str(
                pick(rng, (*NUMBERS, "x", "1,5", "nan(1)", "-nan", "0x1p3", "١"))
            )
        elif kind == 3:
            for row in rows:
                row[column : column + 1] = [str(pick(rng, ("nan", "0", "1e300", "inf")))]
        elif kind == 4:
            rows[at] = rows[at][:column]
        elif kind == 5:
            rows[at] = rows[at] + ["1"]
        elif kind == 6:
            rows = rows[at:] + rows[:at]
        elif kind == 7:
            rows.insert(at, list(rows[at]))
        elif kind == 8:
            rows = rows[: int(pick(rng, (0, 1, 2)))]
        else:
            rows.insert(at, [str(pick(rng, ("#", "# a b", "\x1b[31m", "t,x,y,z", "\0")))])
    ends = pick(rng, ("\n", "\n", "\n", "\r\n", "\r"))
    return str(ends.join(" ".join(row) for row in rows) + pick(rng, ("\n", "", "\n\n\n")))


# -------------------------------------------------------------------------------------- sensor logs


def logged_run(shared: Path) -> Path:
    """A run of half a second with a sensor log, made once."""
    from support.export_support import ALL
    from support.replay_support import make_run

    run = shared / "logged"
    if not run.exists():
        partial = shared / f"logged.{os.getpid()}"
        make_run(partial, seconds=0.5, needs=ALL, shared=ALL)
        partial.rename(run)
    return run


def mcap_case(rng: Rng, folder: Path, shared: Path) -> Case:
    """``sensors.mcap`` of a replay or an export: damaged, or rewritten with other messages."""
    run = folder / "run"
    shutil.copytree(logged_run(shared), run)
    data = (run / "sensors.mcap").read_bytes()
    if chance(rng, 0.7):
        data = _other_log(rng, data)
    (run / "sensors.mcap").unlink()
    if chance(rng, 0.3):
        data = flipped(rng, data) if chance(rng, 0.4) else data[: int(rng.integers(len(data)))]
    put(rng, run / "sensors.mcap", data, 0.08)
    commands: tuple[tuple[str, ...], ...] = (
        *[("fly", "--replay", "run", "--estimator", "gps", "--out", "out", "--quiet")] * 2,
        ("fly", "--replay", "run", "--estimator", "optical_flow", "--out", "out", "--quiet"),
        ("fly", "--replay", "run", "--estimator", "stereo", "--out", "out", "--quiet"),
        ("export", "run", "--format", "mcap", "--out", "rep", "--images", "raw"),
        ("export", "run", "--format", "mcap", "--out", "rep"),
        ("export", "run", "--format", "ply", "--points", "scans", "--out", "rep.ply"),
        ("export", "run", "--format", "csv", "--out", "rep"),
        ("check-estimator", "gps", "--replay", "run"),
        ("check-estimator", "gps", "--replay", "run", "--json"),
    )
    return Case(arguments=pick(rng, commands), writes=("rep", "rep.ply", "out"))


def _other_log(rng: Rng, data: bytes) -> bytes:
    """The log with messages dropped, doubled, moved or changed, or with other metadata."""
    from io import BytesIO

    from mcap.reader import make_reader
    from mcap.writer import Writer

    reader = make_reader(BytesIO(data))
    messages = [list(m) for m in reader.iter_messages()]
    metadata = {m.name: dict(m.metadata) for m in make_reader(BytesIO(data)).iter_metadata()}
    for _ in range(int(pick(rng, (1, 1, 2, 4)))):
        messages = _other_messages(rng, messages)
    if chance(rng, 0.4):
        _other_metadata(rng, metadata)
    out = BytesIO()
    writer = Writer(out)
    writer.start()
    for name, content in metadata.items():
        writer.add_metadata(name, content)
    known: dict[int, int] = {}
    for schema, channel, message in messages:
        if channel.id not in known:
            number = writer.register_schema(schema.name, schema.encoding, schema.data)
            known[channel.id] = writer.register_channel(
                channel.topic, channel.message_encoding, number, channel.metadata
            )
        writer.add_message(
            known[channel.id], message.log_time, message.data, message.publish_time,
            message.sequence,
        )  # fmt: skip
    writer.finish()
    return out.getvalue()


def _other_messages(rng: Rng, messages: list[Any]) -> list[Any]:
    if not messages:
        return messages
    at = int(rng.integers(len(messages)))
    topic = messages[at][1].topic
    kind = int(rng.integers(8))
    if kind == 0:
        return [m for m in messages if m[1].topic != topic]
    if kind == 1:
        return messages[:at] + messages[at + 1 :]
    if kind == 2:
        return messages[:at] + [messages[at]] + messages[at:]
    if kind == 3:
        rng.shuffle(messages)
        return messages
    if kind == 4:
        message = messages[at][2]
        message.log_time = int(pick(rng, (0, 1, 2**63 - 1, 2**64 - 1, message.log_time // 2)))
        return messages
    if kind == 5:
        return messages[:at]
    steps = [m for m in messages if m[1].topic == "/touchdown/observation"]
    chosen = pick(rng, steps) if steps and kind == 6 else messages[at]
    chosen[2].data = _other_payload(rng, chosen[2].data)
    return messages


def _other_payload(rng: Rng, data: bytes) -> bytes:
    """CDR: a text of JSON gets another value, all else other bytes."""
    start = data.find(b"{")
    if start >= 0 and chance(rng, 0.9):
        try:
            tree = json.loads(data[start:].rstrip(b"\0"))
            mutate_tree(rng, tree)
            text = json.dumps(tree).encode() + b"\0"
            return data[:4] + len(text).to_bytes(4, "little") + text
        except ValueError:
            pass
    return flipped(rng, data) if chance(rng, 0.6) else damaged(rng, data)


def _other_metadata(rng: Rng, metadata: dict[str, dict[str, str]]) -> None:
    content = metadata.get("touchdown", {})
    key = pick(rng, content) if content else "rig"
    kind = int(rng.integers(4))
    if kind == 0:
        content.pop(key, None)
    elif kind == 1:
        metadata.pop("touchdown", None)
    elif key in content and content[key].startswith("{"):
        tree = json.loads(content[key])
        for _ in range(int(pick(rng, (1, 1, 2)))):
            mutate_tree(rng, tree)
        content[key] = json.dumps(tree)
    else:
        content[key] = "".join(c for c in str(pick(rng, TEXTS)) if not "\ud800" <= c <= "\udfff")


# ---------------------------------------------------------------------------------------------- SQL


_COLUMN = '"position_error_m.mean"'
_SQL = (
    "select * from runs",
    "describe runs",
    "summarize runs",
    f"select estimator, avg({_COLUMN}) from runs group by all",
    "select count(*) from runs where outcome = 'COMPLETED'",
    f"select seed, {_COLUMN} from runs order by seed desc limit 2",
    "with a as (select * from runs) select a.seed from a join runs using (seed)",
    "select [1, {'a': 2}], map {'x': 1}, date '2020-01-01', interval 3 days, now(), uuid()",
)
_HOSTILE = (
    "copy runs to 'runs/flat-gps-s0/result.json'", "copy (select 1) to '../../x/keep.txt'",
    "select * from read_csv('../../x/keep.txt')", "select * from read_text('/etc/passwd')",
    "select * from '/etc/passwd'", "attach 'new.db'", "install httpfs", "load httpfs",
    "create table t as select 1", "drop table runs", "drop view runs", "delete from runs",
    "insert into runs select * from runs", "export database 'dump'", "select 1; select 2", "",
    " ", ";", "--", "/*", "pragma version", "set memory_limit='1TB'",
    "set enable_external_access=true", "set threads=1000", "set temp_directory='../../x'",
    "select getenv('HOME')", "select * from glob('/*')", "select chr(27) || '[31m'",
    "select '[/x]' as \"[bold]\"", "select 'a\nb\r\tc'", "select '\\ud800'", "select 1 as \"\"",
    "select 0/0, 1e308*10, 'nan'::double, -0.0", "select x'00ff'::blob", "select null",
    "select 99999999999999999999999999999999999999", "select 1::hugeint << 126",
    "select range(100000)", "select * from range(20000)", "select repeat('x', 1000000)",
    "select * from runs, runs r2", "checkpoint", "vacuum", "begin", "rollback", "use x",
    "explain analyze select 1", "call pragma_version()", "prepare v as select ?", "execute v",
    "select $1", "select ?", "from runs", "pivot runs on scene", "select columns('.*') from runs",
    "select " + "(" * 2000 + "1" + ")" * 2000, "select " + "1+" * 3000 + "1",
    "with recursive t(n) as (select 1 union all select n + 1 from t where n < 900) from t",
    "select 1 -- \x00", "sélect 1", "SELECT '\u202e'", "select time '25:00'", "show all tables",
    "select * from duckdb_settings()", "copy runs from 'base.json'", "import database 'x'",
)  # fmt: skip


def sql_case(rng: Rng, folder: Path, _shared: Path) -> Case:
    """``query``: SQL over runs or a campaign."""
    runs = folder / "runs"
    for number in range(int(pick(rng, (1, 2)))):
        write_run(rng, runs / f"flat-gps-s{number}", changes=int(pick(rng, (0, 0, 0, 1))))
    sql = pick(rng, _HOSTILE) if chance(rng, 0.5) else pick(rng, _SQL)
    if chance(rng, 0.5):
        words = sql.split(" ")
        at = int(rng.integers(len(words)))
        new = pick(rng, (*NUMBERS, "null", "*", "runs", "(", ")", "''", '"', "select", "distinct",
                         "::int", "over ()", "cast", "[", "lambda", "seed", "::json"))  # fmt: skip
        words[at : at + chance(rng, 0.5)] = [str(new)]
        sql = " ".join(words)
    sql = sql.replace("\0", "")
    more = pick(rng, ((), (), ("--json",), ("--csv",)))
    where = pick(rng, ("runs", "runs", "runs", "runs/flat-gps-s0", ".", "gone"))
    return Case(arguments=("query", where, sql, *more))
