"""Runs of a campaign on a Ray cluster, each under the supervisor of `experiments.campaign.executor`
on the node that Ray chooses. A finished run directory comes back through Ray's object store: the
nodes share no folder. Needs the extra ``ray``."""

import dataclasses
import functools
import io
import os
import subprocess
import sys
import tarfile
import tempfile
from collections import Counter, deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from touchdown.experiments.campaign.campaign_file import Limits
from touchdown.experiments.campaign.executor import MAX_KILLED, Event, Supervisor
from touchdown.experiments.campaign.worker import Failure, Task
from touchdown.experiments.errors import UsageError

_POLL_S = 0.5
REACH_S = 20.0
"""Time for a cluster to answer; by itself Ray tries for minutes."""
_CONNECT = (
    "import sys, ray\n"
    "try:\n"
    "    ray.init(address=sys.argv[1], log_to_driver=False, configure_logging=False)\n"
    "except Exception as error:\n"
    "    sys.exit(' '.join(str(error).split()))\n"
)


@functools.cache
def _supervisor(limits: Limits) -> Supervisor:
    """That of a process of Ray, which keeps its worker from run to run."""
    return Supervisor(limits)


def fly_on_node(task: Task, limits: Limits) -> tuple[list[Event], bytes]:
    """Flies a task on a node. Returns its events and the run directory as a tar file, empty
    without one."""
    with tempfile.TemporaryDirectory(prefix="touchdown-", ignore_cleanup_errors=True) as folder:
        here = dataclasses.replace(task, folder=str(Path(folder, "flight", task.run_id)))
        events: list[Event] = []
        _supervisor(limits).complete(here, events.append)
        packed = io.BytesIO()
        if events[-1]["event"] == "finished":
            with tarfile.open(fileobj=packed, mode="w") as tar:
                tar.add(Path(here.folder, task.run_id), arcname=task.run_id)
        return events, packed.getvalue()


class RayEngine:
    """``address`` is that of a cluster, such as ``auto``; None takes that of the environment
    (``RAY_ADDRESS``), or else starts a cluster on this machine."""

    name = "ray"

    def __init__(self, jobs: int | None, address: str | None) -> None:
        try:
            import ray
        except ImportError:
            raise UsageError(
                "--engine ray needs Ray: pip install -c constraints.txt -e '.[ray]', or use "
                "--engine local"
            ) from None
        address = address or os.environ.get("RAY_ADDRESS") or "local"
        if not ray.is_initialized():
            if address != "local":
                check_address(address)
            try:
                ray.init(address=address, log_to_driver=False, configure_logging=False)
            except (ConnectionError, ValueError, RuntimeError) as error:
                raise UsageError(f"--ray-address {address}: {error}") from error
        self._ray: Any = ray
        self.jobs = jobs or max(1, int(ray.cluster_resources().get("CPU", 1)))

    def run(self, tasks: Sequence[Task], limits: Limits, notify: Callable[[Event], None]) -> None:
        """As of `Engine`."""
        ray = self._ray
        # Modules are found on the nodes as in this process.
        path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
        fly = ray.remote(num_cpus=1, max_retries=0, runtime_env={"env_vars": {"PYTHONPATH": path}})(
            fly_on_node
        )
        waiting, flying = deque(tasks), dict[Any, Task]()
        losses: Counter[str] = Counter()
        try:
            while waiting or flying:
                while waiting and len(flying) < self.jobs:
                    task = waiting.popleft()
                    notify({"event": "started", "run_id": task.run_id})
                    flying[fly.remote(task, limits)] = task
                for reference in ray.wait(list(flying), num_returns=1, timeout=_POLL_S)[0]:
                    task = flying.pop(reference)
                    try:
                        events, packed = ray.get(reference)
                    except ray.exceptions.RayTaskError:
                        raise  # a defect of the program
                    except ray.exceptions.RayError:
                        losses[task.run_id] += 1
                        event = _lost(task, losses[task.run_id])
                        if event["event"] == "retry":
                            waiting.append(task)
                        notify(event)
                        continue
                    if packed:
                        with tarfile.open(fileobj=io.BytesIO(packed)) as tar:
                            tar.extractall(task.folder, filter="data")
                    for event in events[1:]:  # after started
                        notify(event)
        finally:
            for reference in flying:
                ray.cancel(reference, force=True)


def _lost(task: Task, losses: int) -> Event:
    """What follows when a node, or Ray's process on it, is gone with a run."""
    error = "the Ray worker was lost"
    if losses <= MAX_KILLED:
        return {"event": "retry", "run_id": task.run_id, "error": error}
    failure = Failure("killed", error)
    return {"event": "failed", "run_id": task.run_id, "failure": failure, "attempts": losses}


def check_address(address: str) -> None:
    """Raises UsageError, one line, unless a Ray cluster answers at ``address`` within `REACH_S`.
    Another process tries, since Ray ends its own where there is none."""
    reason = "no Ray cluster answers there"
    try:
        subprocess.run(
            [sys.executable, "-c", _CONNECT, address],
            capture_output=True, check=True, text=True, errors="replace", timeout=REACH_S,
        )  # fmt: skip
        return
    except subprocess.CalledProcessError as error:
        if error.returncode == 1:
            reason = error.stderr.strip().splitlines()[-1].rstrip(".") or reason
    except subprocess.TimeoutExpired:
        pass
    raise UsageError(
        f"--ray-address {address}: {reason}; start a cluster there with 'ray start --head', or "
        "leave the option out"
    )
