"""A SLURM of two nodes on this machine for tests, on loopback, without root's rights, services or /etc.

It needs the programs of Debian's packages slurm-wlm and munge on PATH, wherever they are installed.
"""

import os
import secrets
import shutil
import signal
import socket
import subprocess
import time
from contextlib import suppress
from pathlib import Path

PROGRAMS = ("slurmctld", "slurmd", "munged", "sbatch", "squeue", "scancel", "scontrol", "srun")
CONFIG = """
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CredType=cred/munge
PluginDir={plugins}
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool.%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.%n.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SchedulerType=sched/backfill
SchedulerParameters=sched_interval=1,bf_interval=1,batch_sched_delay=0
ReturnToService=2
KillWait=2
InactiveLimit=0
SlurmdTimeout=10
JobRequeue=1
NodeName=n1 NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[1]} CPUs=2 RealMemory=2000 State=UNKNOWN
NodeName=n2 NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[2]} CPUs=2 RealMemory=2000 State=UNKNOWN
PartitionName=main Nodes=n1,n2 Default=YES MaxTime=INFINITE OverSubscribe=NO State=UP
"""


def missing_programs() -> list[str]:
    """Return the programs of SLURM and MUNGE that are not on PATH."""
    return [name for name in PROGRAMS if shutil.which(name) is None]


class SlurmCluster:
    """A running SLURM; `environment` has the variables with which its commands reach it.

    Args:
        folder: Folder of all its files, whose path must be short because of the sockets in it.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.environment = {**os.environ, "SLURM_CONF": str(folder / "slurm.conf")}
        for name in ("state", "spool.n1", "spool.n2"):
            (folder / name).mkdir(parents=True, exist_ok=True)
        key = folder / "munge.key"
        key.touch(mode=0o600)
        key.write_bytes(secrets.token_bytes(128))
        host = socket.gethostname().partition(".")[0]
        sbin = Path(str(shutil.which("slurmctld"))).parent
        user = subprocess.run(["id", "-un"], capture_output=True, text=True, check=True).stdout.strip()
        plugins = next(sbin.parent.glob("lib/*/slurm*/auth_munge.so")).parent
        config = CONFIG.format(folder=folder, host=host, user=user, plugins=plugins, ports=_free_ports(3))
        (folder / "slurm.conf").write_text(config)
        try:
            self._run(
                *("munged", "--force", f"--key-file={key}", f"--socket={folder}/munge.socket"),
                *(f"--pid-file={folder}/munge.pid", f"--log-file={folder}/munge.log"),
                f"--seed-file={folder}/munge.seed",
            )
            self._run("slurmctld")
            self._stepd = shutil.which("slurmstepd") or str(next(sbin.glob("slurmstepd*")))
            for node in ("n1", "n2"):
                self.start_node(node)
        except BaseException:  # the test was stopped, or a daemon does not start
            self.close()
            raise

    def start_node(self, node: str) -> None:
        """Start the daemon of a node, and wait until jobs can run there."""
        self._run("slurmd", "-N", node, "-d", self._stepd)
        deadline = time.monotonic() + 30
        while self.command("sinfo", "-h", "-o", "%T", "-n", node).strip() not in ("idle", "mixed"):
            if time.monotonic() > deadline:
                logs = "\n".join(path.read_text()[-2000:] for path in self.folder.glob("*.log"))
                raise TimeoutError(f"the node {node} did not start:\n{logs}")
            time.sleep(0.05)

    def kill_node(self, node: str) -> None:
        """Kill the daemon of a node and every process that it has started, as when a machine loses its power.

        The processes that report the end of a job die before the job, so that nobody reports its end.
        """
        _kill(int((self.folder / f"slurmd.{node}.pid").read_text()))
        marks = {f"SLURMD_NODENAME={node}".encode(), f"SLURM_CONF={self.folder}/slurm.conf".encode()}
        jobs, reporters = set[int](), set[int]()
        for process in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):  # the process has ended
                if marks <= set((process / "environ").read_bytes().split(b"\0")):
                    jobs.add(int(process.name))
                    parent = int((process / "stat").read_text().rpartition(")")[2].split()[1])
                    if b"slurmstepd" in Path(f"/proc/{parent}/cmdline").read_bytes():
                        reporters.add(parent)
        for pid in (*reporters, *jobs):
            _kill(pid)

    def kill_script(self, number: str) -> None:
        """Kill the batch script of a running job on its node."""
        script = f"job{int(number):05}/slurm_script".encode()
        for process in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):  # the process has ended
                words = (process / "cmdline").read_bytes().split(b"\0")
                if any(word.startswith(bytes(self.folder)) and word.endswith(script) for word in words):
                    _kill(int(process.name))

    def command(self, *words: str) -> str:
        """Return the output of a command of SLURM."""
        done = subprocess.run(words, env=self.environment, capture_output=True, text=True, check=False)
        return done.stdout

    def close(self) -> None:
        """Cancel all jobs and end the daemons."""
        self.command("scancel", "--user", str(os.getuid()))
        paths = [self.folder / f"{name}.pid" for name in ("slurmd.n1", "slurmd.n2", "slurmctld", "munge")]
        pids = [int(path.read_text()) for path in paths if path.is_file()]
        for pid in pids:
            _kill(pid, signal.SIGTERM)
        deadline = time.monotonic() + 10
        while any(Path(f"/proc/{pid}").exists() for pid in pids) and time.monotonic() < deadline:
            time.sleep(0.05)

    def _run(self, *words: str) -> None:
        subprocess.run(
            words, env=self.environment, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )


def _free_ports(count: int) -> list[int]:
    sockets = [socket.socket() for _ in range(count)]
    for one in sockets:
        one.bind(("127.0.0.1", 0))
    ports = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return ports


def _kill(pid: int, number: int = signal.SIGKILL) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, number)
