"""Checking of a config against a plugin's constructor signature, and construction of the plugin from the config.

Parameters of a constructor before `*` come from the framework and are filled by name (`target`, `input_shape`,
`model`). Keyword-only parameters come from the config, are checked against their annotations, and have their defaults
in the signature. A keyword-only parameter that is annotated with an abstract base is a *part*: the config names a
plugin of that base's registry, and the constructor receives the built plugin. A parameter that is annotated with a
dataclass of keyword-only fields is a *value*: its fields are keys of the config beside the other keys, and the
constructor receives the dataclass. If the parameter has a default, the fields of that default are the defaults of these
keys.

A checked config consists of plain values only, because checkpoints store it: a path is stored as text, an enum as its
value, and a pydantic model or a dataclass as a mapping of its fields. `build` reads these values by the annotations
again, so that the constructor receives values of the annotated types.
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

from framework.configuration.paths import is_marked_path
from framework.configuration.registry import load
from framework.configuration.signature import arguments, parts, positional, signature
from framework.errors import ConfigError, did_you_mean, list_names, quote, shorten
from framework.storage.enclosed import add_data_folder
from framework.storage.plain_values import is_number

WRITTEN = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)
"""Pattern of a text that is accepted as a number, such as the value of an environment variable."""


def forbid_targets(config: Any, path: str = "") -> None:
    """Refuse the key `_target_` at any depth, because a config contains names and values but never code.

    Args:
        config: A config, or a value in one.
        path: Dotted key of `config` in the whole config, for the message; "" if it is the whole config.

    Raises:
        ConfigError: `config` contains a key `_target_`.
    """
    if isinstance(config, Mapping):
        for key, value in config.items():
            key_path = f"{path}.{key}" if path else str(key)
            if key == "_target_":
                raise ConfigError(
                    f"{shorten(key_path)} = {quote(value)}: `_target_` is refused, because a config must not be able "
                    "to run code. Write `name: <plugin>` instead (`mode=plugins` lists the installed plugins)."
                )
            forbid_targets(value, key_path)
    elif isinstance(config, list | tuple):
        for index, value in enumerate(config):
            forbid_targets(value, f"{path}[{index}]")


def resolve(group: str, config: Any, path: str | None = None) -> dict[str, Any]:
    """Check the config of one plugin against its constructor, and return the config with every default filled in.

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
            f"{shorten(path)} = {quote(config)}: expected the name of a plugin of the group {group}, or a mapping "
            "with `name` and the parameters of the plugin."
        )
    forbid_targets(config, path)
    values = dict(config)
    name = values.pop("name", None)
    if not isinstance(name, str):
        raise ConfigError(
            f"{shorten(path)}.name is missing. Write the name of a plugin of the group {group} (`mode=plugins` "
            "lists them)."
        )
    cls = load(group, name)
    checked = _checked_plain_values(cls, values, path)
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
    supplied = []
    for parameter in positional(cls):
        if parameter.name not in context:
            raise ConfigError(
                f"The constructor of {cls.__name__} has the parameter `{parameter.name}`, which the framework does not "
                f"supply to a {group} here; the framework supplies {', '.join(context) or 'nothing'}. Make it a "
                "keyword-only parameter, which comes from the config."
            )
        supplied.append(context[parameter.name])
    stored = _defaults(cls) | {key: value for key, value in config.items() if key != "name"}
    values = _validate(cls, _to_plain_values(cls, stored, group), group, nullable=True)
    for name, value in values.items():
        if isinstance(value, str) and is_marked_path(signature(cls)[name][0]):
            add_data_folder(value)
    for key, part in parts(cls).items():
        if values[key] is None:
            continue
        try:
            if part.many:
                values[key] = part.many(build(part.group, item, **context) for item in values[key])
            else:
                values[key] = build(part.group, values[key], **context)
        except ConfigError as error:  # the user may not know of the part, which has a default
            raise ConfigError(
                f"{group} {config['name']} cannot be built, because its part `{key}` cannot be built: {error}"
            ) from error
    try:
        plugin = cls(*supplied, **arguments(cls, values))
    except ValueError as error:
        parameters = " ".join(f"{key}={shorten(value)}" for key, value in config.items() if key != "name")
        raise ConfigError(
            f"{group} {config['name']} refuses {parameters or 'its arguments'}: {shorten(error)} (ValueError at "
            f"{_error_line(error, cls)})."
        ) from error
    if hasattr(cls, "register_buffer") and "_modules" not in vars(plugin):  # its Module part was not built
        raise ConfigError(
            f"The constructor of {cls.__name__}, the {group} {config['name']!r}, does not call that of its base class. "
            "Write `super().__init__()` as its first line."
        )
    return plugin


def _error_line(error: BaseException, cls: type) -> str:
    """Return file and line where an error was raised, in the file of `cls` if the stack trace reaches that file."""
    lines = [(frame.f_code.co_filename, line) for frame, line in walk_tb(error.__traceback__)]
    own = [place for place in lines if place[0] == inspect.getsourcefile(cls)]
    file, line = (own or lines)[-1]
    return f"{file}:{line}"


def check(model: type[BaseModel], values: Mapping[str, Any], path: str) -> dict[str, Any]:
    """Validate `values` with a pydantic model, and return them with the defaults of the model.

    Args:
        model: The pydantic model.
        values: Values by key.
        path: Name of the config in messages.

    Raises:
        ConfigError: A key is unknown or missing, or a value has the wrong type or range; the message describes the
            first fault.
    """
    try:
        checked = model.model_validate(dict(values)).model_dump()
    except ValidationError as error:
        raise _validation_error(error, path, list(model.model_fields)) from None
    _require_numbers(values, checked, path)
    return checked


def _require_numbers(written: Any, read: Any, where: str) -> None:
    """Refuse values that pydantic converts to a number but that are not meant as one: true, "1_0", " 1 ", "nan".

    Args:
        written: Value of the config before its conversion by pydantic.
        read: The value of the config after its conversion by pydantic.
        where: Dotted key of the value, for the message.

    Raises:
        ConfigError: `written` contains such a value.
    """
    if isinstance(written, Mapping) and isinstance(read, Mapping):
        for key in written.keys() & read.keys():
            _require_numbers(written[key], read[key], f"{where}.{key}" if where else str(key))
    elif isinstance(written, list | tuple) and isinstance(read, list | tuple) and len(written) == len(read):
        for number, (item, read_item) in enumerate(zip(written, read, strict=True)):
            _require_numbers(item, read_item, f"{where}[{number}]")
    elif is_number(read) and not isinstance(read, Enum) and _is_not_number(written):
        raise ConfigError(
            f"{shorten(where)} = {quote(written)}: expected a number. Write a number, such as {read}."
        )


def _is_not_number(written: Any) -> bool:
    return isinstance(written, bool) or (isinstance(written, str) and not WRITTEN.fullmatch(written))


def _validation_error(error: ValidationError, path: str, known: Sequence[str]) -> ConfigError:
    """Return an error that describes the first fault; if this is an unknown key, the message lists the keys `known`."""
    fault = error.errors()[0]
    where = shorten(".".join(filter(None, [path, *(str(item) for item in fault["loc"])])))
    # pydantic reports an unknown key of a dataclass by the second type
    if fault["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        left = path and fault["input"] is not None and "[" not in where
        return _unknown_key_error(where, str(fault["loc"][-1]), known, bool(left))
    if fault["type"] == "missing":
        return ConfigError(f"{where} is missing: {fault['msg']}. Give this setting a value.")
    hint = ""
    if fault["type"] == "literal_error":
        hint = did_you_mean(str(fault["input"]), re.findall("'([^']*)'", fault.get("ctx", {})["expected"]))
    message = fault["msg"].removeprefix("Value error, ")
    return ConfigError(f"{where} = {quote(fault['input'])}: {message}.{hint}")


def _unknown_key_error(where: str, key: str, known: Sequence[str], left: bool) -> ConfigError:
    # the key may belong to another plugin that the experiment chose; Hydra cannot delete a key whose value is null
    advice = f" If an experiment sets the key, ~{where} removes it." if left else ""
    return ConfigError(
        f"{where}: unknown key.{did_you_mean(key, known)} Known keys: {list_names(key, known) or 'none'}.{advice}"
    )


def _checked_plain_values(cls: type, values: Mapping[str, Any], path: str) -> dict[str, Any]:
    """Check `values`, add the defaults of `cls`, and return all of them as plain values.

    Raises:
        ConfigError: A key is unknown or missing, a value has the wrong type or range or cannot be stored, or reading
            the stored plain values would give other values.
    """
    plain_values = _to_plain_values(cls, _validate(cls, _defaults(cls) | dict(values), path), path)
    try:
        reread = _to_plain_values(cls, _validate(cls, plain_values, path), path)
    except ConfigError as error:
        raise ConfigError(
            f"{error} A checkpoint stores this setting as a plain value (numbers, texts, lists and dictionaries of "
            f"them), which the annotation in {cls.__name__} does not accept. Annotate the parameter with a type that "
            "also accepts this value."
        ) from None
    for key, value in plain_values.items():
        # NaN does not equal itself, so its text is compared too
        if reread[key] != value and repr(reread[key]) != repr(value):
            raise ConfigError(
                f"{shorten(f'{path}.{key}')} = {quote(value)} becomes {quote(reread[key])} when a checkpoint with this "
                f"value is read, because the annotation changes the value each time. Let the constructor of "
                f"{cls.__name__} change the value instead."
            )
    return plain_values


def _defaults(cls: type) -> dict[str, Any]:
    return {
        key: default for key, (_, default) in signature(cls).items() if default is not inspect.Parameter.empty
    }


def _validate(cls: type, values: Mapping[str, Any], path: str, *, nullable: bool = False) -> dict[str, Any]:
    """Return the value of every key of `cls`, converted to the type of its annotation.

    Args:
        cls: Class of the plugin.
        values: Values by key.
        path: Name of the config in messages.
        nullable: Accept None for any key, since a loaded model receives None for parameters that only training needs
            (`Encoder.initial`).

    Raises:
        ConfigError: A key is unknown or missing, or a value has the wrong type or range.
    """
    validated = {}
    models = _models(cls)
    for key in values:
        if key not in models:
            where = shorten(f"{path}.{key}")
            raise _unknown_key_error(
                where, str(key), list(models), values[key] is not None and "[" not in where
            )
    for key, (annotation, _) in signature(cls).items():
        if key not in values:
            raise ConfigError(
                f"{shorten(f'{path}.{key}')} is missing: Field required. Give this setting a value."
            )
        value = values[key]
        if nullable and value is None:
            validated[key] = None
            continue
        try:
            # without `extra`, a misspelt key of an inner model would be ignored silently
            read: Any = models[key].model_validate({key: value}, extra="forbid")
            # pydantic turns a value annotated as Iterable into an iterator, which can be read only once
            validated[key] = list(read.value) if isinstance(read.value, Iterator) else read.value
            _require_numbers(value, validated[key], f"{path}.{key}")
        except ValidationError as error:
            raise _validation_error(error, path, _inner_keys(annotation)) from None
    return validated


def _inner_keys(annotation: Any) -> list[str]:
    """Return the names of the fields of all models and dataclasses inside an annotation."""
    named = getattr(annotation, "model_fields", None) or getattr(annotation, "__dataclass_fields__", ())
    return [*named, *(name for inner in get_args(annotation) for name in _inner_keys(inner))]


def _to_plain_values(cls: type, values: Mapping[str, Any], path: str) -> dict[str, Any]:
    """Return the values in the form in which a checkpoint stores them.

    Raises:
        ConfigError: A value does not consist of plain values.
    """
    plain_values = {}
    for key, value in values.items():
        try:
            plain_values[key] = _to_plain(value)
        except TypeError as error:
            raise ConfigError(
                f"{shorten(f'{path}.{key}')} = {quote(value)}: {error}. Annotate the "
                f"parameter of {cls.__name__} with numbers, text, paths, enums, or lists, mappings, dataclasses or "
                "pydantic models of these, and let the constructor build other objects from them."
            ) from None
    return plain_values


@cache
def _models(cls: type) -> dict[str, type[BaseModel]]:
    """Return for each key a pydantic model with one field `value`, whose alias is the key.

    Raises:
        ConfigError: An annotation is not a type that pydantic can check.
    """
    models = {}
    config = ConfigDict(extra="forbid", arbitrary_types_allowed=True)
    for key, (annotation, _) in signature(cls).items():
        kind = Any if key in parts(cls) else annotation
        try:
            models[key] = create_model(cls.__name__, __config__=config, value=(kind, Field(alias=key)))
        except Exception as error:  # pydantic raises errors of many classes
            raise ConfigError(
                f"{cls.__name__}: the annotation of `{key}`, {shorten(annotation)}, cannot be checked: "
                f"{shorten(str(error))} Annotate the parameter with a type that pydantic can check: numbers, text, "
                "lists, dataclasses, ..."
            ) from error
    return models


_SEVERAL: tuple[Any, ...] = (list, tuple, set)
_SINGLE: tuple[Any, ...] = (bool, int, float, complex, str, bytes)


def _to_plain(value: Any) -> Any:
    """Return a copy that consists of None, numbers, text, lists, tuples, sets and dicts.

    Raises:
        TypeError: An inner value cannot be converted to one of these types; the message names its type.
    """
    if isinstance(value, Enum):
        return _to_plain(value.value)
    if isinstance(value, BaseModel):
        return _to_plain(value.model_dump(by_alias=True))
    if isinstance(value, PurePath):
        return str(value)
    if isinstance(value, date | time | timedelta | Decimal | UUID):
        return to_jsonable_python(value)
    if isinstance(value, Mapping):
        return {_to_plain(key): _to_plain(item) for key, item in value.items()}
    if isinstance(value, frozenset):
        # torch does not read a frozenset, and a list cannot be an item of a set
        return tuple(map(_to_plain, value))
    for kind in _SEVERAL:
        if isinstance(value, kind):
            return kind(map(_to_plain, value))
    for kind in _SINGLE:
        if isinstance(value, kind):
            return kind(value)
    if value is None:
        return None
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: _to_plain(getattr(value, field.name)) for field in fields(value) if field.init}
    raise TypeError(f"the value contains a {type(value).__name__}, which a checkpoint cannot store")
