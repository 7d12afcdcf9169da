"""Inspection of a plugin's constructor: its keys in the config, their annotations and defaults, and its parts."""

import inspect
import sys
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from typing import Annotated, Any

from pydantic import AfterValidator

from framework.configuration.registry import group_of
from framework.errors import ConfigError, shorten


class Part(typing.NamedTuple):
    """Constructor parameter that takes a plugin of the registry `group`, or several plugins.

    `many` is list or tuple if the parameter takes a list or tuple of plugins, and None if it takes a single plugin.
    """

    group: str
    many: type[list[Any]] | type[tuple[Any, ...]] | None


@cache
def parts(cls: type) -> dict[str, Part]:
    """Return, by name, the parameters of `cls` that take plugins: keyword-only ones annotated with an abstract base.

    Raises:
        ConfigError: An annotation contains a base in a form for which no config can name plugins, such as a dict.
    """
    part_by_name = {}
    for name, (annotation, _) in signature(cls).items():
        for candidate in typing.get_args(annotation) if _is_union(annotation) else (annotation,):
            if typing.get_origin(candidate) is typing.Annotated:
                candidate = typing.get_args(candidate)[0]
            many = {list: list, tuple: tuple, Sequence: list}.get(typing.get_origin(candidate))
            # a bare `List` has no arguments
            group = group_of(next(iter(typing.get_args(candidate)), None) if many else candidate)
            if group is not None:
                part_by_name[name] = Part(group, many)
        if name not in part_by_name and (group := next(_groups_within(annotation), None)):
            raise ConfigError(
                f"{cls.__name__}: the annotation of `{name}`, {shorten(annotation)}, contains the base of the group "
                f"{group} in a form for which a config cannot name plugins. Annotate the parameter with the base, or "
                "with a list or a tuple of the base."
            )
    return part_by_name


def _groups_within(annotation: Any) -> Iterator[str]:
    group = group_of(annotation)
    if group is not None:
        yield group
    for inner in typing.get_args(annotation):
        yield from _groups_within(inner)


@cache
def signature(cls: type) -> dict[str, tuple[Any, Any]]:
    """Return annotation and default of every key that `cls` has in the config.

    Raises:
        ConfigError: Two parameters have the same key, or a key is `name`, which names the plugin.
    """
    annotation_and_default: dict[str, tuple[Any, Any]] = {}
    owner: dict[str, str] = {"name": "the name of the plugin"}
    for name, key, annotation, default in _keys(cls):
        description = f"the parameter `{name}`" if name == key else f"a field of `{name}`"
        if key in owner:
            raise ConfigError(
                f"{cls.__name__} has the key {key!r} twice, as {owner[key]} and as {description}, but a config can "
                "hold it only once. Rename one of them."
            )
        owner[key] = description
        annotation_and_default[key] = annotation, default
    return annotation_and_default


def _keys(cls: type, instance: Any = None) -> Iterator[tuple[str, str, Any, Any]]:
    """Yield parameter, key, annotation and default of every key of `cls`.

    A parameter that is a dataclass has one key for each of its fields. If `instance` is given, the defaults are the
    values of its attributes.
    """
    for name, (annotation, default) in _keywords(cls).items():
        default = getattr(instance, name, default)
        if _is_value(annotation):
            for _, key, kind, key_default in _keys(annotation, default):
                yield name, key, kind, key_default
        else:
            yield name, name, annotation, default


def arguments(cls: type, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keyword arguments of the constructor of `cls`, built from the values of its keys."""
    return {
        name: kind(**arguments(kind, values)) if _is_value(kind) else values[name]
        for name, (kind, _) in _keywords(cls).items()
    }


def _is_value(kind: Any) -> bool:
    """Return whether an annotation is a dataclass of keyword-only fields."""
    if not (isinstance(kind, type) and is_dataclass(kind)):
        return False
    return all(field.kw_only for field in fields(kind) if field.init)


@cache
def _keywords(cls: type) -> dict[str, tuple[Any, Any]]:
    """Return annotation and default of every keyword-only parameter.

    A parameter without an annotation has the type of its default, if this is a number, a truth value or a text.

    Raises:
        ConfigError: An annotation cannot be evaluated.
    """
    factories = {
        field.name: field.default_factory
        for field in (fields(cls) if is_dataclass(cls) else ())
        if field.default_factory is not MISSING
    }
    return {
        name: (
            _type_of(parameter.default) if name in untyped(cls) else _annotation(cls, name),
            factories[name]() if name in factories else parameter.default,
        )
        for name, parameter in inspect.signature(cls.__init__).parameters.items()
        if parameter.kind is parameter.KEYWORD_ONLY
    }


def untyped(cls: type) -> list[str]:
    """Return the names of the keyword-only parameters without an annotation."""
    annotated = getattr(cls.__init__, "__annotations__", {})
    return [
        name
        for name, parameter in inspect.signature(cls.__init__).parameters.items()
        if parameter.kind is parameter.KEYWORD_ONLY and name not in annotated
    ]


def _type_of(default: Any) -> Any:
    """Return the type that a default shows: any number for a number, and any value for other defaults than texts."""
    if isinstance(default, bool | str):
        return type(default)
    return Annotated[Any, AfterValidator(_require_number)] if isinstance(default, int | float) else Any


def _require_number(value: Any) -> Any:
    """Return the value if it is a number, of the same type; pydantic turns the error into a message with the key."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError("expected a number, as the default is. Write a number, or annotate the parameter")
    return value


def _annotation(cls: type, name: str) -> Any:
    """Return the evaluated annotation of one parameter.

    The annotations are evaluated one by one, because those of other parameters may use names that exist for type
    checkers only.
    """
    written = getattr(cls.__init__, "__annotations__", {}).get(name, Any)
    names = getattr(inspect.unwrap(cls.__init__), "__globals__", {})
    # the constructor belongs to the module of the class, but a field may come from a base in another module
    if is_dataclass(cls):
        owner = next((base for base in cls.__mro__ if name in inspect.get_annotations(base)), cls)
        names = vars(sys.modules[owner.__module__])
    holder = types.SimpleNamespace(__annotations__={name: written})
    try:
        return typing.get_type_hints(holder, globalns=names, include_extras=True)[name]
    except Exception as error:
        raise ConfigError(
            f"{cls.__name__}: the annotation of `{name}`, {shorten(written)}, cannot be evaluated: "
            f"{type(error).__name__}: {shorten(error)}. The annotation of a keyword-only parameter is the type of a "
            "key in the config. Import the names in it at run time, not under `if TYPE_CHECKING`, or correct them."
        ) from error


def positional(cls: type) -> list[inspect.Parameter]:
    """Return the constructor parameters of `cls` before `*`, which the framework fills."""
    parameters = list(inspect.signature(cls.__init__).parameters.values())[1:]
    return [
        parameter
        for parameter in parameters
        if parameter.kind in (parameter.POSITIONAL_ONLY, parameter.POSITIONAL_OR_KEYWORD)
    ]


def _is_union(annotation: object) -> bool:
    return typing.get_origin(annotation) in (typing.Union, types.UnionType)
