"""Runs all kinds of fuzzed cases, in parts that may be interrupted, and prints a table.

``python tests/fuzz/run_all.py --out DIR`` goes on where an earlier call with that folder stopped.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from fuzz import fleet
from fuzz.kinds import KINDS

FIRST = 10_000
WHOLE, FIRST_WHOLE = 300, 50_000


def numbers_of(kind: str, count: int | None = None, first: int = FIRST) -> range:
    """Numbers of the long run of a kind."""
    return range(first, first + (KINDS[kind].long if count is None else count))


def whole_commands(out: Path, count: int = WHOLE) -> fleet.Verdicts:
    """Runs cases of all kinds in turn as commands in processes of their own."""
    chosen = list(itertools.islice(itertools.cycle(KINDS), count))
    done = {(v["kind"], v["number"]): v for v in fleet.read(out)}
    for kind in KINDS:
        mine = [FIRST_WHOLE + at for at, name in enumerate(chosen) if name == kind]
        part = out.with_name(f"{out.stem}-{kind}.jsonl")
        for verdict in fleet.run_kind(kind, mine, part, whole=True):
            done[kind, verdict["number"]] = verdict
    return list(done.values())


def main() -> int:
    """Returns 1 where there are findings."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of verdicts")
    parser.add_argument("--kinds", default=",".join(KINDS), help="separated by commas")
    parser.add_argument("--count", type=int, help="cases of each kind  [1500 or more]")
    parser.add_argument("--first", type=int, default=FIRST, help="number of the first case")
    parser.add_argument("--no-whole", action="store_true", help="no separate commands")
    parser.add_argument("--again", action="store_true", help="the findings that are there")
    parser.add_argument("--only-table", action="store_true", help="of what is there")
    given = parser.parse_args()
    found: fleet.Verdicts = []
    for kind in given.kinds.split(","):
        out = given.out / f"{kind}.jsonl"
        if given.again:
            fleet.forget_findings(out)
        if given.only_table:
            found += fleet.read(out)
        else:
            found += fleet.run_kind(kind, numbers_of(kind, given.count, given.first), out)
            print(fleet.table(found).split("\n")[-2], flush=True)
    print(fleet.table(found))
    if not given.no_whole and not given.only_table:
        whole = whole_commands(given.out / "whole.jsonl")
        print(f"\nwhole commands\n{fleet.table(whole)}")
        found += whole
    for cause, same in fleet.causes(found).items():
        print(f"\n{len(same)} x {cause}\n  {fleet.finding_text(same[0])}")
    return 1 if fleet.causes(found) else 0


if __name__ == "__main__":
    sys.exit(main())
