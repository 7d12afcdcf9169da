"""Small process that ends the processes of a local Ray cluster after the command that has started the cluster died.

Ray's own processes end with the command, except for the two agents of the node. An agent notices the end only when it
has started and has waited for the cluster, which takes more than a minute on a busy machine.

The process waits until its input ends, that is, until the command has died. It finds the processes of the cluster by
the cluster's token, which is in the environment variable RAY_AUTH_TOKEN of this process and of each of them.
"""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

from framework.tracking.signals import ENDING

_COMMAND = (sys.executable, "-P", "-m", __name__)
_TOKEN = "RAY_AUTH_TOKEN"
_PAUSE = 0.1
"""Seconds between two looks at the processes."""


def start_guard() -> subprocess.Popen[bytes]:
    """Start the guard; its input stays open as long as the process that calls this function lives."""
    return subprocess.Popen(
        _COMMAND,
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # so that signals to the process group of the command do not reach it
    )


def end_cluster(token: str, patience: float = ENDING) -> None:
    """Wait until the processes of a cluster of this machine have ended, and kill those that have not (Linux only).

    Jobs are not killed: each gets a signal when its process of Ray ends, and has a watcher of its own.

    Args:
        token: Token of the cluster.
        patience: Seconds in which the processes must end by themselves.
    """
    deadline = time.monotonic() + patience
    while (alive := cluster_processes(token)) and time.monotonic() < deadline:
        time.sleep(_PAUSE)
    while alive:  # a process may have started another one
        for process in alive:
            with suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        time.sleep(_PAUSE)
        alive = cluster_processes(token)


def cluster_processes(token: str) -> list[int]:
    """Return the ids of Ray's processes on this machine that have `token` in their environment."""
    spec = find_spec("ray")
    package = None if spec is None else f"{Path(str(spec.origin)).parent}{os.sep}"
    entry, processes = f"{_TOKEN}={token}".encode(), []
    for place in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # the process has ended, or belongs to another user
            command = (place / "cmdline").read_bytes()
            from_ray = command.startswith(b"ray::") or (
                package is not None and os.fsencode(package) in command
            )
            if from_ray and entry in (place / "environ").read_bytes().split(b"\0"):
                processes.append(int(place.name))
    return processes


if __name__ == "__main__":
    sys.stdin.buffer.read()
    end_cluster(os.environ[_TOKEN])
