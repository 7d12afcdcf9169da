"""Tests of the engines of a sweep: the same jobs, records and tables on the pool, on SLURM and on Ray.

SLURM runs with real daemons on loopback (`slurm_cluster.py`), if the programs of Debian's packages slurm-wlm and munge
are on PATH. Ray runs a cluster of this machine.
"""

import csv
import ipaddress
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import pytest

from framework.errors import ConfigError, UserError
from framework.reports.table import COST_COLUMNS
from framework.sweeps import slurm as slurm_engine
from framework.sweeps.jobs import runs_elsewhere
from framework.sweeps.node import NODE
from framework.sweeps.ray_guard import cluster_processes, start_guard
from framework.sweeps.ray_tasks import Ray, RaySettings
from tests.conftest import PATIENCE, wait_for
from tests.slurm_cluster import SlurmCluster, missing_programs
from tests.test_pool import ROOT, App

Address = ipaddress.IPv4Address | ipaddress.IPv6Address
MOONS = (
    *("experiment=moons/vanilla_128", "seed=0,1", "encoder.mlp.widths=[8],[16]", "debug=fast"),
    *("pictures=false", "logger=none", "threads=1"),
)


@pytest.fixture(scope="module")
def slurm() -> Iterator[SlurmCluster]:
    if missing := missing_programs():
        pytest.skip(f"{', '.join(missing)} not on PATH; apt-get install slurm-wlm munge installs SLURM")
    with tempfile.TemporaryDirectory(prefix="slurm") as folder:  # a short path, because it holds sockets
        cluster = SlurmCluster(Path(folder))
        yield cluster
        cluster.close()


@pytest.fixture
def app(slurm: SlurmCluster, tmp_path: Path) -> Iterator[App]:
    app = App(tmp_path, launcher="slurm")
    app.environment |= {"SLURM_CONF": slurm.environment["SLURM_CONF"]}
    yield app
    app.close()
    slurm.command("scancel", "--user", str(os.getuid()))


def handles(app: App, *numbers: int) -> list[str]:
    return [app.record(number)["handle"] for number in numbers]


def start_requeued_job(app: App, slurm: SlurmCluster) -> None:
    """Start job 0 three seconds after SLURM has queued it again; SLURM itself waits two minutes.

    A node refuses a job that starts in the same second in which its earlier try was killed.
    """
    number = app.record(0)["handle"].partition(":")[2]
    wait_for(lambda: slurm.command("squeue", "-h", "-j", number, "-o", "%T").strip() == "PENDING")
    slurm.command("scontrol", "update", f"JobId={number}", "StartTime=now+3")


def test_a_sweep_begun_on_slurm_is_finished_on_the_pool(app: App) -> None:
    code, output = app("what=ok,raise,once", "x=1")
    assert code == 1, output
    records = [app.record(number) for number in range(3)]
    assert [record["status"] for record in records] == ["completed", "failed", "died"]
    assert records[1]["error"] == "ValueError: this job is bad (exit code 1)"
    assert records[2]["error"].startswith("killed by SIGKILL on n")
    assert all(record["processor_seconds"] > 0 for record in records)
    assert (app.sweep / "0" / "console.log").read_text() == "hello from ok\n"
    app.chosen = "hydra/launcher=pool"
    code, output = app("what=ok,once", "x=1")
    assert (code, [app.tries(number) for number in range(3)]) == (0, [1, 1, 2]), output
    assert app.record(2)["handle"] is None


@pytest.mark.slow
def test_jobs_of_slurm_outlive_their_launcher_and_are_taken_up_again(app: App, slurm: SlurmCluster) -> None:
    arguments = ["-m", app.chosen, "what=hold", "x=0,1,2", "hydra.launcher.cpus=2"]
    process = app.start(*arguments)
    app.until_ready(0, 1)  # the third waits in SLURM for a free node
    wait_for(lambda: all(handle is not None for handle in handles(app, 0, 1, 2)))
    before = handles(app, 0, 1, 2)
    process.kill()
    process.wait()
    again, pool = app.start(*arguments), app.start("-m", "hydra/launcher=pool", *arguments[2:4])
    wait_for(lambda: app.said().count("was started earlier") >= 3)
    (app.folder / "release").touch()
    assert [again.wait(timeout=PATIENCE), pool.wait(timeout=PATIENCE)] == [0, 0], app.said()
    assert handles(app, 0, 1, 2) == before
    assert [app.tries(number) for number in range(3)] == [1, 1, 1]
    assert [app.record(number)["status"] for number in range(3)] == ["completed"] * 3


@pytest.mark.slow
def test_an_eager_sweep_returns_and_shows_its_table_when_it_is_repeated(app: App) -> None:
    arguments = ("what=hold", "x=0,1", "hydra.launcher.eager=true")
    assert app(*arguments)[0] == 0
    assert "2 of 2 jobs go on without this command" in app.said()
    app.until_ready(0, 1)
    assert app(*arguments)[0] == 0
    assert "2 of 2 jobs go on without this command" in app.said()
    (app.folder / "release").touch()
    assert app(*arguments[:2])[0] == 0
    assert [(app.record(job)["status"], app.tries(job)) for job in range(2)] == [("completed", 1)] * 2


@pytest.mark.slow
def test_a_job_is_neither_lost_nor_doubled_when_its_node_dies(app: App, slurm: SlurmCluster) -> None:
    process = app.start("-m", app.chosen, "what=hold", "x=0,1", "hydra.launcher.cpus=2")
    app.until_ready(0, 1)
    nodes = [json.loads((app.sweep / str(job) / "node.json").read_text())["host"] for job in range(2)]
    assert set(nodes) == {"n1", "n2"}
    before = handles(app, 0, 1)
    slurm.kill_node(nodes[0])
    wait_for(lambda: "sweep-" in slurm.command("squeue", "-h", "-t", "PENDING", "-o", "%j"))
    assert app.record(0)["status"] == "running", "SLURM has queued the job again by itself"
    (app.folder / "release").touch()
    # The job starts again on the other node. On its first node, the command that kills its first try could still
    # arrive; SLURM waits two minutes, so that it arrives before the second try.
    start_requeued_job(app, slurm)
    assert process.wait(timeout=PATIENCE) == 0, app.said()
    slurm.start_node(nodes[0])
    assert handles(app, 0, 1) == before
    assert [app.tries(job) for job in range(2)] == [2, 1]
    assert app.record(0)["processor_seconds"] is None


@pytest.mark.slow
def test_a_job_whose_batch_script_is_killed_on_its_node_is_done_again(app: App, slurm: SlurmCluster) -> None:
    process = app.start("-m", app.chosen, "what=hold")
    app.until_ready(0)
    before = app.record(0)["handle"]
    slurm.kill_script(before.partition(":")[2])
    wait_for(lambda: app.said().count("#0 started") == 2)
    assert "#0 died after" in app.said()
    (app.folder / "release").touch()
    assert process.wait(timeout=PATIENCE) == 0, app.said()
    assert (app.tries(0), app.record(0)["status"]) == (2, "completed")
    assert app.record(0)["handle"] != before


@pytest.mark.parametrize(
    ("line", "lost"),
    [
        ("FAILED|JobLaunchFailure", True),
        ("NODE_FAIL|None", True),
        ("PREEMPTED|None", True),
        ("FAILED|NonZeroExitCode", False),
        ("OUT_OF_MEMORY|OutOfMemory", False),
        ("CANCELLED|None", False),
    ],
)
@pytest.mark.parametrize("code", [None, 143, 1])
def test_a_job_is_lost_if_slurm_says_so_and_the_job_did_not_end_by_itself(
    line: str, lost: bool, code: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = {"handle": "slurm:7", "host": "n1", "seconds": 1.0, "code": code, "reason": None}
    (tmp_path / NODE).write_text(json.dumps(state))
    listed = slurm_engine.Listed(*line.split("|"), slurm_engine.job_name(tmp_path))
    monkeypatch.setattr(slurm_engine.QUEUE, "state", lambda *_, **__: listed)
    monkeypatch.setattr(slurm_engine, "_ENDED", dict.fromkeys(slurm_engine._ENDED, 0.0))
    process = slurm_engine.SlurmProcess("slurm:7", tmp_path)
    assert process.poll() == (-signal.SIGKILL if code is None else code)
    assert process.lost == (lost and code != 1)


def test_no_batch_file_that_lies_in_the_folder_of_a_sweep_is_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A node unpickles what lies under the name of its job in this folder, before submitit has moved the job there."""
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "srun").write_text("#!/bin/sh")
    (tmp_path / "bin" / "srun").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path / "bin"), prepend=os.pathsep)
    planted = tmp_path / slurm_engine.SUBMITTED
    planted.mkdir()
    for number in range(9):
        (planted / f"{number}_submitted.pkl").write_bytes(b"code")
    settings = slurm_engine.SlurmSettings()
    folders = [Path(slurm_engine.Slurm(tmp_path, settings)._executor.folder) for _ in range(2)]
    for folder in folders:
        assert folder.parent == planted and not list(folder.glob("*.pkl"))
    assert folders[0] != folders[1]


@pytest.mark.slow
def test_a_job_at_its_time_limit_is_queued_again_and_goes_on(app: App, slurm: SlurmCluster) -> None:
    process = app.start("-m", app.chosen, "what=hold")
    app.until_ready(0)
    slurm.command("scancel", "--signal=USR2", app.record(0)["handle"].partition(":")[2])
    wait_for((app.sweep / "0" / "closed SIGTERM").exists)
    (app.folder / "release").touch()
    start_requeued_job(app, slurm)
    assert process.wait(timeout=PATIENCE) == 0, app.said()
    assert (app.tries(0), app.record(0)["status"]) == (2, "completed")
    assert app.record(0)["processor_seconds"] > 0


@pytest.mark.slow
def test_ctrl_c_stops_waiting_and_running_jobs_of_slurm(app: App) -> None:
    process = app.start("-m", app.chosen, "what=hold", "x=0,1,2", "hydra.launcher.cpus=2")
    app.until_ready(0, 1)
    wait_for(lambda: app.record(2).get("handle") is not None)
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=PATIENCE) == 130, app.said()
    assert [app.record(job)["status"] for job in range(3)] == ["died"] * 3
    assert [app.record(job)["error"] for job in range(2)] == ["stopped by SIGTERM"] * 2
    assert app.record(2)["error"].startswith("ended by SLURM: CANCELLED")
    assert (app.sweep / "0" / "closed SIGTERM").exists()


@pytest.mark.slow
def test_a_closed_terminal_leaves_jobs_of_slurm_alone(app: App) -> None:
    process = app.start("-m", app.chosen, "what=hold")
    app.until_ready(0)
    process.send_signal(signal.SIGHUP)
    assert process.wait(timeout=PATIENCE) == 128 + signal.SIGHUP
    assert app.record(0)["status"] == "running"
    (app.folder / "release").touch()
    assert app("what=hold")[0] == 0
    assert app.tries(0) == 1


@pytest.mark.slow
def test_a_handle_from_a_file_cancels_no_other_job(app: App, slurm: SlurmCluster) -> None:
    """A sweep's folder may come from another person, who names a job of the user in a record."""
    mine = slurm.command("sbatch", "--parsable", "-o", "/dev/null", "--wrap", "sleep 100").strip()
    assert app("what=once")[0] == 1
    record = app.record(0) | {"status": "running", "handle": f"slurm:{mine}", "config": "another"}
    (app.sweep / "0" / "job.json").write_text(json.dumps(record))
    assert app("what=once")[0] == 0
    assert app.tries(0) == 2
    assert slurm.command("squeue", "-h", "-j", mine, "-o", "%T").strip() == "RUNNING"


@pytest.mark.slow
def test_what_slurm_refuses_is_said_in_its_words(app: App) -> None:
    assert app("what=ok", "hydra.launcher.partition=none")[0] == 1
    assert app.record(0)["status"] == "failed"
    assert "invalid partition specified: none" in app.record(0)["error"]
    code, output = app("what=ok", "hydra.launcher.cpus=many")
    assert code == 1
    assert "hydra.launcher.cpus = 'many'" in output


@pytest.fixture
def ray_app(tmp_path: Path) -> Iterator[App]:
    pytest.importorskip("ray", reason="pip install -e '.[ray]' installs Ray")
    app = App(tmp_path, launcher="ray")
    yield app
    app.close()


@pytest.mark.slow
def test_a_sweep_begun_on_ray_is_finished_on_the_pool(ray_app: App) -> None:
    process = ray_app.start("-m", ray_app.chosen, "what=ok,raise,once,hold")
    ray_app.until_ready(3)
    wait_for(
        lambda: all(ray_app.record(job)["status"] not in ("queued", "running") for job in range(3)), PATIENCE
    )
    addresses = listening_addresses(process.pid)
    assert addresses
    assert all(address.is_loopback for address in addresses), addresses
    process.kill()
    process.wait()
    wait_for((ray_app.sweep / "3" / "closed SIGTERM").exists)
    records = [ray_app.record(number) for number in range(4)]
    assert [record["status"] for record in records] == ["completed", "failed", "died", "running"]
    assert not any(map(runs_elsewhere, records))
    assert records[2]["error"].startswith("killed by SIGKILL on ")
    assert all(record["processor_seconds"] > 0 for record in records[:3])
    (ray_app.folder / "release").touch()
    ray_app.chosen = "hydra/launcher=pool"
    assert ray_app("what=ok,once,hold")[0] == 0
    assert [ray_app.tries(number) for number in range(4)] == [1, 1, 2, 2]


def listening_addresses(parent: int) -> set[Address]:
    """Return the addresses at which a process and its descendants listen (Linux)."""
    sockets = set[str]()
    for pid in family_of(parent):
        with suppress(OSError):  # the process has ended
            for file in Path(f"/proc/{pid}/fd").iterdir():
                with suppress(OSError):
                    sockets.add(str(file.readlink()))
    lines = [
        line.split()
        for name in ("tcp", "tcp6")
        for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]
    ]
    return {
        address_of(local.partition(":")[0])
        for _, local, _, state, _, _, _, _, _, inode, *_ in lines
        if state == "0A" and f"socket:[{inode}]" in sockets
    }


def address_of(digits: str) -> Address:
    """Return an address of /proc/net/tcp or tcp6, whose words of four bytes have the order of the machine."""
    words = [
        int(digits[start : start + 8], 16).to_bytes(4, sys.byteorder) for start in range(0, len(digits), 8)
    ]
    address = ipaddress.ip_address(b"".join(words))
    return getattr(address, "ipv4_mapped", None) or address


def family_of(parent: int) -> list[int]:
    """Return a process and its descendants (Linux)."""
    children: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):  # the process has ended
            children.setdefault(int(stat.read_text().rpartition(")")[2].split()[1]), []).append(
                int(stat.parent.name)
            )
    family = [parent]
    for pid in family:  # grows while it is read
        family += children.get(pid, [])
    return family


@pytest.mark.parametrize("failures", [1, 3])
def test_a_local_cluster_of_ray_that_does_not_start_is_started_again(
    failures: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Let `ray.init` fail as on a busy machine."""
    starts, ended = [], []

    def init(**settings: object) -> None:
        starts.append(settings)
        if len(starts) <= failures:
            raise Exception("The current node timed out during startup.")

    ray = SimpleNamespace(init=init, shutdown=lambda: ended.append(0), remote=lambda **_: lambda task: task)
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setattr(os, "environ", dict(os.environ))
    if failures < 3:
        Ray(RaySettings()).close()
        ended.pop()
    else:
        with pytest.raises(
            UserError, match=r"no cluster on this machine in 3 attempts \(The current node timed out"
        ):
            Ray(RaySettings())
    assert (len(starts), len(ended)) == (min(failures + 1, 3), failures)
    with pytest.raises(ConfigError, match=r"address=127\.0\.0\.1:1 cannot be reached"):
        starts.clear()
        Ray(RaySettings(address="127.0.0.1:1"))
    assert len(starts) == 1


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere /proc does not list the processes")
def test_the_processes_of_a_ray_cluster_are_ended_and_no_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The input of the guard ends as if the command had died; the processes ignore SIGTERM, as Ray's agents may."""
    pytest.importorskip("ray", reason="pip install -e '.[ray]' installs Ray")
    import ray

    own, other = "a" * 64, "b" * 64
    agent = [str(Path(ray.__file__).parent / "agent.py")]
    script = "import signal, sys; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(); sys.stdin.read()"
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", script, *words],
            env={**os.environ, "RAY_AUTH_TOKEN": token},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        for token, words in ((own, agent), (other, agent), (own, ["-m", "framework"]))
    ]
    try:
        for process in processes:
            assert process.stdout is not None
            process.stdout.readline()
        assert cluster_processes(own) == [processes[0].pid]
        monkeypatch.setenv("RAY_AUTH_TOKEN", own)
        with start_guard() as guard:
            assert guard.stdin is not None
            guard.stdin.close()
            assert processes[0].wait(PATIENCE) == -signal.SIGKILL
            assert guard.wait(PATIENCE) == 0
        assert [process.poll() for process in processes[1:]] == [None, None]
    finally:
        for process in processes:
            process.kill()
            process.communicate()


@pytest.mark.slow
def test_a_signal_ends_the_tasks_of_ray(ray_app: App) -> None:
    process = ray_app.start("-m", ray_app.chosen, "what=hold", "x=0,1", "hydra.launcher.jobs=1")
    ray_app.until_ready(0)
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=PATIENCE) == 130, ray_app.said()
    assert [ray_app.record(job)["status"] for job in range(2)] == ["died", "queued"]
    assert (ray_app.sweep / "0" / "closed SIGTERM").exists()


CLUSTER = """
import os, sys, time
from pathlib import Path
from ray.cluster_utils import Cluster
here = Path(sys.argv[1])
small = dict(num_cpus=1, object_store_memory=100_000_000, node_ip_address="127.0.0.1")
cluster = Cluster(initialize_head=True, head_node_args=dict(include_dashboard=False, **small))
node = cluster.add_node(**small)
(here / "address").write_text(cluster.address)
while not (here / "kill").exists():
    time.sleep(0.05)
cluster.remove_node(node, allow_graceful=False)
(here / "killed").touch()
while not (here / "end").exists():
    time.sleep(0.05)
cluster.shutdown()
"""


@pytest.mark.slow
def test_a_job_is_done_again_when_the_node_of_its_ray_task_dies(ray_app: App) -> None:
    ray_app.environment |= {
        "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN": "5" * 64,
    }
    cluster = subprocess.Popen([sys.executable, "-c", CLUSTER, str(ray_app.folder)], env=ray_app.environment)
    try:
        wait_for((ray_app.folder / "address").exists)
        address = (ray_app.folder / "address").read_text()
        process = ray_app.start(
            "-m", ray_app.chosen, "what=hold", "x=0,1", f"hydra.launcher.address='{address}'"
        )
        ray_app.until_ready(0, 1)
        (ray_app.folder / "kill").touch()
        wait_for(lambda: "ended by Ray" in ray_app.said())
        (ray_app.folder / "release").touch()
        assert process.wait(timeout=PATIENCE) == 0, ray_app.said()
        assert sorted(ray_app.tries(job) for job in range(2)) == [1, 2]
    finally:
        (ray_app.folder / "kill").touch()
        (ray_app.folder / "end").touch()
        cluster.wait(timeout=PATIENCE)


@pytest.fixture(scope="module")
def pool_table(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, str]]:
    return moons("pool", tmp_path_factory.mktemp("pool"), {})


@pytest.mark.slow
def test_a_sweep_of_moons_on_slurm_ends_with_the_table_of_the_pool(
    pool_table: list[dict[str, str]], slurm: SlurmCluster, tmp_path: Path
) -> None:
    assert moons("slurm", tmp_path, slurm.environment) == pool_table


@pytest.mark.slow
def test_a_sweep_of_moons_on_ray_ends_with_the_table_of_the_pool(
    pool_table: list[dict[str, str]], tmp_path: Path
) -> None:
    pytest.importorskip("ray", reason="pip install -e '.[ray]' installs Ray")
    assert moons("ray", tmp_path, {}) == pool_table


def moons(launcher: str, sweep: Path, environment: Mapping[str, str]) -> list[dict[str, str]]:
    """Run a sweep of four short runs, and return its table without the costs."""
    command = [sys.executable, "-m", "framework", "-m", *MOONS, f"hydra/launcher={launcher}"]
    done = subprocess.run(
        [*command, f"hydra.sweep.dir={sweep}"],
        cwd=ROOT, env={**os.environ, **environment}, capture_output=True, text=True, timeout=PATIENCE,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    with (sweep / "comparison.csv").open() as file:
        table = list(csv.DictReader(file))
    assert len(table) == 2
    costs = (*COST_COLUMNS, *COST_COLUMNS.values())
    return [{key: value for key, value in row.items() if not key.startswith(costs)} for row in table]
