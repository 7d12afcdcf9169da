"""Processes of a sweep's jobs: separate processes, or forks of a process that has already imported the modules."""

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

from framework.tracking.signals import end_with_parent

LARGEST = 2**17
"""Largest size, in bytes, of a packet that describes a job."""
PATIENCE = 60.0
"""Seconds that the start of the server process may take, not counting the imports of its modules."""
_SERVER = "framework.sweeps.fork_server"
_SET_CHILD_SUBREAPER = 36  # constant of prctl.h


@runtime_checkable
class Process(Protocol):
    """Protocol of the process that runs a job.

    Attributes:
        seconds: Processor time of all processes of the job; None while it runs, or if its end was not observed.
        handle: Name by which the engine knows the job, if the job runs on a node of a cluster (`node.NodeJob`) and
            acquires the lock of its folder itself; None for a process on this machine.
        alive: Whether the engine has confirmed that the job waits or runs.
        reason: What ended the job, in the words of its engine; None if the exit code says it.
        lost: Whether the job ended because its node failed, so that it is started again.
    """

    seconds: float | None
    handle: str | None
    alive: bool
    reason: str | None
    lost: bool

    @property
    def pid(self) -> int | None:
        """Return the id of the job's first process; None before it is known."""
        ...

    def poll(self) -> int | None:
        """Return the exit code, or None while the job runs.

        A code -n means that signal n killed the job or, if the end of the job was not observed, was sent to it.
        """
        ...

    def send(self, number: int) -> None:
        """Send a signal to the job's first process, which informs the job's other processes."""
        ...

    def kill(self) -> None:
        """Kill all processes of the job's session."""
        ...


class LocalProcess:
    """Base class of processes on this machine; it sets the attributes of `Process` that are equal for all of them."""

    handle: str | None = None
    alive: bool = True
    reason: str | None = None
    lost: bool = False


Starter = Callable[[Sequence[str], Mapping[str, str], int, int], Process]
"""Type of a function that starts a job.

Its arguments are a Python command, all environment variables, the descriptor of the output file, and the descriptor of
a lock that is held until the last process of the job has ended.
"""


class SeparateProcess(LocalProcess):
    """Job in a new Python process; an implementation of `Process` whose constructor is a `Starter`.

    Args:
        command: Command of the job.
        environment: Environment variables of the job.
        console: Descriptor of the file that receives the job's output.
        lock: Descriptor of a lock that is held until the last process of the job has ended.
    """

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
            start_new_session=True,  # Ctrl-C signals only the sweep, which passes the signal on to each job
            preexec_fn=end_with_parent(),
        )
        self.pid = self._process.pid
        self.seconds: float | None = None

    def poll(self) -> int | None:
        before = _children_seconds()
        code = self._process.poll()
        if self.seconds is None and code is not None:
            self.seconds = _children_seconds() - before
        return code

    def send(self, number: int) -> None:
        with suppress(ProcessLookupError):
            self._process.send_signal(number)

    def kill(self) -> None:
        with suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)


class Forks:
    """Starter of jobs as forks of one server process (`fork_server`), which is started with the first job; Linux only.

    A fork differs from a new process (`SeparateProcess`) only in that the modules are already imported. If the server
    dies, its running jobs receive a signal to end. Jobs that had been sent to it, but had not started, run as new
    processes. For later jobs another server is started. If the dead server had never forked a job, no other server is
    started, and all later jobs run as new processes too.

    Args:
        modules: Modules that the server imports.
    """

    def __init__(self, modules: Sequence[str] = ()) -> None:
        self._modules = modules
        self._server: _Server | None = None
        self._forking_failed = False

    def __call__(
        self, command: Sequence[str], environment: Mapping[str, str], console: int, lock: int
    ) -> Process:
        if self._server is not None and not self._server.alive:
            self._forking_failed = not self._server.forked
            self.close()
        if self._forking_failed:
            return SeparateProcess(command, environment, console, lock)
        try:
            if self._server is None:
                self._server = _Server(command, self._modules, environment)
            return self._server.fork(command, environment, console, lock)
        except OSError:
            # The server did not start, the command exceeds a packet, or too many descriptors are open.
            self._forking_failed = self._server is None
            return SeparateProcess(command, environment, console, lock)

    def close(self) -> None:
        """End the server process; jobs that still run as its forks receive a signal to end."""
        if self._server is not None:
            self._server.close()
        self._server = None


class _Server:
    """Connection to a server process (`fork_server`); the constructor raises OSError if the process does not start."""

    def __init__(
        self, command: Sequence[str], modules: Sequence[str], environment: Mapping[str, str]
    ) -> None:
        _adopt_orphans()
        target = _target_index(command)
        self._environment = dict(environment)
        self._channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self._process = subprocess.Popen(
                [
                    *command[:target],
                    "-m",
                    _SERVER,
                    str(theirs.fileno()),
                    ",".join(modules),
                    *_run_target(command),
                ],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                env=environment,
                pass_fds=(theirs.fileno(),),
                start_new_session=True,
                preexec_fn=end_with_parent(),
            )
        self._channel.settimeout(PATIENCE)
        try:
            if not self._channel.recv(LARGEST):
                raise OSError("the process that starts the jobs ended before it was ready")
        except OSError:
            self.close()
            raise
        self._channel.settimeout(None)
        self.alive = True
        self.forked = False
        self._requested = deque["_Fork"]()
        self._running: dict[int, _Fork] = {}

    def fork(
        self, command: Sequence[str], environment: Mapping[str, str], console: int, lock: int
    ) -> "_Fork":
        """Request a fork for a job; raises OSError if the job does not fit into a packet."""
        changed_variables = {
            key: value for key, value in environment.items() if self._environment.get(key) != value
        }
        arguments = command[_target_index(command) + len(_run_target(command)) :]
        packet = json.dumps({"arguments": arguments, "environment": changed_variables}).encode()
        if len(packet) > LARGEST:
            raise OSError(
                f"the command and the environment of the job have {len(packet)} bytes, but at most {LARGEST} fit "
                "into one packet"
            )
        socket.send_fds(self._channel, [packet], [console, lock])
        path = Path(f"/proc/self/fd/{console}").readlink()  # the caller closes the descriptor soon

        def fresh() -> Process:
            with path.open("ab") as reopened:
                return SeparateProcess(command, environment, reopened.fileno(), lock)

        job = _Fork(self, fresh)
        self._requested.append(job)
        return job

    def listen(self) -> None:
        """Read the messages that the server has sent, and pass them to the jobs."""
        while self.alive:
            try:
                packet = self._channel.recv(LARGEST, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return
            except OSError:
                packet = b""
            if not packet:
                self.alive = False
                self.close()  # after the server has ended, its jobs are children of this process
                return
            message: dict[str, Any] = json.loads(packet)
            if "started" in message:
                self.forked = True
                self._running[message["started"]] = self._requested.popleft()
                self._running[message["started"]].begin(message["started"])
            else:
                self._running.pop(message["ended"]).end(message["code"], message["seconds"])

    def close(self) -> None:
        """Close the socket and kill the server."""
        self._channel.close()
        self._process.kill()
        self._process.wait()


class _Fork(LocalProcess):
    """Job for which a fork was requested; it gets a separate process if the server dies before the fork."""

    def __init__(self, server: _Server, fresh: Callable[[], Process]) -> None:
        self._server = server
        self._fresh = fresh
        self._process: Process | None = None
        self._code: int | None = None
        self._early_signals: list[int] = []
        self.pid: int | None = None
        self.seconds: float | None = None

    def begin(self, pid: int) -> None:
        """Record that the job was started, and send it the signals that were received before."""
        self.pid = pid
        for number in self._early_signals:
            self.send(number)

    def end(self, code: int, seconds: float) -> None:
        """Record the exit code and the processor time of the job."""
        self._code, self.seconds = code, seconds

    def poll(self) -> int | None:
        self._server.listen()
        if self._code is not None:
            return self._code
        if self._process is not None:
            self._code, self.seconds = self._process.poll(), self._process.seconds
        elif not self._server.alive and self.pid is None:
            if self._early_signals:
                self.end(-self._early_signals[0], 0.0)
            else:
                self._process = self._fresh()
                self.pid = self._process.pid
        elif not self._server.alive and self.pid is not None:
            try:
                ended, status, usage = os.wait4(self.pid, os.WNOHANG)
            except ChildProcessError:  # the server read the exit code and died before it sent the code
                self._code = -signal.SIGTERM
                self.reason: str | None = "its exit code is not known, because its parent process died"
            else:
                if ended:
                    self.end(os.waitstatus_to_exitcode(status), usage.ru_utime + usage.ru_stime)
        return self._code

    def send(self, number: int) -> None:
        self._server.listen()
        if self.pid is None:
            self._early_signals.append(number)  # the server is still importing
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
    """Make this process the parent of each of its descendants whose own parent dies (Linux only).

    This process then observes the end of these descendants.
    """
    ctypes.CDLL(None).prctl(_SET_CHILD_SUBREAPER, 1)


def _target_index(command: Sequence[str]) -> int:
    """Return the index of the target, `-m` or a file, in a Python command; the interpreter's options come before it."""
    return next(index for index, word in enumerate(command) if index and (word == "-m" or word[0] != "-"))


def _run_target(command: Sequence[str]) -> Sequence[str]:
    """Return the target of a Python command: `-m` and a module, or a file."""
    start = _target_index(command)
    return command[start : start + (2 if command[start] == "-m" else 1)]


def _children_seconds() -> float:
    """Return the processor seconds of all ended child processes and their descendants."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime
