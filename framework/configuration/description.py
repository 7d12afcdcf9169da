"""What a checkpoint says of its model beside the weights: enough to build it again, to feed it and to name it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from typing import Any, get_args

from framework.configuration.assembly import Resolved
from framework.configuration.paths import UNUSED, require_said, without_paths
from framework.configuration.registry import MODEL
from framework.configuration.schema import check, resolve
from framework.configuration.settings import Settings
from framework.data import Data
from framework.errors import CheckpointError, quoted, shown
from framework.storage.limits import LONGEST_NAME, MOST_DRAWN, MOST_DRAWS, MOST_INPUT, MOST_NAMES, MOST_SIDES
from framework.target import Kind, Target

MOST_REMARKS, LONGEST_REMARK = 8, 500
"""Remarks of a stored model that are read, and letters of each."""
INHERITED = ("seed", "batch_size", "samples", "experiment_name")
"""Settings that a later test of the model repeats, so that it gives the numbers of the model's own run."""


@dataclass(frozen=True)
class Description:
    """Plain values, written into every checkpoint.

    Attributes:
        config: every part with every parameter.
        target: what is predicted.
        input_shape, columns: of what the model reads, as of `Data`.
        synthetic: whether it was trained on generated data.
        method: what tables call it; "" in checkpoints of version 0.1.
        settings: of its run, those `INHERITED`; none in checkpoints of version 0.1.
        data_state: `Data.state_dict` of the data it was trained on.
        path: of the checkpoint it was read from.
        dropped: paths that the stored config names and the user has not said again, by dotted keys; in `config` they
            have their defaults.
        remarks: what the wrappers found when they were calibrated (`Uncertainty.remark`).
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
        """Of a model made of `parts` for `data`, which is prepared."""
        kept = {key: getattr(settings, key) for key in INHERITED}
        state = dict(data.state_dict())
        about = data.target, data.input_shape, data.columns, data.synthetic
        return cls(parts, *about, method, kept, state, remarks=remarks)

    def __str__(self) -> str:
        parts = [*self.config["encoder"], self.config["density_head"], *self.config["uncertainty"]]
        names = " + ".join(part["name"] for part in parts)
        unit = {
            "angle": "angles in radians",
            "real": "reals in their own unit",
            "class": "classes",
            "image": "images",
        }
        return "\n".join(
            [
                f"{self.method or names}, trained on {self.config['data']['name']}{' (synthetic)' * self.synthetic}",
                f"  reads    {'×'.join(map(str, self.input_shape))} {', '.join(self.columns)}".rstrip(),
                f"  predicts {unit[self.target.kind]}: {self.target.told}",
                f"  made of  {names}",
                f"  from     {self.path}",
                *(f"  {remark}" for remark in self.remarks),
            ]
        )

    def stored(self) -> dict[str, Any]:
        """As a checkpoint holds it."""
        return {
            "format": 1,
            "version": version("robust-visual-learning"),
            **{key: value for key, value in asdict(self).items() if key not in ("path", "dropped")},
        }

    @classmethod
    def read(
        cls, content: Mapping[str, Any], path: str, paths: Mapping[str, Any] | None = None
    ) -> "Description":
        """Out of a checkpoint's contents; the config is checked again: it can only choose among installed plugins.

        Args:
            content, path: of the checkpoint.
            paths: what the user says again of its config's paths (`framework.configuration.paths`).

        Raises:
            CheckpointError: there is none.
            ConfigError: a part of the config is unknown here, or a path of the model is not said again.
            LookupError, TypeError, ValueError: it is not whole.
        """
        stored = content.get("framework")
        if not isinstance(stored, Mapping) or stored.get("format") != 1:
            raise CheckpointError(
                f"{path} was not written by this framework (it holds no model description of format 1). "
                "Give a run folder, or a checkpoint from its checkpoints/."
            )
        target = stored_target(stored["target"])
        config, dropped = without_paths(stored["config"], paths or {}, UNUSED)
        require_said(dropped, MODEL, path)
        return cls(
            checked(config),
            target,
            stored_shape(stored["input_shape"]),
            stored_names(stored.get("columns", ()), "columns"),
            bool(stored.get("synthetic", False)),
            str(stored.get("method", "")),
            stored_settings(stored.get("settings", {}), target),
            dict(stored.get("data_state", {})),
            path,
            dropped,
            tuple(shown(remark, LONGEST_REMARK) for remark in list(stored.get("remarks", ()))[:MOST_REMARKS]),
        )


def stored_shape(stored: Sequence[Any]) -> tuple[int, ...]:
    """The shape of an input; a ValueError where it is none, or of more than MOST_INPUT numbers."""
    shape = tuple(map(int, stored[: MOST_SIDES + 1]))
    if len(shape) > MOST_SIDES or min(shape, default=0) < 0 or math.prod(shape) > MOST_INPUT:
        raise ValueError(
            f"inputs of shape {quoted(list(shape))}; at most {MOST_SIDES} sides, and {MOST_INPUT} numbers in all"
        )
    return shape


def stored_names(stored: Sequence[Any], what: str) -> tuple[str, ...]:
    """Names of columns or of a target; a ValueError where they are too many, or too long."""
    if len(stored) > MOST_NAMES:
        raise ValueError(f"{len(stored)} {what}; at most {MOST_NAMES}")
    names = tuple(map(str, stored))
    if any(len(name) > LONGEST_NAME for name in names):
        raise ValueError(f"{what} of more than {LONGEST_NAME} letters")
    return names


def stored_settings(stored: Mapping[str, Any], target: Target) -> dict[str, Any]:
    """Those `INHERITED`, as the command line takes them; a ValueError where `samples` would fill any memory.

    Raises:
        ConfigError: a value is of the wrong type or range.
    """
    kept = {key: value for key, value in dict(stored).items() if key in INHERITED}
    values = check(Settings, kept, "settings")
    samples, numbers = values["samples"], math.prod(target.event_shape)
    if samples > MOST_DRAWS or samples * numbers > max(MOST_DRAWN, 1000 * numbers):
        raise ValueError(
            f"settings.samples = {samples}; at most {MOST_DRAWS}, and {MOST_DRAWN} numbers in all"
        )
    return {key: values[key] for key in kept}


def stored_target(stored: Mapping[str, Any]) -> Target:
    """What is predicted; a ValueError where that is no target."""
    kind, names = stored["kind"], stored_names(stored["names"], "names of a target")
    location, scale = (tuple(map(float, stored.get(key, ()))) for key in ("location", "scale"))
    sizes = {len(location), len(scale)}
    size = tuple(map(int, stored.get("size", ())))
    if kind not in get_args(Kind):
        raise ValueError(f"a target of kind {quoted(kind)} with the names {quoted(names)}")
    if len(size) != 2 * (kind == "image") or min(size, default=1) < 1:
        raise ValueError(f"a target of kind {kind!r} and of size {quoted(size)}")
    if math.prod(size) * len(names) > MOST_INPUT:
        raise ValueError(
            f"a target of size {quoted(size)} and {len(names)} numbers; at most {MOST_INPUT} in all"
        )
    if (
        sizes not in ({0}, {len(names)})
        or not all(map(math.isfinite, location + scale))
        or min(scale, default=1) <= 0
    ):
        raise ValueError(
            "a target's location and scale are no finite numbers of which the scales are above 0"
        )
    return Target(kind, names, location, scale, size)


def checked(config: Mapping[str, Any]) -> Resolved:
    """A stored config, checked again: a checkpoint can only choose among installed plugins and valid values.

    What a model predicts without (its data, metrics and objectives) is checked where it is used: the packages may be
    missing where the model is deployed.
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
