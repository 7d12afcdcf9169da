"""Modes of the command line; each mode is a module that is imported only if the mode is chosen."""

import os
from collections.abc import Sequence
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path
from typing import Any

from framework.configuration.config import Config
from framework.configuration.modes import MODES as MODES
from framework.configuration.modes import idle_sentences, require_read
from framework.configuration.settings import require_device
from framework.configuration.stored_keys import names_run
from framework.errors import ConfigError, did_you_mean
from framework.runs.job import PARENT, refuse_idle
from framework.storage.enclosed import require_enclosed
from framework.storage.first_rank import first_rank
from framework.storage.imports import without_collection
from framework.tracking.store_process import started_early
from framework.training.process_count import require_processes


def run(values: dict[str, Any], folder: Path, overrides: Sequence[str]) -> float | None:
    """Run the mode that a composed config chooses; return its number for a sweeper to minimise, or None if it has none.

    Args:
        values: Composed config.
        folder: Folder of the run.
        overrides: Overrides on the command line.

    Raises:
        ConfigError: The mode is unknown, or the config has a fault.
    """
    require_enclosed(folder)
    resumed = names_run(values.get("resume"))
    if resumed:
        from framework.runs.resuming import read_command, send_rest

        if send_rest(folder, (values.get("logger") or {}).get("uri")):
            return None
        values, overrides = read_command(folder, values, overrides)
    name = values["mode"].get("name") if isinstance(values.get("mode"), dict) else None
    if not isinstance(name, str) or name not in MODES:
        raise ConfigError(
            f"mode = {name!r} is not a mode.{did_you_mean(str(name), MODES)} The modes are {', '.join(MODES)}."
        )
    config = Config.of(values, folder, overrides)
    # A resumed run keeps its settings, which an earlier version may have accepted without this check.
    if not resumed:
        require_read(name, overrides)
        for sentence in idle_sentences(values, overrides):
            refuse_idle(folder, sentence)
    with started_early() if _sends_run(config) else nullcontext():
        with without_collection():
            if name == "train":  # find mistakes before the slow import of Lightning
                require_device(config.settings.trainer.get("accelerator"))
                require_processes(config.settings.trainer)
                _ = config.assembly
            mode = import_module(f"framework.modes.{name}")
        return mode.run(config)


def _sends_run(config: Config) -> bool:
    """Return whether this process sends the run of a command to a store; jobs of a sweep leave this to the sweep."""
    return (
        "resume" in MODES[config.mode].reads  # the mode opens a run
        and config.settings.logger.name == "mlflow"
        and first_rank()
        and PARENT not in os.environ
    )
