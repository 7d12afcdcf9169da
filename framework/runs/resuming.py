"""Resuming of a run that was stopped or killed: which run continues, and what of it is restored, in which order.

1. `read_command` gives a command with `resume=<folder>` the config and the overrides of that run.
2. `may_resume` decides whether the run in a folder continues: it has not finished, and its config is the same.
3. The tracker continues the run's record and journal (`framework.tracking.tracker`).
4. `begin_again` finds the newest undamaged checkpoint and removes the journal lines of later steps. Lightning restores
   from the checkpoint the weights, the optimiser with its schedule, the loops and the states of the callbacks.
   Random numbers and the order of the batches are functions of the seed and the step, so they are not stored.
5. The steps after the training (calibration, test) leave nothing to restore; a resumed run repeats them.

`resume_arguments` writes the command that continues a run, and `remove_resume_files` deletes what only a resumed run
needs. Other modules read `Run.resumed` to find out whether a run continues.
"""

import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from framework.configuration.config import Config
from framework.configuration.paths import flatten, paths_of, require_repeated, shell_arguments
from framework.configuration.registry import plugin_line
from framework.configuration.settings import Settings
from framework.errors import CheckpointError, ConfigError, UserError, count_of, shorten
from framework.runs import provenance
from framework.storage.first_rank import first_rank
from framework.storage.old_versions import can_resume_from_best
from framework.storage.plain_values import read_yaml
from framework.storage.reading import translate_errors
from framework.tracking.ended import sync
from framework.tracking.run_info import read_run_info
from framework.tracking.stores import confirm_address

if TYPE_CHECKING:
    from rich.console import Console

    from framework.runs.run import Run
    from framework.training.module import Training

HOW = ("threads", "workers", "logger.uri")
"""Keys that do not affect the result of a run, except that `threads` may change the last digits.

A resumed run may have other values of them.
"""
PROCESSES = ("trainer.devices", "trainer.num_nodes", "trainer.strategy")
"""Keys that say how many processes train.

Their values may change when a run is resumed; the results then differ by rounding.
"""
CHANGEABLE = (*HOW, *PROCESSES)
"""Keys whose values may change when a run is resumed."""
TRAINED = ("last.ckpt", "previous.ckpt")
"""Names of checkpoints from which training can resume; all others hold weights only."""
DAMAGED = "Start a new run if the checkpoint is damaged; otherwise see traceback.txt in the run folder."
"""Advice if a training cannot continue."""
BEST = "best.ckpt"
"""Name of the checkpoint with the lowest validation loss."""


def send_rest(folder: Path, store: str | None) -> bool:
    """Send the journal lines that a run of status FINISHED could not send; return whether there were any.

    Args:
        folder: Folder of the run.
        store: Address of the tracking store that the command names; None if it names none.
    """
    info = read_run_info(folder)
    if info is None or info.status != "FINISHED" or not info.uri:
        return False
    sent = sync(folder, store)
    if sent:
        sys.stdout.write(
            f"The run had already finished; sent to its store, which lacked them: {count_of(sent, 'journal line')}.\n"
        )
    return sent > 0


def read_command(
    folder: Path, command_values: dict[str, Any], overrides: Sequence[str]
) -> tuple[dict[str, Any], list[str]]:
    """Return the config and overrides with which the run in `folder` was started.

    Values of the keys in `CHANGEABLE` are taken from `command_values`, the config of the present command, if the
    command sets them.

    Raises:
        ConfigError: The run has finished, its files are damaged, or the command changes the run's config. Or the
            config names files, and the command does not repeat their paths (`stored.<key>=<path>`).
    """
    keys = {item: item.lstrip("+~").partition("=")[0] for item in overrides}
    allowed = ("resume", "checkpoint", *CHANGEABLE)  # and keys `stored.…`, which repeat stored paths
    changing = [item for item, key in keys.items() if key not in allowed and not key.startswith("stored.")]
    if changing:
        raise ConfigError(
            f"resume={folder} continues that run with its own config, but {' '.join(changing)} would change this "
            f"config. Leave these overrides out, or start a new run. Only {', '.join(CHANGEABLE)} may be overridden."
        )
    earlier = read_run_info(folder)
    if earlier is not None and earlier.status == "FINISHED":
        raise ConfigError(f"resume={folder}: that run has finished and cannot be continued. Start a new run.")
    values, changed = (
        read_yaml(folder / name, "a config that a run has left", "Start a new run.", ConfigError)
        for name in ("config.yaml", "overrides.yaml")
    )
    if (
        not isinstance(values, dict)
        or not isinstance(changed, list)
        or not all(isinstance(item, str) for item in (*values, *changed))
    ):
        raise ConfigError(f"{folder / 'config.yaml'} is not the config of a run. Start a new run.")
    logger = values.get("logger")
    recorded = logger.get("uri") if isinstance(logger, dict) else None
    if recorded is not None and "logger.uri" not in keys.values():
        store = confirm_address(str(recorded), None, folder, folder / "config.yaml")
        values["logger"]["uri"] = store.uri if store.named else None
    repeated = flatten(command_values.get("stored") or {})
    repeated |= {"checkpoint": command_values["checkpoint"]} if "checkpoint" in keys.values() else {}
    require_repeated(paths_of(values), repeated, folder)
    values["resume"] = "auto"  # also if the run was started with resume=never
    for key in CHANGEABLE:
        if key in keys.values():
            group, _, name = key.rpartition(".")
            target, source = (values[group], command_values[group]) if group else (values, command_values)
            target[name] = source[name]
    return values, changed


def stored_config(folder: Path) -> dict[str, Any] | None:
    """Return the config in a run folder; None if the folder contains no config yet."""
    path = folder / "config.yaml"
    return read_yaml(path, "the config of a run") if path.is_file() else None


def may_resume(config: Config) -> bool:
    """Return whether the run in `config.folder` continues.

    It continues if it is unfinished, its settings are those of `config` apart from the keys in `CHANGEABLE`, and the
    setting `resume` is not "never".
    """
    earlier = read_run_info(config.folder)
    return (
        earlier is not None
        and earlier.status != "FINISHED"
        and config.settings.resume != "never"
        and _same_settings(stored_config(config.folder), config.settings)
    )


def _same_settings(stored: Mapping[str, Any] | None, settings: Settings) -> bool:
    if stored is None:
        return False
    try:
        earlier = Settings.of(stored)
    except ConfigError:  # written by a version with other settings
        return False
    earlier_values, values = (
        {
            key: value
            for key, value in provenance.flatten(each.model_dump()).items()
            if key not in ("resume", *CHANGEABLE)
        }
        for each in (earlier, settings)
    )
    return earlier_values == values


def find_resumable(folder: Path) -> Path | None:
    """Return the newest undamaged checkpoint in a folder that training can resume from; None if there is none."""
    from framework.storage import checkpoints  # imports torch, which a command that is refused does not need

    resumable = checkpoints.latest_good(folder, names={*TRAINED})
    if resumable is not None:
        return resumable
    best = checkpoints.latest_good(folder, names={BEST})
    return best if best is not None and can_resume_from_best(checkpoints.read(best)) else None


@contextmanager
def blame_checkpoint(checkpoint: Path | None, training: "Training") -> Iterator[None]:
    """Convert errors in the first epoch of a resumed training to an error that names the plugin or the checkpoint.

    An error that passed through a plugin names the line of the plugin, since plugins may change between two runs. Any
    other error names the checkpoint: the state of optimisers, loops and callbacks may come from an untrusted source,
    and Lightning does not check it.

    Args:
        checkpoint: Checkpoint from which the training continues; None for a training that begins anew.
        training: The training.

    Raises:
        CheckpointError: The training cannot continue from the checkpoint.
    """
    import torch  # imported late: a refused command does not need it

    try:
        yield
    except Exception as error:
        own = isinstance(error, UserError | OSError | MemoryError | torch.OutOfMemoryError)
        if checkpoint is None or training.begun_epochs > 1 or own:
            raise
        fault = f"{type(error).__name__}: {shorten(error)}".removesuffix(": ")
        if place := plugin_line(error):
            raise CheckpointError(
                f"The training cannot continue from {checkpoint}, because a plugin failed at {place} ({fault}). Mend "
                "the plugin and resume again; traceback.txt in the run folder has all lines. If the plugin is right, "
                "the checkpoint may be damaged: start a new run."
            ) from error
        raise CheckpointError(
            f"{checkpoint}: The training cannot continue from this checkpoint ({fault}). {DAMAGED}"
        ) from error


def begin_again(run: "Run", console: "Console", processes: int, models: int) -> Path | None:
    """Return the checkpoint from which the training of `run` continues, or None if it begins anew.

    The metrics of steps after the checkpoint are removed from the journal of a resumed run, because the run repeats
    these steps. All ranks must call this function before rank 0 writes a checkpoint, so that all find the same one.

    Args:
        run: Run in progress.
        console: Console on which to say from where the run continues.
        processes: Number of processes that train now.
        models: Number of models that train together.

    Raises:
        ConfigError: Several models train together, and either one process trained before and several train now, or the
            other way round. The models have batches of their own only if one process trains.
    """
    from framework.storage import checkpoints

    checkpoint = find_resumable(run.checkpoints) if run.resumed else None
    if not run.resumed or not first_rank():
        return checkpoint
    if checkpoint is None:
        run.tracker.drop_after(0)
        console.print("nothing to resume from yet: starting from the beginning.")
        return None
    stored = checkpoints.read(checkpoint)
    with translate_errors(checkpoint, "the state of a training", DAMAGED, kind=CheckpointError):
        step, before = int(stored["global_step"]), stored.get("processes")
    before = before if isinstance(before, int) else processes  # an earlier version did not store the number
    if models > 1 and (before == 1) != (processes == 1):
        raise ConfigError(
            f"{checkpoint} was written by {before} processes, and {processes} train now. The {models} models of this "
            "run have batches of their own if one process trains, and share their batches if several do. Resume the "
            "run on as many processes as before."
        )
    run.tracker.drop_after(step)
    console.print(f"resuming from {checkpoint} (step {step}).", soft_wrap=True, highlight=False)
    if before != processes:
        console.print(
            f"{before} processes trained before, and {processes} train from here on: the results are those of one run "
            "on the same processes to rounding, not to the last bit."
        )
    return checkpoint


def resume_arguments(run: "Run") -> str:
    """Return the arguments of the command that continues a run, quoted for a shell."""
    # the address of a store and paths are included, because stored ones are used only if the user repeats them
    store = run.settings.logger.uri
    own = [
        shlex.quote(item) for item in (f"resume={run.folder}", *([f"logger.uri={store}"] if store else []))
    ]
    chosen = run.settings.trainer
    trainer = (stored_config(run.folder) or {"trainer": chosen}).get("trainer") or {}
    changed = {key: chosen.get(key.partition(".")[2]) for key in PROCESSES}
    own += [
        shlex.quote(f"{key}={'null' if value is None else value}")
        for key, value in changed.items()
        if trainer.get(key.partition(".")[2]) != value
    ]
    return " ".join([*own, *shell_arguments(paths_of(run.settings.plain()))])


def remove_resume_files(run: "Run") -> None:
    """Delete the checkpoints that only a resumed run needs; a mode calls this when no training is left to resume."""
    for name in (*TRAINED, BEST):
        (run.checkpoints / name).unlink(missing_ok=True)
