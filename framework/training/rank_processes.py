"""The processes of several ranks, of which none outlives another: whichever dies, all end, and the run is closed."""

import os
import select
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, final

import pytorch_lightning as pl
from hydra.core.hydra_config import HydraConfig
from lightning_fabric.strategies.launchers.subprocess_script import (
    _basic_subprocess_cmd,
    _hydra_subprocess_cmd,
)
from lightning_fabric.utilities.distributed import _set_num_threads_if_needed
from pytorch_lightning.strategies.launchers import _SubprocessScriptLauncher

from framework.errors import UserError
from framework.tracking.signals import ENDING, SIGNALS, Stopped, Stopper, ending_with_parent

_GRACE = 4.0
"""Seconds that this rank has to leave the training by itself, after another one has died."""
_CLOSING = 3.0
"""Seconds for closing the run where this rank has not left by itself."""
_MOMENT = 5.0
"""Seconds within which a rank that has closed its connections has ended."""
_TOLD = ("gloo", "NCCL", "c10d", "ProcessGroup", "Connection")
"""Words of an error that a collective raises from compiled code."""
_PAUSE = 0.1


@final
class RankStopped(Stopped):
    """Another rank was killed, or told to stop alone."""

    def __init__(self, rank: int, number: int) -> None:
        super().__init__(number)
        self.signal = f"{self.signal} of rank {rank}"


@final
class RankFailed(UserError):
    """Another rank ended with an error of its own."""


@final
class RankLauncher(_SubprocessScriptLauncher):
    """Lightning's launcher of ranks, but that they die with this process, and that nobody kills this process for one.

    Lightning kills it, with a signal that leaves no time to close the run (`_ChildProcessObserver`).
    """

    def launch(
        self, function: Callable[..., Any], *args: Any, trainer: pl.Trainer | None = None, **kwargs: Any
    ) -> Any:
        self.cluster_environment.validate_settings(num_devices=self.num_processes, num_nodes=self.num_nodes)
        if not self.cluster_environment.creates_processes_externally:
            self._call_children_scripts()
        _set_num_threads_if_needed(num_processes=self.num_processes)
        return function(*args, **kwargs)

    def _call_children_scripts(self) -> None:
        self._check_can_spawn_children()
        os.environ["MASTER_ADDR"] = self.cluster_environment.main_address
        os.environ["MASTER_PORT"] = str(self.cluster_environment.main_port)
        os.environ["NODE_RANK"] = str(self.cluster_environment.node_rank())
        os.environ["LOCAL_RANK"] = str(self.cluster_environment.local_rank())
        os.environ["WORLD_SIZE"] = str(self.num_processes * self.num_nodes)
        for rank in range(1, self.num_processes):
            command, folder = _command(rank)
            process = subprocess.Popen(
                command,
                env={**os.environ, "LOCAL_RANK": str(rank)},
                cwd=folder,
                preexec_fn=ending_with_parent(signal.SIGKILL),
            )
            self.procs.append(process)


def _command(rank: int) -> tuple[Sequence[str], str | None]:
    """What starts a rank: Lightning's command, with the options that this Python was started with (-P above all)."""
    if HydraConfig.initialized():
        command, folder = _hydra_subprocess_cmd(rank)
    else:
        command, folder = _basic_subprocess_cmd(), None
    return [command[0], *subprocess._args_from_interpreter_flags(), *command[1:]], folder  # type: ignore[attr-defined]


@contextmanager
def sharing_one_fate(
    trainer: pl.Trainer, stopper: Stopper, close: Callable[[BaseException], None]
) -> Iterator[None]:
    """Train inside the block, with however many ranks; in an error of this rank, see whether another one caused it.

    This rank has a few seconds to leave the block after another one has died, or after a signal that it does not take
    notice of, since it waits in a collective. Then its run is closed from here, and the process ended.

    Args:
        close: the run as that error asks for; whatever it takes longer than a few seconds for is left.

    Raises:
        RankStopped: another rank was killed or told to stop.
        RankFailed: another rank failed.
    """
    connector = trainer._signal_connector
    register = connector.register_signal_handlers

    def register_ours_last() -> None:
        register()  # one of Lightning's broadcasts from inside of a signal, which hangs several ranks
        stopper.install()

    connector.register_signal_handlers = register_ours_last
    launcher = trainer.strategy.launcher
    if type(launcher) is not _SubprocessScriptLauncher:
        yield
        return
    ours = RankLauncher(launcher.cluster_environment, launcher.num_processes, launcher.num_nodes)
    trainer.strategy._launcher = ours
    guard = _Guard(ours.procs, stopper, close)
    guard.start()
    try:
        yield
    except RuntimeError as error:
        cause = guard.cause(_MOMENT) if _of_a_collective(error) else None
        guard.leave(cause)
        if cause is None:
            raise
        raise cause from error
    except BaseException:
        guard.leave(None)
        raise
    guard.end()


def _of_a_collective(error: BaseException) -> bool:
    """Return whether an error says that another rank is away."""
    frames = traceback.walk_tb(error.__traceback__)
    names = (str(frame.f_globals.get("__name__")) for frame, _ in frames)
    return any(word in str(error) for word in _TOLD) or any(
        name.startswith("torch.distributed") for name in names
    )


@final
class _Guard(threading.Thread):
    """Looks after the ranks that this process has started, beside the training.

    Signals that come are read from a pipe, since Python's own handlers wait for the main thread.
    """

    def __init__(
        self,
        ranks: Sequence[subprocess.Popen[bytes]],
        stopper: Stopper,
        close: Callable[[BaseException], None],
    ) -> None:
        super().__init__(name="ranks", daemon=True)
        self._ranks = ranks
        self._stopper = stopper
        self._close = close
        self._reads, self._writes = os.pipe()
        os.set_blocking(self._writes, False)
        self._before = signal.set_wakeup_fd(self._writes, warn_on_full_buffer=False)
        self._over = threading.Event()
        self._left: float | None = None
        """When the main thread has left the training with an error."""
        self._caused = False
        """Whether another rank has caused that error."""

    def run(self) -> None:
        died: float | None = None
        signalled: tuple[float, int] | None = None
        while not self._over.is_set():
            number = self._signal()
            now = time.monotonic()
            if number is not None and signalled is None:
                signalled = now, number
            if died is None and any(process.poll() is not None for process in self._ranks):
                died = now
            if self._left is not None:
                if now - self._left > _GRACE:
                    self._kill()
                if self._caused and died is not None and now - died > 2 * _GRACE:
                    os._exit(1)  # the run is closed; what the store lacks is sent by a later sync
            elif died is not None and now - died > _GRACE:
                self._end(self.cause(0.0) or RankFailed("Another rank ended before the training did."))
            elif signalled and self._stopper.received is None and now - signalled[0] > ENDING:
                self._end(Stopped(signalled[1]))

    def cause(self, patience: float) -> RankStopped | RankFailed | Stopped | None:
        """Why this rank cannot go on; None where nothing says so within so many seconds."""
        deadline = time.monotonic() + patience
        while True:
            for rank, process in enumerate(self._ranks, 1):
                code = process.poll()
                if code is not None and code < 0:
                    return RankStopped(rank, -code)
                if code is not None and code - 128 in SIGNALS:
                    return RankStopped(rank, code - 128)
                if code:
                    return RankFailed(
                        f"Rank {rank} of the training failed (exit code {code}), so the others cannot go on. Its own "
                        "error stands above."
                    )
            if self._stopper.received is not None:  # by a launcher that ends all ranks for one
                return Stopped(self._stopper.received)
            if time.monotonic() >= deadline:
                return None
            time.sleep(_PAUSE)

    def leave(self, cause: BaseException | None) -> None:
        """See that the other ranks end, of which one may have caused the error that this rank leaves training with."""
        self._release()
        self._caused = cause is not None
        self._left = time.monotonic()

    def end(self) -> None:
        """Training has ended."""
        self._over.set()
        self.join()
        self._release()
        for descriptor in (self._reads, self._writes):
            os.close(descriptor)

    def _signal(self) -> int | None:
        """The number of a signal that has come; waits a moment for one."""
        if select.select([self._reads], [], [], _PAUSE)[0]:
            numbers = [number for number in os.read(self._reads, 64) if number in SIGNALS]
            return numbers[0] if numbers else None
        return None

    def _release(self) -> None:
        signal.set_wakeup_fd(self._before)

    def _kill(self) -> None:
        for process in self._ranks:
            with suppress(ProcessLookupError):
                process.kill()

    def _end(self, error: BaseException) -> None:
        """Close the run in place of the main thread, which waits in a collective, and end this process."""
        self._kill()
        closing = threading.Thread(target=self._close, args=(error,), daemon=True)
        closing.start()
        closing.join(_CLOSING)
        sys.stderr.flush()
        os._exit(error.code if isinstance(error, Stopped) and isinstance(error.code, int) else 1)
