"""Runs of a campaign on a Ray cluster: an actor a worker, each with the supervisor of
`experiments.campaign.executor`. Needs the extra ``ray`` and a file system that all nodes share,
which is proved before the first flight and at each task of an actor."""

from __future__ import annotations

import os
import sys
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from touchdown.experiments.campaign.directory import write_failure
from touchdown.experiments.campaign.executor import (
    MAX_KILLED,
    EngineStoppedError,
    Event,
    Supervisor,
    local_environment,
)
from touchdown.experiments.campaign.plan import Limits
from touchdown.experiments.campaign.ray_share import (
    VISIBLE_S,
    NotSharedError,
    Question,
    answer,
    asked,
    check_address,
    check_nodes,
    refusal,
    this_node,
)
from touchdown.experiments.campaign.worker import Task
from touchdown.experiments.errors import UsageError

_POLL_S = 0.5


class SupervisedWorker:
    """The actor: flies one task at a time in a process of its own on the node where it lives."""

    def __init__(self, limits: Limits, directory: str) -> None:
        self._supervisor = Supervisor(limits, local_environment(), directory)

    def complete(self, task: Task, question: Question) -> list[Event]:
        """Flies a task. Raises NotSharedError where its row would stay on this node."""
        import ray

        node_id, name = this_node(ray)
        if reason := answer(question, node_id):
            raise NotSharedError(refusal(name, reason))
        events: list[Event] = []
        self._supervisor.complete(task, events.append)
        return events

    def close(self) -> None:
        self._supervisor.close()


class RayEngine:
    """``address`` is that of a cluster, such as ``auto``; None takes that of the environment
    (``RAY_ADDRESS``), or else starts a cluster on this machine."""

    name = "ray"
    patience_s = VISIBLE_S

    def __init__(self, jobs: int | None, address: str | None) -> None:
        try:
            import ray
        except ImportError:
            raise UsageError(
                "--engine ray needs Ray: pip install -c constraints.txt -e '.[ray]', or use "
                "--engine local"
            ) from None
        address = address or os.environ.get("RAY_ADDRESS") or "local"
        if address != "local" and not ray.is_initialized():
            check_address(address)
        try:
            if not ray.is_initialized():
                ray.init(address=address, log_to_driver=False, configure_logging=False)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise UsageError(f"--ray-address {address}: {error}") from error
        self._ray: Any = ray
        self.jobs = jobs or max(1, int(ray.cluster_resources().get("CPU", 1)))

    def run(self, tasks: Sequence[Task], limits: Limits, notify: Callable[[Event], None]) -> None:
        """As of `Engine`. Raises UsageError naming a node that does not share the directory."""
        ray = self._ray
        with asked(Path(tasks[0].directory)) as question:
            check_nodes(ray, question, _environment())
            self._fly(tasks, limits, notify, question)

    def _fly(
        self,
        tasks: Sequence[Task],
        limits: Limits,
        notify: Callable[[Event], None],
        question: Question,
    ) -> None:
        ray = self._ray
        waiting, kills = deque(tasks), dict.fromkeys((task.run_id for task in tasks), 0)
        flying: dict[Any, tuple[Any, Task]] = {}
        idle = [self._actor(limits) for _ in range(min(self.jobs, len(tasks)))]
        actors = list(idle)
        try:
            while waiting or flying:
                while idle and waiting:
                    actor, task = idle.pop(), waiting.popleft()
                    notify({"event": "started", "run_id": task.run_id})
                    flying[actor.complete.remote(task, question)] = (actor, task)
                ended, _ = ray.wait(list(flying), num_returns=1, timeout=_POLL_S)
                for reference in ended:
                    actor, task = flying.pop(reference)
                    try:
                        for event in ray.get(reference):
                            if event["event"] != "started":
                                notify(event)
                    except ray.exceptions.RayTaskError as error:
                        if isinstance(error.cause, EngineStoppedError):
                            raise EngineStoppedError(str(error.cause)) from error
                        if isinstance(error.cause, NotSharedError):
                            raise UsageError(str(error.cause)) from error
                        raise
                    except ray.exceptions.RayError:
                        actors.remove(actor)
                        actor = self._actor(limits)
                        actors.append(actor)
                        kills[task.run_id] += 1
                        self._lost(task, kills[task.run_id], waiting, notify)
                    idle.append(actor)
        finally:
            for actor in actors:
                ray.kill(actor)

    def _actor(self, limits: Limits) -> Any:
        remote = self._ray.remote(num_cpus=1, max_restarts=0, max_concurrency=1)(SupervisedWorker)
        return remote.options(runtime_env={"env_vars": _environment()}).remote(limits, os.getcwd())

    def _lost(
        self, task: Task, kills: int, waiting: deque[Task], notify: Callable[[Event], None]
    ) -> None:
        """An actor, or its node, is gone: its run is flown again."""
        error = "the Ray worker was lost"
        if kills <= MAX_KILLED:
            waiting.append(task)
            notify({"event": "retry", "run_id": task.run_id, "error": error})
        else:
            write_failure(task, "killed", error, "", kills)
            notify({"event": "failed", "run_id": task.run_id, "error": error})


def _environment() -> dict[str, str]:
    """Variables of processes on the nodes: modules are found as in this process."""
    return {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
