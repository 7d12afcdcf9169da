"""Modes of the command line; each mode is a separate module, which is imported when the mode is chosen."""

import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from framework.configuration.config import Config
from framework.configuration.modes import MODES as MODES
from framework.configuration.modes import idle_sentences, require_read
from framework.configuration.settings import require_device
from framework.errors import ConfigError, did_you_mean
from framework.runs.job import refuse_idle
from framework.storage.enclosed import require_enclosed


def run(values: dict[str, Any], folder: Path, overrides: Sequence[str]) -> float | None:
    """Run the chosen mode on composed values, and return its value for a sweeper to minimise, or None.

    Raises:
        ConfigError: The mode is unknown, or the config has a fault.
    """
    require_enclosed(folder)
    resumed = values.get("resume") not in ("auto", "never", None)
    if resumed:
        if _sent_the_rest(folder, (values.get("logger") or {}).get("uri")):
            return None
        values, overrides = _stored(folder, values, overrides)
    name = values["mode"].get("name") if isinstance(values.get("mode"), dict) else None
    if not isinstance(name, str) or name not in MODES:
        raise ConfigError(
            f"mode = {name!r}: unknown.{did_you_mean(str(name), MODES)} Known: {', '.join(MODES)}."
        )
    config = Config.of(values, folder, overrides)
    # a resumed run keeps its settings, which an earlier version may have accepted without this check
    if not resumed:
        require_read(name, overrides)
        for sentence in idle_sentences(values, overrides):
            refuse_idle(folder, sentence)
    if name == "train":  # finds mistakes before the import of Lightning, which takes seconds
        require_device(config.settings.trainer.get("accelerator"))
        _ = config.parts
    return import_module(f"framework.modes.{name}").run(config)


def _sent_the_rest(folder: Path, store: str | None) -> bool:
    """Send the lines that a finished run has not sent because it was killed; return whether there were any."""
    from framework.tracking.ended import sync
    from framework.tracking.run_info import read_run_info

    info = read_run_info(folder)
    if info is None or info.status != "FINISHED" or not info.uri:
        return False
    sent = sync(folder, store)
    if sent:
        sys.stdout.write(
            f"that run had finished; {sent} lines of its journal that were not sent yet are in its store.\n"
        )
    return sent > 0


def _stored(
    folder: Path, given: dict[str, Any], overrides: Sequence[str]
) -> tuple[dict[str, Any], list[str]]:
    """Return the config and overrides with which the run in `folder` was started.

    Keys that do not affect the results (`HOW`) are taken from the present command, `given`, if it sets them.
    """
    from framework.configuration.paths import flatten, paths_of, require_repeated
    from framework.runs.run import HOW
    from framework.storage.plain_values import read_yaml
    from framework.tracking.run_info import read_run_info
    from framework.tracking.stores import confirm_address

    keys = {item: item.lstrip("+~").partition("=")[0] for item in overrides}
    again = ("resume", "checkpoint", *HOW)  # and keys `stored.…`, which repeat stored paths
    others = [item for item, key in keys.items() if key not in again and not key.startswith("stored.")]
    if others:
        raise ConfigError(
            f"resume={folder} goes on with that run's own config; {' '.join(others)} would change it. "
            f"Leave them out, or start a new run. {', '.join(HOW)} may be given."
        )
    earlier = read_run_info(folder)
    if earlier is not None and earlier.status == "FINISHED":
        raise ConfigError(
            f"resume={folder}: that run has finished; there is nothing to go on with. Start a new run."
        )
    values, changed = (
        read_yaml(folder / name, "a config that a run has left", "Start a new run.", ConfigError)
        for name in ("config.yaml", "overrides.yaml")
    )
    if (
        not isinstance(values, dict)
        or not isinstance(changed, list)
        or not all(isinstance(item, str) for item in (*values, *changed))
    ):
        raise ConfigError(f"{folder / 'config.yaml'} is not a config. Start a new run.")
    logger = values.get("logger")
    recorded = logger.get("uri") if isinstance(logger, dict) else None
    if recorded is not None and "logger.uri" not in keys.values():
        store = confirm_address(str(recorded), None, folder, folder / "config.yaml")
        values["logger"]["uri"] = store.uri if store.named else None
    said = flatten(given.get("stored") or {})
    said |= {"checkpoint": given["checkpoint"]} if "checkpoint" in keys.values() else {}
    require_repeated(paths_of(values), said, folder)
    values["resume"] = "auto"  # also if the run was started with resume=never
    for key in HOW:
        if key in keys.values():
            group, _, name = key.rpartition(".")
            into, of = (values[group], given[group]) if group else (values, given)
            into[name] = of[name]
    return values, changed
