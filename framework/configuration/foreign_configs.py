"""Config folders that a command adds (`--config-dir`): they may have come with somebody's sweep, and run no code."""

import re
from collections.abc import Collection, Sequence
from pathlib import Path

import yaml
from hydra._internal.utils import get_args_parser

from framework.configuration.schema import forbid_targets
from framework.errors import ConfigError, quoted, shown
from framework.storage.enclosed import require_enclosed
from framework.storage.plain_values import read_yaml

OWN = ("hydra", "logger", "mode")
"""Parts of a config that say what is run, where it is written and which store is contacted."""
HARMLESS = {"hydra": ("sweeper", "launcher", "verbose"), "logger": ("name", "experiment"), "mode": ()}
"""Keys of these that such a folder may set all the same."""
CHOSEN = re.compile(r"hydra/(launcher|sweeper)|logger")
MOST = 1000
"""Config files of such a folder."""


def require_harmless(arguments: Sequence[str], groups: Collection[str]) -> None:
    """Refuse config folders on a command line that would say what Hydra runs, or where results go.

    Args:
        groups: config groups of the framework and its plugins. Of such a folder their files are looked at, and no other
            can be chosen; where the command names the primary config, that too.

    Raises:
        ConfigError: a folder holds links, or a config of Hydra's logging, callbacks, environment or folders, of a
            store's address or of a mode.
    """
    named, _ = get_args_parser().parse_known_args(list(arguments))
    for text in (named.config_dir, named.config_path):
        folder = None if text is None else Path(text)
        if folder is None or not folder.is_dir():
            continue
        require_enclosed(folder, ConfigError)
        files = [path for path in folder.rglob("*") if path.suffix.lower() in (".yaml", ".yml")]
        primary = named.config_name is not None or named.config_path is not None
        files = [path for path in files if _group(path, folder) in (*groups, *OWN, *[""] * primary)]
        if len(files) > MOST:
            raise ConfigError(
                f"{shown(folder)} holds {len(files)} configs; wanted {MOST} at most. Give another."
            )
        for file in files:
            _require_harmless(file, folder, groups)


def _group(file: Path, folder: Path) -> str:
    """Return the first folder below `folder` in which a config stands; empty for one in `folder` itself."""
    return (*file.relative_to(folder).parts[:-1], "")[0]


def _require_harmless(file: Path, folder: Path, groups: Collection[str]) -> None:
    try:
        content = read_yaml(file, "a config", "Mend it, or take it out of the folder.", ConfigError)
    except ConfigError as error:
        if isinstance(error.__cause__, yaml.YAMLError | UnicodeDecodeError):
            return  # what is no YAML Hydra cannot read either, and says where
        raise
    with file.open(encoding="utf-8") as text:
        header = re.findall(r"^#\s*@package\s+(.*)$", text.read(), re.MULTILINE)
    below = file.relative_to(folder).with_suffix("").parts
    if any(re.search("|".join([*OWN, "_name_", "_group_"]), package) for package in header) or {*OWN} & {
        *below
    }:
        raise _refused(file, "stands in a part of the config that is the user's own")
    if not isinstance(content, dict):
        return
    for key, harmless in HARMLESS.items():
        value = content.get(key)
        if value is not None and not (isinstance(value, dict) and set(value) <= set(harmless)):
            raise _refused(file, f"sets {key}: {quoted(value)}")
    try:
        forbid_targets(content)
    except ConfigError as error:
        raise ConfigError(f"{shown(file)}: {error}") from error
    defaults = content.get("defaults") or []
    for entry in defaults if isinstance(defaults, list) else [defaults]:
        for text, name in entry.items() if isinstance(entry, dict) else [(str(entry), "")]:
            group, _, package = str(text).removeprefix("override ").partition("@")
            absolute = group.startswith("/") or not _group(file, folder)
            if _is_own(group.lstrip("/"), package) or ".." in f"{group}{name}":
                raise _refused(file, f"chooses {quoted(entry)}")
            first = group.lstrip("/").split("/")[0]
            # what a sweep has left there was not looked at; of what is nowhere Hydra says so
            if absolute and first not in (*groups, "", "_self_") and _holds(folder, first):
                raise _refused(file, f"chooses {quoted(entry)}")


def _is_own(group: str, package: str) -> bool:
    """Return whether a choice is one of, or goes into, a part of the config that is the user's own."""
    if CHOSEN.fullmatch(group):
        return bool(package)
    return any(word in f"{group}@{package}" for word in OWN)


def _holds(folder: Path, name: str) -> bool:
    return any((folder / f"{name}{ending}").exists() for ending in ("", ".yaml", ".yml"))


def _refused(file: Path, what: str) -> ConfigError:
    return ConfigError(
        f"{shown(file)} {what}. A config folder may be a stranger's, so it says neither what is run nor where results "
        "go. Take that out, and say it on the command line."
    )
