"""A campaign's directory at an address, such as ``s3://bucket/many``: each run is flown into a copy
on this machine, then sent. Addresses are those of fsspec."""

import hashlib
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from touchdown.experiments.campaign.directory import PLAN_FILE, SOURCE_FILE, Shard
from touchdown.experiments.campaign.executor import Engine, Event
from touchdown.experiments.campaign.plan import Plan
from touchdown.experiments.campaign.results_table import (
    CAMPAIGN_RUN_FILES,
    FAILED,
    RESULTS_FILE,
    ROW_FILE,
    RUNS,
    finished_ids,
    refresh,
)
from touchdown.experiments.campaign.session import Watcher, fly_campaign, summary
from touchdown.experiments.campaign.worker import REAL_RUNNER, Task
from touchdown.experiments.errors import UsageError, reason_of
from touchdown.experiments.io.run_directory import whole_file
from touchdown.experiments.io.untrusted import inside


class Remote:
    """The directory at ``address``, and its copy ``directory``. Raises UsageError for an address
    that fsspec does not know, and where it cannot be reached."""

    def __init__(self, address: str) -> None:
        self.address = address
        digest = hashlib.sha256(address.encode()).hexdigest()[:12]
        caches = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()
        self.directory = caches / "touchdown" / "campaigns" / digest
        with self._said():
            from fsspec.core import url_to_fs

            self._files, self._root = url_to_fs(address)
        self._there: set[str] = set()

    def fetch(self) -> None:
        """Copies what is only there, of a run the row last."""
        with self._said():
            self._there = self._listed()
        for name in sorted(self._there, key=lambda name: name.endswith(ROW_FILE)):
            if _is_of_campaign(name) and not (path := inside(self.directory, name)).exists():
                with self._said(), whole_file(path) as partial:
                    self._files.get_file(f"{self._root}/{name}", str(partial))

    def send(self) -> None:
        """Sends what is only here: runs, recordings of runs flown once more, and the files of the
        campaign."""
        for run_id in sorted(finished_ids(self.directory)):
            self.send_run(run_id)
        failed = [f"{FAILED}/{path.name}" for path in self.directory.glob(f"{FAILED}/*.json")]
        for name in (SOURCE_FILE, PLAN_FILE, RESULTS_FILE, *failed):
            self.send_file(name)

    def send_run(self, run_id: str) -> None:
        """Sends a run, the row last: without it the run is not there. Of one that is there, sends
        the files that are not."""
        folder = f"{RUNS}/{run_id}"
        names = {f"{folder}/{path.name}" for path in (self.directory / folder).iterdir()}
        row = f"{folder}/{ROW_FILE}"
        for name in sorted(names - self._there if row in self._there else names, key=row.__eq__):
            self.send_file(name)
        if (failed := f"{FAILED}/{run_id}.json") in self._there:
            with self._said():
                self._files.rm_file(f"{self._root}/{failed}")
            self._there.discard(failed)

    def send_file(self, name: str) -> None:
        """Sends a file of the copy, if there is one."""
        if (path := self.directory / name).is_file():
            with self._said():
                self._files.makedirs(f"{self._root}/{name}".rpartition("/")[0], exist_ok=True)
                self._files.put_file(str(path), f"{self._root}/{name}")
            self._there.add(name)

    def _listed(self) -> set[str]:
        if not self._files.exists(self._root):
            return set()
        return {path.removeprefix(f"{self._root}/") for path in self._files.find(self._root)}

    @contextmanager
    def _said(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # each file system has its own
            raise UsageError(f"--out {self.address}: {reason_of(error)}") from error


def _is_of_campaign(name: str) -> bool:
    match name.split("/"):
        case [name]:
            return name in (PLAN_FILE, SOURCE_FILE)
        case [folder, name]:
            return folder == FAILED and name.endswith(".json")
        case [folder, _, name]:
            return folder == RUNS and name in CAMPAIGN_RUN_FILES
    return False


class Sending(Watcher):
    """Sends each run as it is finished, and tells ``watcher``."""

    def __init__(self, remote: Remote, watcher: Watcher) -> None:
        self._remote, self._watcher = remote, watcher

    def start(self, todo: Sequence[Task], done: int, jobs: int) -> None:
        for name in (SOURCE_FILE, PLAN_FILE):  # runs without them are no campaign
            self._remote.send_file(name)
        self._watcher.start(todo, done, jobs)

    def see(self, event: Event) -> None:
        if event["event"] == "finished":
            self._remote.send_run(event["run_id"])
        self._watcher.see(event)

    def end(self) -> None:
        self._watcher.end()


def fly_to_address(
    plan: Plan,
    address: str,
    engine: Engine,
    *,
    shard: Shard | None = None,
    watcher: Watcher | None = None,
    runner: str = REAL_RUNNER,
) -> dict[str, Any]:
    """`fly_campaign` with a directory at an address. Stopped at any moment and called again, here
    or on another machine, it goes on with the runs that are neither here nor there."""
    remote = Remote(address)
    remote.fetch()
    sending = Sending(remote, watcher or Watcher())
    try:
        flown = fly_campaign(
            plan, remote.directory, engine, shard=shard, watcher=sending, runner=runner
        )
    finally:
        remote.send()
    remote.fetch()  # what other machines have sent meanwhile
    refresh(remote.directory, must_write=True)
    remote.send()
    return summary(remote.directory) | {"missing": flown["missing"]}
