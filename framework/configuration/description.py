"""Description of a model in a checkpoint, which suffices to build the model, to prepare its inputs and to name it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from typing import Any, get_args

from framework.configuration.assembly import Resolved
from framework.configuration.paths import UNUSED, remove_paths, require_paths
from framework.configuration.registry import MODEL
from framework.configuration.schema import check, resolve
from framework.configuration.settings import Settings
from framework.data import Data
from framework.errors import CheckpointError, quote, shorten
from framework.storage.limits import LONGEST_NAME, MOST_DRAWN, MOST_DRAWS, MOST_INPUT, MOST_NAMES, MOST_SIDES
from framework.storage.old_versions import complete_description
from framework.target import Kind, Target

MOST_REMARKS, LONGEST_REMARK = 8, 500
"""Largest number of remarks (`Description.remarks`) that are read from a checkpoint, and of characters of a remark."""
INHERITED = ("seed", "batch_size", "samples", "experiment_name")
"""Settings that a later test takes over from the run that trained the model, so that both give the same numbers."""


@dataclass(frozen=True)
class Description:
    """Description of a model in plain values, which every checkpoint contains.

    Attributes:
        config: Configs of all parts with every parameter.
        target: Target that the model predicts.
        input_shape: Shape of one input, as in `Data`.
        columns: Names of the input columns, as in `Data`.
        synthetic: Whether the model was trained on generated data.
        method: Name of the model in tables; "" for a checkpoint of version 0.1, which stores no name.
        settings: Values of the settings `INHERITED` in the run that trained the model; see
            `framework.storage.old_versions` for checkpoints that store none.
        data_state: `Data.state_dict` of the training data.
        path: Path of the checkpoint from which the description was read.
        dropped: Paths in the stored config that the user has not repeated, by dotted keys; in `config` these keys have
            their defaults.
        remarks: Sentences for the user: the remarks of wrappers and heads (`Uncertainty.remark`, `Fitted.remark`) and,
            after a search for a budget, the chosen setting of the knobs.
    """

    config: Resolved
    target: Target
    input_shape: tuple[int, ...]
    columns: tuple[str, ...]
    synthetic: bool
    method: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    data_state: Mapping[str, Any] = field(default_factory=dict)
    path: str = ""
    dropped: Mapping[str, Any] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()

    @classmethod
    def of(
        cls, parts: Resolved, data: Data, method: str, settings: Settings, remarks: tuple[str, ...] = ()
    ) -> "Description":
        """Return the description of a model that consists of `parts` and is trained on `data`, which are prepared."""
        inherited = {key: getattr(settings, key) for key in INHERITED}
        state = dict(data.state_dict())
        about = data.target, data.input_shape, data.columns, data.synthetic
        return cls(parts, *about, method, inherited, state, remarks=remarks)

    def __str__(self) -> str:
        parts = [*self.config["encoder"], self.config["density_head"], *self.config["uncertainty"]]
        names = " + ".join(part["name"] for part in parts)
        unit = {
            "angle": "angles in radians",
            "real": "real numbers in their own unit",
            "class": "classes",
            "image": "images",
        }
        columns = f": {', '.join(self.columns)}" if self.columns else ""
        return "\n".join(
            [
                f"{self.method or names}, trained on {self.config['data']['name']}{' (synthetic)' * self.synthetic}",
                f"  reads    inputs of shape {'×'.join(map(str, self.input_shape))}{columns}",
                f"  predicts {unit[self.target.kind]}: {self.target.listed_names}",
                f"  made of  {names}",
                f"  from     {self.path}",
                *(f"  {remark}" for remark in self.remarks),
            ]
        )

    def stored(self) -> dict[str, Any]:
        """Return the description as the plain values that a checkpoint stores."""
        return {
            "format": 1,
            "version": version("robust-visual-learning"),
            **{key: value for key, value in asdict(self).items() if key not in ("path", "dropped")},
        }

    @classmethod
    def read(
        cls, content: Mapping[str, Any], path: str, paths: Mapping[str, Any] | None = None
    ) -> "Description":
        """Return the description in a checkpoint after checking that its config chooses installed plugins only.

        Args:
            content: Contents of the checkpoint.
            path: Path of the checkpoint.
            paths: Paths of the stored config that the user repeats (`framework.configuration.paths`).

        Raises:
            CheckpointError: The checkpoint contains no description.
            ConfigError: A plugin of the config is not installed, or the user does not repeat a path of the model.
            LookupError, TypeError, ValueError: The description is incomplete.
        """
        stored = content.get("framework")
        if not isinstance(stored, Mapping) or stored.get("format") != 1:
            raise CheckpointError(
                f"{path} was not written by this framework: it contains no model description of format 1. "
                "Give a run folder, or a checkpoint from the folder checkpoints/ of a run."
            )
        stored = complete_description(stored)
        target = stored_target(stored["target"])
        config, dropped = remove_paths(stored["config"], paths or {}, UNUSED)
        require_paths(dropped, MODEL, path)
        return cls(
            check_config(config),
            target,
            stored_shape(stored["input_shape"]),
            stored_names(stored["columns"], "columns"),
            bool(stored["synthetic"]),
            str(stored["method"]),
            stored_settings(stored["settings"], target),
            dict(stored["data_state"]),
            path,
            dropped,
            tuple(shorten(remark, LONGEST_REMARK) for remark in list(stored["remarks"])[:MOST_REMARKS]),
        )


def stored_shape(stored: Sequence[Any]) -> tuple[int, ...]:
    """Return the stored shape of an input.

    Raises:
        ValueError: The value is not a shape, or has more than MOST_SIDES dimensions or MOST_INPUT elements.
    """
    shape = tuple(map(int, stored[: MOST_SIDES + 1]))
    if len(shape) > MOST_SIDES or min(shape, default=0) < 0 or math.prod(shape) > MOST_INPUT:
        raise ValueError(
            f"the stored model reads inputs of shape {quote(list(shape))}, but at most {MOST_SIDES} dimensions and "
            f"{MOST_INPUT} numbers, and no negative sizes, are allowed"
        )
    return shape


def stored_names(stored: Sequence[Any], description: str) -> tuple[str, ...]:
    """Return the stored names of columns or of a target; `description` is the term for the names in messages.

    Raises:
        ValueError: There are too many names, or one is too long.
    """
    if len(stored) > MOST_NAMES:
        raise ValueError(
            f"the stored model has {len(stored)} {description}, but at most {MOST_NAMES} are allowed"
        )
    names = tuple(map(str, stored))
    if any(len(name) > LONGEST_NAME for name in names):
        raise ValueError(
            f"the stored model has {description} of more than {LONGEST_NAME} characters, which is not allowed"
        )
    return names


def stored_settings(stored: Mapping[str, Any], target: Target) -> dict[str, Any]:
    """Return the stored settings that are in `INHERITED`, checked as on the command line.

    Raises:
        ConfigError: A value has the wrong type or range.
        ValueError: `samples` is so large that the samples would fill the memory.
    """
    inherited = {key: value for key, value in dict(stored).items() if key in INHERITED}
    values = check(Settings, inherited, "settings")
    samples, numbers = values["samples"], math.prod(target.event_shape)
    if samples > MOST_DRAWS or samples * numbers > max(MOST_DRAWN, 1000 * numbers):
        raise ValueError(
            f"the stored model has settings.samples = {samples}, but at most {MOST_DRAWS} samples and {MOST_DRAWN} "
            "numbers in all are allowed"
        )
    return {key: values[key] for key in inherited}


def stored_target(stored: Mapping[str, Any]) -> Target:
    """Return the stored target.

    Raises:
        ValueError: The stored values do not form a target.
    """
    kind, names = stored["kind"], stored_names(stored["names"], "names of a target")
    location, scale = (tuple(map(float, stored.get(key, ()))) for key in ("location", "scale"))
    sizes = {len(location), len(scale)}
    size = tuple(map(int, stored.get("size", ())))
    if kind not in get_args(Kind):
        raise ValueError(
            f"the stored target has the kind {quote(kind)}; expected one of the kinds {', '.join(get_args(Kind))}"
        )
    if len(size) != 2 * (kind == "image") or min(size, default=1) < 1:
        raise ValueError(
            f"the stored target of kind {kind!r} has the size {quote(size)}; expected a height and a width for an "
            "image, and no size for another kind"
        )
    if math.prod(size) * len(names) > MOST_INPUT:
        raise ValueError(
            f"the stored target has the size {quote(size)} and {len(names)} numbers for each pixel, but at most "
            f"{MOST_INPUT} numbers in all are allowed"
        )
    if (
        sizes not in ({0}, {len(names)})
        or not all(map(math.isfinite, location + scale))
        or min(scale, default=1) <= 0
    ):
        raise ValueError(
            "the stored location and scale of the target are not finite, have a scale that is not above 0, or do "
            "not have one number for each name"
        )
    return Target(kind, names, location, scale, size)


def check_config(config: Mapping[str, Any]) -> Resolved:
    """Return a stored config after checking that it chooses only installed plugins and valid values.

    Data, metrics and objectives, without which the model can predict, are checked only where they are used, because
    their packages may be missing on the machine where the model is deployed.
    """
    resolved: Resolved = {}
    for group, part in config.items():
        if group in ("metric", "objective"):
            resolved[group] = [dict(item) for item in part]
        elif isinstance(part, list):
            resolved[group] = [resolve(group, item, f"{group}[{i}]") for i, item in enumerate(part)]
        elif group in ("encoder", "density_head", "uncertainty"):
            resolved[group] = resolve(group, part)
        else:
            resolved[group] = None if part is None else dict(part)
    return resolved
