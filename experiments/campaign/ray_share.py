"""Proof that the nodes of a Ray cluster see the campaign's directory: the driver writes a random
text there, every node reads it and writes it back."""

from __future__ import annotations

import contextlib
import os
import secrets
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from touchdown.experiments.campaign.directory import SHARE_FILE
from touchdown.experiments.errors import UsageError

NODE_START_S = 120.0
"""for a node to start a Python process and load the package"""
VISIBLE_S = 30.0
"""for a file to be seen on other machines: NFS keeps names and attributes for some seconds"""
_POLL_S = 0.2


class NotSharedError(RuntimeError):
    """This node does not see the directory of the campaign."""


@dataclass(frozen=True, slots=True)
class Question:
    """The proof asked of a node: ``file`` holds ``text``."""

    file: str
    text: str
    directory: str
    """the driver's working directory, which workers start in"""

    def answer_file(self, node_id: str) -> Path:
        """The file into which the node writes the text."""
        return Path(f"{self.file}-{node_id}")


@contextlib.contextmanager
def asked(directory: Path) -> Iterator[Question]:
    """Writes the question into ``directory``; all its files are gone at the end."""
    file = directory / f"{SHARE_FILE}-{secrets.token_hex(8)}"
    question = Question(str(file), secrets.token_hex(16), os.getcwd())
    try:
        file.write_text(question.text, encoding="ascii")
        yield question
    except OSError as error:
        if error.filename != str(file):
            raise
        raise UsageError(f"--out {directory}: {error.strerror}") from error
    finally:
        for path in directory.glob(f"{file.name}*"):
            path.unlink(missing_ok=True)


def answer(question: Question, node_id: str) -> str:
    """Answers on a node. Returns the reason why it cannot, or an empty text."""
    try:
        found = _read_when_visible(Path(question.file), question.text, 0.0)
        if found != question.text:
            return f"does not see '{Path(question.file).parent}' of the machine that started it"
        question.answer_file(node_id).write_text(question.text, encoding="ascii")
    except OSError as error:
        return f"cannot write into '{Path(question.file).parent}' ({error.strerror})"
    if not Path(question.directory).is_dir():
        return f"has no directory '{question.directory}', in which the campaign was started"
    return ""


def refusal(node: str, reason: str) -> str:
    """The message for a node that does not share the directory."""
    return (
        f"the Ray node {node} {reason}; mount the same file system there, name an --out that all "
        "nodes share, or take the node out of the cluster"
    )


def check_nodes(ray: Any, question: Question, environment: Mapping[str, str]) -> None:
    """Raises UsageError naming the first node that offers processors and does not share the
    directory."""
    pinned_to = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy

    def ask(node: Mapping[str, Any]) -> Any:
        remote = ray.remote(num_cpus=0, max_retries=0)(answer)
        return remote.options(
            scheduling_strategy=pinned_to(node_id=node["NodeID"], soft=False),
            runtime_env={"env_vars": dict(environment)},
        ).remote(question, node["NodeID"])

    nodes = _working_nodes(ray)
    asks = [(node, ask(node)) for node in nodes]
    replies = [reply for _node, reply in asks]
    ready, _ = ray.wait(replies, num_returns=len(replies), timeout=NODE_START_S)
    for node, reply in asks:
        if reply not in ready:
            raise UsageError(
                f"the Ray node {node_name(node)} has not answered for {NODE_START_S:g} s; free it, "
                "or take it out of the cluster"
            )
        _check_reply(ray, node, reply, question)


def _check_reply(ray: Any, node: Mapping[str, Any], reply: Any, question: Question) -> None:
    try:
        reason = ray.get(reply)
    except ray.exceptions.RayError as error:
        if node["NodeID"] not in [other["NodeID"] for other in _working_nodes(ray)]:
            return  # it has left in the meantime
        last = str(error).strip().splitlines()[-1:]
        raise UsageError(
            f"the Ray node {node_name(node)} cannot run touchdown ({' '.join(last)}); install the "
            "same version there, or take the node out of the cluster"
        ) from error
    if not reason:
        file = question.answer_file(node["NodeID"])
        if _read_when_visible(file, question.text, VISIBLE_S) != question.text:
            reason = f"writes into another '{file.parent}' than the machine that started it"
    if reason:
        raise UsageError(refusal(node_name(node), reason))


def _working_nodes(ray: Any) -> Sequence[Mapping[str, Any]]:
    return [node for node in ray.nodes() if node["Alive"] and node["Resources"].get("CPU", 0) > 0]


def node_name(node: Mapping[str, Any]) -> str:
    """``HOST (ADDRESS)``, or the name that the node was given."""
    host, address = node["NodeManagerHostname"], node["NodeManagerAddress"]
    given = node.get("NodeName") or address
    return f"{host} ({address})" if given == address else f"{given} ({host})"


def this_node(ray: Any) -> tuple[str, str]:
    """Id and name of the node of an actor."""
    node_id = str(ray.get_runtime_context().get_node_id())
    known = {node["NodeID"]: node for node in ray.nodes()}
    return node_id, node_name(known[node_id]) if node_id in known else node_id


def _read_when_visible(file: Path, wanted: str, patience_s: float) -> str | None:
    deadline = time.monotonic() + patience_s
    while True:
        with contextlib.suppress(OSError, UnicodeDecodeError):
            os.listdir(file.parent)  # makes NFS look again
            if (found := file.read_text(encoding="ascii")) == wanted:
                return found
        if time.monotonic() >= deadline:
            return None
        time.sleep(_POLL_S)


# ---------------------------------------------------------------------------------------- address

REACH_S = 20.0
"""for a cluster to answer; by itself Ray tries for minutes"""

_TRIAL = (
    "import sys, ray\n"
    "try:\n"
    "    ray.init(address=sys.argv[1], log_to_driver=False, configure_logging=False)\n"
    "except Exception as error:\n"
    "    print(' '.join(str(error).split()))\n"
    "    sys.exit(3)\n"
)


def check_address(address: str) -> None:
    """Raises UsageError, one line, unless a Ray cluster answers at ``address`` within
    `REACH_S`. Another process tries, since Ray ends its own where there is none."""
    import socket
    import subprocess
    import sys

    start = f"--ray-address {address}: "
    remedy = "start a cluster there with 'ray start --head', or leave the option out"
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdecimal() and int(port) < 65536:
        try:
            socket.create_connection((host.strip("[]"), int(port)), timeout=5.0).close()
        except OSError as error:
            reason = error.strerror or str(error) or "no answer"
            raise UsageError(f"{start}cannot be reached ({reason}); {remedy}") from None
    try:
        trial = subprocess.run(
            [sys.executable, "-c", _TRIAL, address],
            capture_output=True,
            text=True,
            errors="replace",
            timeout=REACH_S,
        )
    except subprocess.TimeoutExpired:
        raise UsageError(f"{start}no Ray cluster answers there; {remedy}") from None
    if trial.returncode == 3:
        reason = trial.stdout.strip().rstrip(".") or "no Ray cluster answers there"
        raise UsageError(f"{start}{reason}; {remedy}")
    if trial.returncode != 0:
        raise UsageError(f"{start}no Ray cluster answers there; {remedy}")
