"""Compare the time that each engine of a sweep adds to a job that does nothing.

    python -m benchmarks.framework.engines

The script starts a SLURM of two nodes on loopback, for which the programs of Debian's packages slurm-wlm and munge must
be on PATH, and a local Ray cluster. It writes engines.md beside this file.
"""

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from importlib.metadata import distribution
from pathlib import Path
from typing import NamedTuple

from benchmarks.commands import ROOT
from benchmarks.pages import machine, write_page
from benchmarks.timing import ROUNDS, median_and_range, require_idle
from tests.slurm_cluster import SlurmCluster, missing_programs

JOBS, AT_ONCE = 20, 2
ENGINES = {
    "pool, new processes": ("pool", f"hydra.launcher.jobs={AT_ONCE}", "hydra.launcher.fork=false"),
    "pool, forks": ("pool", f"hydra.launcher.jobs={AT_ONCE}", "hydra.launcher.fork=true"),
    "SLURM": ("slurm",),
    "Ray": ("ray",),
}
# An application whose jobs are another script, so that the times are those of the engines and not of imports.
APP = """
import sys
from pathlib import Path
from types import SimpleNamespace
import hydra
from framework.sweeps import jobs

sys.modules["framework.sweeps.comparison"] = SimpleNamespace(
    begin=lambda *_: None, summarise=lambda *_: None, store_of=lambda _: None
)
jobs.COMMAND = [sys.executable, str(Path(__file__).with_name("job.py"))]
hydra.main(version_base="1.3", config_path="conf", config_name="config")(lambda config: None)()
"""
CONFIG = "x: 0\nhydra: {output_subdir: null}\n"


class Sweep(NamedTuple):
    """Measurements of one sweep.

    Attributes:
        first: Time until the first job is started or submitted, seconds.
        total: Time until the command ends, seconds.
        job: Time after the start of the first job, divided by the number of jobs, seconds.
        memory: Largest proportional set size of the command and of the processes that it starts, MB. The daemons of
            SLURM and their jobs are not among them.
    """

    first: float
    total: float
    job: float
    memory: float


class Application:
    """Application in a folder of its own, whose sweeps consist of jobs that do nothing."""

    def __init__(self, folder: Path, environment: dict[str, str]) -> None:
        self.folder = folder
        self.environment = environment
        self.count = 0
        (folder / "conf").mkdir()
        (folder / "conf" / "config.yaml").write_text(CONFIG)
        (folder / "conf" / "hydra").symlink_to(ROOT / "conf" / "hydra")
        (folder / "app.py").write_text(APP)
        (folder / "job.py").write_text("")

    def run(self, engine: str) -> Sweep:
        """Run a sweep on an engine, and measure it."""
        self.count += 1
        launcher, *settings = ENGINES[engine]
        command = [sys.executable, "app.py", "-m", f"hydra/launcher={launcher}", *settings]
        command += [f"x={','.join(map(str, range(JOBS)))}", f"hydra.sweep.dir=sweep{self.count}"]
        largest, ended = [0.0], threading.Event()
        start = time.time()
        process = subprocess.Popen(
            command, cwd=self.folder, env=self.environment, stdout=subprocess.DEVNULL, start_new_session=True
        )

        def sample() -> None:
            while not ended.wait(0.5):
                largest[0] = max(largest[0], memory_of_tree(process.pid))

        sampler = threading.Thread(target=sample)
        sampler.start()
        code = process.wait()
        end = time.time()
        ended.set()
        sampler.join()
        if code:
            raise subprocess.CalledProcessError(code, command)
        records = (self.folder / f"sweep{self.count}").glob("*/job.json")
        first = min(json.loads(record.read_text())["started"] for record in records)
        return Sweep(first - start, end - start, (end - first) / JOBS, largest[0])


def memory_of_tree(root: int) -> float:
    """Return the proportional set size of a process and all its descendants, MB."""
    parents: dict[int, int] = {}
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            parents[int(process.name)] = int((process / "stat").read_text().rpartition(")")[2].split()[1])
    tree = {root}
    while grown := {pid for pid, parent in parents.items() if parent in tree} - tree:
        tree |= grown
    total = 0
    for pid in tree:
        with suppress(OSError):
            lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
            total += sum(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    return total * 1024 / 1e6


def installed_megabytes(package: str) -> float:
    """Return the size of a package's files, without those of its dependencies, MB."""
    files = distribution(package).files or []
    sizes = (Path(str(file.locate())).stat().st_size for file in files if Path(str(file.locate())).is_file())
    return sum(sizes) / 1e6


def main() -> None:
    if missing := missing_programs():
        sys.exit(f"{', '.join(missing)} not on PATH; apt-get install slurm-wlm munge installs SLURM.")
    require_idle()
    sweeps: dict[str, list[Sweep]] = {engine: [] for engine in ENGINES}
    with (
        tempfile.TemporaryDirectory(prefix="slurm") as slurm_folder,
        tempfile.TemporaryDirectory(prefix="engines") as folder,
    ):
        cluster = SlurmCluster(Path(slurm_folder))
        try:
            application = Application(
                Path(folder), {**os.environ, **cluster.environment, "PYTHONPATH": str(ROOT)}
            )
            for _ in range(ROUNDS):
                for engine in ENGINES:
                    sweeps[engine].append(application.run(engine))
            slurm_version = cluster.command("squeue", "--version").split()[-1]
        finally:
            cluster.close()
    base = [sweep.total for sweep in sweeps["pool, new processes"]]
    lines = []
    for engine, measured in sweeps.items():
        ratios = [sweep.total / other for sweep, other in zip(measured, base, strict=True)]
        first, total, job, memory = zip(*measured, strict=True)
        columns = (first, job, total, ratios, memory)
        lines.append(f"| {engine} | {' | '.join(median_and_range(column) for column in columns)} |")
    write_page(
        __file__,
        [
            "# The time that an engine adds to a job",
            "",
            "This page compares the engines of a sweep (`hydra/launcher`) on one machine. The jobs do nothing: each is "
            "an empty Python script. So the time of a sweep is what the command, the engine and the start of Python "
            "take. The pool starts its jobs as forks of a process, which here has not imported PyTorch; "
            "[sweep_start](sweep_start.md) measures what forks save in training runs.",
            "",
            f"Each engine runs a sweep of {JOBS} jobs. The pool runs {AT_ONCE} jobs at once. SLURM has two nodes of "
            "two cores each on this machine (real daemons on loopback), and runs four jobs at once. Ray starts a local "
            "cluster for each sweep, and runs one job per core of the machine. The time of a job is the time from "
            f"the start of the first job to the end of the command, divided by {JOBS}. The memory is the largest "
            "proportional set size of the command and the processes that it starts, without the daemons and jobs of "
            f"SLURM. All numbers are medians of {ROUNDS} interleaved rounds, with the smallest and the largest round "
            "in brackets.",
            "",
            "| engine | before the first job, s | each job, s | whole sweep, s | relative to new processes | memory, "
            "MB |",
            "|---|---:|---:|---:|---:|---:|",
            *lines,
            "",
            f"The installed packages take {installed_megabytes('submitit'):.1f} MB (submitit) and "
            f"{installed_megabytes('ray'):.0f} MB (Ray) on disk, without their dependencies. The pool needs no "
            "package.",
            "",
            f"{machine('hydra-core', 'submitit', 'ray')[:-1]}, SLURM {slurm_version}. "
            "Command: `python -m benchmarks.framework.engines`.",
        ],
    )


if __name__ == "__main__":
    main()
