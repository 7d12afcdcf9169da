"""Handling of paths in a stored config, which are used only if the user repeats them (SECURITY.md).

The reason is that a checkpoint or a run folder may come from an untrusted source. A text counts as a path if the
annotation of its parameter says so (`FilePath`, `pathlib.Path`, pydantic's `FilePath` and `DirectoryPath`). Without
such an annotation, a text counts as a path if it looks like one, so that a plugin without annotations is safe too.
"""

import argparse
import inspect
import re
import shlex
import typing
from collections.abc import Collection, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import PurePath
from typing import Any

from pydantic import BaseModel

from framework.configuration.registry import GROUPS, MODEL, load
from framework.configuration.signature import parts, signature
from framework.errors import ConfigError, did_you_mean, escape_unprintable, quote, shorten
from framework.storage.path_marks import FilePath as FilePath
from framework.storage.path_marks import Mark
from framework.storage.path_marks import Words as Words

SINGLE = ("data", "outliers", "density_head", "renderer")
"""Groups from which a config chooses one plugin; from each other group, a config may choose several."""
OPTIONS = ("files", "into", "members", "run", "truth", "camera")
"""Options of modes that name files, folders or runs."""
UNUSED = ("metric", "objective", "outliers", "renderer")
"""Groups whose plugins are not imported to load a model.

The types of their parameters are therefore not known: a text that looks like a path counts as a path.
"""


@dataclass
class _Part:
    """Config of one plugin inside a larger config; a change of `values` changes the larger config.

    Attributes:
        key: Dotted key of the plugin in the whole config.
        values: Parameters of the plugin.
        cls: Class of the plugin; None if it is not known.
    """

    key: str
    values: dict[str, Any]
    cls: type | None

    def annotation(self, name: str) -> Any:
        """Return the annotation of a parameter; Any if it is not known."""
        return signature(self.cls)[name][0] if self.cls and name in signature(self.cls) else Any

    def default(self, name: str) -> Any:
        """Return the default of a parameter; None if it is not known."""
        return signature(self.cls)[name][1] if self.cls and name in signature(self.cls) else None

    def take_default(self, name: str) -> None:
        """Set a parameter to its default."""
        default = self.default(name)
        self.values[name] = default
        if self.cls is None or not (default is None or isinstance(default, str)):  # the schema fills it in
            del self.values[name]

    def paths(self) -> Iterator[str]:
        """Yield the names of the parameters whose value differs from the default and contains a path."""
        for name, value in self.values.items():
            if name == "name" or (self.cls and name in parts(self.cls)):
                continue
            if not _equal(value, self.default(name)) and holds_path(self.annotation(name), value):
                yield name


def remove_paths(
    config: Mapping[str, Any], user_values: Mapping[str, Any], unused: Collection[str] = ()
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Remove from a stored config every path that the user does not repeat.

    Args:
        config: Plugins by group, as a checkpoint or a run folder stores them; not checked yet.
        user_values: Values of the user by dotted keys, such as "data.root" or "encoder.<name>.weights".
        unused: Groups whose plugins are not imported to find out which of their parameters are paths.

    Returns:
        A copy of the config with the user's values, in which all other paths are replaced by the defaults; and the
        removed paths by dotted keys. Paths of parameters that only training needs (`Encoder.initial`) are removed but
        not listed.

    Raises:
        ConfigError: The config has no part for a key of `user_values`, or the key is not a path of the model.
    """
    cleaned = deepcopy(dict(config))
    dropped: dict[str, Any] = {}
    unmatched = dict(user_values)
    all_parts = list(_parts(cleaned, unused))
    for part in all_parts:
        paths = list(part.paths())
        for name in paths:
            if f"{part.key}.{name}" not in user_values:
                if name not in getattr(part.cls, "initial", ()):
                    dropped[f"{part.key}.{name}"] = part.values[name]
                part.take_default(name)
        for key in [key for key in user_values if key.rpartition(".")[0] == part.key]:
            name = key.rpartition(".")[2]
            if (
                part.key.partition(".")[0] in MODEL
                and name not in paths
                and not is_marked_path(part.annotation(name))
            ):
                raise ConfigError(
                    f"{shorten(key)} = {quote(user_values[key])} would change a trained model. A command may override "
                    "only the paths of a trained model. Leave this setting out."
                )
            value = user_values[key]
            part.values[name] = str(value) if isinstance(value, PurePath) else value
            unmatched.pop(key, None)
    for key in unmatched:
        candidates = [f"{part.key}.{name}" for part in all_parts for name in (*part.values, *part.paths())]
        raise ConfigError(
            f"{shorten(key)} = {quote(unmatched[key])}: the stored config has no such key."
            f"{did_you_mean(key, [*candidates, *dropped])} "
            f"The stored config has the parts {', '.join(shorten(part.key) for part in all_parts)}."
        )
    return cleaned, dropped


def paths_of(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return all paths of a composed config, by the dotted keys that a command uses for them."""
    config = deepcopy({group: values.get(group) for group in (*GROUPS, "outliers")})
    paths_by_key = {
        f"{part.key}.{name}": part.values[name] for part in _parts(config, ()) for name in part.paths()
    }
    mode = values.get("mode")
    for name, value in mode.items() if isinstance(mode, Mapping) else ():
        if name != "name" and holds_path(FilePath if name in OPTIONS else Any, value):
            paths_by_key[f"mode.{name}"] = value
    repeated = values.get("stored")
    paths_by_key |= flatten(repeated) if isinstance(repeated, Mapping) else {}
    checkpoint = values.get("checkpoint")
    return paths_by_key if checkpoint is None else {**paths_by_key, "checkpoint": checkpoint}


def flatten(nested: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of nested mappings by dotted keys."""
    flattened: dict[str, Any] = {}
    for key, value in nested.items():
        inner = flatten(value) if isinstance(value, Mapping) else None
        flattened |= (
            {str(key): value} if inner is None else {f"{key}.{rest}": item for rest, item in inner.items()}
        )
    return flattened


def require_paths(dropped: Mapping[str, Any], groups: Collection[str], source: str) -> None:
    """Refuse to continue if a path of a plugin of `groups` was removed from the stored config.

    Args:
        dropped: Removed paths, by dotted keys.
        groups: Groups of plugins that are needed.
        source: Path of the checkpoint, for the message.

    Raises:
        ConfigError: Such a path was removed; the message names the paths, and says what to write.
    """
    needed = {key: value for key, value in dropped.items() if key.partition(".")[0] in groups}
    if needed:
        named = ", ".join(f"{shorten(key)} = {quote(value)}" for key, value in needed.items())
        example = ", ".join(f'"{shorten(key)}": ...' for key in needed)
        raise ConfigError(
            f"{shorten(source)} contains a path: {named}. A checkpoint may come from an untrusted source, so a path "
            "in it is used only if you repeat this path or give another one. In a command of `python -m framework`, "
            f"add {' '.join(shell_arguments(needed))}. In the command of a plugin, write --path before each of these "
            f"settings. In a call of framework.load or framework.freeze, add paths={{{example}}}."
        )


def require_repeated(stored: Mapping[str, Any], repeated: Mapping[str, Any], folder: object) -> None:
    """Refuse to resume a run whose paths the command does not repeat.

    Args:
        stored: Paths of the stored config, by dotted keys.
        repeated: Paths that the command gives, by dotted keys.
        folder: Folder of the run.

    Raises:
        ConfigError: The command lacks a path, or gives another one; the message says what to write.
    """
    for key, value in repeated.items():
        if key not in stored or not _equal(stored[key], value):
            stored_value = quote(stored[key]) if key in stored else "not set"
            raise ConfigError(
                f"resume={folder} continues that run with its own config, in which {shorten(key)} is {stored_value}. "
                f"The command gives {quote(value)}, which would change it. Give the same value, or start a new run."
            )
    missing = {key: value for key, value in stored.items() if key not in repeated}
    if missing:
        named = ", ".join(f"{shorten(key)} = {quote(value)}" for key, value in missing.items())
        raise ConfigError(
            f"resume={folder}: the config of that run contains a path: {named}. A run folder may come from an "
            "untrusted source, so its paths are used only if the command repeats them. Add to the command: "
            f"{' '.join(shell_arguments(missing))}"
        )


PLAIN = re.compile(
    r"[A-Za-z0-9_.@-]*/[A-Za-z0-9_./@-]+|(?!(?i:null|true|false|nan|inf)\Z)[A-Za-z][A-Za-z0-9_.-]*"
)
"""Paths that Hydra reads as they are; others need quotes, so that they are not read as a number, null or a list."""


def shell_arguments(paths: Mapping[str, Any]) -> list[str]:
    """Return the command-line arguments, quoted for a shell, that set the paths in `paths`, given by dotted keys."""
    return [shlex.quote(f"{shorten(key)}={_shell_value(value)}") for key, value in paths.items()]


def _shell_value(value: Any) -> str:
    if isinstance(value, Mapping):
        return (
            "{" + ",".join(f"{_shell_value(key)}:{_shell_value(item)}" for key, item in value.items()) + "}"
        )
    if isinstance(value, list | tuple | set):
        return "[" + ",".join(map(_shell_value, value)) + "]"
    text = escape_unprintable(str(value), allowed="")
    if isinstance(value, str) and not PLAIN.fullmatch(text):
        # imports Hydra, which loading does not need
        from framework.configuration.composition import in_quotes

        return in_quotes(text)
    return text


def add_option(parser: argparse.ArgumentParser) -> None:
    """Add the option `--path KEY=PATH`, whose values `parse_paths` reads, to the command line of a plugin."""
    parser.add_argument(
        "--path",
        action="append",
        default=[],
        metavar="KEY=PATH",
        help="a path from the run's config, repeated or replaced: data.root=<folder>",
    )


def parse_paths(options: Sequence[str]) -> dict[str, str]:
    """Return the paths in the values KEY=PATH of the option `--path`, by their keys."""
    return {key: path for key, _, path in (option.partition("=") for option in options)}


def _parts(config: dict[str, Any], unused: Collection[str]) -> Iterator[_Part]:
    """Yield every plugin in a config, including plugins inside plugins; groups in `unused` are not imported."""
    for group in (*GROUPS, "outliers"):
        chosen = config.get(group)
        named: list[tuple[str, Any]] = []
        if isinstance(chosen, Mapping):
            named = [(group, chosen)] if "name" in chosen or group in SINGLE else []
            named = named or [(f"{group}.{key}", part) for key, part in chosen.items()]
        elif isinstance(chosen, list | tuple):
            named = [(f"{group}.{_name(part)}", part) for part in chosen]
        for key, part in named:
            if isinstance(part, dict):
                yield from _nested_parts("data" if group == "outliers" else group, key, part, group in unused)


def _nested_parts(group: str, key: str, values: dict[str, Any], unused: bool) -> Iterator[_Part]:
    cls = None
    if not unused and isinstance(values.get("name"), str):
        try:
            cls = load(group, values["name"])
        except ConfigError:
            cls = None  # the error is raised where the plugin is used
    inner = parts(cls) if cls else {}
    yield _Part(key, values, cls)
    for name, part in inner.items():
        value = values.get(name)
        several = list(value) if isinstance(value, list | tuple) else [value]
        for number, item in enumerate(several):
            if isinstance(item, dict):
                yield from _nested_parts(
                    part.group, f"{key}.{name}" + f".{number}" * (value is not item), item, unused
                )


def _name(part: Any) -> str:
    return str(part.get("name")) if isinstance(part, Mapping) else str(part)


def holds_path(annotation: Any, value: Any) -> bool:
    """Return whether the value of a parameter contains a path, by its annotation or, without one, by its text."""
    if isinstance(value, str):
        if value in _literals(annotation):
            return False
        mark = _path_mark(annotation)
        return bool(value) and (
            mark if mark is not None else "/" in value or "\\" in value or value[0] == "~"
        )
    if isinstance(value, Mapping):
        fields = _fields(annotation)
        return any(
            holds_path(fields.get(key, annotation), item) or holds_path(annotation, key)
            for key, item in value.items()
        )
    if isinstance(value, list | tuple | set | frozenset):
        return any(holds_path(annotation, item) for item in value)
    return False


def is_marked_path(annotation: Any) -> bool:
    """Return whether the annotation of a parameter says that its text names a file or folder."""
    return bool(_path_mark(annotation))


def _path_mark(annotation: Any) -> bool | None:
    """Return whether a text is a path according to its annotation; None if the annotation says nothing about it."""
    marks = [item.path for item in getattr(annotation, "__metadata__", ()) if isinstance(item, Mark)]
    if isinstance(annotation, type) and issubclass(annotation, PurePath):
        marks.append(True)
    marks += [mark for inner in typing.get_args(annotation) if (mark := _path_mark(inner)) is not None]
    return None if not marks else any(marks)


def _literals(annotation: Any) -> set[Any]:
    if typing.get_origin(annotation) is typing.Literal:
        return {item for item in typing.get_args(annotation) if isinstance(item, str)}
    return {item for inner in typing.get_args(annotation) for item in _literals(inner)}


def _fields(annotation: Any) -> dict[str, Any]:
    """Return the annotations of the fields of all dataclasses and pydantic models inside an annotation."""
    annotations: dict[str, Any] = {}
    if isinstance(annotation, type) and (is_dataclass(annotation) or issubclass(annotation, BaseModel)):
        try:
            annotations = typing.get_type_hints(annotation, include_extras=True)
        except Exception:  # the annotation uses a name that exists for type checkers only
            annotations = {}
    for inner in typing.get_args(annotation):
        annotations |= _fields(inner)
    return annotations


def _equal(value: Any, default: Any) -> bool:
    if default is inspect.Parameter.empty:
        return False
    plain = str(default) if isinstance(default, PurePath) else default
    if is_dataclass(plain) and not isinstance(plain, type):
        plain = asdict(plain)
    if isinstance(value, list | tuple) and isinstance(plain, list | tuple):
        return list(map(str, value)) == list(map(str, plain))
    return bool(value == plain)
