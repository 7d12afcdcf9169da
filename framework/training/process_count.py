"""Check, before a training, that a launcher has started as many processes as the settings of the trainer require."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from framework.errors import ConfigError

INTERACTIVE = ("bash", "interactive")
"""Names of SLURM jobs in which Lightning starts the processes itself, because a person types the commands."""

OTHER_LAUNCHERS = ("MASTER_ADDR", "LSB_JOBID", "OMPI_COMM_WORLD_SIZE", "PMI_SIZE")
"""Environment variables that show how the processes on all nodes were started, if not by torchrun or srun.

If they were started by hand or by another launcher, at least one of the variables is set.
"""


@dataclass(frozen=True)
class Launched:
    """Processes that a launcher has started for one training.

    Attributes:
        launcher: Name of the launcher.
        processes: Number of processes on all nodes.
        nodes: Number of nodes.
    """

    launcher: str
    processes: int
    nodes: int


def require_processes(trainer: Mapping[str, Any]) -> None:
    """Refuse a training if the number of its processes does not fit `trainer.devices` and `trainer.num_nodes`.

    Without this check, the training would wait for processes that nobody starts, or end with an error of Lightning that
    does not name the cause. Nothing is checked if this process trains alone or starts the other processes itself.

    Args:
        trainer: Settings of the trainer.

    Raises:
        ConfigError: The numbers differ, or nobody has started the other nodes or the other tasks of an allocation.
    """
    launched, nodes = launched_processes(), trainer.get("num_nodes") or 1
    if launched is None:
        if nodes > 1 and not any(name in os.environ for name in OTHER_LAUNCHERS):
            raise ConfigError(
                f"trainer.num_nodes={nodes}, but no launcher has started this command on {nodes} nodes, so it would "
                "wait for the others without end. Start it by torchrun or srun (docs/processes.md), or set "
                "MASTER_ADDR, MASTER_PORT and NODE_RANK on each node."
            )
        return
    devices = count_devices(trainer)
    local, rest = divmod(launched.processes, launched.nodes)
    if (devices, nodes, 0) != (local, launched.nodes, rest):
        wanted = f"Set trainer.num_nodes={launched.nodes} trainer.devices={local} trainer.strategy=ddp"
        raise ConfigError(
            f"{launched.launcher} has started {launched.processes} processes on {launched.nodes} nodes, but "
            f"trainer.devices={trainer.get('devices')} and trainer.num_nodes={nodes} make {devices * nodes} processes. "
            f"{'Start equally many on each node' if rest else wanted}, or start {devices} on each of {nodes} nodes."
        )
    if launched.launcher == "srun" and "SLURM_NTASKS_PER_NODE" not in os.environ:
        raise ConfigError(
            f"srun has started {launched.processes} processes without --ntasks-per-node, which Lightning needs. Add "
            f"--ntasks-per-node={local} to the options of the job or of srun, and leave --ntasks out."
        )


def launched_processes() -> Launched | None:
    """Return the processes that torchrun or srun has started with this one; None if neither has started it.

    Raises:
        ConfigError: SLURM has allocated several tasks, and `srun` did not start this process.
    """
    if "TORCHELASTIC_RUN_ID" in os.environ:
        processes, local = (int(os.environ.get(name, "1")) for name in ("WORLD_SIZE", "LOCAL_WORLD_SIZE"))
        return Launched("torchrun", processes, int(os.environ.get("GROUP_WORLD_SIZE", processes // local)))
    tasks = int(os.environ.get("SLURM_NTASKS", "1"))
    if os.environ.get("SLURM_JOB_NAME") in INTERACTIVE or tasks == 1:
        return None
    if "SLURM_STEP_NUM_TASKS" not in os.environ:
        raise ConfigError(
            f"This command runs in a SLURM allocation of {tasks} tasks, but srun has not started it, so it would wait "
            "for the other tasks without end. Write srun before the command, or request one task (--ntasks=1; "
            "--cpus-per-task gives it more cores)."
        )
    return Launched("srun", tasks, int(os.environ.get("SLURM_NNODES", "1")))


def count_devices(trainer: Mapping[str, Any]) -> int:
    """Return the number of devices that the trainer uses on each node; a node has one process for each device."""
    devices = trainer.get("devices", 1)
    if isinstance(devices, list):
        return len(devices)
    if devices in (None, "auto", -1, "-1"):
        return _count_all_devices(trainer.get("accelerator"))
    return len(str(devices).split(",")) if "," in str(devices) else int(devices)


def _count_all_devices(accelerator: str | None) -> int:
    """Return the number of devices that Lightning's `auto` uses on this node."""
    if accelerator in ("cpu", "mps"):
        return 1
    import torch

    return max(1, torch.cuda.device_count())
