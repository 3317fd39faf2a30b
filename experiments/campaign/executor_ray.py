"""Runs of a campaign on a Ray cluster: an actor a worker, each with the supervisor of
`experiments.campaign.executor`. Needs ``pip install touchdown[ray]`` and a file system that all
nodes share."""

from __future__ import annotations

import os
import sys
from collections import deque
from collections.abc import Callable, Sequence
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
from touchdown.experiments.campaign.worker import Task
from touchdown.experiments.errors import UsageError

_POLL_S = 0.5


class SupervisedWorker:
    """The actor: flies one task at a time in a process of its own on the node where it lives."""

    def __init__(self, limits: Limits, directory: str) -> None:
        self._supervisor = Supervisor(limits, local_environment(), directory)

    def complete(self, task: Task) -> list[Event]:
        events: list[Event] = []
        self._supervisor.complete(task, events.append)
        return events

    def close(self) -> None:
        self._supervisor.close()


class RayEngine:
    """``address`` is that of a cluster, such as ``auto``; None starts one on this machine."""

    name = "ray"

    def __init__(self, jobs: int | None, address: str | None) -> None:
        try:
            import ray
        except ImportError:
            raise UsageError(
                "--engine ray needs Ray: pip install 'touchdown[ray]', or use --engine local"
            ) from None
        try:
            if not ray.is_initialized():
                ray.init(address=address, log_to_driver=False, configure_logging=False)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise UsageError(f"--ray-address {address}: {error}") from error
        self._ray: Any = ray
        self.jobs = jobs or max(1, int(ray.cluster_resources().get("CPU", 1)))

    def run(self, tasks: Sequence[Task], limits: Limits, tell: Callable[[Event], None]) -> None:
        ray = self._ray
        waiting, kills = deque(tasks), dict.fromkeys((task.run_id for task in tasks), 0)
        flying: dict[Any, tuple[Any, Task]] = {}
        idle = [self._actor(limits) for _ in range(min(self.jobs, len(tasks)))]
        actors = list(idle)
        try:
            while waiting or flying:
                while idle and waiting:
                    actor, task = idle.pop(), waiting.popleft()
                    tell({"event": "started", "run_id": task.run_id})
                    flying[actor.complete.remote(task)] = (actor, task)
                ended, _ = ray.wait(list(flying), num_returns=1, timeout=_POLL_S)
                for reference in ended:
                    actor, task = flying.pop(reference)
                    try:
                        for event in ray.get(reference):
                            if event["event"] != "started":
                                tell(event)
                    except ray.exceptions.RayTaskError as error:
                        if isinstance(error.cause, EngineStoppedError):
                            raise EngineStoppedError(str(error.cause)) from error
                        raise
                    except ray.exceptions.RayError:
                        actors.remove(actor)
                        actor = self._actor(limits)
                        actors.append(actor)
                        kills[task.run_id] += 1
                        self._lost(task, kills[task.run_id], waiting, tell)
                    idle.append(actor)
        finally:
            for actor in actors:
                ray.kill(actor)

    def _actor(self, limits: Limits) -> Any:
        remote = self._ray.remote(num_cpus=1, max_restarts=0, max_concurrency=1)(SupervisedWorker)
        return remote.options(
            runtime_env={"env_vars": {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}}
        ).remote(limits, os.getcwd())

    def _lost(
        self, task: Task, kills: int, waiting: deque[Task], tell: Callable[[Event], None]
    ) -> None:
        """An actor, or its node, is gone: its run is flown again."""
        error = "the Ray worker was lost"
        if kills <= MAX_KILLED:
            waiting.append(task)
            tell({"event": "retry", "run_id": task.run_id, "error": error})
        else:
            write_failure(task, "killed", error, "", kills)
            tell({"event": "failed", "run_id": task.run_id, "error": error})
