"""Waiting policy of OpenMP threads, and a thread pool for compiled code, which runs without the interpreter's lock."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor


def wait_passively() -> None:
    """Make OpenMP threads sleep between two parallel operations; call this before torch is imported.

    They spin by default. As soon as another process uses a core, a thread spins while it waits for a thread that does
    not run. A training with two threads then took several times the processor time and the wall time of one thread.
    Values that the user set in OMP_WAIT_POLICY or GOMP_SPINCOUNT are kept.
    """
    if "GOMP_SPINCOUNT" not in os.environ:
        os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


class Pool:
    """Pool of threads that are started on first use, and started again in a child process, since a fork ends them."""

    def __init__(self) -> None:
        self.threads: ThreadPoolExecutor | None = None
        self.size = 0
        os.register_at_fork(after_in_child=self.forget)

    def forget(self) -> None:
        """Drop the threads, which do not exist in a child process."""
        self.threads = None

    def run(self, work: Callable[[int], object], threads: int) -> None:
        """Call work(0) … work(threads - 1) at the same time, the first in this thread; `work` must not use the pool."""
        if threads <= 1:
            work(0)
            return
        if self.threads is None or self.size < threads - 1:
            self.size = threads - 1
            self.threads = ThreadPoolExecutor(self.size, "compiled")
        waiting = [self.threads.submit(work, i) for i in range(1, threads)]
        work(0)
        for one in waiting:
            one.result()

    def share(self, work: Callable[[int], object], count: int, threads: int) -> None:
        """Call work(0) … work(count - 1), each in the thread that is free next."""
        waiting = iter(range(count))

        def some(_: int) -> None:
            try:
                for number in waiting:
                    work(number)
            finally:
                list(waiting)  # empty the iterator, so that the other threads stop after a failure

        self.run(some, min(threads, count))


POOL = Pool()
