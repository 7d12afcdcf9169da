"""What a committed result says of where and when it was measured."""

import datetime
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from statistics import median


def machine(*packages: str) -> str:
    """Processor, date and versions, one line of Markdown."""
    processor = platform.processor() or "unknown processor"
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        text = cpuinfo.read_text()
        names = re.findall(r"^model name\s*:\s*(.*)$", text, re.MULTILINE)
        # the widest of them decides by how much float32 and bfloat16 differ
        widest = [each for each in ("avx512_bf16", "avx512f", "avx2") if re.search(rf"\b{each}\b", text)][:1]
        processor = ", ".join([names[0], f"{len(names)} cores", *widest]) if names else processor
    versions = ", ".join(f"{name} {version(name)}" for name in packages)
    return (
        f"{processor}; {datetime.date.today().isoformat()}; Python {platform.python_version()}, {versions}."
    )


def first_calls(script: str, **elsewhere: str) -> tuple[float, float]:
    """What a script prints, seconds, in a fresh process: with nothing compiled, and with everything in the cache.

    Args:
        elsewhere: further environment; the cache of compiled code is in the folder {} of a value.
    """
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, **{name: value.format(folder) for name, value in elsewhere.items()}}
        cold, warm = (
            subprocess.run(
                [sys.executable, "-c", script],
                env=environment, cwd=Path(__file__).parent.parent, check=True, capture_output=True, text=True,
            ).stdout
            for _ in range(2)
        )  # fmt: skip
    return float(cold), float(warm)


def milliseconds(
    call: Callable[[], object],
    repeats: int = 300,
    clock: Callable[[], float] = time.thread_time,
    warm_up: int = 10,
) -> float:
    """Median processor time, after calls to warm up: of the calling thread, or what else the clock counts."""
    for _ in range(warm_up):
        call()
    times = []
    for _ in range(repeats):
        start = clock()
        call()
        times.append(clock() - start)
    return 1e3 * median(times)
