"""The processes that jobs of a sweep run in: one of its own each, or forks of one that has imported what they need."""

import ctypes
import json
import os
import resource
import signal
import socket
import subprocess
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from framework.tracking.signals import ending_with_parent

LARGEST = 2**17
"""Bytes of a packet that describes a job."""
PATIENCE = 60.0
"""Seconds that the start of a process may take, without what it imports then."""
_SERVER = "framework.sweeps.fork_server"
_SET_CHILD_SUBREAPER = 36  # of prctl.h


@runtime_checkable
class Process(Protocol):
    """A job that runs, or has run.

    Attributes:
        seconds: processor time of all its processes, once it has ended; None where nobody saw how it did.
    """

    seconds: float | None

    @property
    def pid(self) -> int | None:
        """That of its session; None before it is known."""
        ...

    def poll(self) -> int | None:
        """Exit code, below 0 the signal that killed it, or that it was sent where nobody saw; None while it runs."""
        ...

    def send(self, number: int) -> None:
        """A signal for the job's first process, which tells the others."""
        ...

    def kill(self) -> None:
        """Kill all processes of its session."""
        ...


Starter = Callable[[Sequence[str], Mapping[str, str], int, int], Process]
"""Starts a job, given a command of Python, the whole environment, the descriptor of the file for its output, and one to
hold until the last process of the job has ended."""


class Fresh:
    """A job in a process of its own."""

    def __init__(
        self, command: Sequence[str], environment: Mapping[str, str], console: int, lock: int
    ) -> None:
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=console,
            stderr=subprocess.STDOUT,
            env=environment,
            pass_fds=(lock,),
            start_new_session=True,  # Ctrl-C comes to the sweep alone, and from there once to each job
            preexec_fn=ending_with_parent(),
        )
        self.pid = self._process.pid
        self.seconds: float | None = None

    def poll(self) -> int | None:
        before = _of_children()
        code = self._process.poll()
        if self.seconds is None and code is not None:
            self.seconds = _of_children() - before
        return code

    def send(self, number: int) -> None:
        with suppress(ProcessLookupError):
            self._process.send_signal(number)

    def kill(self) -> None:
        with suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)


class Forks:
    """Starts jobs as forks of one process (`fork_server`), which is started with the first of them; Linux.

    A job gets all that a process of its own would have, but for modules that are there already. If that process dies,
    its jobs are told to end; later jobs get another one, or processes of their own where it could not start any, as do
    jobs that it had not started yet.

    Args:
        modules: what it imports.
    """

    def __init__(self, modules: Sequence[str] = ()) -> None:
        self._modules = modules
        self._server: _Server | None = None
        self._useless = False

    def __call__(
        self, command: Sequence[str], environment: Mapping[str, str], console: int, lock: int
    ) -> Process:
        if self._server is not None and not self._server.alive:
            self._useless = not self._server.forked
            self.close()
        if self._useless:
            return Fresh(command, environment, console, lock)
        try:
            if self._server is None:
                self._server = _Server(command, self._modules, environment)
            return self._server.fork(command, environment, console, lock)
        except OSError:  # it could not start; a command of more than a packet, a limit of descriptors
            self._useless = self._server is None
            return Fresh(command, environment, console, lock)

    def close(self) -> None:
        """End the process; jobs that still run in forks of it are told to end."""
        if self._server is not None:
            self._server.close()
        self._server = None


class _Server:
    """Raises OSError where the process does not start."""

    def __init__(
        self, command: Sequence[str], modules: Sequence[str], environment: Mapping[str, str]
    ) -> None:
        _adopt_orphans()
        target = _target(command)
        self._environment = dict(environment)
        self._channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self._process = subprocess.Popen(
                [*command[:target], "-m", _SERVER, str(theirs.fileno()), ",".join(modules), *_run(command)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                env=environment,
                pass_fds=(theirs.fileno(),),
                start_new_session=True,
                preexec_fn=ending_with_parent(),
            )
        self._channel.settimeout(PATIENCE)
        try:
            if not self._channel.recv(LARGEST):
                raise OSError("it ended")
        except OSError:
            self.close()
            raise
        self._channel.settimeout(None)
        self.alive = True
        self.forked = False
        self._asked = deque["_Fork"]()
        self._running: dict[int, _Fork] = {}

    def fork(
        self, command: Sequence[str], environment: Mapping[str, str], console: int, lock: int
    ) -> "_Fork":
        own = {key: value for key, value in environment.items() if self._environment.get(key) != value}
        arguments = command[_target(command) + len(_run(command)) :]
        packet = json.dumps({"arguments": arguments, "environment": own}).encode()
        if len(packet) > LARGEST:
            raise OSError("a packet is smaller")
        socket.send_fds(self._channel, [packet], [console, lock])
        path = Path(f"/proc/self/fd/{console}").readlink()  # whoever opened it closes it soon

        def fresh() -> Process:
            with path.open("ab") as again:
                return Fresh(command, environment, again.fileno(), lock)

        job = _Fork(self, fresh)
        self._asked.append(job)
        return job

    def listen(self) -> None:
        """Take what the process has answered."""
        while self.alive:
            try:
                packet = self._channel.recv(LARGEST, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return
            except OSError:
                packet = b""
            if not packet:
                self.alive = False
                self.close()  # when it has ended, its jobs are children of this process
                return
            answer: dict[str, Any] = json.loads(packet)
            if "started" in answer:
                self.forked = True
                self._running[answer["started"]] = self._asked.popleft()
                self._running[answer["started"]].begin(answer["started"])
            else:
                self._running.pop(answer["ended"]).end(answer["code"], answer["seconds"])

    def close(self) -> None:
        self._channel.close()
        self._process.kill()
        self._process.wait()


class _Fork:
    """A job that a server is to fork; a process of its own where the server dies before it has."""

    def __init__(self, server: _Server, fresh: Callable[[], Process]) -> None:
        self._server = server
        self._fresh = fresh
        self._process: Process | None = None
        self._code: int | None = None
        self._early: list[int] = []
        self.pid: int | None = None
        self.seconds: float | None = None

    def begin(self, pid: int) -> None:
        self.pid = pid
        for number in self._early:
            self.send(number)

    def end(self, code: int, seconds: float) -> None:
        self._code, self.seconds = code, seconds

    def poll(self) -> int | None:
        self._server.listen()
        if self._code is not None:
            return self._code
        if self._process is not None:
            self._code, self.seconds = self._process.poll(), self._process.seconds
        elif not self._server.alive and self.pid is None:
            if self._early:
                self.end(-self._early[0], 0.0)
            else:
                self._process = self._fresh()
                self.pid = self._process.pid
        elif not self._server.alive and self.pid is not None:
            try:
                ended, status, usage = os.wait4(self.pid, os.WNOHANG)
            except ChildProcessError:  # the server asked how it ended, and died before it said so
                self._code = -signal.SIGTERM
            else:
                if ended:
                    self.end(os.waitstatus_to_exitcode(status), usage.ru_utime + usage.ru_stime)
        return self._code

    def send(self, number: int) -> None:
        self._server.listen()
        if self.pid is None:
            self._early.append(number)  # while the server imports
        elif self._code is None:
            with suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def kill(self) -> None:
        self._server.listen()
        if self.pid is not None:
            with suppress(ProcessLookupError):
                os.killpg(self.pid, signal.SIGKILL)
        elif self._code is None:
            self.end(-signal.SIGKILL, 0.0)
            self._server.close()


def _adopt_orphans() -> None:
    """Become the parent of the children of a child that dies (Linux), so that their ends are known."""
    ctypes.CDLL(None).prctl(_SET_CHILD_SUBREAPER, 1)


def _target(command: Sequence[str]) -> int:
    """Where options of Python end in a command of it."""
    return next(index for index, word in enumerate(command) if index and (word == "-m" or word[0] != "-"))


def _run(command: Sequence[str]) -> Sequence[str]:
    """`-m` and a module, or a file."""
    start = _target(command)
    return command[start : start + (2 if command[start] == "-m" else 1)]


def _of_children() -> float:
    """Processor seconds of the processes that were waited for, and of theirs."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime
