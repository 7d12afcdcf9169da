"""Processes of several ranks that end together: if one process dies, the others end, and the run is closed."""

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
from framework.tracking.signals import ENDING, SIGNALS, Stopped, Stopper, end_with_parent

_GRACE = 4.0
"""Seconds that this rank has to leave the training by itself after another rank has died."""
_CLOSING = 3.0
"""Seconds that closing the run may take if this rank has not left the training by itself."""
_MOMENT = 5.0
"""Seconds that this rank waits, after a collective operation has failed, for the process of another rank to end."""
_COLLECTIVE_WORDS = ("gloo", "NCCL", "c10d", "ProcessGroup", "Connection")
"""Words that identify the message of an error of a collective operation in compiled code."""
_PAUSE = 0.1
"""Seconds between two checks of the ranks."""


@final
class RankStopped(Stopped):
    """Exception of this rank if another rank was killed, or was stopped by a signal that this rank did not receive.

    Args:
        rank: Number of the other rank.
        number: Number of the signal.
    """

    def __init__(self, rank: int, number: int) -> None:
        super().__init__(number)
        self.signal = f"{self.signal} of rank {rank}"


@final
class RankFailed(UserError):
    """Error of this rank if another rank ended with an error."""


@final
class RankLauncher(_SubprocessScriptLauncher):
    """Launcher of the other ranks, derived from Lightning's; the ranks that it starts die with this process.

    If another rank dies, Lightning's own launcher kills this process with a signal that leaves no time to close the run
    (`_ChildProcessObserver`). This launcher does not.
    """

    def launch(
        self, function: Callable[..., Any], *args: Any, trainer: pl.Trainer | None = None, **kwargs: Any
    ) -> Any:
        """Start the other ranks, call `function` in this one, and return its result."""
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
                preexec_fn=end_with_parent(signal.SIGKILL),
            )
            self.procs.append(process)


def _command(rank: int) -> tuple[Sequence[str], str | None]:
    """Return the command that starts a rank, and its working folder.

    The command is Lightning's, with the options of the running Python interpreter (above all -P).
    """
    if HydraConfig.initialized():
        command, folder = _hydra_subprocess_cmd(rank)
    else:
        command, folder = _basic_subprocess_cmd(), None
    return [command[0], *subprocess._args_from_interpreter_flags(), *command[1:]], folder  # type: ignore[attr-defined]


@contextmanager
def end_together(
    trainer: pl.Trainer, stopper: Stopper, close: Callable[[BaseException], None]
) -> Iterator[None]:
    """Make all ranks that train inside the `with` block end together.

    If this rank fails because of another rank, the error that leaves the block says so. After the death of another
    rank, and after a signal that this rank cannot handle because it waits in a collective operation, this rank has a
    few seconds to leave the block. If it does not, another thread closes the run and ends the process.

    Args:
        trainer: the trainer of the block.
        stopper: handler of the signals that stop the run.
        close: function that closes the run after the given error; it has a few seconds.

    Raises:
        RankStopped: another rank was killed or stopped by a signal.
        RankFailed: another rank failed.
    """
    connector = trainer._signal_connector
    register = connector.register_signal_handlers

    def register_ours_last() -> None:
        # Replace Lightning's handler, whose broadcast inside a signal handler makes several ranks hang.
        register()
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
        cause = guard.cause(_MOMENT) if _is_collective_error(error) else None
        if (
            cause is None
            and ours.cluster_environment.creates_processes_externally
            and _is_collective_error(error)
        ):
            cause = RankFailed(
                f"The connection to another process of the training was lost ({_first_line(error)}), because that "
                "process has ended or its node cannot be reached. Look at the output of the other processes."
            )
        guard.leave(cause)
        if cause is None:
            raise
        raise cause from error
    except BaseException:
        guard.leave(None)
        raise
    guard.end()


def _first_line(error: BaseException) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)


def _is_collective_error(error: BaseException) -> bool:
    """Return whether an error comes from a collective operation, which fails if another rank is gone."""
    frames = traceback.walk_tb(error.__traceback__)
    names = (str(frame.f_globals.get("__name__")) for frame, _ in frames)
    return any(word in str(error) for word in _COLLECTIVE_WORDS) or any(
        name.startswith("torch.distributed") for name in names
    )


@final
class _Guard(threading.Thread):
    """Thread that watches, during the training, the ranks that this process has started.

    It reads signals from a pipe, because Python's own handlers wait for the main thread.
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
        """Time at which the main thread left the training with an error; None if it has not."""
        self._caused = False
        """True if another rank has caused the error with which the main thread left the training."""

    def run(self) -> None:
        """Check the ranks and the signals until the training is over."""
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
                    os._exit(1)  # the run is closed; a later mode=sync sends the numbers that the store lacks
            elif died is not None and now - died > _GRACE:
                self._end(
                    self.cause(0.0)
                    or RankFailed(
                        "Another rank ended before the training was finished. Look for its error message above."
                    )
                )
            elif signalled and self._stopper.received is None and now - signalled[0] > ENDING:
                self._end(Stopped(signalled[1]))

    def cause(self, patience: float) -> RankStopped | RankFailed | Stopped | None:
        """Return the error with which this rank must stop, caused by another rank or a signal; None without a cause.

        The method waits up to `patience` seconds for a cause to appear.
        """
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
                        f"Rank {rank} of the training failed (exit code {code}), so the other ranks cannot continue. "
                        "The error message of that rank is printed above."
                    )
            if (
                self._stopper.received is not None
            ):  # sent by a launcher that ends all ranks because one failed
                return Stopped(self._stopper.received)
            if time.monotonic() >= deadline:
                return None
            time.sleep(_PAUSE)

    def leave(self, cause: BaseException | None) -> None:
        """Note that this rank has left the training with an error; the others have a few seconds to end.

        Args:
            cause: the error of another rank or the signal because of which this rank left; None if its error is its
                own.
        """
        self._release()
        self._caused = cause is not None
        self._left = time.monotonic()

    def end(self) -> None:
        """Stop watching, because the training has ended."""
        self._over.set()
        self.join()
        self._release()
        for descriptor in (self._reads, self._writes):
            os.close(descriptor)

    def _signal(self) -> int | None:
        """Wait up to _PAUSE seconds for a signal and return its number; None if there is none."""
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
        """Close the run for the main thread, which waits in a collective operation, and end the process."""
        self._kill()
        closing = threading.Thread(target=self._close, args=(error,), daemon=True)
        closing.start()
        closing.join(_CLOSING)
        sys.stderr.flush()
        os._exit(error.code if isinstance(error, Stopped) and isinstance(error.code, int) else 1)
