"""Translation of keys that belong to a stored config, such as `data.root=...` in a command with `checkpoint=`."""

import re
from collections.abc import Sequence

from framework.configuration.modes import MODES
from framework.configuration.registry import GROUPS

READING = tuple(name for name, mode in MODES.items() if mode.stored)
"""Modes that use the plugins of a stored model if the command chooses none."""


def names_run(resume: object) -> bool:
    """Return whether the value of the setting `resume` is the folder of a run to continue."""
    return resume not in ("auto", "never", "null", "", None)


def as_stored(arguments: Sequence[str]) -> list[str]:
    """Replace `data.root=...` by `+stored.data.root=...` if the key belongs to a stored config.

    Hydra refuses `data.root=<folder>` if no data is chosen. In a command with a checkpoint, or with the folder of a run
    to resume, `data.root` is a key of the data in the stored config. The same holds for the other plugins.
    """
    values = {key.lstrip("+"): value for key, _, value in (argument.partition("=") for argument in arguments)}
    resumed = names_run(values.get("resume"))
    mode, checkpoint = values.get("mode", "train"), values.get("checkpoint", "null")
    reads = set(mode.split(",")) <= set(READING) and (checkpoint not in ("null", "") or mode == "combine")
    if "experiment" in values or not (resumed or reads):
        return list(arguments)
    chosen = {key.partition("@")[2] or key for key in values}
    groups = {*GROUPS, "outliers", *(("mode",) if resumed else ())} - chosen
    key = re.compile(rf"\+{{0,2}}((?:{'|'.join(sorted(groups))})\.[^=]*=.*)", re.DOTALL)
    return [
        f"+stored.{match[1]}" if (match := key.fullmatch(argument)) else argument for argument in arguments
    ]
