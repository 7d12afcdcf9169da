"""Composition of a config with Hydra, and translation of Hydra's errors into one sentence."""

import os
import re
import shlex
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from shutil import get_terminal_size
from traceback import walk_tb
from typing import Any

import yaml
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from hydra.plugins.config_source import ConfigResult
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from framework.configuration.registry import SEVERAL, config_folders, describe_missing_config
from framework.errors import ConfigError, did_you_mean, list_names, nearest_name, shorten

GLOBAL = ("experiment", "preset", "debug")
"""Groups whose configs set keys at the top level."""


def folder() -> Path:
    """Return the project's own folder conf/, which lies inside the package in a wheel and beside it in a checkout."""
    package = Path(__file__).resolve().parent.parent
    for candidate in (package / "conf", package.parent / "conf"):
        if (candidate / "config.yaml").is_file():
            return candidate
    raise ConfigError("conf/config.yaml is missing from this installation. Reinstall the package.")


class PluginConfigs(SearchPathPlugin):
    """Hydra plugin that adds the plugins' config folders to the search path, after the project's own folder."""

    folders: Mapping[str, Path] = {}

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for name, path in self.folders.items():
            search_path.append(provider=name, path=f"{PluginFolder.scheme()}://{path}")


class PluginFolder(FileConfigSource):
    """Config folder of a plugin; loading a config that several plugins ship raises an error.

    Hydra itself would silently use one of these configs.
    """

    @staticmethod
    def scheme() -> str:
        return "plugin"

    def load_config(self, config_path: str) -> ConfigResult:
        file = self._normalize_file_name(config_path)
        shipped = [
            f"{name!r} ({folder})"
            for name, folder in PluginConfigs.folders.items()
            if (folder / file).is_file()
        ]
        if len(shipped) > 1:
            raise ConfigError(
                f"Several plugins ship the config {file}: {', '.join(shipped)}. Uninstall all but one of these "
                "plugins, or rename the config in one of them. All other configs still work."
            )
        return super().load_config(config_path)

    # Hydra asks each plugin's folder for each config of a command, and would resolve 2,000 paths.

    def is_group(self, config_path: str) -> bool:
        return os.path.isdir(os.path.join(self.path, config_path))  # noqa: PTH112, PTH118

    def is_config(self, config_path: str) -> bool:
        return os.path.isfile(os.path.join(self.path, self._normalize_file_name(config_path)))  # noqa: PTH113, PTH118


def register() -> None:
    """Register the plugins' configs with Hydra; call this before composing. Repeated calls are harmless."""
    PluginConfigs.folders = config_folders()
    Plugins.instance().register(PluginConfigs)
    Plugins.instance().register(PluginFolder)
    OmegaConf.register_new_resolver("first", lambda *values: next(filter(None, values)), replace=True)


def in_quotes(text: str) -> str:
    """Return a text in quotes, so that Hydra's grammar reads exactly this text.

    The text may come from an untrusted source and be long, so the time is linear in its length.
    """
    return "'" + re.sub(r"(\\++)('|\Z)?|'", _escape_quote, text) + "'"


def _escape_quote(match: re.Match[str]) -> str:
    """Return backslashes and a quotation mark, escaped for a text in quotes.

    Backslashes are doubled only before a quotation mark and at the end of the text, where they would escape the mark.
    """
    if match[0] == "'":
        return "\\'"
    return match[1] if match[2] is None else 2 * match[1] + ("\\'" if match[2] else "")


def plain(config: DictConfig) -> dict[str, Any]:
    """Return the composed config as plain values with interpolations resolved.

    In the groups `SEVERAL`, entries without a `name` are dropped. Such an entry remains, for example, if an experiment
    sets keys of `encoder.a`, and the command replaces this encoder by `encoder=b`.

    Raises:
        ConfigError: A required value is missing, or an experiment's keys are not at the top level.
    """
    try:
        values = OmegaConf.to_container(config, resolve=True)
    except OmegaConfBaseException as error:  # an interpolation of a missing key
        raise ConfigError(
            f"{_message_with_config(error)}. Give the missing key a value, or correct the text between ${{ and }}."
        ) from error
    assert isinstance(values, dict)
    for group in GLOBAL:
        if group in values:
            raise ConfigError(
                f"The config chosen as {group} sets nothing at the top level. Its first line must be `# @package "
                f"_global_`, because Hydra puts its keys under `{group}` otherwise. Keys and values must follow this "
                "line."
            )
    for group in SEVERAL:
        chosen = values.get(group) or {}
        values[group] = {
            key: part for key, part in chosen.items() if isinstance(part, Mapping) and "name" in part
        }
    for key, description in _missing(values):
        raise ConfigError(f"{key} is missing{description}. Write {key}=...")
    return {str(key): value for key, value in values.items()}


def _missing(values: Any, before: str = "") -> Iterator[tuple[str, str]]:
    """Yield the dotted key of each missing required value, and the part of the message that describes the value.

    A config marks such a value by a description, `<a file of ...>`, or by `???`. `before` is the dotted key of
    `values`.
    """
    if isinstance(values, str) and re.fullmatch(r"\?\?\?|<.*>", values):
        yield before, f": give {values[1:-1]}" if values != "???" else ""
    parts = enumerate(values) if isinstance(values, list) else ()
    for key, value in values.items() if isinstance(values, Mapping) else parts:
        yield from _missing(value, f"{before}.{key}" if before else str(key))


def help_text() -> str:
    """Return the text of `--help`: the usage, and every group with its options.

    Hydra's own function is not used, because it copies Hydra's store of configs for each group, which is slow.
    """
    words = yaml.safe_load((folder() / "config.yaml").read_text(encoding="utf-8"))["hydra"]["help"]
    return "\n".join([words["header"], *map(_help_paragraph, groups()), "", words["footer"].rstrip()])


def _help_paragraph(group: str) -> str:
    """Return a group with its options, wrapped to the terminal; options of a subfolder stand on lines of their own.

    Options that only other configs choose are left out (`is_part`).
    """
    width = min(100, get_terminal_size().columns)
    folders: dict[str, list[str]] = {}
    for option in options(group):
        if is_part(group, option):
            continue
        top, _, name = option.rpartition("/")
        folders.setdefault(top, []).append(name)
    lines = []
    for top, names in sorted(folders.items()):
        start = f"  {top}/: " if top else "  "
        if top and group == "preset":  # the name of the folder chooses by the data
            start = f"  {top}, for "
        lines += textwrap.wrap(
            ", ".join(names), width, initial_indent=start, subsequent_indent="    ", break_on_hyphens=False
        )
    heading = f"{group}=[<name>,...]" if group in SEVERAL else f"{group}=<name>"
    if group == "hydra":
        heading = "hydra/launcher=<name> and hydra/sweeper=<name>"
    return "\n".join(["", heading, *lines])


def is_part(group: str, option: str) -> bool:
    """Return whether an option is no choice of its own, but a part of others.

    These options are the bases of experiments, what `debug=fast` changes in a single plugin, and what a preset changes
    in a single experiment.
    """
    return (
        option.endswith("/base")
        or (group == "debug" and "/" in option)
        or (group == "preset" and option.count("/") > 1)
    )


def groups() -> list[str]:
    """Return the names of all config groups of the framework and the plugins."""
    return sorted({path.name for root in _roots() for path in root.iterdir() if path.is_dir()})


def _roots() -> list[Path]:
    return [folder(), *config_folders().values()]


def options(group: str) -> list[str]:
    """Return the names of all configs of a group, including subfolders, of the framework and the plugins."""
    paths = {path.relative_to(root / group) for root in _roots() for path in (root / group).rglob("*.yaml")}
    return sorted(str(path.with_suffix("")) for path in paths)


def describe_error(error: BaseException) -> str | None:
    """Return the message for a composition error of Hydra or OmegaConf, with a remedy; None for any other error."""
    if isinstance(error, MissingConfigException):
        config_name = error.missing_cfg_file or ""
        group, _, name = config_name.partition("/")
        installed = describe_missing_config(group, name)
        if installed:
            return f"There is no config {config_name!r}.{installed}"
        known = [str(option) for option in error.options or ()] or options(group)
        available = f" Available in {group}: {list_names(name, known)}." if known else ""
        return f"There is no config {config_name!r}.{did_you_mean(name, known)}{available}"
    if isinstance(error, ValueError) and "Config group override must be" in str(error):
        return (
            "A group takes a name; it cannot be set to null, true or a number. Remove a group with `~`, e.g. "
            "`~data@outliers` or `~density_head`."
        )
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, OmegaConfBaseException):
        cause = cause.__cause__ or cause.__context__
    if isinstance(cause, OmegaConfBaseException) and cause.parent_node is not None and "not in" in str(cause):
        return _describe_unknown_key(cause)
    damaged = _describe_damage(error)
    if damaged is not None:
        return damaged
    if isinstance(error, OverrideParseException):
        return _describe_unreadable(error.override)
    if isinstance(error, HydraException | OmegaConfBaseException):
        return _message_with_config(error)
    return None


def _describe_unreadable(override: str) -> str:
    key, equals, value = override.partition("=")
    quoted = f"{key}={in_quotes(value)}"
    try:
        OverridesParser.create().parse_override(quoted)
    except HydraException:
        equals = ""
    typed = shlex.quote(quoted) if set(quoted) & set('"$`\\!') else f'"{quoted}"'
    meant = f" If the whole value is one text, write {typed}." if equals else ""
    return (
        f"{override!r} cannot be read; expected key=value, with quotes around a value that contains commas or "
        f"brackets.{meant}"
    )


def _describe_damage(error: BaseException) -> str | None:
    """Return the message for an error caused by a file that is not a valid config; None for any other error."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, yaml.YAMLError):
        cause = cause.__cause__
    if isinstance(cause, yaml.MarkedYAMLError) and cause.problem_mark is not None:
        mark = cause.problem_mark
        during = f" {cause.context}," if cause.context else ""
        return (
            f"{mark.name}, line {mark.line + 1}, column {mark.column + 1}:{during} {shorten(cause.problem)}. "
            "The file cannot be read as YAML. Correct it at that position."
        )
    if cause is not None:
        return f"{shorten(cause)}. The file cannot be read as YAML. Correct it."
    if isinstance(error, UnicodeDecodeError) and _config_in_progress(error):
        byte = error.object[error.start]
        return (
            f"In {_config_in_progress(error)!r}: byte {byte:#04x} at position {error.start} is not UTF-8. "
            "Save the file in UTF-8."
        )
    no_config = "Cannot merge DictConfig with ListConfig" in str(error)
    if no_config or (isinstance(error, ValueError | OSError) and _config_in_progress(error)):
        return (
            f"{_message_with_config(error)}. A config consists of keys and values (`key: value`); `defaults`, if it is "
            "set, is a list of `- group: name`."
        )
    return None


def _message_with_config(error: BaseException) -> str:
    """Return the message of Hydra or OmegaConf in one line, preceded by the name of the config that was composed."""
    message = (str(error) or str(error.__cause__ or "")).split("\n\nSet the environment")[0]
    message = " ".join(message.split("\nSee https://hydra.cc")[0].split())
    message = re.sub(
        r" full_key: (\S*) ?object_type=\w+", lambda key: f" (at {key[1]})" * bool(key[1]), message
    )
    config_name = _config_in_progress(error)
    return f"In {config_name!r}: {message}" if config_name and config_name not in message else message


def _config_in_progress(error: BaseException) -> str | None:
    """Return the name of the config, such as 'experiment/moons/scvae', that Hydra failed to read; None without one.

    The name is read from the local variables of Hydra's functions in the stack trace.
    """
    config_path = None
    for frame, _ in walk_tb(error.__traceback__):
        if frame.f_globals["__name__"] in (
            "hydra._internal.config_repository",
            "hydra._internal.config_loader_impl",
        ):
            default = frame.f_locals.get("default")
            config_path = (
                getattr(default, "config_path", None) or frame.f_locals.get("config_path") or config_path
            )
    return config_path if isinstance(config_path, str) else None


def _describe_unknown_key(cause: OmegaConfBaseException) -> str:
    """Return the message for an unknown key; it suggests the same key elsewhere in the config, or a similar key."""
    assert cause.parent_node is not None
    key, root = str(cause.key), cause.parent_node._get_root()
    known = [str(name) for name in cause.parent_node if name != "hydra"]
    paths = _dotted_keys(OmegaConf.to_container(root, resolve=False))
    # of several equal keys, the least nested one
    elsewhere = {path.rpartition(".")[2]: path for path in sorted(paths, key=lambda path: -path.count("."))}
    beside = [*known, *groups()] if cause.parent_node is root else known
    near = key if key in elsewhere else nearest_name(key, beside) or nearest_name(key, elsewhere, 0.7)
    if cause.parent_node is root and key in beside:
        return f"No {key} is chosen, so {cause.full_key}... has no effect. Choose {key}=<name>, or {key}=[<name>]."
    hint = f" Did you mean {(near if near in beside else elsewhere[near])!r}?" if near else ""
    return (
        f"{cause.full_key}: unknown key.{hint} Known keys: {list_names(key, known) or 'none'}. (If the plugin has "
        f"this parameter and its YAML config does not list it, write +{cause.full_key}=...)"
    )


def _dotted_keys(values: Any, before: str = "") -> list[str]:
    """Return the dotted keys of all entries of nested mappings, without Hydra's keys; each key begins with `before`."""
    keys = []
    for key, value in values.items() if isinstance(values, Mapping) else ():
        if before or key != "hydra":
            keys += [f"{before}{key}", *_dotted_keys(value, f"{before}{key}.")]
    return keys
