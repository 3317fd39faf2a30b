"""Ray's interface as the engine uses it, in this process. What goes to a node and comes back is
pickled, and a node does not see the folder ``hidden``."""

import contextlib
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any


class RayError(Exception):
    pass


class RayTaskError(RayError):
    pass


class FakeRay:
    """A cluster of two cores. ``lost``: numbers of the tasks whose node dies when they are done;
    ``on_the_way`` changes what comes back."""

    class exceptions:  # noqa: N801  as Ray spells it
        RayError, RayTaskError = RayError, RayTaskError

    def __init__(
        self,
        hidden: Path,
        lost: tuple[int, ...] = (),
        on_the_way: Callable[[Any], Any] = lambda answer: answer,
    ) -> None:
        self.hidden, self.lost, self.on_the_way = hidden, lost, on_the_way
        self.asked = 0
        self.answers: list[Any] = []
        self.cancelled: list[Any] = []

    def is_initialized(self) -> bool:
        return True

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": 2.0}

    def remote(self, **options: Any) -> Any:
        assert options["max_retries"] == 0, "the engine counts the losses"
        return lambda function: _Remote(self, function)

    def wait(self, references: list[Any], **_options: Any) -> tuple[list[Any], list[Any]]:
        return references[:1], references[1:]

    def get(self, reference: Any) -> Any:
        answer = pickle.loads(self.answers[reference])
        if isinstance(answer, Exception):
            raise answer
        return self.on_the_way(answer)

    def cancel(self, reference: Any, *, force: bool) -> None:
        assert force
        self.cancelled.append(reference)

    @contextlib.contextmanager
    def away(self) -> Iterator[None]:
        """The folder is another place while a node works."""
        elsewhere = self.hidden.with_name("elsewhere")
        self.hidden.rename(elsewhere)
        try:
            yield
            assert not self.hidden.exists(), "a node has written there"
        finally:
            elsewhere.rename(self.hidden)


class _Remote:
    def __init__(self, ray: FakeRay, function: Any) -> None:
        self.ray, self.function = ray, function

    def remote(self, *arguments: Any) -> int:
        ray = self.ray
        given = pickle.loads(pickle.dumps(arguments))
        with ray.away():
            try:
                answer = self.function(*given)
            except Exception as error:
                answer = RayTaskError(str(error))
        if ray.asked in ray.lost:
            answer = RayError("the node died")
        ray.asked += 1
        ray.answers.append(pickle.dumps(answer))
        return len(ray.answers) - 1
