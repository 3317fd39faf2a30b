"""Ray's interface as the engine uses it, in this process."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any


class RayError(Exception):
    pass


class RayTaskError(RayError):
    def __init__(self, cause: Exception) -> None:
        super().__init__(str(cause))
        self.cause = cause


class Reference:
    def __init__(self, value: Any = None, error: RayError | None = None) -> None:
        self.value, self.error = value, error


class Actor:
    def __init__(self, worker: Any, node: Node, ray: FakeRay, *, dies: bool) -> None:
        self.worker, self.dies, self.tasks = worker, dies, 0
        self.node, self.ray = node, ray
        self.complete = self

    def remote(self, task: Any, question: Any) -> Reference:
        self.tasks += 1
        if self.dies and self.tasks > 1:
            self.worker.close()
            return Reference(error=RayError("the actor died"))
        self.ray.here = self.node
        if self.node.sees is not None:
            question, task = self.node.sees(question), self.node.flies(task)
        try:
            return Reference(self.worker.complete(task, question))
        except Exception as error:
            return Reference(error=RayTaskError(error))


@dataclasses.dataclass(eq=False)
class Node:
    """``sees``: what a question of the driver is on a node with another file system; ``flies``: a
    task there."""

    name: str
    cpus: float = 1.0
    sees: Callable[[Any], Any] | None = None
    flies: Callable[[Any], Any] = lambda task: task

    @property
    def facts(self) -> dict[str, Any]:
        return {
            "NodeID": f"id-of-{self.name}", "Alive": True, "Resources": {"CPU": self.cpus},
            "NodeManagerHostname": self.name, "NodeManagerAddress": "10.0.0.1",
            "NodeName": "10.0.0.1",
        }  # fmt: skip


class FakeRay:
    """A cluster of two cores. The first actor dies at its second task. Actors start on the nodes in
    turn."""

    class exceptions:  # noqa: N801  as Ray spells it
        RayError, RayTaskError = RayError, RayTaskError

    util = SimpleNamespace(
        scheduling_strategies=SimpleNamespace(
            NodeAffinitySchedulingStrategy=lambda node_id, soft: node_id
        )
    )

    def __init__(self, *nodes: Node) -> None:
        self.actors: list[Actor] = []
        self.killed: list[Actor] = []
        self.all_nodes = list(nodes) or [Node("one", 2.0)]
        self.joined: list[Node] = []
        self.here = self.all_nodes[0]

    def is_initialized(self) -> bool:
        return True

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": 2.0}

    def nodes(self) -> list[dict[str, Any]]:
        return [node.facts for node in self.all_nodes]

    def get_runtime_context(self) -> Any:
        return SimpleNamespace(get_node_id=lambda: self.here.facts["NodeID"])

    def remote(self, **_options: Any) -> Any:
        ray = self

        class Remote:
            def __init__(self, code: Any) -> None:
                self.code, self.node_id = code, ""

            def options(self, scheduling_strategy: str = "", **_options: Any) -> Any:
                self.node_id = scheduling_strategy
                return self

            def remote(self, *arguments: Any) -> Any:
                if self.node_id:
                    return ray.on_node(self.node_id, self.code, *arguments)
                ray.all_nodes += ray.joined  # after the check of the nodes
                ray.joined = []
                node = ray.all_nodes[len(ray.actors) % len(ray.all_nodes)]
                actor = Actor(self.code(*arguments), node, ray, dies=not ray.actors)
                ray.actors.append(actor)
                return actor

        return Remote

    def on_node(self, node_id: str, code: Any, question: Any, *rest: Any) -> Reference:
        (node,) = [node for node in self.all_nodes if node.facts["NodeID"] == node_id]
        try:
            return Reference(code(node.sees(question) if node.sees else question, *rest))
        except Exception as error:
            return Reference(error=RayTaskError(error))

    def wait(
        self, references: list[Any], num_returns: int = 1, **_options: Any
    ) -> tuple[list[Any], list[Any]]:
        return references[:num_returns], references[num_returns:]

    def get(self, reference: Reference) -> Any:
        if reference.error is not None:
            raise reference.error
        return reference.value

    def kill(self, actor: Actor) -> None:
        actor.worker.close()
        self.killed.append(actor)
