"""Clusters of several Ray nodes on one machine, for tests."""

import contextlib
import os
import shutil
import subprocess
import sys
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from support.campaign_flights import ROOT, wait_for

THREADS = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


class Cluster:
    """A head node that shares all, and nodes that join it, each with one processor."""

    def __init__(self, folder: Path) -> None:
        from ray.cluster_utils import Cluster as RayCluster

        self._folder = folder
        self._started: list[subprocess.Popen[bytes]] = []
        self.mark = f"cluster-{uuid.uuid4().hex}"
        self.environment = {
            **os.environ, **THREADS, "MARK": self.mark, "RAY_AUTH_MODE": "disabled",
            "PYTHONPATH": os.pathsep.join((str(ROOT / "src"), str(ROOT / "tests"))),
        }  # fmt: skip
        os.environ.update({"MARK": self.mark, "RAY_AUTH_MODE": "disabled"})
        self._cluster = RayCluster(
            initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False}
        )
        self.address = str(self._cluster.address)

    def nodes(self) -> list[dict[str, Any]]:
        """The nodes that are alive, as Ray describes them."""
        return [node for node in self._cluster.global_state.node_table() if node["Alive"]]

    def join(self, name: str, hidden: Path | None = None) -> None:
        """Starts a node; another empty file system lies over ``hidden`` there."""
        count = len(self.nodes())
        command = [
            sys.executable, "-c", "from ray.scripts.scripts import main; main()", "start",
            "--block", "--num-cpus=1", f"--address={self.address}", f"--node-name={name}",
        ]  # fmt: skip
        if hidden is not None:
            inner = 'mount -t tmpfs none "$0" && exec "$@"'
            command = ["unshare", "--mount", "sh", "-c", inner, str(hidden), *command]
        with (self._folder / f"{name}.log").open("wb") as log:
            self._started.append(
                subprocess.Popen(command, env=self.environment, stdout=log, stderr=log)
            )
        wait_for(lambda: len(self.nodes()) > count, f"{name} does not join")

    def close(self) -> None:
        for node in self._started:
            node.terminate()
        for node in self._started:
            with contextlib.suppress(subprocess.TimeoutExpired):
                node.wait(30.0)
        self._cluster.shutdown()


@contextlib.contextmanager
def cluster(folder: Path) -> Iterator[Cluster]:
    """A cluster whose nodes are gone at the end."""
    before = {name: os.environ.get(name) for name in ("MARK", "RAY_AUTH_MODE")}
    made = Cluster(folder)
    try:
        yield made
    finally:
        made.close()
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


def may_mount() -> bool:
    """True if this user may hide a folder from a process."""
    if shutil.which("unshare") is None:
        return False
    trial = ["unshare", "--mount", "sh", "-c", "mount -t tmpfs none /mnt"]
    return subprocess.run(trial, capture_output=True).returncode == 0
