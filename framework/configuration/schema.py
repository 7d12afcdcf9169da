"""Checking of a config against a plugin's constructor signature, and construction of the plugin from the config.

Parameters of a constructor before `*` come from the framework and are filled by name (`target`, `input_shape`,
`model`). Keyword-only parameters come from the config, are checked against their annotations, and have their defaults
in the signature. A keyword-only parameter that is annotated with an abstract base is a *part*: the config names a
plugin of that base's registry, and the constructor receives the built plugin. A parameter that is annotated with a
dataclass of keyword-only fields is a *value*: its fields are keys of the config beside the other keys, and the
constructor receives the dataclass. If the parameter has a default, the fields of that default are the defaults of these
keys.

A checked config holds plain values only, because checkpoints store it: a path is stored as text, an enum as its value,
and a pydantic model or a dataclass as a mapping of its fields. `build` reads these values by the annotations again, so
that the constructor receives values of the annotated types.
"""

import inspect
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from datetime import date, time, timedelta
from decimal import Decimal
from enum import Enum
from functools import cache
from pathlib import PurePath
from traceback import walk_tb
from typing import Any, get_args
from uuid import UUID

from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model
from pydantic_core import to_jsonable_python

from framework.configuration.registry import load
from framework.configuration.signature import arguments, parts, positional, signature
from framework.errors import ConfigError, did_you_mean, list_names, quote, shorten
from framework.storage.plain_values import is_number

WRITTEN = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)
"""Pattern of a text that is accepted as a number, such as the value of an environment variable."""


def forbid_targets(config: Any, path: str = "") -> None:
    """Refuse the key `_target_` anywhere, because a config holds names and values but never code.

    Raises:
        ConfigError: `config` contains a key `_target_`.
    """
    if isinstance(config, Mapping):
        for key, value in config.items():
            here = f"{path}.{key}" if path else str(key)
            if key == "_target_":
                raise ConfigError(
                    f"{shorten(here)} = {quote(value)}: `_target_` is refused, since a config must not be able "
                    "to run code. Write `name: <installed plugin>` instead (`mode=plugins` lists them)."
                )
            forbid_targets(value, here)
    elif isinstance(config, list | tuple):
        for index, value in enumerate(config):
            forbid_targets(value, f"{path}[{index}]")


def resolve(group: str, config: Any, path: str | None = None) -> dict[str, Any]:
    """Return the config of one plugin with every default filled in, checked against its constructor.

    Args:
        group: Registry, such as "density_head".
        config: Name of a plugin, or a mapping with `name` and parameters.
        path: Name of the config in messages; the group's name by default.

    Raises:
        ConfigError: The name or a key is unknown, or a value has the wrong type or range.
    """
    path = path or group
    if isinstance(config, str):
        config = {"name": config}
    if not isinstance(config, Mapping):
        raise ConfigError(
            f"{shorten(path)} = {quote(config)}: wanted the name of a {group}, or a mapping with `name` and "
            "its parameters."
        )
    forbid_targets(config, path)
    values = dict(config)
    name = values.pop("name", None)
    if not isinstance(name, str):
        raise ConfigError(
            f"{shorten(path)}.name is missing: write the name of a {group} (`mode=plugins` lists them)."
        )
    cls = load(group, name)
    checked = _stored(cls, values, path)
    for key, part in parts(cls).items():
        value = checked[key]
        if value is None:
            continue
        if part.many:
            items = value if isinstance(value, list | tuple) else [value]
            checked[key] = [resolve(part.group, item, f"{path}.{key}[{i}]") for i, item in enumerate(items)]
        else:
            checked[key] = resolve(part.group, value, f"{path}.{key}")
    return {"name": name, **checked}


def build(group: str, config: Mapping[str, Any], **context: Any) -> Any:
    """Build the plugin of a resolved config, after building its parts.

    Args:
        group: Registry, such as "density_head".
        config: Resolved config of the plugin.
        context: Values that the framework supplies, by parameter name.

    Raises:
        ConfigError: The constructor has a parameter that the framework cannot supply here, or raises a ValueError.
    """
    cls = load(group, config["name"])
    given = []
    for parameter in positional(cls):
        if parameter.name not in context:
            raise ConfigError(
                f"{cls.__name__} asks the framework for `{parameter.name}`, which a {group} is not given here; "
                f"it may ask for: {', '.join(context) or 'nothing'}. Keyword-only parameters come from the config."
            )
        given.append(context[parameter.name])
    stored = _defaults(cls) | {key: value for key, value in config.items() if key != "name"}
    values = _validated(cls, _kept(cls, stored, group), group, nullable=True)
    for key, part in parts(cls).items():
        if values[key] is None:
            continue
        try:
            if part.many:
                values[key] = part.many(build(part.group, item, **context) for item in values[key])
            else:
                values[key] = build(part.group, values[key], **context)
        except ConfigError as error:  # the user may never have named the part
            raise ConfigError(f"{group} {config['name']}, of which {key} is a part: {error}") from error
    try:
        return cls(*given, **arguments(cls, values))
    except ValueError as error:
        said = " ".join(f"{key}={shorten(value)}" for key, value in config.items() if key != "name")
        raise ConfigError(
            f"{group} {config['name']} does not take {said or 'what it was given'}: {shorten(error)} (ValueError at "
            f"{_place(error, cls)})."
        ) from error


def _place(error: BaseException, cls: type) -> str:
    """Return file and line of an error: the last line reached in the plugin's own file, or else the last of all."""
    lines = [(frame.f_code.co_filename, line) for frame, line in walk_tb(error.__traceback__)]
    own = [place for place in lines if place[0] == inspect.getsourcefile(cls)]
    file, line = (own or lines)[-1]
    return f"{file}:{line}"


def check(model: type[BaseModel], values: Mapping[str, Any], path: str) -> dict[str, Any]:
    """Return `values` validated and completed by a pydantic model.

    Raises:
        ConfigError: A key is unknown or missing, or a value has the wrong type or range; the message describes the
            first fault.
    """
    try:
        found = model.model_validate(dict(values)).model_dump()
    except ValidationError as error:
        raise _refusal(error, path, list(model.model_fields)) from None
    _require_numbers(values, found, path)
    return found


def _require_numbers(given: Any, read: Any, where: str) -> None:
    """Refuse values that pydantic reads as a number but that are not meant as one: true, "1_0", " 1 ", "nan".

    Raises:
        ConfigError: `given` contains such a value where pydantic `read` a number.
    """
    if isinstance(given, Mapping) and isinstance(read, Mapping):
        for key in given.keys() & read.keys():
            _require_numbers(given[key], read[key], f"{where}.{key}" if where else str(key))
    elif isinstance(given, list | tuple) and isinstance(read, list | tuple) and len(given) == len(read):
        for number, (one, other) in enumerate(zip(given, read, strict=True)):
            _require_numbers(one, other, f"{where}[{number}]")
    elif is_number(read) and not isinstance(read, Enum) and _no_number(given):
        raise ConfigError(f"{shorten(where)} = {quote(given)}: wanted a number. Write one, such as {read}.")


def _no_number(given: Any) -> bool:
    return isinstance(given, bool) or (isinstance(given, str) and not WRITTEN.fullmatch(given))


def _refusal(error: ValidationError, path: str, known: Sequence[str]) -> ConfigError:
    """Return an error that describes the first fault; `known` are the valid keys, for an unknown key."""
    fault = error.errors()[0]
    where = shorten(".".join(filter(None, [path, *(str(item) for item in fault["loc"])])))
    # the second kind comes from a dataclass
    if fault["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        left = path and fault["input"] is not None and "[" not in where
        return _unknown(where, str(fault["loc"][-1]), known, bool(left))
    if fault["type"] == "missing":
        return ConfigError(f"{where} is missing: {fault['msg']}. Give it a value.")
    hint = ""
    if fault["type"] == "literal_error":
        hint = did_you_mean(str(fault["input"]), re.findall("'([^']*)'", fault.get("ctx", {})["expected"]))
    message = fault["msg"].removeprefix("Value error, ")
    return ConfigError(f"{where} = {quote(fault['input'])}: {message}.{hint}")


def _unknown(where: str, key: str, known: Sequence[str], left: bool) -> ConfigError:
    # the key may belong to another plugin that the experiment chose; Hydra cannot delete a key whose value is null
    advice = f" ~{where} leaves out what an experiment sets." if left else ""
    return ConfigError(
        f"{where}: unknown key.{did_you_mean(key, known)} Known keys: {list_names(key, known) or 'none'}.{advice}"
    )


def _stored(cls: type, values: Mapping[str, Any], path: str) -> dict[str, Any]:
    """Return `values` checked and completed by the defaults of `cls`, as plain values that do not change when reread.

    Raises:
        ConfigError: A key is unknown or missing, or a value has the wrong type or range or cannot be stored.
    """
    found = _kept(cls, _validated(cls, _defaults(cls) | dict(values), path), path)
    try:
        again = _kept(cls, _validated(cls, found, path), path)
    except ConfigError as error:
        raise ConfigError(
            f"{error} That is how {cls.__name__} keeps what it was given, which its annotation does not take: "
            "annotate the parameter with a type that also takes plain values."
        ) from None
    for key, value in found.items():
        # NaN does not equal itself, so its text is compared too
        if again[key] != value and repr(again[key]) != repr(value):
            raise ConfigError(
                f"{shorten(f'{path}.{key}')} = {quote(value)} becomes {quote(again[key])} when a checkpoint that "
                f"keeps it is read: the annotation changes what it is given. Let {cls.__name__} compute that in its "
                "constructor."
            )
    return found


def _defaults(cls: type) -> dict[str, Any]:
    return {key: own for key, (_, own) in signature(cls).items() if own is not inspect.Parameter.empty}


def _validated(cls: type, values: Mapping[str, Any], path: str, *, nullable: bool = False) -> dict[str, Any]:
    """Return the value of every key of `cls`, converted as its annotation says.

    Args:
        cls: Class of the plugin.
        values: Values by key.
        path: Name of the config in messages.
        nullable: Accept None for any key, since a loaded model receives None for parameters that only training needs
            (`Encoder.initial`).

    Raises:
        ConfigError: A key is unknown or missing, or a value has the wrong type or range.
    """
    found = {}
    models = _models(cls)
    for key in values:
        if key not in models:
            where = shorten(f"{path}.{key}")
            raise _unknown(where, str(key), list(models), values[key] is not None and "[" not in where)
    for key, (annotation, _) in signature(cls).items():
        if key not in values:
            raise ConfigError(f"{shorten(f'{path}.{key}')} is missing: Field required. Give it a value.")
        value = values[key]
        if nullable and value is None:
            found[key] = None
            continue
        try:
            # without `extra`, a misspelt key of an inner model would be ignored silently
            read: Any = models[key].model_validate({key: value}, extra="forbid")
            # pydantic turns a value annotated as Iterable into an iterator, which can be read only once
            found[key] = list(read.value) if isinstance(read.value, Iterator) else read.value
            _require_numbers(value, found[key], f"{path}.{key}")
        except ValidationError as error:
            raise _refusal(error, path, _inner_keys(annotation)) from None
    return found


def _inner_keys(annotation: Any) -> list[str]:
    """Return the names of the fields of all models and dataclasses inside an annotation."""
    named = getattr(annotation, "model_fields", None) or getattr(annotation, "__dataclass_fields__", ())
    return [*named, *(name for inner in get_args(annotation) for name in _inner_keys(inner))]


def _kept(cls: type, values: Mapping[str, Any], path: str) -> dict[str, Any]:
    """Return the values in the form in which a checkpoint stores them.

    Raises:
        ConfigError: A value does not consist of plain values.
    """
    found = {}
    for key, value in values.items():
        try:
            found[key] = _plain(value)
        except TypeError as error:
            raise ConfigError(
                f"{shorten(f'{path}.{key}')} = {quote(value)}: {error}, which no checkpoint keeps. Annotate the "
                f"parameter of {cls.__name__} with numbers, text, paths, enums, or lists, mappings, dataclasses or "
                "pydantic models of these, and make what it needs of them in its constructor."
            ) from None
    return found


@cache
def _models(cls: type) -> dict[str, type[BaseModel]]:
    """Return for each key a pydantic model with one field `value`, whose alias is the key.

    Raises:
        ConfigError: An annotation is no type that pydantic can check.
    """
    found = {}
    config = ConfigDict(extra="forbid", arbitrary_types_allowed=True)
    for key, (annotation, _) in signature(cls).items():
        kind = Any if key in parts(cls) else annotation
        try:
            found[key] = create_model(cls.__name__, __config__=config, value=(kind, Field(alias=key)))
        except Exception as error:  # pydantic raises a dozen kinds
            raise ConfigError(
                f"{cls.__name__}: the annotation of `{key}`, {shorten(annotation)}, cannot be checked: "
                f"{shorten(str(error))} Annotate it with a type: numbers, text, lists, dataclasses, ..."
            ) from error
    return found


_SEVERAL: tuple[Any, ...] = (list, tuple, set)
_SINGLE: tuple[Any, ...] = (bool, int, float, complex, str, bytes)


def _plain(value: Any) -> Any:
    """Return a copy that consists of None, numbers, text, lists, tuples, sets and dicts.

    Raises:
        TypeError: A value in it cannot be converted to these; the message names its type.
    """
    if isinstance(value, Enum):
        return _plain(value.value)
    if isinstance(value, BaseModel):
        return _plain(value.model_dump(by_alias=True))
    if isinstance(value, PurePath):
        return str(value)
    if isinstance(value, date | time | timedelta | Decimal | UUID):
        return to_jsonable_python(value)
    if isinstance(value, Mapping):
        return {_plain(key): _plain(item) for key, item in value.items()}
    if isinstance(value, frozenset):
        # torch does not read a frozenset, and a list cannot be an item of a set
        return tuple(map(_plain, value))
    for kind in _SEVERAL:
        if isinstance(value, kind):
            return kind(map(_plain, value))
    for kind in _SINGLE:
        if isinstance(value, kind):
            return kind(value)
    if value is None:
        return None
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value) if field.init}
    raise TypeError(f"it holds a {type(value).__name__}")
