"""Changes one statement of an algorithm at a time and runs the tests that should see it.

    python tests/mutations/run.py [--only PATTERN] [--jobs 2] [--again] [--list]

The work tree is copied, once for each job; only the copies change. Results go to a log, and a call
goes on where an earlier one stopped: a result holds as long as the mutation, the file that it
changes and the tests that it names stay as they were. States are KILLED (a test failed), TIMED OUT
(counts as killed), SURVIVED, NOT FOUND (the statement is not there, or more than once) and CRASHED
(the changed program does not run, or there is no test). The exit code is 1 after an error, a
survivor that gives no reason, or less than 95 % killed.
"""

import argparse
import fcntl
import hashlib
import json
import queue
import re
import signal
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from mutations.places import SOURCES, Mutation, load
from mutations.trees import KILLED, SURVIVED, TIMED_OUT, Outcome, Tree

NEEDED = 0.95


class Log:
    """Outcomes by the hash of what decides them, one JSON object a line."""

    def __init__(self, path: Path, again: bool) -> None:
        self._path = path
        if again:
            path.unlink(missing_ok=True)
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        entries = [json.loads(line) for line in lines]
        self._known = {entry.pop("key"): Outcome(**entry) for entry in entries}

    def get(self, key: str) -> Outcome | None:
        return self._known.get(key)

    def add(self, key: str, outcome: Outcome) -> None:
        self._known[key] = outcome
        with self._path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps({"key": key, **vars(outcome)}) + "\n")


def _hash(parts: Iterable[object], paths: Iterable[Path]) -> str:
    """Of words and of the Python files of paths, which may be folders."""
    digest = hashlib.sha256(repr(list(parts)).encode())
    for path in paths:
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(file.read_bytes() if file.exists() else b"")
    return digest.hexdigest()


def _test_files(project: Path, tests: Iterable[str]) -> list[Path]:
    return sorted({project / test.partition("::")[0] for test in tests})


class Suite:
    """Mutations of a project, run in copies of it below ``folder``."""

    def __init__(
        self, project: Path, folder: Path, jobs: int, timeout_s: float, again: bool = False
    ) -> None:
        self._project = project
        self._trees = [Tree(folder / f"tree-{number}", timeout_s) for number in range(jobs)]
        self._log = Log(folder / "log.jsonl", again)
        self._filled = False

    def run(self, mutations: list[Mutation]) -> list[Outcome]:
        """One outcome for each mutation; those of unchanged tests that fail, if any do."""
        failed = self._unchanged(mutations)
        if failed:
            return failed
        listed = [m for m in mutations if m.survives and not m.tests]
        keys = {m.name: self.key(m) for m in mutations if m not in listed}
        outcomes = self._all(
            [(keys[m.name], lambda tree, m=m: tree.test(m)) for m in mutations if m not in listed]
        )
        return [*outcomes, *(Outcome(m.name, SURVIVED) for m in listed)]

    def _unchanged(self, mutations: list[Mutation]) -> list[Outcome]:
        """Tests that fail, or are none, without a mutation: they could not tell anything."""
        tests = sorted({test for mutation in mutations for test in mutation.tests})
        files = sorted({test.partition("::")[0] for test in tests})
        sources = (self._project / SOURCES).glob("*/**/*.py")
        everything = _hash((), [*sources, *_test_files(self._project, tests)])
        tasks = []
        for file in files:
            named = [test for test in tests if test.partition("::")[0] == file]
            key = _hash([everything, *named], ())
            tasks.append((key, lambda tree, f=file, n=named: tree.pytest(f"{f}, unchanged", n)))
        return [outcome for outcome in self._all(tasks) if outcome.state != SURVIVED]

    def key(self, mutation: Mutation) -> str:
        """Of a result in the log."""
        paths = [self._project / mutation.path, *_test_files(self._project, mutation.tests)]
        parts = (mutation.function, mutation.statement, mutation.becomes, mutation.tests)
        return _hash(parts, paths)

    def _all(self, tasks: list[tuple[str, Callable[[Tree], Outcome]]]) -> list[Outcome]:
        """Outcomes from the log, the others from the trees, in parallel."""
        known = [(key, self._log.get(key)) for key, _ in tasks]
        outcomes = [outcome for _, outcome in known if outcome is not None]
        left = [task for task, (_, outcome) in zip(tasks, known, strict=True) if outcome is None]
        if left and not self._filled:
            for tree in self._trees:
                tree.fill(self._project)
            self._filled = True
        free: queue.SimpleQueue[Tree] = queue.SimpleQueue()
        for tree in self._trees:
            free.put(tree)

        def run(task: tuple[str, Callable[[Tree], Outcome]]) -> tuple[str, Outcome]:
            tree = free.get()
            try:
                return task[0], task[1](tree)
            finally:
                free.put(tree)

        with ThreadPoolExecutor(len(self._trees)) as pool:
            try:
                for future in as_completed([pool.submit(run, task) for task in left]):
                    key, outcome = future.result()
                    self._log.add(key, outcome)
                    outcomes.append(outcome)
                    print(_line(outcome), flush=True)
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                for tree in self._trees:
                    tree.stop()
                raise
        return outcomes


def _line(outcome: Outcome) -> str:
    return f"{outcome.state:9} {outcome.name} ({outcome.seconds:.0f} s) {outcome.seen_by}".rstrip()


def report(mutations: list[Mutation], outcomes: list[Outcome]) -> bool:
    """Prints the summary; whether the suite is as it should be."""
    states = {outcome.name: outcome for outcome in outcomes}
    if any(m.name not in states for m in mutations):
        print("tests that fail without any mutation:")
        print(*(f"  {_line(outcome)}" for outcome in outcomes), sep="\n")
        return False
    killed = {m for m in mutations if states[m.name].state in (KILLED, TIMED_OUT)}
    for area in dict.fromkeys(m.area for m in mutations):
        members = [m for m in mutations if m.area == area]
        print(f"{area:20} {len(killed & set(members)):3} of {len(members):3} killed")
    for m in mutations:
        if m not in killed:
            print(f"{_line(states[m.name])}{m.survives and f': {m.survives}'}")
        elif m.survives:
            print(f"{m.name} is killed; its reason to survive can go")
    fraction = len(killed) / max(1, len(mutations))
    minutes = sum(outcome.seconds for outcome in outcomes) / 60
    print(
        f"{len(killed)} of {len(mutations)} killed ({fraction:.1%}), {minutes:.0f} min of one core"
    )
    excused = all(
        m in killed or (m.survives and states[m.name].state == SURVIVED) for m in mutations
    )
    return excused and fraction >= NEEDED


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--only", default="", help="mutations whose name matches this expression")
    parser.add_argument("--jobs", type=int, default=2, help="that run at the same time")
    parser.add_argument("--timeout-s", type=float, default=600.0, help="for the tests of one")
    parser.add_argument("--again", action="store_true", help="forget earlier results")
    parser.add_argument("--list", action="store_true", help="names and places only")
    parser.add_argument("--project", type=Path, default=Path(__file__).parents[2])
    options = parser.parse_args(arguments)
    project = options.project.resolve()
    mutations = [m for m in load(project / "tests/mutations") if re.search(options.only, m.name)]
    if options.list:
        print(
            *(f"{m.name}\n    {m.function}\n    {m.statement.strip()}" for m in mutations), sep="\n"
        )
        return 0
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # tests that run are ended, too
    folder = project / "runs/mutation"
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            print(f"another run works in {folder}", file=sys.stderr)
            return 2
        suite = Suite(project, folder, options.jobs, options.timeout_s, options.again)
        return 0 if report(mutations, suite.run(mutations)) else 1


if __name__ == "__main__":
    sys.exit(main())
