"""Checks of config folders that a command adds (`--config-dir`), so that an untrusted folder cannot run code."""

import re
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

from hydra._internal.utils import get_args_parser
from yaml.parser import ParserError
from yaml.reader import ReaderError
from yaml.scanner import ScannerError

from framework.configuration.schema import forbid_targets
from framework.configuration.stored_keys import names_run
from framework.errors import ConfigError, quote, shorten
from framework.storage.enclosed import require_enclosed
from framework.storage.plain_values import read_yaml

OWN = ("hydra", "logger", "mode")
"""Parts of a config that only the user may set: they determine the command, the output folder and the store."""
HARMLESS = {"hydra": ("sweeper", "launcher", "verbose"), "logger": ("name", "experiment"), "mode": ()}
"""Keys that an added config folder may set in each part of `OWN`; it may set no other key of these parts."""
LAUNCHERS = ("basic", "pool")
"""Launchers that an added config folder may choose; others reach other machines."""
PART_KEYS = {
    "launcher": ("jobs", "retries", "devices", "fork"),
    "sweeper": (
        *("params", "max_batch_size"),
        *("trials", "seed", "metric", "direction", "sampler", "batch", "population", "pruner"),
    ),
}
"""Keys of the launcher and the sweeper that an added config folder may set; others reach other machines."""
KEY = re.compile(r"[+~]{0,2}(\w+)(?:[./]\w+)*(?:@(\w+)(?:\.\w+)*)?")
"""Pattern of a key that a sweep varies; the groups are the first words of the key and of its package."""
HEADER = re.compile(r"\s*#\s*@")
"""Pattern of the lines that Hydra reads before a config, such as `# @package _global_`; blanks may stand before them.

Hydra ends lines where `str.splitlines` does, and reads these lines only at the beginning of a file.
"""
SYNTAX = (ReaderError, ScannerError, ParserError, UnicodeDecodeError)
"""Errors in files that no YAML loader reads.

Hydra's loader reads more than `read_yaml`, for example tags that stand for paths.
"""
REFERENCE = re.compile(r"\$\{[\w.\[\]]+\}")
"""Pattern of an interpolation that stands for another value of the config.

Every other interpolation calls a function, which can copy an environment variable or a path of this machine into the
files of the run.
"""
CHOSEN = re.compile(r"hydra/(launcher|sweeper)|logger")
MOST = 1000
"""Largest number of config files in an added config folder."""


def require_harmless(arguments: Sequence[str], groups: Collection[str]) -> None:
    """Refuse a command whose config folders would determine what Hydra runs, or where results go.

    Args:
        arguments: Arguments of the command.
        groups: Config groups of the framework and its plugins. Only files of these groups are checked, and no other
            file can be chosen; the primary config is checked too if the command names it.

    Raises:
        ConfigError: A folder contains links, or it configures Hydra's logging, callbacks, environment or folders, the
            address of a store, a mode, a run to continue, or an interpolation that reads more than the config.
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
                f"{shorten(folder)} contains {len(files)} configs, but at most {MOST} are read. Give a smaller folder."
            )
        for file in files:
            _require_harmless(file, folder, groups)


def _group(file: Path, folder: Path) -> str:
    """Return the name of the subfolder of `folder` in which `file` lies at any depth; "" if it lies in none."""
    return (*file.relative_to(folder).parts[:-1], "")[0]


def _require_harmless(file: Path, folder: Path, groups: Collection[str]) -> None:
    try:
        content = read_yaml(file, "a config", "Correct the file, or remove it from the folder.", ConfigError)
    except ConfigError as error:
        if isinstance(error.__cause__, SYNTAX):
            return  # Hydra cannot read it either, and reports the place of the error
        raise
    with file.open(encoding="utf-8") as text:
        header = [line for line in text.read().splitlines() if HEADER.match(line)]
    below = file.relative_to(folder).with_suffix("").parts
    if any(re.search("|".join([*OWN, "_name_", "_group_"]), line) for line in header) or {*OWN} & {*below}:
        raise _refusal(file, "sets a part of the config that only the user may set")
    if not isinstance(content, dict):
        return
    for key, harmless in HARMLESS.items():
        value = content.get(key)
        if value is not None and not (isinstance(value, dict) and set(value) <= set(harmless)):
            raise _refusal(file, f"sets {key}: {quote(value)}")
        for part, part_keys in PART_KEYS.items():
            chosen = value.get(part) if isinstance(value, dict) else None
            if chosen is not None and not (isinstance(chosen, dict) and set(chosen) <= set(part_keys)):
                raise _refusal(file, f"sets {key}.{part}: {quote(chosen)}")
            if part == "sweeper" and isinstance(chosen, dict):
                _require_harmless_sweep(file, chosen.get("params"))
    if names_run(content.get("resume")):
        raise _refusal(file, f"sets resume: {quote(content['resume'])}")
    for text in _texts(content):
        if "${" in _without_references(text):
            raise _refusal(file, f"contains {quote(text)}, which may read more than the config")
    try:
        forbid_targets(content)
    except ConfigError as error:
        raise ConfigError(f"{shorten(file)}: {error}") from error
    defaults = content.get("defaults") or []
    for entry in defaults if isinstance(defaults, list) else [defaults]:
        for text, name in entry.items() if isinstance(entry, dict) else [(str(entry), "")]:
            words, _, package = str(text).partition("@")
            group = words.split(" ")[-1]  # before it stand `override` and `optional`, in any order
            if isinstance(entry, dict) and not group:
                raise _refusal(file, f"chooses {quote(entry)}")
            absolute = group.startswith("/") or not _group(file, folder)
            elsewhere = group.lstrip("/") == "hydra/launcher" and name not in LAUNCHERS
            if elsewhere or _is_own(group.lstrip("/"), package) or ".." in f"{group}{name}":
                raise _refusal(file, f"chooses {quote(entry)}")
            first = group.lstrip("/").split("/")[0]
            # other files in the folder, which a sweep may have left, were not checked; Hydra reports missing ones
            if absolute and first not in (*groups, "", "_self_") and _has_config(folder, first):
                raise _refusal(file, f"chooses {quote(entry)}")


def _require_harmless_sweep(file: Path, params: object) -> None:
    """Refuse a sweep that varies a part of the config that only the user may set (`OWN`)."""
    if params is None:
        return
    if not isinstance(params, dict):
        raise _refusal(file, f"sets hydra.sweeper.params: {quote(params)}")
    for key in params:
        match = KEY.fullmatch(str(key))
        if match is None or {*match.groups()} & {*OWN, "resume"}:
            raise _refusal(file, f"sweeps over {quote(key)}")


def _texts(value: object) -> Iterator[str]:
    """Yield all texts in nested dictionaries and lists, keys included."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from (*_texts(key), *_texts(item))
    elif isinstance(value, list):
        for item in value:
            yield from _texts(item)
    elif isinstance(value, str):
        yield value


def _without_references(text: str) -> str:
    """Return a text without interpolations that stand for values of the config, including nested ones."""
    shorter = REFERENCE.sub("x", text)
    return text if shorter == text else _without_references(shorter)


def _is_own(group: str, package: str) -> bool:
    """Return whether a choice `group@package` concerns a part of the config that only the user may set (`OWN`)."""
    if CHOSEN.fullmatch(group):
        return bool(package)
    return any(word in f"{group}@{package}" for word in OWN)


def _has_config(folder: Path, name: str) -> bool:
    return any((folder / f"{name}{ending}").exists() for ending in ("", ".yaml", ".yml"))


def _refusal(file: Path, reason: str) -> ConfigError:
    return ConfigError(
        f"{shorten(file)} {reason}. A config folder may come from an untrusted source, so it may decide neither "
        "what is run nor where results go. Remove this setting, and give it on the command line."
    )
