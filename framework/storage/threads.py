"""Waiting policy of OpenMP threads, and a thread pool for compiled code, which runs without the interpreter's lock."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

SPINS = "1000"
"""Number of times that a waiting OpenMP thread looks for work before it sleeps; this takes some microseconds.

A thread that sleeps at once must be woken for every operation. A thread that looks for work much longer uses a core for
nothing while it waits for a thread whose core another process uses (benchmarks/framework/threads.md).
"""


def limit_spinning() -> None:
    """Make OpenMP threads sleep soon if they have nothing to do; call this before torch is imported.

    By default, waiting threads spin for long. If another process uses one of the cores, a thread may then spin while it
    waits for a thread that does not run. Values that the user set in OMP_WAIT_POLICY or GOMP_SPINCOUNT are not changed.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", SPINS)


class Pool:
    """Pool of threads, which start at the first use and, in a forked child process, at the first use there."""

    def __init__(self) -> None:
        self.threads: ThreadPoolExecutor | None = None
        self.size = 0
        os.register_at_fork(after_in_child=self.forget)

    def forget(self) -> None:
        """Forget the threads of the parent in a forked child process, which does not inherit them."""
        self.threads = None

    def run(self, work: Callable[[int], object], threads: int) -> None:
        """Call work(0) … work(threads - 1) concurrently, work(0) in this thread; `work` must not use the pool."""
        if threads <= 1:
            work(0)
            return
        if self.threads is None or self.size < threads - 1:
            self.size = threads - 1
            self.threads = ThreadPoolExecutor(self.size, "compiled")
        waiting = [self.threads.submit(work, i) for i in range(1, threads)]
        work(0)
        for future in waiting:
            future.result()

    def share(self, work: Callable[[int], object], count: int, threads: int) -> None:
        """Call work(0) … work(count - 1), each in the next free one of `threads` threads."""
        waiting = iter(range(count))

        def some(_: int) -> None:
            try:
                for number in waiting:
                    work(number)
            finally:
                list(waiting)  # empty the iterator, so that the other threads stop after a failure

        self.run(some, min(threads, count))


POOL = Pool()
