"""Server process that runs the jobs of a sweep as forks, so that slow imports happen only once.

Its arguments are the descriptor of a socket, the modules to import, and the target to run: `-m` and a module, or a
file. A packet on the socket describes a job as JSON (its arguments and its own environment variables), and carries the
descriptors of the job's console and lock. The server answers {"ready": pid} before it imports, and {"started": pid} for
each job. When a job has ended, it sends {"ended": pid, "code": exit code as in subprocess.Popen, "seconds": processor
time of the job and all its processes}. The server ends when the other side closes the socket.
"""

import gc
import json
import os
import random
import runpy
import select
import socket
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from framework.sweeps.processes import LARGEST
from framework.tracking.signals import end_with_parent

PATIENCE = 0.02
"""Seconds between two checks of whether a running job has ended."""


@dataclass(frozen=True)
class ForkJob:
    """Job that a fork runs.

    Attributes:
        arguments: Arguments of the job's command.
        environment: Environment variables of the job.
        console: Descriptor of the file that receives the job's output.
        lock: Descriptor of a lock that is held until the last process of the job has ended.
    """

    arguments: list[str]
    environment: dict[str, str]
    console: int
    lock: int


def serve(channel: socket.socket) -> ForkJob | None:
    """Fork a process for each job that a packet requests.

    The function returns in two kinds of process: in each fork, at once, with its job; and in the server, when the other
    side has closed the socket, with None.
    """
    running = set[int]()
    while True:
        if select.select([channel], [], [], PATIENCE if running else None)[0]:
            packet, descriptors, *_ = socket.recv_fds(channel, LARGEST, 2)
            if not packet:
                return None
            request: dict[str, Any] = json.loads(packet)
            job = ForkJob(request["arguments"], request["environment"], *descriptors)
            end_with_server = end_with_parent()
            pid = os.fork()
            if pid == 0:
                os.setsid()
                end_with_server()
                channel.close()
                _become(job)
                return job
            for descriptor in descriptors:
                os.close(descriptor)
            running.add(pid)
            _send(channel, {"started": pid})
        for pid in sorted(running):
            ended, status, usage = os.wait4(pid, os.WNOHANG)
            if ended:
                running.remove(pid)
                seconds = usage.ru_utime + usage.ru_stime
                _send(channel, {"ended": pid, "code": os.waitstatus_to_exitcode(status), "seconds": seconds})


def _become(job: ForkJob) -> None:
    """Set the fork's streams, environment, arguments and random seed to those of a separate process."""
    for number, descriptor in enumerate((os.open(os.devnull, os.O_RDONLY), job.console, job.console)):
        os.dup2(descriptor, number)
    os.close(job.console)
    os.set_inheritable(job.lock, True)
    os.environ.update(job.environment)
    sys.argv[1:] = job.arguments
    random.seed()
    if "numpy" in sys.modules:
        sys.modules["numpy"].random.seed()


def _send(channel: socket.socket, message: dict[str, Any]) -> None:
    with suppress(OSError):  # the other side has closed the socket, which `serve` notices
        channel.send(json.dumps(message).encode())


def main(descriptor: str, modules: str, *target: str) -> None:
    """Import the modules, fork the requested jobs, and run the target in each fork as Python would.

    Args:
        descriptor: Descriptor of the socket, as text.
        modules: Names of the modules, separated by commas.
        target: "-m" and the name of a module, or the path of a file.
    """
    channel = socket.socket(fileno=int(descriptor))
    _send(channel, {"ready": os.getpid()})
    for name in filter(None, modules.split(",")):
        with suppress(Exception):  # the job itself will report the error
            import_module(name)
    gc.collect()
    gc.freeze()  # so that garbage collection in a fork copies none of these pages
    if serve(channel) is not None:
        _run(target)


def _run(target: Sequence[str]) -> None:
    if target[0] == "-m":
        runpy.run_module(target[1], run_name="__main__", alter_sys=True)
    else:
        sys.argv[0] = target[0]
        runpy.run_path(target[0], run_name="__main__")


if __name__ == "__main__":
    main(*sys.argv[1:])
