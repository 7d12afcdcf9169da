"""Training over the processes of other launchers: torchrun and srun, each with two nodes of one process on loopback."""

import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import pytest

from framework.errors import ConfigError
from framework.training.process_count import count_devices, require_processes
from tests.conftest import PATIENCE, TINY, Done, Framework, paths_again, wait_for
from tests.fuzz.kills import ROOT, status
from tests.slurm_cluster import SlurmCluster, missing_programs
from tests.test_ranks import numbers

TORCHRUN = {
    "TORCHELASTIC_RUN_ID": "none",
    "WORLD_SIZE": "2",
    "LOCAL_WORLD_SIZE": "1",
    "GROUP_WORLD_SIZE": "2",
}
BATCH = {"SLURM_NTASKS": "2", "SLURM_PROCID": "0", "SLURM_JOB_NAME": "job.sh", "SLURM_NNODES": "2"}
SRUN = {**BATCH, "SLURM_STEP_NUM_TASKS": "2", "SLURM_NTASKS_PER_NODE": "1"}
NODES = {"strategy": "ddp", "devices": 1, "num_nodes": 2}


@pytest.mark.parametrize(
    ("environment", "trainer", "sentence"),
    [
        (TORCHRUN, {"devices": 1}, "torchrun has started 2 processes .* make 1 processes"),
        (TORCHRUN, {"devices": 2, "num_nodes": 1}, "make 2 processes. Set trainer.num_nodes=2 trainer.devices=1"),
        (TORCHRUN | {"WORLD_SIZE": "3"}, NODES, "Start equally many on each node, or start 1 on each of 2 nodes"),
        (BATCH, NODES, "runs in a SLURM allocation of 2 tasks, but srun has not started it"),
        (BATCH, {"devices": 1}, "Write srun before the command, or request one task"),
        (SRUN, {"devices": 1}, "srun has started 2 processes on 2 nodes"),
        ({**SRUN, "SLURM_NTASKS_PER_NODE": ""}, NODES, "Add --ntasks-per-node=1"),
        ({}, NODES, "no launcher has started this command on 2 nodes"),
    ],
)  # fmt: skip
def test_processes_that_are_not_those_of_the_settings_are_refused(
    environment: Mapping[str, str],
    trainer: Mapping[str, object],
    sentence: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, value in environment.items():
        monkeypatch.setenv(name, value) if value else monkeypatch.delenv(name, raising=False)
    with pytest.raises(ConfigError, match=sentence):
        require_processes(trainer)


@pytest.mark.parametrize(
    ("environment", "trainer"),
    [
        (TORCHRUN, NODES),
        (SRUN, NODES),
        (BATCH | {"SLURM_JOB_NAME": "interactive"}, {"devices": 2}),
        (BATCH | {"SLURM_NTASKS": "1"}, {"devices": 2}),
        ({"WORLD_SIZE": "2", "LOCAL_RANK": "1"}, {"devices": 2}),
        ({"MASTER_ADDR": "node1", "NODE_RANK": "1"}, NODES),
    ],
)
def test_processes_of_the_settings_pass(
    environment: Mapping[str, str], trainer: Mapping[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    require_processes(trainer)


@pytest.mark.parametrize(
    ("devices", "count"), [(2, 2), ("3", 3), ([0, 2], 2), ("0,1,3", 3), ("auto", 1), (-1, 1)]
)
def test_devices_are_counted(devices: object, count: int) -> None:
    assert count_devices({"devices": devices, "accelerator": "cpu"}) == count


STEPS = (
    *(*TINY, "logger=none", "trainer.accelerator=cpu", "trainer.checkpoint_every_steps=1"),
    *("trainer=ddp", "trainer.devices=1", "trainer.num_nodes=2"),
)
Start = Callable[[list[str], Mapping[str, str], Path], int]
"""Function that runs a Python module with arguments on two nodes of one process, and returns the exit code.

Its arguments are the module with its arguments, further environment variables, and the file for the output.
"""


def on_two_nodes_of_torchrun(words: list[str], environment: Mapping[str, str], output: Path) -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    launch = [sys.executable, "-P", "-m", "torch.distributed.run", "--nnodes=2", "--nproc-per-node=1"]
    launch += ["--master-addr=127.0.0.1", f"--master-port={port}"]
    with output.open("ab") as file:
        nodes = [
            subprocess.Popen(
                [*launch, f"--node-rank={node}", "-m", *words],
                env={**os.environ, **environment}, stdout=file, stderr=file, cwd=output.parent,
            )
            for node in range(2)
        ]  # fmt: skip
        return max(abs(node.wait(timeout=PATIENCE)) for node in nodes)


def environment_of_nodes(site: Path, folder: Path) -> dict[str, str]:
    return {
        "PYTHONPATH": os.pathsep.join(map(str, (ROOT, site))),
        "FRAMEWORK_CACHE": str(folder / "cache"),
        "GLOO_SOCKET_IFNAME": "lo",  # both nodes are this machine
        "OMP_NUM_THREADS": "1",
    }


@pytest.fixture(scope="module")
def whole_of_two_nodes(stranger_site: Path, tmp_path_factory: pytest.TempPathFactory) -> Done:
    """Train on two nodes without an interruption; no setting names the folder of the run."""
    base = tmp_path_factory.mktemp("two_nodes")
    output = base / "output.txt"
    code = on_two_nodes_of_torchrun(["framework", *STEPS], environment_of_nodes(stranger_site, base), output)
    (folder,) = [path.parent for path in base.rglob("*/journal.jsonl")]
    return Done(code, output.read_text(), folder)


@pytest.mark.slow
def test_ranks_of_another_launcher_leave_one_folder(whole_of_two_nodes: Done) -> None:
    """Hydra makes a folder for each process, named after the time, if the command names none."""
    assert whole_of_two_nodes.code == 0, whole_of_two_nodes.out
    folder = whole_of_two_nodes.folder
    assert [path for path in folder.parent.iterdir() if path.is_dir()] == [folder]


@pytest.fixture
def srun() -> Iterator[Start]:
    if missing := missing_programs():
        pytest.skip(f"{', '.join(missing)} not on PATH; apt-get install slurm-wlm munge installs SLURM")
    with tempfile.TemporaryDirectory(prefix="slurm") as folder:  # a short path, because it holds sockets
        cluster = SlurmCluster(Path(folder))

        def start(words: list[str], environment: Mapping[str, str], output: Path) -> int:
            options = ["--nodes=2", "--ntasks-per-node=1", "--kill-on-bad-exit=1", f"--chdir={output.parent}"]
            with output.open("ab") as file:
                return subprocess.run(
                    ["srun", *options, sys.executable, "-P", "-m", *words],
                    env={**cluster.environment, **environment, "MASTER_ADDR": "127.0.0.1"},
                    stdout=file, stderr=file, timeout=PATIENCE, check=False,
                ).returncode  # fmt: skip

        yield start
        cluster.close()


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["torchrun", "srun"])
def test_a_run_of_two_nodes_whose_ranks_are_killed_is_finished_by_one_process(
    launcher: str, whole_of_two_nodes: Done, framework: Framework, stranger_site: Path, tmp_path: Path,
    request: pytest.FixtureRequest,
) -> None:  # fmt: skip
    start: Start = on_two_nodes_of_torchrun if launcher == "torchrun" else request.getfixturevalue("srun")
    output, killed, folder = tmp_path / "nodes.txt", tmp_path / "killed", tmp_path / "run"
    environment = {**environment_of_nodes(stranger_site, tmp_path), "KILLED": str(killed)}

    def train(*words: str, kill: str = "") -> None:
        code = start(["tests.killed", *words], {**environment, "KILL": kill}, output)
        assert (code != 0, killed.exists()) == (bool(kill), bool(kill)), output.read_text()
        killed.unlink(missing_ok=True)

    train(*STEPS, f"hydra.run.dir={folder}", kill="1|collective|SIGKILL")
    wait_for(lambda: status(folder) in ("FAILED", "KILLED"))
    resume = [f"resume={folder}", *paths_again([f"resume={folder}"])]
    train(*resume, kill="0|between epochs|SIGKILL")
    wait_for(lambda: status(folder) == "KILLED")
    done = framework(*resume, "trainer.num_nodes=1")
    assert done.code == 0, done.out
    assert "2 processes trained before, and 1 train from here on" in done.out
    wanted, found = (numbers(Done(0, "", path), "") for path in (whole_of_two_nodes.folder, folder))
    metrics = [key for key in wanted if not key.startswith("cost/")]
    assert len(metrics) > 30
    assert found.keys() == wanted.keys()
    for key in metrics:
        assert found[key] == pytest.approx(wanted[key], rel=1e-5, abs=1e-7, nan_ok=True), key
