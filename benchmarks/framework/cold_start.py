"""Measure how much longer the main job takes on a machine that has run nothing before.

    python -m benchmarks.framework.cold_start

The script writes cold_start.md beside this file.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.commands import ROOT
from benchmarks.pages import machine, publish
from benchmarks.timing import cores_used_by_others, median_and_range

RUN = ("experiment=pascal3d/scvae", "trainer.max_epochs=1")
ROUNDS = 3
STATES = ("empty", "filled")
KINDS = {
    "wall": "wall time, s",
    "own": "processor time of the main process, s",
    "processor": "processor time of all processes, s",
}
PARTS = """
import json, tempfile, time
from pathlib import Path

import torch

from plugins.data.pascal3d.generator import generate_class
from plugins.density_head.von_mises.density import VonMises
from plugins.renderer.rasterizer.renderer import Rasterizer

torch.set_num_threads(1)
renderer, seconds = Rasterizer(), {}


def timed(name, work):
    start = time.process_time()
    work()
    seconds[name] = time.process_time() - start


with tempfile.TemporaryDirectory() as folder:
    timed("rasterizer", lambda: generate_class(Path(folder), "car", 1, 0, renderer))
    generate_class(Path(folder), "car", 200, 0, renderer)  # imports and compiles what the first image did not need
    timed("images", lambda: generate_class(Path(folder), "car", 200, 1, renderer))
zeros = torch.zeros(2**18)
with torch.no_grad():
    timed("von_mises", lambda: VonMises(zeros, zeros + 1).log_prob(zeros))
print(json.dumps(seconds))
"""
"""Script that measures the parts of the additional time, processor seconds, if the cache is empty.

Of the 200 images, a second process draws half, whose time does not count.
"""
IMAGES, MEASURED_IMAGES = 2400, 100
LIMIT = 10
"""Largest difference that the project allows, seconds."""


@dataclass(frozen=True)
class Duration:
    """Durations of a command, seconds.

    Attributes:
        wall: Wall time.
        own: Processor time of the process of the command, without the processes that it started.
        processor: Processor time of all processes of the command.
    """

    wall: float
    own: float
    processor: float


def run_command(tree: Path, cache: Path) -> Duration:
    """Run the main job with the version of the framework in a folder, and with a cache."""
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        process = subprocess.Popen(
            [sys.executable, "-m", "framework", *RUN, f"hydra.run.dir={folder}/outputs/run"],
            cwd=tree, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": str(tree), "FRAMEWORK_CACHE": str(cache), "NUMBA_CACHE_DIR": ""},
        )  # fmt: skip
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        wall = time.perf_counter() - start
        own = _own_processor_seconds(process.pid)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise subprocess.CalledProcessError(process.returncode, RUN)
    return Duration(wall, own, usage.ru_utime + usage.ru_stime)


def _own_processor_seconds(number: int) -> float:
    """Return the processor seconds of a process of this number that has ended and has not been waited for."""
    fields = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")  # utime and stime, see proc(5)


def measure_round() -> dict[str, float]:
    """Run the main job with an empty cache and with the cache that this run has filled; measure the parts; seconds."""
    row = {"others": cores_used_by_others()}
    with tempfile.TemporaryDirectory() as cache:
        for state in STATES:
            duration = run_command(ROOT, Path(cache))
            row |= {f"{state}_{key}": getattr(duration, key) for key in KINDS}
    return row | measure_parts()


def measure_parts() -> dict[str, float]:
    """Return the processor seconds of the parts of a first run, with an empty cache."""
    with tempfile.TemporaryDirectory() as cache:
        output = subprocess.run(
            [sys.executable, "-c", PARTS], cwd=ROOT, check=True, capture_output=True, text=True,
            env={**os.environ, "FRAMEWORK_CACHE": cache, "NUMBA_CACHE_DIR": ""},
        ).stdout  # fmt: skip
    return json.loads(output)


def page(rows: Sequence[dict[str, Any]]) -> str:
    """Return the text of the page."""
    lines = []
    wall = median([row["empty_wall"] - row["filled_wall"] for row in rows])
    for key, name in KINDS.items():
        empty, filled = ([row[f"{state}_{key}"] for row in rows] for state in STATES)
        difference = [more - less for more, less in zip(empty, filled, strict=True)]
        lines.append(f"| {name} | {' | '.join(map(median_and_range, (empty, filled, difference)))} |")
    compiled = {name: median_and_range([row[name] for row in rows]) for name in ("rasterizer", "von_mises")}
    image = [1e3 * row["images"] / MEASURED_IMAGES for row in rows]
    drawing = median(image) * IMAGES / 2e3
    return "\n".join(
        [
            "# The first run on a machine",
            "",
            f"This page says how much longer the main job, `python -m framework {' '.join(RUN)}`, takes on a machine "
            f"that has run nothing before. The first run draws the {IMAGES:,} images of its data set (synthetic) in "
            "two processes, and compiles the functions of the rasteriser and of the von Mises density for the "
            "processor. Both stay in the cache (`FRAMEWORK_CACHE`), where later runs find them. The project allows "
            f"the first run {LIMIT} s more wall time than a later one.",
            "",
            f"Each of {len(rows)} rounds runs the command twice: first with an empty cache, and then with the cache "
            "that the first run has filled. Each number is the median over the rounds (least to largest). The time of "
            "the main process does not include the processes that it starts; one of these draws half of the images. "
            "On a machine without other work, the difference of the main process is close to the difference in wall "
            "time, because the main process waits for little else.",
            "",
            "| time | empty cache | filled cache | difference |",
            "|---|---:|---:|---:|",
            *lines,
            "",
            "The additional time consists of three parts, measured in processes of their own. The first image, which "
            f"compiles the functions of the rasteriser, takes {compiled['rasterizer']} s. A further image takes "
            f"{median_and_range(image)} ms, so that each of the two processes draws for {drawing:.1f} s. The first "
            f"evaluation of the von Mises density takes {compiled['von_mises']} s, also because it compiles.",
            "",
            f"Before the rounds, other processes used {median_and_range([row['others'] for row in rows], 2)} of 2 "
            "cores. Such work multiplies wall times, and lengthens processor times less. The additional wall time is "
            f"{'above' if wall > LIMIT else 'at most'} {LIMIT} s.",
            "",
            f"{machine('numba', 'torch', 'pytorch-lightning')} Command: `python -m benchmarks.framework.cold_start`.",
            "",
        ]
    )


def main() -> None:
    rows = []
    for _ in range(ROUNDS):
        rows.append(measure_round())
        sys.stderr.write(f"{rows[-1]}\n")
    publish(__file__, page(rows))


if __name__ == "__main__":
    main()
