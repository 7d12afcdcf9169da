"""Import of large packages without garbage collection."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def without_collection() -> Iterator[None]:
    """Switch Python's garbage collection off in the block, which imports large packages, and exempt what is there then.

    An import creates hundreds of thousands of objects that stay, and the collector would examine all of them again and
    again. Importing PyTorch and Lightning without garbage collection takes three quarters of the processor time that it
    takes with it. After the block, collections ignore all objects that exist then, so that a short training takes a
    quarter less processor time as a whole. Only the first block of a process exempts objects: a later one would keep
    the unused objects of an earlier job.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if gc.get_freeze_count() == 0:
            gc.freeze()
        if enabled:
            gc.enable()
