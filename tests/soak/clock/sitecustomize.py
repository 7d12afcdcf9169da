"""Python's clock of a soak test: it is an hour back at each start of a process, and goes back again while it runs.

Python imports this module at its start if this folder is on PYTHONPATH. CLOCK names a folder in which each process
leaves a file, so that later processes count them.
"""

import os
import time
from pathlib import Path

STEP, EVERY = 3600.0, 2.0
"""Seconds by which the clock goes back, and seconds between two such jumps of a running process."""

_time, _begin = time.time, time.monotonic()
_folder = Path(os.environ["CLOCK"])
_folder.mkdir(parents=True, exist_ok=True)
(_folder / str(os.getpid())).touch()
_starts = len(list(_folder.iterdir()))


def _back() -> float:
    return _time() - STEP * (_starts + (time.monotonic() - _begin) // EVERY)


time.time = _back
time.time_ns = lambda: int(1e9 * _back())
