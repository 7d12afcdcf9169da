"""From a plugin's constructor signature to a checked config, and from a checked config to the built plugin.

The rule of constructors: parameters before `*` come from the framework and are filled by name (`target`,
`input_shape`, `model`); keyword-only parameters come from the config, are checked against their annotations
and have their defaults there. A keyword-only parameter annotated with an abstract base is a *part*: the config
names it, it is built from that base's registry and arrives ready. One annotated with a dataclass of keyword-only
fields is a *value*: its fields stand in the config beside the other keys, and it arrives made of them; the
parameter's own default, where it has one, gives the keys their defaults.
"""

import inspect
import re
import types
import typing
from collections.abc import Mapping
from dataclasses import is_dataclass
from functools import cache
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model

from framework.configuration.registry import group_of, load
from framework.errors import ConfigError, did_you_mean, quoted, shown


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
    checked = check(_model(cls), values, path)
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
        ConfigError: the constructor asks the framework for something it does not have here.
    """
    cls = load(group, config["name"])
    values = {key: value for key, value in config.items() if key != "name"}
    for key, part in parts(cls).items():
        if values.get(key) is None:
            continue
        try:
            if part.many:
                values[key] = [build(part.group, item, **context) for item in values[key]]
            else:
                values[key] = build(part.group, values[key], **context)
        except ConfigError as error:  # which the user may never have named
            raise ConfigError(f"{group} {config['name']}, of which {key} is a part: {error}") from error
    given = []
    for parameter in _positional(cls):
        if parameter.name not in context:
            raise ConfigError(
                f"{cls.__name__} asks the framework for `{parameter.name}`, which a {group} is not given here; "
                f"it may ask for: {', '.join(context) or 'nothing'}. Keyword-only parameters come from the config."
            )
        given.append(context[parameter.name])
    for key, kind in _values(cls).items():
        values[key] = kind(**{field: values.pop(field) for field in _signature(kind)})
    return cls(*given, **values)


def check(model: type[BaseModel], values: Mapping[str, Any], path: str) -> dict[str, Any]:
    """`values` validated and completed by a pydantic model; the first fault becomes a sentence.

    Raises:
        ConfigError: unknown key, missing key, or a value of wrong type or range.
    """
    try:
        return model.model_validate(dict(values)).model_dump()
    except ValidationError as error:
        fault = error.errors()[0]
        where = shown(".".join(filter(None, [path, *(str(item) for item in fault["loc"])])))
        known = list(model.model_fields)
        if fault["type"] == "extra_forbidden":
            key = str(fault["loc"][-1])
            # of another plugin that an experiment had chosen; Hydra deletes no key whose value is null
            left = path and fault["input"] is not None and "[" not in where
            advice = f" ~{where} leaves out what an experiment sets." if left else ""
            raise ConfigError(
                f"{where}: unknown key.{did_you_mean(key, known)} Known keys: {', '.join(known) or 'none'}.{advice}"
            ) from None
        if fault["type"] == "missing":
            raise ConfigError(f"{where} is missing: {fault['msg']}. Give it a value.") from None
        if fault["type"] == "literal_error":
            expected = re.findall("'([^']*)'", fault.get("ctx", {})["expected"])
            hint = did_you_mean(str(fault["input"]), expected)
        else:
            hint = ""
        message = fault["msg"].removeprefix("Value error, ")
        raise ConfigError(f"{where} = {quoted(fault['input'])}: {message}.{hint}") from None


class Part(typing.NamedTuple):
    """A constructor parameter that is itself a plugin (`many`: a list of them)."""

    group: str
    many: bool


@cache
def parts(cls: type) -> dict[str, Part]:
    """The keyword-only parameters of `cls` that are annotated with an abstract base."""
    found = {}
    for name, (annotation, _) in _signature(cls).items():
        candidates = typing.get_args(annotation) if _is_union(annotation) else (annotation,)
        for candidate in candidates:
            many = typing.get_origin(candidate) in (list, tuple)
            group = group_of(typing.get_args(candidate)[0] if many else candidate)
            if group is not None:
                found[name] = Part(group, many)
    return found


@cache
def _model(cls: type) -> type[BaseModel]:
    fields: dict[str, Any] = {}
    for name, (annotation, default) in _signature(cls).items():
        fields[name] = (
            Any if name in parts(cls) else annotation,
            Field() if default is inspect.Parameter.empty else default,
        )
    return create_model(
        cls.__name__,
        __config__=ConfigDict(extra="forbid", arbitrary_types_allowed=True, protected_namespaces=()),
        **fields,
    )


def _signature(cls: type) -> dict[str, tuple[Any, Any]]:
    """Annotation and default of every key that `cls` has in the config."""
    found = {}
    for name, (annotation, default) in _keywords(cls).items():
        if name in _values(cls):
            fields = _signature(annotation)
            found |= {key: (kind, getattr(default, key, own)) for key, (kind, own) in fields.items()}
        else:
            found[name] = annotation, default
    return found


def _values(cls: type) -> dict[str, type]:
    keywords = _keywords(cls).items()
    return {name: kind for name, (kind, _) in keywords if isinstance(kind, type) and is_dataclass(kind)}


def _keywords(cls: type) -> dict[str, tuple[Any, Any]]:
    """Annotation and default of every keyword-only parameter."""
    hints = typing.get_type_hints(cls.__init__, include_extras=True)
    return {
        parameter.name: (hints.get(parameter.name, Any), parameter.default)
        for parameter in inspect.signature(cls.__init__).parameters.values()
        if parameter.kind is parameter.KEYWORD_ONLY
    }


def _positional(cls: type) -> list[inspect.Parameter]:
    parameters = list(inspect.signature(cls.__init__).parameters.values())[1:]
    return [parameter for parameter in parameters if parameter.kind is parameter.POSITIONAL_OR_KEYWORD]


def _is_union(annotation: object) -> bool:
    return typing.get_origin(annotation) in (typing.Union, types.UnionType)
