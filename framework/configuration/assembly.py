"""Building of the parts of the density pipeline from a config: data, predictor, objectives and metrics."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from framework.configuration.citations import bibtex_of
from framework.configuration.registry import GROUPS, installed, load
from framework.configuration.schema import build, parts, resolve
from framework.configuration.settings import Settings
from framework.data import Data
from framework.density_head import DensityHead, Fitted
from framework.encoder import Encoder
from framework.errors import ConfigError, quote
from framework.model import FrozenFrontEnd, Model, Predictor
from framework.objective import Objective
from framework.target import Target

if TYPE_CHECKING:
    from framework.metric import Metric

Resolved = dict[str, Any]
"""Checked configs of all plugins of a run, as plain values with every parameter, by group.

The value of a group from which several plugins may be chosen is a list of configs.
"""


@dataclass
class Assembly:
    """Plugins of a training, checked and built before any data is read; `framework.runs.session` uses these objects.

    Attributes:
        parts: Resolved configs of all plugins.
        data: Data set, whose `prepare` has not been called yet.
        target: Target that the data set knows before it is prepared; None if it knows no target yet.
        head: Density head for `target`. None without a target, and if building the head draws random numbers.
            `build_predictor` then builds the head, so that its initial weights are a function of the seed.
        metrics: Metrics for `target`, without any state; None without a target.
    """

    parts: Resolved
    data: Data
    target: Target | None = None
    head: DensityHead | None = None
    metrics: "list[Metric] | None" = None

    def take_head(self, target: Target) -> DensityHead | None:
        """Return the head at the first call, if it was built for `target`; return None in all other cases."""
        head, self.head = self.head, None
        return head if target == self.target else None

    def take_metrics(self, target: Target) -> "list[Metric]":
        """Return the metrics at the first call, if they were built for `target`; return new ones in all other cases."""
        metrics, self.metrics = self.metrics, None
        return metrics if metrics is not None and target == self.target else build_metrics(self.parts, target)


def assemble(settings: Settings) -> Assembly:
    """Check every plugin of a config, and build what can be built before any data is read.

    Raises:
        ConfigError: A part of the pipeline is missing, or a plugin's name, key or value is wrong.
    """
    for group in ("data", "density_head", "encoder"):
        # a head that is fitted in one step may read the inputs without an encoder
        if not getattr(settings, group) and not (
            group == "encoder" and _is_fitted_at_once(settings.density_head)
        ):
            raise ConfigError(
                f"No {group} is chosen. Name an experiment (`experiment=...`; `--help` lists them), or choose an "
                f"installed {group}: {group}={'|'.join(installed(group))}."
                + (
                    " If you have named an encoder of your own, its yaml file must begin with the line `# @package "
                    "encoder.<name>`."
                    if group == "encoder"
                    else ""
                )
            )
    resolved: Resolved = {
        "data": resolve("data", settings.data),
        "density_head": resolve("density_head", settings.density_head),
    }
    assembly = Assembly(resolved, build_data(resolved))
    assembly.target = target = getattr(assembly.data, "target", None)
    if target is not None:  # known before data is read, so a head that cannot describe the target fails here
        generator_state = torch.default_generator.get_state()
        head: DensityHead = build("density_head", resolved["density_head"], target=target)
        if torch.equal(generator_state, torch.default_generator.get_state()):
            assembly.head = head
    for group in ("encoder", "uncertainty", "objective", "metric"):
        chosen = getattr(settings, group) or {}
        if not isinstance(chosen, Mapping):
            raise ConfigError(
                f"{group} = {quote(chosen)}: expected a list of plugins, or a mapping with one plugin for each key. "
                f"Write {group}=[<plugin>], or {group}.<key>.name=<plugin> with a key of your choice."
            )
        resolved[group] = [resolve(group, part, f"{group}.{key}") for key, part in chosen.items()]
    resolved["outliers"] = resolve("data", settings.outliers, "outliers") if settings.outliers else None
    require_outliers(resolved)
    if target is not None:
        assembly.metrics = build_metrics(resolved, target)
    return assembly


def _is_fitted_at_once(head: Any) -> bool:
    return issubclass(load("density_head", resolve("density_head", head)["name"]), Fitted)


def require_outliers(resolved: Resolved) -> None:
    """Refuse metrics that read outliers if no outliers are configured.

    Raises:
        ConfigError: A metric reads outliers and none are configured.
    """
    metric_names = metrics_reading_outliers(resolved)
    if metric_names and not resolved.get("outliers"):
        raise ConfigError(
            f"The metric {metric_names[0]} compares the test split with outliers, but no outliers are chosen. Name a "
            f"data set of outliers, e.g. `data@outliers={resolved['data']['name']} outliers.<key>=...`, or leave this "
            "metric out."
        )


def metrics_reading_outliers(resolved: Resolved) -> list[str]:
    """Return the names of the metrics that read predictions on outliers."""
    return [part["name"] for part in resolved["metric"] if "outliers" in load("metric", part["name"]).splits]


def build_outliers(resolved: Resolved, data: Data) -> Data | None:
    """Return the prepared data set of the outliers; None if no metric reads it.

    Raises:
        ConfigError: The outliers have inputs of another shape than `data`, which is already prepared.
        DataError: `Data.prepare` fails.
    """
    if not metrics_reading_outliers(resolved):
        return None
    outliers: Data = build("data", resolved["outliers"])
    outliers.prepare()
    if outliers.input_shape != data.input_shape:
        raise ConfigError(
            f"The outliers {resolved['outliers']['name']} have inputs of shape {outliers.input_shape}, but the data "
            f"{resolved['data']['name']} has inputs of shape {data.input_shape}. Set the size of one of them so that "
            "both shapes are equal."
        )
    return outliers


def build_data(resolved: Resolved) -> Data:
    """Return the data set, whose `prepare` has not been called yet."""
    return build("data", resolved["data"])


def build_predictor(
    resolved: Resolved,
    target: Target,
    input_shape: tuple[int, ...],
    seed: int,
    columns: tuple[str, ...] = (),
    head: DensityHead | None = None,
) -> Predictor:
    """Return the untrained predictor, whose initial weights are a function of `seed` and the config.

    The chain of encoders may begin with fixed ones (`Encoder.fixed`), which are placed outside the uncertainty
    wrappers. If a wrapper has several models, all of them share the fixed encoders.

    Args:
        resolved: Resolved configs of all plugins.
        target: Target that is predicted.
        input_shape: Shape of one input.
        seed: Seed of the initial weights.
        columns: Names of the input columns.
        head: Density head for `target` that is built already (`Assembly.take_head`); the first model gets it. None:
            every model gets a new head.
    """
    # the model is built on the CPU; the generators of other devices stay unchanged
    torch.default_generator.manual_seed(seed)
    parts = list(resolved["encoder"])
    fixed: list[Encoder] = []
    built_encoders: list[Encoder] = []  # the encoder that is built already is used for the first model
    built_heads = [] if head is None else [head]
    shape, names = input_shape, columns
    while parts:
        encoder: Encoder = build("encoder", parts[0], input_shape=shape, input_columns=names)
        if not encoder.fixed:
            built_encoders.append(encoder)
            break
        fixed.append(encoder)
        shape, names = encoder.output_shape, ()
        del parts[0]

    def build_encoders() -> tuple[list[Encoder], tuple[int, ...]]:
        encoders: list[Encoder] = []
        feature_shape, column_names = shape, names
        for part in parts:
            built = (
                built_encoders.pop()
                if built_encoders
                else build("encoder", part, input_shape=feature_shape, input_columns=column_names)
            )
            encoders.append(built)
            feature_shape, column_names = encoders[-1].output_shape, ()
        return encoders, feature_shape

    def build_model() -> Predictor:
        encoders, feature_shape = build_encoders()
        head: DensityHead = (
            built_heads.pop()
            if built_heads
            else build("density_head", resolved["density_head"], target=target)
        )
        return Model(encoders, head, feature_shape, [build_encoders()[0] for _ in head.backbones[1:]])

    factory: Callable[[], Predictor] = build_model
    for part in resolved["uncertainty"]:
        factory = _wrapper_factory(part, factory, target)
    return FrozenFrontEnd(fixed, factory()) if fixed else factory()


def _wrapper_factory(
    part: Mapping[str, Any], inner: Callable[[], Predictor], target: Target
) -> Callable[[], Predictor]:
    return lambda: build("uncertainty", part, model=inner, target=target)


def build_objectives(resolved: Resolved) -> Sequence[Objective]:
    """Return the objectives, which are added to the training loss; none by default."""
    return [build("objective", part) for part in resolved["objective"]]


def build_metrics(resolved: Resolved, target: Target) -> "list[Metric]":
    """Return new metrics in the order of the config."""
    return [build("metric", part, target=target) for part in resolved["metric"]]


def citations(resolved: Resolved) -> dict[str, str]:
    """Return the BibTeX of every plugin used, including plugins inside plugins, by 'group name', such as 'data moons'.

    Metrics and objectives of a stored model that are not installed are left out, since the model predicts without them.
    """
    bibtex_by_part: dict[str, str] = {}

    def visit(group: str, part: Mapping[str, Any]) -> None:
        try:
            cls = load(group, part["name"])
        except ConfigError:
            if group in ("metric", "objective"):
                return
            raise
        bibtex = bibtex_of(cls)
        if bibtex:
            bibtex_by_part[f"{group} {part['name']}"] = bibtex
        for key, inner in parts(cls).items():
            for item in _items(part.get(key)):
                visit(inner.group, item)

    for group in GROUPS:
        for part in _items(resolved.get(group)):
            visit(group, part)
    for part in _items(resolved.get("outliers")):
        visit("data", part)
    return bibtex_by_part


def _items(value: Any) -> list[Any]:
    if value is None:
        return []
    return list(value) if isinstance(value, list | tuple) else [value]
