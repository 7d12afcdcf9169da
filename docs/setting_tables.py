"""Text of the page of all settings, and tables of the settings of plugins, from the annotations of the code.

The page is written when the site is built (`docs/site_pages.py`); it is not committed.
"""

import dataclasses
import inspect
import re
import types
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import griffe
import yaml
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from framework.configuration.modes import MODES, UNUSED_BY_TRAINING
from framework.configuration.registry import GROUPS, group_of
from framework.configuration.settings import (
    CALLBACKS,
    BudgetSettings,
    LoggerSettings,
    OptimizerSettings,
    Settings,
    TrainerSettings,
)
from framework.configuration.signature import signature
from framework.storage.path_marks import FilePath

ROOT = Path(__file__).resolve().parent.parent
BOUNDS = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤", "multiple_of": "a multiple of"}
SIMPLE = {
    bool: "true or false",
    int: "integer",
    float: "number",
    str: "text",
    type(None): "null",
    Any: "any value",
}
INTRODUCTION = """# Settings of the command line

Every setting of a command has the form `key=value`. This page lists the settings that every experiment has, with their
types, ranges and defaults. The settings of a data set, an encoder or another plugin are on the page of the
[method](site:methods.md). `python -m framework experiment=<name> --cfg job` prints the settings of one command.

A setting that a command does not read is refused with an error message. The table at the end of the page says which
`mode` reads which settings. In the column "values", "null" means that the setting may be left empty.
"""
MEANINGS = {
    "seed": "Seed of all random numbers of the run.",
    "batch_size": "Number of samples in a batch.",
    "trainer.log_every_steps": "Number of steps between two records of the training loss.",
    "trainer.max_epochs": "Largest number of epochs.",
    "trainer.check_val_every_n_epoch": "Number of epochs between two validations; at most `max_epochs` is used.",
    "trainer.gradient_clip_val": "Largest norm of a gradient; larger ones are scaled down. null clips nothing.",
    "trainer.devices": "Number of devices of a machine, or a list of their indices.",
    "trainer.num_nodes": "Number of machines.",
    "trainer.accelerator": "Kind of device; `auto` takes a GPU if there is one.",
    "optimizer.weight_decay": "Weight decay.",
    "optimizer.schedule": "Change of the learning rate over the training.",
    "mode": "Task of the command, and its options; see below.",
    "data": "Data set; see [methods](site:methods.md).",
    "outliers": "Data set of outliers, for metrics that read one: `data@outliers=<name>`.",
    "encoder": "Encoders in their order: `encoder=[bps,mlp]`.",
    "density_head": "Density head: `density_head=mixture`.",
    "uncertainty": "Uncertainty wrappers from the innermost to the outermost: `uncertainty=[ensemble,temperature]`.",
    "objective": "Objectives that are added to the loss: `objective=[outlier_exposure]`.",
    "metric": "Metrics of the test: `metric=[nll,accuracy]`.",
    "renderer": "Renderer, for `mode=render` and `mode=check`.",
    "optimizer": "Optimiser: `optimizer=adamw`, `adam` or `sgd`; see below.",
    "trainer": "Training: `trainer=default` or `ddp`; see below.",
    "budget": "Limit of run time or error, by which the knobs of a stored model are set; see below.",
    "logger": "Where the numbers of a run go: `logger=none`, or a list such as `[mlflow,csv,tensorboard]`; see below.",
    "mode.files": "Folder or files to read.",
    "experiment_name": "Name of the run in tables; the name of the experiment by default.",
    "stored": "Set by the framework from the command; not a setting of yours.",
}


CALLBACK_NOTE = (
    "`trainer.callbacks=[weight_averaging,model_summary]` chooses callbacks, and these keys set them. See "
    "[training](site:how_to/training.md)."
)


class Setting(NamedTuple):
    """One row of a table of settings."""

    key: str
    values: str
    default: str
    meaning: str


def table(settings: list[Setting]) -> str:
    """Return a Markdown table of settings."""
    rows = ["| key | values | default | meaning |", "|---|---|---|---|"]
    rows += [f"| `{row.key}` | {row.values} | {row.default} | {row.meaning} |" for row in settings]
    return "\n".join(rows)


def settings_page() -> str:
    """Return the page of all settings that do not belong to a plugin."""
    written = yaml.safe_load((ROOT / "conf/config.yaml").read_text(encoding="utf-8"))["defaults"]
    chosen = {key: value for item in written if isinstance(item, dict) for key, value in item.items()}
    core = [
        row._replace(values="see below", default=code(chosen[row.key]))
        if row.key in ("optimizer", "trainer", "logger", "mode")
        else row
        for row in model_settings(Settings, "conf/config.yaml")
        if row.key != "stored"
    ]
    parts = [INTRODUCTION, "## All commands", table(core)]
    for title, model, file in (
        ("`optimizer`", OptimizerSettings, "conf/optimizer/adamw.yaml"),
        ("`trainer`", TrainerSettings, "conf/trainer/default.yaml"),
        ("`logger`", LoggerSettings, "conf/logger/mlflow.yaml"),
        ("`budget`", BudgetSettings, ""),
    ):
        prefix = title.strip("`")
        rows = [row for row in model_settings(model, file, f"{prefix}.") if row.key != f"{prefix}.name"]
        parts += [f"## {title}", _note(prefix), table(rows)]
        if prefix == "trainer":
            parts += ["### `trainer.callbacks`", CALLBACK_NOTE, table(_callback_settings())]
    parts += ["## Modes", "`mode=<name>` chooses what a command does.", *_modes(), _readers()]
    return "\n\n".join(part for part in parts if part) + "\n"


def _callback_settings() -> list[Setting]:
    """Return the settings of all callbacks."""
    return [
        row
        for name, model in CALLBACKS.items()
        for row in model_settings(model, "", f"trainer.callbacks.{name}.")
    ]


def _note(prefix: str) -> str:
    if prefix == "trainer":
        return (
            '"As in Lightning" means that [Lightning\'s '
            "Trainer](https://lightning.ai/docs/pytorch/stable/common/trainer.html) has a parameter of this name."
        )
    if prefix == "optimizer":
        return "The defaults are those of `optimizer=adamw`. `adam` and `sgd` have other ones (`conf/optimizer/`)."
    return ""


def _modes() -> Iterator[str]:
    for name in MODES:
        text = (ROOT / f"conf/mode/{name}.yaml").read_text(encoding="utf-8")
        yield f"### `mode={name}`"
        yield escape(" ".join(line.removeprefix("#").strip() for line in text.split("name:")[0].splitlines()))
        comments = yaml_comments(text)
        values = {key: value for key, value in yaml.safe_load(text).items() if key != "name"}
        rows = [
            f"| `mode.{key}` | {code(value) if required is None else 'must be set'} "
            f"| {in_cell(required[1] if required else comments.get(key, MEANINGS.get(f'mode.{key}', '')))} |"
            for key, value in values.items()
            for required in [re.fullmatch("<(.*)>", str(value))]
        ]
        if rows:
            yield "\n".join(["| key | default | meaning |", "|---|---|---|", *rows])


def _readers() -> str:
    rows = ["### Which mode reads which settings", "| mode | settings that it reads |\n|---|---|"]
    for name, mode in MODES.items():
        keys = ", ".join(f"`{key}`" for key in mode.reads) or "none"
        rows[1] += f"\n| `{name}` | {keys} |"
    rows.append("Every mode also reads `seed`, `threads` and `logger`.")
    return "\n\n".join(rows)


def model_settings(model: type[BaseModel], file: str, prefix: str = "") -> list[Setting]:
    """Return the settings of a pydantic model, with the defaults and comments of a config file if one is named."""
    text = (ROOT / file).read_text(encoding="utf-8") if file else "{}"
    written, comments, texts = yaml.safe_load(text), yaml_comments(text), attribute_texts(model)
    return [
        Setting(
            prefix + key,
            "names of plugins" if not prefix and key in GROUPS else field_values(field),
            "see below" if isinstance(default, BaseModel) else code(written.get(key, default)),
            in_cell(
                f"Refused: {UNUSED_BY_TRAINING[key]}."
                if prefix == "trainer." and key in UNUSED_BY_TRAINING
                else MEANINGS.get(prefix + key)
                or texts.get(key)
                or comments.get(key)
                or ("As in Lightning." if prefix == "trainer." else "")
            ),
        )
        for key, field in model.model_fields.items()
        for default in [field.get_default(call_default_factory=True)]
    ]


def plugin_settings(cls: type, written: Mapping[str, Any], meanings: Mapping[str, str]) -> list[Setting]:
    """Return the settings of a plugin.

    Args:
        cls: Class of the plugin.
        written: Values of the plugin's config file, which replace the defaults of the constructor.
        meanings: Meaning of keys; the docstrings of the class and its dataclasses say the meaning of other keys.
    """
    texts: dict[str, str] = {}
    for annotation in typing.get_type_hints(cls.__init__, include_extras=True).values():
        if isinstance(annotation, type) and dataclasses.is_dataclass(annotation):
            for base in (base for base in reversed(annotation.__mro__) if dataclasses.is_dataclass(base)):
                summary = (inspect.getdoc(base) or "").partition("\n")[0]
                texts |= dict.fromkeys(inspect.get_annotations(base), summary) | argument_texts(base)
    texts |= argument_texts(cls)
    return [
        Setting(
            key,
            values_of(annotation),
            code(written.get(key, default)),
            in_cell(meanings.get(key) or texts.get(key, "")),
        )
        for key, (annotation, default) in signature(cls).items()
    ]


def field_values(field: FieldInfo) -> str:
    """Return the values that a field of a pydantic model accepts."""
    return _with_bounds(values_of(field.annotation), field.metadata)


def values_of(annotation: Any) -> str:
    """Return the values that an annotation accepts, in words: "number > 0 and ≤ 1, or null"."""
    origin, inner = typing.get_origin(annotation), typing.get_args(annotation)
    if annotation == FilePath:
        return "path"
    if origin is Annotated:
        metadata = [
            part for item in inner[1:] for part in (item.metadata if isinstance(item, FieldInfo) else [item])
        ]
        return _with_bounds(values_of(inner[0]), metadata)
    if origin is Literal:
        return _joined([code(value) for value in inner])
    if origin in (typing.Union, types.UnionType):
        return _joined([values_of(item) for item in sorted(inner, key=lambda item: item is type(None))])
    if origin in (list, tuple, set, frozenset) or getattr(origin, "__name__", "") == "Sequence":
        return "list" if not inner else f"list of {_plural(values_of(inner[0]))}"
    if group := group_of(annotation):
        return f"a plugin of the registry [`{group}`](site:methods.md)"
    if dataclasses.is_dataclass(annotation):
        return f"mapping with {', '.join(f'`{field.name}`' for field in dataclasses.fields(annotation))}"
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "see below"
    return SIMPLE.get(annotation, "mapping" if origin is dict or annotation is dict else str(annotation))


def _with_bounds(values: str, metadata: list[Any]) -> str:
    bounds = [
        f"{sign} {_number(getattr(item, name))}"
        for item in metadata
        for name, sign in BOUNDS.items()
        if getattr(item, name, None) is not None
    ]
    return f"{values} {' and '.join(bounds)}" if bounds else values


def _number(value: float) -> str:
    return f"{value:,}" if isinstance(value, int) else f"{value:g}"


def _joined(items: list[str]) -> str:
    items = list(dict.fromkeys(items))
    separator = ", or " if any("," in item or " and " in item for item in items[:-1]) else " or "
    return f"{', '.join(items[:-1])}{separator}{items[-1]}" if len(items) > 1 else items[0]


def _plural(values: str) -> str:
    return re.sub(r"^(integer|number|text|path|list)", r"\1s", values)


def code(value: Any) -> str:
    """Return a value as it is written in a command, as inline code; "must be set" if there is no default."""
    if value is inspect.Parameter.empty or value is dataclasses.MISSING or repr(value) == "PydanticUndefined":
        return "must be set"
    if isinstance(value, str) and value.startswith("${"):
        return "see meaning"
    text = yaml.safe_dump(_plain(value), default_flow_style=True, width=10**6, allow_unicode=True).strip()
    text = re.sub(r"\n\.\.\.$", "", text).replace("|", "\\|")
    return f"`{text}`" if text not in ("''", '""') else '`""`'


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    if isinstance(value, BaseModel):
        return value.model_dump()
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [_plain(item) for item in value]
    return value if isinstance(value, bool | int | float | str | type(None)) else str(value)


def in_cell(text: str) -> str:
    """Return a text in a single line, with its bars escaped, so that it fits into a cell of a table."""
    text = re.sub(r"(?<!\\)\|", r"\\|", " ".join(text.split()))
    plain = re.match(r"[a-z]+\b(?![.=_:(\]])", text)
    return escape(text[:1].upper() + text[1:] if plain else text)


def escape(text: str) -> str:
    """Return a text in which a `<` outside of inline code is not a beginning of an HTML element."""
    return "".join(
        part if part.startswith("`") else part.replace("<", "&lt;") for part in re.split(r"(`[^`]*`)", text)
    )


def yaml_comments(text: str) -> dict[str, str]:
    """Return the comments behind the top-level keys of a YAML text; a comment may continue in the next lines."""
    comments: dict[str, str] = {}
    key = ""
    for line in text.splitlines():
        if match := re.match(r"(\w+):[^#]*(?:#\s*(.*))?$", line):
            key = match[1]
            if match[2]:
                comments[key] = match[2]
        elif key in comments and (match := re.match(r"\s+#\s*(.*)", line)):
            comments[key] += f" {match[1]}"
    return comments


def argument_texts(cls: type) -> dict[str, str]:
    """Return the meaning of the arguments and attributes that the docstring of a class describes."""
    texts: dict[str, str] = {}
    docstring = griffe.Docstring((cls.__doc__ and inspect.getdoc(cls)) or "")
    for section in docstring.parse("google", warnings=False):
        if section.kind.value in ("parameters", "attributes"):
            for item in section.value:  # griffe reads the second of two attributes as the type of the first
                names = f"{item.name} {item.annotation}" if item.name.endswith(",") else item.name
                texts |= dict.fromkeys(names.split(", "), str(item.description))
    return texts


def attribute_texts(model: type[BaseModel]) -> dict[str, str]:
    """Return the docstrings below the fields of a pydantic model."""
    source = griffe.visit(
        "settings", Path(inspect.getfile(model)), Path(inspect.getfile(model)).read_text("utf-8")
    )
    members = source[model.__name__].attributes
    texts = {name: str(member.docstring.value) for name, member in members.items() if member.docstring}
    words = {"None": "null", "True": "true", "False": "false"}  # as a command writes them
    return {
        name: re.sub(r"\b(?:None|True|False)\b", lambda word: words[word[0]], text)
        for name, text in texts.items()
    }
