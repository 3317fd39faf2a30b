"""Ray's interface as the engine uses it, in this process."""

from __future__ import annotations

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
    def __init__(self, worker: Any, *, dies: bool) -> None:
        self.worker, self.dies, self.tasks = worker, dies, 0
        self.complete = self

    def remote(self, task: Any) -> Reference:
        self.tasks += 1
        if self.dies and self.tasks > 1:
            self.worker.close()
            return Reference(error=RayError("the actor died"))
        try:
            return Reference(self.worker.complete(task))
        except Exception as error:
            return Reference(error=RayTaskError(error))


class FakeRay:
    """A cluster of two cores. The first actor dies at its second task."""

    class exceptions:  # noqa: N801  as Ray spells it
        RayError, RayTaskError = RayError, RayTaskError

    def __init__(self) -> None:
        self.actors: list[Actor] = []
        self.killed: list[Actor] = []

    def is_initialized(self) -> bool:
        return True

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": 2.0}

    def remote(self, **_options: Any) -> Any:
        ray = self

        class Remote:
            def __init__(self, worker_class: Any) -> None:
                self.worker_class = worker_class

            def options(self, **_options: Any) -> Any:
                return self

            def remote(self, *arguments: Any) -> Actor:
                ray.actors.append(Actor(self.worker_class(*arguments), dies=not ray.actors))
                return ray.actors[-1]

        return Remote

    def wait(self, references: list[Any], **_options: Any) -> tuple[list[Any], list[Any]]:
        return references[:1], references[1:]

    def get(self, reference: Reference) -> Any:
        if reference.error is not None:
            raise reference.error
        return reference.value

    def kill(self, actor: Actor) -> None:
        actor.worker.close()
        self.killed.append(actor)
