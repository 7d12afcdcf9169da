"""Generated data sets in the cache, which one process at a time writes and which are marked as synthetic."""

import json
import os
import shutil
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import current_process, get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

from framework.errors import DataError
from framework.storage.files import hold_lock
from framework.storage.plain_values import read_json
from framework.storage.progress import track_progress

MARK = "synthetic.json"
PAINTERS = 2
"""Number of threads or processes that draw files at the same time."""
WORTH_A_PROCESS = 100
"""Number of files from which they are drawn in processes, if the caller allows this."""
Result = TypeVar("Result")


def ensure_generated(root: Path, mark: Mapping[str, Any], write: Callable[[Path], None]) -> Path:
    """Generate data in the folder `root` if the folder does not exist, and return the folder.

    Args:
        root: Folder of the generated data.
        mark: Settings that determine the generated data, as JSON values; the file `synthetic.json` in the folder stores
            them, and they distinguish generated from recorded data.
        write: Function that writes the data into an empty folder, which is renamed to `root` when it is complete.

    Raises:
        DataError: The cache cannot be written, or `root` contains data with another mark.
    """
    try:
        root.parent.mkdir(parents=True, exist_ok=True)
        if not root.exists():
            with hold_lock(root.with_name(f".{root.name}.lock")):
                if not root.exists():  # another process may have written the data while this one waited
                    _write(root, mark, write)
    except OSError as error:
        raise DataError(
            f"Generated data cannot be written to {root} ({error}). Free space there, or set FRAMEWORK_CACHE to "
            "another folder."
        ) from error
    if read_mark(root) != mark:
        raise DataError(
            f"{root / MARK} does not describe {dict(mark)}, so this file was changed. Delete {root}; the data are then "
            "generated again."
        )
    return root


def read_mark(root: Path) -> dict[str, Any] | None:
    """Return the content of `synthetic.json` in a folder, or None if the file is missing, as for recorded data.

    Raises:
        DataError: The file cannot be read.
    """
    if not (root / MARK).exists():
        return None
    return read_json(
        root / MARK, "the mark of generated data", f"Delete {root}; the data are then generated again."
    )


def draw_all(
    count: int, draw: Callable[[int], Result], name: str, *, in_processes: bool = False
) -> list[Result]:
    """Call `draw` with 0 … count - 1 in several threads or processes, and return the results in this order.

    Args:
        count: Number of files to draw.
        draw: Function that draws the file of a number. In processes, it runs in a copy of this process: it must not
            change variables, and its results are pickled.
        name: Name of the files in the progress report.
        in_processes: Whether to draw in processes where this is safe and saves time; Python code takes half the time
            then. Otherwise the files are drawn in threads.
    """
    work = f"drawing {name}"
    if in_processes and count >= WORTH_A_PROCESS and _may_fork():
        return _draw_in_processes(count, draw, work)
    with ThreadPoolExecutor(PAINTERS) as painters:
        try:
            return list(track_progress(painters.map(draw, range(count)), work, count, "files"))
        except BaseException:
            painters.shutdown(cancel_futures=True)
            raise


def _may_fork() -> bool:
    """Return whether a fork of this process can compute, and there is a core for it.

    A fork has only the thread that forks, and a lock that another thread holds stays locked in it. CUDA does not work
    in a fork.
    """
    if sys.platform != "linux" or len(os.sched_getaffinity(0)) < PAINTERS:
        return False
    if threading.active_count() > 1 or current_process().daemon:  # such a process may have no children
        return False
    torch = sys.modules.get("torch")
    return torch is None or not torch.cuda.is_initialized()


def _draw_in_processes(count: int, draw: Callable[[int], Result], work: str) -> list[Result]:
    """Draw the files in PAINTERS processes, one of which is this process; `draw_all` describes the rest."""
    first = draw(0)  # before the forks, so that functions are compiled once
    fork, parent = get_context("fork"), os.getpid()
    pipes = [fork.Pipe(duplex=False) for _ in range(PAINTERS - 1)]
    painters = [
        fork.Process(
            target=_draw_share, args=(sending, parent, draw, range(number, count, PAINTERS)), daemon=True
        )
        for number, (_, sending) in enumerate(pipes, start=2)
    ]
    try:
        for painter, (_, sending) in zip(painters, pipes, strict=True):
            with warnings.catch_warnings():
                # Python warns of threads that belong to libraries; a fork does not use them
                warnings.simplefilter("ignore", DeprecationWarning)
                painter.start()
            sending.close()  # so that the end of the process ends the pipe
        own = range(1, count, PAINTERS)
        results = {0: first}
        # number of files that all processes have drawn when this one is done; file 0 is counted with file 1
        sizes = {number: min(PAINTERS, count - number) + (number == 1) for number in own}
        for number in track_progress(own, work, count, "files", sizes.__getitem__):
            results[number] = draw(number)
        for receiving, _ in pipes:
            try:
                drawn, error = receiving.recv()
            except EOFError:
                raise DataError(
                    f"A process that was {work} has ended early, perhaps because memory is short. Repeat the command."
                ) from None
            if error is not None:
                raise error
            results.update(drawn)
    finally:
        for painter in painters:
            if painter.pid is not None:
                painter.kill()
                painter.join()
    return [results[number] for number in range(count)]


def _draw_share(sending: Connection, parent: int, draw: Callable[[int], Any], numbers: Iterable[int]) -> None:
    """Draw the files of some numbers in a fork, and send the results by number, or the error; end with the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.set_num_threads(1)  # a fork lacks the threads of OpenMP, and would wait for them forever
    results: dict[int, Any] = {}
    try:
        for number in numbers:
            if os.getppid() != parent:
                return
            results[number] = draw(number)
    except Exception as error:
        sending.send((results, error))
    else:
        sending.send((results, None))


def _write(root: Path, mark: Mapping[str, Any], write: Callable[[Path], None]) -> None:
    part = root.with_name(f".{root.name}.part")
    # this process holds the lock, so the process that left such a folder was killed
    shutil.rmtree(part, ignore_errors=True)
    try:
        part.mkdir()
        write(part)
        (part / MARK).write_text(json.dumps(dict(mark), indent=2) + "\n", encoding="utf-8")
        part.rename(root)
    finally:
        shutil.rmtree(part, ignore_errors=True)
