"""Import of large packages without garbage collection."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def without_collection() -> Iterator[None]:
    """Switch Python's garbage collection off in the block, which imports large packages.

    An import creates hundreds of thousands of objects that stay, and the collector would examine all of them again and
    again. Importing PyTorch and Lightning without garbage collection takes three quarters of the processor time that it
    takes with it.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
