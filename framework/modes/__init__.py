"""Modes of the command line; each mode is a module that is imported only if the mode is chosen."""

import os
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path
from typing import Any

from framework.configuration.config import Config
from framework.configuration.modes import MODES as MODES
from framework.configuration.modes import idle_sentences, require_read
from framework.configuration.settings import require_device
from framework.errors import ConfigError, did_you_mean
from framework.runs.job import PARENT, refuse_idle
from framework.storage.enclosed import require_enclosed
from framework.storage.first_rank import first_rank
from framework.tracking.store_process import started_early


def run(values: dict[str, Any], folder: Path, overrides: Sequence[str]) -> float | None:
    """Run the chosen mode with the composed config; return the value that a sweeper minimises, if the mode has one.

    Raises:
        ConfigError: The mode is unknown, or the config has a fault.
    """
    require_enclosed(folder)
    resumed = values.get("resume") not in ("auto", "never", None)
    if resumed:
        if _send_rest(folder, (values.get("logger") or {}).get("uri")):
            return None
        values, overrides = _read_stored_run(folder, values, overrides)
    name = values["mode"].get("name") if isinstance(values.get("mode"), dict) else None
    if not isinstance(name, str) or name not in MODES:
        raise ConfigError(
            f"mode = {name!r} is no mode.{did_you_mean(str(name), MODES)} The modes are {', '.join(MODES)}."
        )
    config = Config.of(values, folder, overrides)
    # A resumed run keeps its settings, which an earlier version may have accepted without this check.
    if not resumed:
        require_read(name, overrides)
        for sentence in idle_sentences(values, overrides):
            refuse_idle(folder, sentence)
    if name == "train":  # find mistakes before the slow import of Lightning
        require_device(config.settings.trainer.get("accelerator"))
        _ = config.parts
    with started_early() if _sends_run(config) else nullcontext():
        return import_module(f"framework.modes.{name}").run(config)


def _sends_run(config: Config) -> bool:
    """Return whether this process sends the run of a command to a store; jobs of a sweep leave this to the sweep."""
    return (
        "resume" in MODES[config.mode].reads  # the mode opens a run
        and config.settings.logger.name == "mlflow"
        and first_rank()
        and PARENT not in os.environ
    )


def _send_rest(folder: Path, store: str | None) -> bool:
    """Send the journal lines that a run of status FINISHED could not send; return whether there were any."""
    from framework.tracking.ended import sync
    from framework.tracking.run_info import read_run_info

    info = read_run_info(folder)
    if info is None or info.status != "FINISHED" or not info.uri:
        return False
    sent = sync(folder, store)
    if sent:
        sys.stdout.write(
            f"The run had already finished; {sent} journal lines that were missing in its store were sent.\n"
        )
    return sent > 0


def _read_stored_run(
    folder: Path, command_values: dict[str, Any], overrides: Sequence[str]
) -> tuple[dict[str, Any], list[str]]:
    """Return the config and overrides with which the run in `folder` was started.

    Values of keys that do not affect the results (`HOW`) are taken from `command_values`, the config of the present
    command, if the command sets them.
    """
    from framework.configuration.paths import flatten, paths_of, require_repeated
    from framework.runs.run import HOW
    from framework.storage.plain_values import read_yaml
    from framework.tracking.run_info import read_run_info
    from framework.tracking.stores import confirm_address

    keys = {item: item.lstrip("+~").partition("=")[0] for item in overrides}
    allowed = ("resume", "checkpoint", *HOW)  # and keys `stored.…`, which repeat stored paths
    changing = [item for item, key in keys.items() if key not in allowed and not key.startswith("stored.")]
    if changing:
        raise ConfigError(
            f"resume={folder} continues with the config of that run, which {' '.join(changing)} would change. "
            f"Leave these overrides out, or start a new run. Only {', '.join(HOW)} may be overridden."
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
    for key in HOW:
        if key in keys.values():
            group, _, name = key.rpartition(".")
            target, source = (values[group], command_values[group]) if group else (values, command_values)
            target[name] = source[name]
    return values, changed
