"""From a plugin's constructor signature to a checked config, and from a checked config to the built plugin.

The rule of constructors: parameters before `*` come from the framework and are filled by name (`target`,
`input_shape`, `model`); keyword-only parameters come from the config, are checked against their annotations
and have their defaults there. A keyword-only parameter annotated with an abstract base is a *part*: the config
names it, it is built from that base's registry and arrives ready. One annotated with a dataclass of keyword-only
fields is a *value*: its fields stand in the config beside the other keys, and it arrives made of them; the
parameter's own default, where it has one, gives the keys their defaults.

A checked config holds plain values only, since checkpoints keep it: a path is its text, an enum its value, a pydantic
model or a dataclass a mapping of its fields. `build` reads them by the annotations again, so that each arrives as what
its parameter is annotated with.
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
from framework.errors import ConfigError, did_you_mean, listed, quoted, shown
from framework.storage.plain_values import is_number

WRITTEN = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)
"""Text that is taken for a number, as of a variable of the environment."""


def forbid_targets(config: Any, path: str = "") -> None:
    """Refuse `_target_` anywhere: a config holds names and values, never code.

    Raises:
        ConfigError: a `_target_` key stands somewhere in `config`.
    """
    if isinstance(config, Mapping):
        for key, value in config.items():
            here = f"{path}.{key}" if path else str(key)
            if key == "_target_":
                raise ConfigError(
                    f"{shown(here)} = {quoted(value)}: `_target_` is refused, since a config must not be able "
                    "to run code. Write `name: <installed plugin>` instead (`mode=plugins` lists them)."
                )
            forbid_targets(value, here)
    elif isinstance(config, list | tuple):
        for index, value in enumerate(config):
            forbid_targets(value, f"{path}[{index}]")


def resolve(group: str, config: Any, path: str | None = None) -> dict[str, Any]:
    """The config of one plugin with every default filled in, checked against its constructor.

    Args:
        group: registry, e.g. "density_head".
        config: a plugin's name, or a mapping with `name` and parameters.
        path: how the config is called in messages; the group's name by default.

    Raises:
        ConfigError: unknown name, unknown key, or a value of wrong type or range.
    """
    path = path or group
    if isinstance(config, str):
        config = {"name": config}
    if not isinstance(config, Mapping):
        raise ConfigError(
            f"{shown(path)} = {quoted(config)}: wanted the name of a {group}, or a mapping with `name` and "
            "its parameters."
        )
    forbid_targets(config, path)
    values = dict(config)
    name = values.pop("name", None)
    if not isinstance(name, str):
        raise ConfigError(
            f"{shown(path)}.name is missing: write the name of a {group} (`mode=plugins` lists them)."
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
    """Construct the plugin of a resolved config; parts first, `context` by parameter name.

    Raises:
        ConfigError: the constructor asks the framework for something it does not have here, or refuses what it is given
            by a ValueError.
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
        except ConfigError as error:  # which the user may never have named
            raise ConfigError(f"{group} {config['name']}, of which {key} is a part: {error}") from error
    try:
        return cls(*given, **arguments(cls, values))
    except ValueError as error:
        said = " ".join(f"{key}={shown(value)}" for key, value in config.items() if key != "name")
        raise ConfigError(
            f"{group} {config['name']} does not take {said or 'what it was given'}: {shown(error)} (ValueError at "
            f"{_place(error, cls)})."
        ) from error


def _place(error: BaseException, cls: type) -> str:
    """Where it was raised: the last line of the plugin's own file, if that was reached."""
    lines = [(frame.f_code.co_filename, line) for frame, line in walk_tb(error.__traceback__)]
    own = [place for place in lines if place[0] == inspect.getsourcefile(cls)]
    file, line = (own or lines)[-1]
    return f"{file}:{line}"


def check(model: type[BaseModel], values: Mapping[str, Any], path: str) -> dict[str, Any]:
    """`values` validated and completed by a pydantic model; the first fault becomes a sentence.

    Raises:
        ConfigError: unknown key, missing key, or a value of wrong type or range.
    """
    try:
        found = model.model_validate(dict(values)).model_dump()
    except ValidationError as error:
        raise _refusal(error, path, list(model.model_fields)) from None
    _require_numbers(values, found, path)
    return found


def _require_numbers(given: Any, read: Any, where: str) -> None:
    """Refuse what pydantic takes for a number and nobody writes for one: true, "1_0", " 1 ", "nan".

    Raises:
        ConfigError: such a value stands in `given` where a number was `read`.
    """
    if isinstance(given, Mapping) and isinstance(read, Mapping):
        for key in given.keys() & read.keys():
            _require_numbers(given[key], read[key], f"{where}.{key}" if where else str(key))
    elif isinstance(given, list | tuple) and isinstance(read, list | tuple) and len(given) == len(read):
        for number, (one, other) in enumerate(zip(given, read, strict=True)):
            _require_numbers(one, other, f"{where}[{number}]")
    elif is_number(read) and not isinstance(read, Enum) and _no_number(given):
        raise ConfigError(f"{shown(where)} = {quoted(given)}: wanted a number. Write one, such as {read}.")


def _no_number(given: Any) -> bool:
    return isinstance(given, bool) or (isinstance(given, str) and not WRITTEN.fullmatch(given))


def _refusal(error: ValidationError, path: str, known: Sequence[str]) -> ConfigError:
    """The first fault as a sentence; `known` are the keys where one is unknown."""
    fault = error.errors()[0]
    where = shown(".".join(filter(None, [path, *(str(item) for item in fault["loc"])])))
    if fault["type"] in ("extra_forbidden", "unexpected_keyword_argument"):  # the latter of a dataclass
        left = path and fault["input"] is not None and "[" not in where
        return _unknown(where, str(fault["loc"][-1]), known, bool(left))
    if fault["type"] == "missing":
        return ConfigError(f"{where} is missing: {fault['msg']}. Give it a value.")
    hint = ""
    if fault["type"] == "literal_error":
        hint = did_you_mean(str(fault["input"]), re.findall("'([^']*)'", fault.get("ctx", {})["expected"]))
    message = fault["msg"].removeprefix("Value error, ")
    return ConfigError(f"{where} = {quoted(fault['input'])}: {message}.{hint}")


def _unknown(where: str, key: str, known: Sequence[str], left: bool) -> ConfigError:
    # of another plugin that an experiment had chosen; Hydra deletes no key whose value is null
    advice = f" ~{where} leaves out what an experiment sets." if left else ""
    return ConfigError(
        f"{where}: unknown key.{did_you_mean(key, known)} Known keys: {listed(key, known) or 'none'}.{advice}"
    )


def _stored(cls: type, values: Mapping[str, Any], path: str) -> dict[str, Any]:
    """`values` checked and completed by the defaults of `cls`, as plain values that give the same when read again.

    Raises:
        ConfigError: unknown key, missing key, a value of wrong type or range, or one that cannot be kept.
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
        # NaN equals nothing
        if again[key] != value and repr(again[key]) != repr(value):
            raise ConfigError(
                f"{shown(f'{path}.{key}')} = {quoted(value)} becomes {quoted(again[key])} when a checkpoint that "
                f"keeps it is read: the annotation changes what it is given. Let {cls.__name__} compute that in its "
                "constructor."
            )
    return found


def _defaults(cls: type) -> dict[str, Any]:
    return {key: own for key, (_, own) in signature(cls).items() if own is not inspect.Parameter.empty}


def _validated(cls: type, values: Mapping[str, Any], path: str, *, nullable: bool = False) -> dict[str, Any]:
    """The value of every key of `cls` as its annotation reads it.

    `nullable`: None is taken as it is, since a loaded model is given None for what only training needs
    (`Encoder.initial`).

    Raises:
        ConfigError: unknown key, missing key, or a value of wrong type or range.
    """
    found = {}
    models = _models(cls)
    for key in values:
        if key not in models:
            where = shown(f"{path}.{key}")
            raise _unknown(where, str(key), list(models), values[key] is not None and "[" not in where)
    for key, (annotation, _) in signature(cls).items():
        if key not in values:
            raise ConfigError(f"{shown(f'{path}.{key}')} is missing: Field required. Give it a value.")
        value = values[key]
        if nullable and value is None:
            found[key] = None
            continue
        try:
            # without `extra` a misspelt key of an inner model would be left out in silence
            read: Any = models[key].model_validate({key: value}, extra="forbid")
            # pydantic reads what is annotated as an Iterable lazily, and once
            found[key] = list(read.value) if isinstance(read.value, Iterator) else read.value
            _require_numbers(value, found[key], f"{path}.{key}")
        except ValidationError as error:
            raise _refusal(error, path, _inner_keys(annotation)) from None
    return found


def _inner_keys(annotation: Any) -> list[str]:
    """Fields of the models and dataclasses that stand in an annotation."""
    named = getattr(annotation, "model_fields", None) or getattr(annotation, "__dataclass_fields__", ())
    return [*named, *(name for inner in get_args(annotation) for name in _inner_keys(inner))]


def _kept(cls: type, values: Mapping[str, Any], path: str) -> dict[str, Any]:
    """The values as a checkpoint keeps them.

    Raises:
        ConfigError: one is not made of plain values.
    """
    found = {}
    for key, value in values.items():
        try:
            found[key] = _plain(value)
        except TypeError as error:
            raise ConfigError(
                f"{shown(f'{path}.{key}')} = {quoted(value)}: {error}, which no checkpoint keeps. Annotate the "
                f"parameter of {cls.__name__} with numbers, text, paths, enums, or lists, mappings, dataclasses or "
                "pydantic models of these, and make what it needs of them in its constructor."
            ) from None
    return found


@cache
def _models(cls: type) -> dict[str, type[BaseModel]]:
    """For each key a model whose `value` it is, whatever the key is called.

    Raises:
        ConfigError: an annotation is no type that pydantic knows how to check.
    """
    found = {}
    config = ConfigDict(extra="forbid", arbitrary_types_allowed=True)
    for key, (annotation, _) in signature(cls).items():
        kind = Any if key in parts(cls) else annotation
        try:
            found[key] = create_model(cls.__name__, __config__=config, value=(kind, Field(alias=key)))
        except Exception as error:  # pydantic raises a dozen kinds
            raise ConfigError(
                f"{cls.__name__}: the annotation of `{key}`, {shown(annotation)}, cannot be checked: "
                f"{shown(str(error))} Annotate it with a type: numbers, text, lists, dataclasses, ..."
            ) from error
    return found


_SEVERAL: tuple[Any, ...] = (list, tuple, set)
_SINGLE: tuple[Any, ...] = (bool, int, float, complex, str, bytes)


def _plain(value: Any) -> Any:
    """A copy made of None, numbers, text, lists, tuples, sets and dicts.

    Raises:
        TypeError: something in it is none of these, nor made of them; says what.
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
        return tuple(map(_plain, value))  # torch reads no frozenset, and a list could be no item of a set
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
