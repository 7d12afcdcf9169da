"""Keys of a stored config in a command, such as `data.root=...` beside `checkpoint=` or `resume=<folder>`."""

import re
from collections.abc import Sequence

from framework.configuration.modes import MODES
from framework.configuration.registry import GROUPS

READING = tuple(name for name, mode in MODES.items() if mode.stored)
"""Modes that use the plugins of a stored model if the command chooses none."""


def as_stored(arguments: Sequence[str]) -> list[str]:
    """Rename keys of plugins that the command does not choose to keys of `stored`.

    Hydra refuses `data.root=<folder>` if no data is chosen. In a command with a checkpoint, or with the folder of a run
    to resume, it is a key of the data that is stored there.
    """
    given = {key.lstrip("+"): value for key, _, value in (one.partition("=") for one in arguments)}
    resumed = given.get("resume", "") not in ("auto", "never", "null", "")
    mode, checkpoint = given.get("mode", "train"), given.get("checkpoint", "null")
    reads = set(mode.split(",")) <= set(READING) and (checkpoint not in ("null", "") or mode == "combine")
    if "experiment" in given or not (resumed or reads):
        return list(arguments)
    chosen = {key.partition("@")[2] or key for key in given}
    groups = {*GROUPS, "outliers", *(("mode",) if resumed else ())} - chosen
    key = re.compile(rf"\+{{0,2}}((?:{'|'.join(sorted(groups))})\.[^=]*=.*)", re.DOTALL)
    return [f"+stored.{found[1]}" if (found := key.fullmatch(one)) else one for one in arguments]
