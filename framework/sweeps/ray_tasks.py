"""Engine that runs the jobs of a sweep as tasks of Ray, on an existing cluster or on a local one.

A task ends with the command that started it, so the jobs do not outlive the command. Tasks are never retried by Ray:
the sweep starts a job again if its node failed, after the earlier processes of the job have released the job's folder.
"""

import logging
import os
import secrets
import signal
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any
from uuid import uuid4

from pydantic import BaseModel, ConfigDict, Field

from framework.errors import ConfigError, UserError, shorten
from framework.sweeps.engines import Process
from framework.sweeps.node import NodeJob, read_node
from framework.sweeps.ray_guard import start_guard

_PASSED_ON = ("FRAMEWORK_", "MLFLOW_")
"""Beginnings of the names of environment variables that the jobs receive from this process; Ray passes on none."""
_OBJECT_STORE = 100_000_000
"""Bytes of shared memory of a local cluster; the tasks exchange no data."""
_STARTS = 3
"""Number of attempts to start a local cluster; Ray gives up after 30 s, which a busy machine exceeds."""

_log = logging.getLogger(__name__)


class RaySettings(BaseModel):
    """Cluster, and resources of each job, as Ray names them.

    Attributes:
        address: Address of the head node, host:port; None: a cluster on this machine for the time of the sweep.
        cpus: CPUs of each job.
        gpus: GPUs of each job, such as 1 or 0.5.
        resources: Other resources of the cluster that each job needs, such as {"a100": 1}.
    """

    model_config = ConfigDict(extra="forbid")
    address: str | None = None
    cpus: Annotated[int, Field(gt=0)] = 1
    gpus: Annotated[float, Field(ge=0)] = 0
    resources: dict[str, float] = {}


class Ray:
    """Engine whose jobs are tasks of Ray.

    Args:
        settings: Cluster, and resources of each job.
        connect: Whether there is a job to start, for which the cluster must be reached.

    Raises:
        ConfigError: The cluster cannot be reached.
        UserError: Ray starts no cluster on this machine.
    """

    interval = 0.1
    outlives = False

    def __init__(self, settings: RaySettings, connect: bool = True) -> None:
        self.threads = settings.cpus
        self._ray: Any = None
        self._guard: subprocess.Popen[bytes] | None = None
        if connect:
            self._connect(settings)

    def _connect(self, settings: RaySettings) -> None:
        if settings.address is None:
            # Ray 2.60 would listen on all addresses of this machine, without a password, and would kill a job by
            # SIGKILL when this command dies, often before the job has closed its run. It reads these variables when
            # it is imported.
            os.environ |= {
                "RAY_kill_child_processes_on_worker_exit": "0",
                "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
                "RAY_AUTH_MODE": "token",
                "RAY_AUTH_TOKEN": secrets.token_hex(32),
            }
            self._guard = start_guard()
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        import ray

        local = {
            "include_dashboard": False,
            "object_store_memory": _OBJECT_STORE,
            "_node_ip_address": "127.0.0.1",
        }
        for start in range(1, 1 + (_STARTS if settings.address is None else 1)):
            try:
                ray.init(
                    address=settings.address or "local",
                    log_to_driver=False,
                    logging_level=logging.ERROR,
                    **({} if settings.address else local),
                )
                break
            except (
                Exception
            ) as error:  # ConnectionError, an error of gRPC about the token, or a start that took 30 s
                ray.shutdown()
                reason = shorten(" ".join(str(error).split()))
                if settings.address is not None:
                    raise ConfigError(
                        f"The Ray cluster hydra.launcher.address={settings.address} cannot be reached ({reason}). Give "
                        "the address of its head node (host:port), and its token in RAY_AUTH_TOKEN, or null for a "
                        "cluster on this machine."
                    ) from error
                if start == _STARTS:
                    self.close()
                    raise UserError(
                        f"Ray has started no cluster on this machine in {_STARTS} attempts ({reason}). Repeat the "
                        "command when the machine is less busy, or choose hydra/launcher=pool, which needs no Ray."
                    ) from error
                _log.warning("Ray has not started (%s); it is started again", reason)
        self._ray = ray
        self._task = ray.remote(
            num_cpus=settings.cpus,
            num_gpus=settings.gpus,
            resources=settings.resources,
            max_retries=0,
        )(run_task)

    def start(
        self, command: Sequence[str], environment: Mapping[str, str], folder: Path, lock: int
    ) -> Process:
        handle = f"ray:{uuid4().hex}"
        passed_on = {name: value for name, value in os.environ.items() if name.startswith(_PASSED_ON)}
        job = NodeJob(list(command), passed_on | dict(environment), str(folder), str(Path.cwd()), handle)
        return RayProcess(self._ray, self._task.remote(job), handle, folder)

    def close(self) -> None:
        if self._ray is not None:
            self._ray.shutdown()
        if self._guard is not None:
            self._guard.kill()
            self._guard.communicate()


def run_task(job: NodeJob) -> None:
    """Run a job in a process of Ray."""
    job()


class RayProcess:
    """Task of Ray that runs a job; an implementation of the protocol `Process`.

    Args:
        ray: Module `ray`.
        reference: Reference to the result of the task.
        handle: Name by which the engine knows the job.
        folder: Folder of the job.
    """

    pid = None
    alive = True

    def __init__(self, ray: Any, reference: Any, handle: str, folder: Path) -> None:
        self.handle: str | None = handle
        self.seconds: float | None = None
        self.reason: str | None = None
        self.lost = False
        self._ray = ray
        self._reference = reference
        self._folder = folder
        self._code: int | None = None

    def poll(self) -> int | None:
        if self._code is None and self._ray.wait([self._reference], timeout=0)[0]:
            error = None
            try:
                self._ray.get(self._reference)
            except self._ray.exceptions.RayError as raised:
                error = raised
            state = read_node(self._folder, str(self.handle))
            self.lost = isinstance(error, self._ray.exceptions.NodeDiedError)
            if state is None or state["code"] is None:
                words = str(error).strip().splitlines() or [""]
                self._code = -signal.SIGKILL
                self.reason = f"ended by Ray: {type(error).__name__}: {shorten(words[0])}"
                return self._code
            self._code, self.seconds = state["code"], state["seconds"]
            if state["reason"] is not None:  # the process of Ray outlived the daemon of its node for a moment
                self.lost, self.reason = True, f"ended by Ray: {shorten(state['reason'])}"
            elif state["code"] < 0:
                self.reason = f"killed by {signal.Signals(-state['code']).name} on {shorten(state['host'])}"
        return self._code

    def send(self, number: int) -> None:
        if self._code is None:
            self._ray.cancel(self._reference)

    def kill(self) -> None:
        if self._code is None:
            self._ray.cancel(self._reference, force=True)
