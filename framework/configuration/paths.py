"""Handling of paths in a stored config, which are used only if the user repeats them (DESIGN, law 15).

A checkpoint or a run folder may come from an untrusted source. A text counts as a path by the annotation of its
parameter (`FilePath`, `pathlib.Path`, pydantic's `FilePath` and `DirectoryPath`), or else if it looks like a path, so
that a plugin without such annotations is safe too.
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
"""Groups of which a config names one plugin; of the other groups it names several."""
OPTIONS = ("files", "into", "members", "run")
"""Options of modes that name files, folders or runs."""
UNUSED = ("metric", "objective", "outliers", "renderer")
"""Groups whose plugins are not imported to load a model; their parameters are checked as texts only."""


@dataclass
class _Part:
    """Config of a plugin that can be changed.

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
        """Yield the names of the parameters whose value differs from the default and holds a path."""
        for name, value in self.values.items():
            if name == "name" or (self.cls and name in parts(self.cls)):
                continue
            if not _equal(value, self.default(name)) and holds_path(self.annotation(name), value):
                yield name


def without_paths(
    config: Mapping[str, Any], said: Mapping[str, Any], unused: Collection[str] = ()
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Remove from a stored config every path that the user does not repeat.

    Args:
        config: Plugins by group, as a checkpoint or a run folder holds them; not checked yet.
        said: Values of the user by dotted keys, such as "data.root" or "encoder.<name>.weights".
        unused: Groups whose plugins are not imported for this.

    Returns:
        A copy of the config with the user's values, in which the other paths have their defaults; and the removed
        paths by their keys. Parameters that only training needs (`Encoder.initial`) are not among the removed paths.

    Raises:
        ConfigError: The config has no part for a key of `said`, or the key is no path of the model.
    """
    found = deepcopy(dict(config))
    dropped: dict[str, Any] = {}
    left = dict(said)
    known = list(_parts(found, unused))
    for part in known:
        paths = list(part.paths())
        for name in paths:
            if f"{part.key}.{name}" not in said:
                if name not in getattr(part.cls, "initial", ()):
                    dropped[f"{part.key}.{name}"] = part.values[name]
                part.take_default(name)
        for key in [key for key in said if key.rpartition(".")[0] == part.key]:
            name = key.rpartition(".")[2]
            if (
                part.key.partition(".")[0] in MODEL
                and name not in paths
                and not _marked(part.annotation(name))
            ):
                raise ConfigError(
                    f"{shorten(key)} = {quote(said[key])} would change a trained model, of which only paths can be said "
                    "again. Leave it out."
                )
            value = said[key]
            part.values[name] = str(value) if isinstance(value, PurePath) else value
            left.pop(key, None)
    for key in left:
        near = [f"{part.key}.{name}" for part in known for name in (*part.values, *part.paths())]
        raise ConfigError(
            f"{shorten(key)} = {quote(left[key])}: the stored config has no such part."
            f"{did_you_mean(key, [*near, *dropped])} "
            f"It has: {', '.join(shorten(part.key) for part in known)}."
        )
    return found, dropped


def paths_of(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return all paths of a composed config, by the keys under which a command gives them."""
    config = deepcopy({group: values.get(group) for group in (*GROUPS, "outliers")})
    found = {f"{part.key}.{name}": part.values[name] for part in _parts(config, ()) for name in part.paths()}
    mode = values.get("mode")
    for name, value in mode.items() if isinstance(mode, Mapping) else ():
        if name != "name" and holds_path(FilePath if name in OPTIONS else Any, value):
            found[f"mode.{name}"] = value
    said = values.get("stored")
    found |= flat(said) if isinstance(said, Mapping) else {}
    checkpoint = values.get("checkpoint")
    return found if checkpoint is None else {**found, "checkpoint": checkpoint}


def flat(said: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of nested mappings by dotted keys."""
    found: dict[str, Any] = {}
    for key, value in said.items():
        inner = flat(value) if isinstance(value, Mapping) else None
        found |= {str(key): value} if inner is None else {f"{key}.{rest}": one for rest, one in inner.items()}
    return found


def require_said(dropped: Mapping[str, Any], groups: Collection[str], source: str) -> None:
    """Refuse to continue without the paths of some groups.

    Args:
        dropped: Removed paths, by dotted keys.
        groups: Groups whose paths are needed.
        source: Path of the checkpoint, for the message.

    Raises:
        ConfigError: Paths of these groups were removed; the message says which, and what to write.
    """
    needed = {key: value for key, value in dropped.items() if key.partition(".")[0] in groups}
    if needed:
        named = ", ".join(f"{shorten(key)} = {quote(value)}" for key, value in needed.items())
        example = ", ".join(f'"{shorten(key)}": ...' for key in needed)
        raise ConfigError(
            f"{shorten(source)} names a path: {named}. A checkpoint may come from anybody, so a path in it is used only "
            f"where you say it again, or another. Add to a command: {' '.join(words(needed))}; to one of a plugin the "
            f"same behind --path; to framework.load or freeze: paths={{{example}}}."
        )


def require_repeated(stored: Mapping[str, Any], said: Mapping[str, Any], folder: object) -> None:
    """Refuse to resume a run whose paths the command does not repeat.

    Args:
        stored: Paths of the stored config, by dotted keys.
        said: Paths that the command gives, by dotted keys.
        folder: Folder of the run.

    Raises:
        ConfigError: A path is missing or differs; the message says what to write.
    """
    for key, value in said.items():
        if key not in stored or not _equal(stored[key], value):
            has = quote(stored[key]) if key in stored else "none"
            raise ConfigError(
                f"resume={folder} goes on with that run's own config; {shorten(key)} = {quote(value)} would change it, "
                f"which has {has}. Give the same, or start a new run."
            )
    missing = {key: value for key, value in stored.items() if key not in said}
    if missing:
        named = ", ".join(f"{shorten(key)} = {quote(value)}" for key, value in missing.items())
        raise ConfigError(
            f"resume={folder}: its config names a path: {named}. A run folder may come from anybody, so a path in it "
            f"is used only where the command says it again. Add: {' '.join(words(missing))}"
        )


def words(paths: Mapping[str, Any]) -> list[str]:
    """Return the arguments that give these paths on a command line, as typed into a shell."""
    return [shlex.quote(f"{shorten(key)}={_typed(value)}") for key, value in paths.items()]


def _typed(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{_typed(key)}:{_typed(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple | set):
        return "[" + ",".join(map(_typed, value)) + "]"
    text = escape_unprintable(str(value), allowed="")
    if isinstance(value, str) and not re.fullmatch(
        r"[A-Za-z0-9_.@-]*/[A-Za-z0-9_./@-]+", text
    ):  # quotes are needed so that it is not read as a number or null
        # imports Hydra, which loading does not need
        from framework.configuration.composition import in_quotes

        return in_quotes(text)
    return text


def add_option(parser: argparse.ArgumentParser) -> None:
    """Add the option `--path KEY=PATH`, which `said` reads, to a command of a plugin."""
    parser.add_argument(
        "--path",
        action="append",
        default=[],
        metavar="KEY=PATH",
        help="a path that the run's config names, said again: data.root=<folder>",
    )


def said(options: Sequence[str]) -> dict[str, str]:
    """Return the paths of the option `--path`, by their keys."""
    return {key: path for key, _, path in (option.partition("=") for option in options)}


def _parts(config: dict[str, Any], unused: Collection[str]) -> Iterator[_Part]:
    """Yield every plugin in a config, including plugins that are parts of others."""
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
                yield from _within("data" if group == "outliers" else group, key, part, group in unused)


def _within(group: str, key: str, values: dict[str, Any], unused: bool) -> Iterator[_Part]:
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
        for number, one in enumerate(several):
            if isinstance(one, dict):
                yield from _within(
                    part.group, f"{key}.{name}" + f".{number}" * (value is not one), one, unused
                )


def _name(part: Any) -> str:
    return str(part.get("name")) if isinstance(part, Mapping) else str(part)


def holds_path(annotation: Any, value: Any) -> bool:
    """Return whether the value of a parameter holds a path, as its annotation says or, without one, as it looks."""
    if isinstance(value, str):
        if value in _literals(annotation):
            return False
        mark = _mark(annotation)
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


def _marked(annotation: Any) -> bool:
    return bool(_mark(annotation))


def _mark(annotation: Any) -> bool | None:
    """Return whether an annotation says that a text is a path (True), is never a path (False), or neither (None)."""
    marks = [each.path for each in getattr(annotation, "__metadata__", ()) if isinstance(each, Mark)]
    if isinstance(annotation, type) and issubclass(annotation, PurePath):
        marks.append(True)
    marks += [mark for inner in typing.get_args(annotation) if (mark := _mark(inner)) is not None]
    return None if not marks else any(marks)


def _literals(annotation: Any) -> set[Any]:
    if typing.get_origin(annotation) is typing.Literal:
        return {one for one in typing.get_args(annotation) if isinstance(one, str)}
    return {one for inner in typing.get_args(annotation) for one in _literals(inner)}


def _fields(annotation: Any) -> dict[str, Any]:
    """Return the annotations of the fields of all dataclasses and pydantic models inside an annotation."""
    found: dict[str, Any] = {}
    if isinstance(annotation, type) and (is_dataclass(annotation) or issubclass(annotation, BaseModel)):
        try:
            found = typing.get_type_hints(annotation, include_extras=True)
        except Exception:  # the annotation uses a name that exists for type checkers only
            found = {}
    for inner in typing.get_args(annotation):
        found |= _fields(inner)
    return found


def _equal(value: Any, default: Any) -> bool:
    if default is inspect.Parameter.empty:
        return False
    plain = str(default) if isinstance(default, PurePath) else default
    if is_dataclass(plain) and not isinstance(plain, type):
        plain = asdict(plain)
    if isinstance(value, list | tuple) and isinstance(plain, list | tuple):
        return list(map(str, value)) == list(map(str, plain))
    return bool(value == plain)
