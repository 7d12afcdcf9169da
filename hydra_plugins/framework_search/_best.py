"""Experiment file of the best trial of a search."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import OmegaConf

from framework.storage.files import write_whole
from framework.storage.progress import PlainConsole

OF_THE_RUN = ("logger", "mode", "debug", "threads", "workers", "resume")
"""Keys that do not change the results of a trial; they are not part of the experiment and stay on the command line."""


def counts(key: str) -> bool:
    """Return whether an override of a key can change the results of a trial."""
    return key.lstrip("+~").partition(".")[0] not in OF_THE_RUN


def write_best(folder: Path, overrides: Sequence[str], loader: ConfigLoader, origin: str) -> None:
    """Write the experiment of the best trial, which has `overrides`, to best.yaml in `folder`.

    A copy is written to the subfolder `experiment`, where Hydra finds it with `--config-dir=<folder>`. `loader` is
    Hydra's configuration loader, and `origin` a line that says where the experiment comes from.
    """
    name, content = build_experiment(overrides, loader, origin)
    path = folder / "best.yaml"
    write_whole(path, content.encode())
    for old in (folder / "experiment").rglob("*.yaml"):  # files of an earlier search in this folder
        old.unlink()
    write_whole(folder / "experiment" / f"{name}.yaml", content.encode())
    command = content.splitlines()[1].removeprefix("# python -m framework ")
    PlainConsole().print(
        f"best trial: {path}\n"
        f"run it:     python -m framework --config-dir={shlex.quote(str(folder))} {command}\n"
        f"keep it:    copy it to conf/experiment/{name}.yaml",
        soft_wrap=True,
        highlight=False,
        markup=False,
    )


AFTER = ("preset", "debug")
"""Groups that config.yaml composes after the experiment.

An experiment cannot override the choice of such a group, but can include one of its configs.
"""


def build_experiment(overrides: Sequence[str], loader: ConfigLoader, origin: str) -> tuple[str, str]:
    """Return name and content of an experiment that has the same effect as `overrides`.

    Args:
        overrides: overrides of one job, without sweeps.
        loader: Hydra's configuration loader, which knows the config groups.
        origin: a line that says where the experiment comes from.
    """
    base: str | None = None
    added: list[Any] = []
    chosen: list[Any] = []
    values = OmegaConf.create({})
    remaining: list[str] = []
    for text, override in zip(
        overrides, OverridesParser.create().parse_overrides(list(overrides)), strict=True
    ):
        key, value = override.key_or_group, override.value()
        if key == "experiment":
            base = None if value is None else str(value)
        elif not counts(key) or _only_on_a_command_line(override):
            remaining.append(text)
        elif key in AFTER:
            added.append({f"/{key}@_global_": value})
        elif not isinstance(value, dict) and loader.get_group_options(key, results_filter=None):
            (added if override.is_add() else chosen).append(
                {f"{'' if override.is_add() else 'override '}/{key}": value}
            )
        else:
            OmegaConf.update(values, key, value, merge=True, force_add=True)
    name = f"{base}_best" if base else "best"
    # The base is named as a group with its own package. For a plain name, Hydra would look for its defaults in the same
    # folder, and it would interpret plain "experiment" as the choice on the command line.
    defaults = [*([{"/experiment@_global_": base}] if base else []), *added, *chosen]
    body = OmegaConf.create({"defaults": defaults} if defaults else {})
    body.update(values)
    command = shlex.join(["python", "-m", "framework", f"experiment={name}", *remaining])
    return name, f"# @package _global_\n# {command}\n# {origin}\n{OmegaConf.to_yaml(body)}"


def _only_on_a_command_line(override: Override) -> bool:
    """Return whether an experiment file cannot express an override: a deletion, another package, or a list item."""
    return (
        override.is_delete()
        or override.package is not None
        or any(map(str.isdigit, override.key_or_group.split(".")))
    )
