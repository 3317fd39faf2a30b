"""Cases over trajectories and sensor logs, and over SQL."""

import contextlib
import json
import os
import shutil
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from touchdown.experiments.io import ros2_messages as ros
from touchdown.experiments.io.sensor_log import IMAGE_TOPICS, OBSERVATION_TOPIC, SCAN_TOPIC

from fuzz import picture_formats as pictures
from fuzz.cases import Case
from fuzz.mutations import (
    NUMBERS,
    TEXTS,
    Rng,
    chance,
    damaged,
    flipped,
    mutate_rows,
    mutate_tree,
    pick,
    put,
)
from fuzz.run_kinds import POSES, write_run
from support.sensor_logs import Log, read_log, write_log


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


def _replace(rng: Rng, path: Path, data: str | bytes, fraction: float = 0.0) -> None:
    path.unlink(missing_ok=True)
    put(rng, path, data, fraction)


def _other_tum(rng: Rng, text: str) -> str:
    rows = [line.split() for line in text.split("\n") if line]
    words = "x 1,5 nan(1) -nan 0x1p3 ١ # #a \x1b[31m t,x,y \0"
    odd = (*NUMBERS, *words.split(" "))
    for _ in range(int(pick(rng, (1, 1, 2, 4)))):
        mutate_rows(rng, rows, odd)
    if chance(rng, 0.1):
        column, word = int(rng.integers(8)), str(pick(rng, ("nan", "0", "1e300", "inf")))
        for row in rows:
            row[column : column + 1] = [word]
    ends = pick(rng, ("\n", "\n", "\n", "\r\n", "\r"))
    return str(ends.join(" ".join(row) for row in rows) + pick(rng, ("\n", "", "\n\n\n")))


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
    file = run / "sensors.mcap"
    if chance(rng, 0.7):
        log = read_log(file)
        for _ in range(int(pick(rng, (1, 1, 2, 4)))):
            pick(rng, _CHANGES)(rng, log)
        write_log(file, log)
    data = file.read_bytes()
    file.unlink()
    if chance(rng, 0.3):
        ways = (flipped, lambda _rng, whole: whole[: int(rng.integers(len(whole)))], _absurd_size)
        data = pick(rng, ways)(rng, data)
    put(rng, file, data, 0.08)
    replay = ("fly", "--replay", "run", "--quiet", "--out", "out", "--estimator")
    commands: tuple[tuple[str, ...], ...] = (
        *[(*replay, name) for name in ("gps", "gps", "optical_flow", "stereo")],
        ("export", "run", "--format", "mcap", "--out", "rep", "--images", "raw"),
        ("export", "run", "--format", "mcap", "--out", "rep"),
        ("export", "run", "--format", "ply", "--points", "scans", "--out", "rep.ply"),
        ("export", "run", "--format", "csv", "--out", "rep"),
        ("check-estimator", "gps", "--replay", "run"),
        ("check-estimator", "gps", "--replay", "run", "--json"),
    )
    return Case(arguments=pick(rng, commands), writes=("rep", "rep.ply", "out"))


def _absurd_size(rng: Rng, data: bytes) -> bytes:
    """A record, or the content of a chunk, says that it is larger than any memory."""
    changed, places, at = bytearray(data), [], 8
    while at + 9 <= len(data) - 8:
        places += [at + 1, at + 25] if data[at] == 0x06 else [at + 1]
        at += 9 + struct.unpack_from("<Q", data, at + 1)[0]
    if places:
        struct.pack_into("<Q", changed, pick(rng, places), pick(rng, (2**31, 2**33, 2**62)))
    return bytes(changed)


def _of(rng: Rng, log: Log, topic: str = "") -> int:
    """The number of a message of a topic, or of any."""
    found = [at for at, entry in enumerate(log.entries) if topic in ("", entry.topic)]
    return int(pick(rng, found or range(len(log.entries))))


def _drop(rng: Rng, log: Log) -> None:
    at = _of(rng, log)
    gone = log.entries[at].topic
    whole = chance(rng, 0.5)
    log.entries = [
        entry for n, entry in enumerate(log.entries) if (entry.topic != gone if whole else n != at)
    ] or log.entries


def _reorder(rng: Rng, log: Log) -> None:
    at = _of(rng, log)
    shuffled = list(log.entries)
    rng.shuffle(shuffled)  # type: ignore[arg-type]
    doubled = [*log.entries[:at], log.entries[at], *log.entries[at:]]
    log.entries = pick(rng, (shuffled, doubled, log.entries[: at + 1]))


def _retime(rng: Rng, log: Log) -> None:
    at = _of(rng, log)
    time = pick(rng, (0, 1, 2**63 - 1, 2**64 - 1, log.entries[at].time // 2))
    log.entries[at] = replace(log.entries[at], time=int(time))


def _change_data(rng: Rng, log: Log) -> None:
    """CDR: a text of JSON gets another value, all else other bytes or those of another message."""
    at = _of(rng, log, pick(rng, ("", OBSERVATION_TOPIC)))
    data = log.entries[at].data
    start = data.find(b"{")
    if start >= 0 and chance(rng, 0.9):
        with contextlib.suppress(ValueError):
            tree = json.loads(data[start:].rstrip(b"\0"))
            mutate_tree(rng, tree)
            data = bytes(ros.serialized(ros.text_message(json.dumps(tree))))
    else:
        other = log.entries[_of(rng, log)].data
        data = pick(rng, (flipped(rng, data), damaged(rng, data), other))
    log.entries[at] = replace(log.entries[at], data=data)


def _change_image(rng: Rng, log: Log) -> None:
    file = pick(rng, (pictures.png(rng), pictures.jpeg(rng), b""))
    message = ros.compressed_image_message(0, "camera", np.frombuffer(file, np.uint8))
    at = _of(rng, log, IMAGE_TOPICS[0])
    log.entries[at] = replace(log.entries[at], data=bytes(ros.serialized(message)))


def _change_scan(rng: Rng, log: Log) -> None:
    """Another number of points, or points that are NaN, infinite or far."""
    at = _of(rng, log, SCAN_TOPIC)
    data = bytearray(log.entries[at].data)
    if chance(rng, 0.5):
        struct.pack_into("<I", data, min(16, len(data) - 4), pick(rng, (0, 1, 2**31, 2**32 - 1)))
    else:
        odd = np.full(len(data) // 8, pick(rng, (np.nan, np.inf, 1e30)), "<f4").tobytes()
        data[20 : 20 + len(odd)] = odd
    log.entries[at] = replace(log.entries[at], data=bytes(data))


def _change_metadata(rng: Rng, log: Log) -> None:
    key = pick(rng, (*log.metadata, "rig"))
    kind = int(rng.integers(4))
    if kind == 0:
        log.metadata.pop(key, None)
    elif kind == 1:
        log.metadata.clear()
    elif log.metadata.get(key, "").startswith("{"):
        tree = json.loads(log.metadata[key])
        mutate_tree(rng, tree)
        log.metadata[key] = json.dumps(tree)
    else:
        log.metadata[key] = str(pick(rng, TEXTS)).encode("utf-8", "ignore").decode()


_CHANGES: tuple[Callable[[Rng, Log], None], ...] = (
    _drop, _reorder, _retime, _change_data, _change_data, _change_image, _change_scan,
    _change_metadata,
)  # fmt: skip


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
    "copy (select 1) to '../../x/keep.txt'", "select * from '/etc/passwd'", "drop view runs",
    "insert into runs select * from runs", " ", ";", "--", "/*", "pragma version",
    "set memory_limit='1TB'", "set threads=1000", "set temp_directory='../../x'",
    "select getenv('HOME')", "select chr(27) || '[31m'",
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
    "select * from duckdb_settings()",
)  # fmt: skip
"""Beside the statements of tests/experiments/cli/test_query.py."""


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
