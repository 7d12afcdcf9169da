"""Contract tests of any installed plugin by its name: every check of every row yields one finding."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from framework.configuration.registry import load
from framework.configuration.schema import build, resolve
from framework.errors import ConfigError, UserError
from framework.target import Target
from framework.testing.finding import Finding
from framework.testing.rows import (
    NEEDS_ROWS,
    DataRow,
    EncoderRow,
    HeadRow,
    MetricRow,
    ObjectiveRow,
    RendererRow,
    WrapperRow,
)

Row = DataRow | HeadRow | EncoderRow | MetricRow | ObjectiveRow | RendererRow | WrapperRow
TARGETS = (
    Target("angle", ("azimuth",)),
    Target("angle", ("azimuth", "elevation", "tilt")),
    Target("real", ("height",)),
    Target("real", ("x", "y")),
    Target("class", ("first", "second", "third")),
)
"""Targets with which a plugin without rows is checked, as far as it accepts them."""
ROW_OF = {
    "data": DataRow,
    "density_head": HeadRow,
    "encoder": EncoderRow,
    "uncertainty": WrapperRow,
    "metric": MetricRow,
    "objective": ObjectiveRow,
    "renderer": RendererRow,
}
"""Registry → class of the rows of its plugins."""
SHAPES = ((3, 64, 64), (1, 96, 80), (16,))
"""Input shapes with which an encoder without rows is checked; it may refuse some of them with a ConfigError."""


@dataclass(frozen=True)
class Contract:
    """Contract rows of one plugin, with the checks of its registry.

    Attributes:
        group, name: Registry and name of the plugin.
        rows: Rows with which the plugin is checked.
    """

    group: str
    name: str
    rows: tuple[Row, ...]

    def findings(self, row: Row) -> Iterator[Finding]:
        """Yield the finding of each check of the plugin with the parameters of `row`."""
        yield from _examine_function(self.group)(self.name, row)


def contract(group: str, name: str, config: Mapping[str, Any] | None = None) -> Contract:
    """Return the contract rows of the plugin `name`; if no row has the configuration `config`, a row for it is added.

    No row is added if `config` is None, or if it equals the configuration of a shipped row or the defaults. If the
    plugin ships rows, the added row is a copy of one of them with the parameters of `config`. A row whose nested
    plugins have the same names as in `config` is copied; if there is none, the first row whose target the
    configured plugin accepts is copied. The copy keeps the target and the list of properties that are not tested,
    but not the reference cases. If the plugin ships no rows, rows are made for the default targets or input shapes.
    Data sets use `configured_row`.

    Args:
        group: Name of the registry.
        name: Name of the plugin.
        config: Parameters of the plugin.

    Raises:
        ConfigError: The plugin does not exist, its registry has no contract, a parameter is invalid, or the configured
            plugin accepts the target of no row.
    """
    _examine_function(group)
    shipped = _shipped(group, name)
    if config is None:
        return Contract(group, name, shipped or _defaults(group, name, {}, "defaults"))
    chosen = resolve(group, {"name": name, **config})
    plain = {key: value for key, value in chosen.items() if key != "name"}
    if not shipped:
        return Contract(group, name, _defaults(group, name, plain, "as configured"))
    known = [{}, *(row.config for row in shipped)]
    if chosen in [resolve(group, {"name": name, **row}) for row in known]:
        return Contract(group, name, shipped)
    if isinstance(shipped[0], DataRow):
        from framework.testing.data_folders import configured_row

        defaults = resolve(group, {"name": name})
        further = configured_row(
            shipped[0], {key: plain[key] for key in plain if plain[key] != defaults[key]}
        )
        return Contract(group, name, (further, *shipped))
    further = replace(_nearest(group, chosen, shipped), name="as configured", config=plain)
    if isinstance(further, HeadRow):
        further = replace(further, cases=None)
    return Contract(group, name, (further, *shipped))


def _nearest(group: str, chosen: Mapping[str, Any], shipped: tuple[Row, ...]) -> Row:
    """Return the shipped row that is closest to the configuration `chosen`.

    This is a row whose nested plugins have the same names as in `chosen` or, if there is none, the first row whose
    target the plugin accepts with the configuration `chosen`.
    """

    def same_parts(row: Row) -> bool:
        resolved = resolve(group, {"name": chosen["name"], **row.config})
        return [part_name(resolved[key]) for key in chosen] == [part_name(value) for value in chosen.values()]

    def part_name(value: Any) -> Any:
        return value.get("name") if isinstance(value, Mapping) else None

    refused: list[ConfigError] = []
    for row in sorted(shipped, key=same_parts, reverse=True):
        try:
            if target := getattr(row, "target", None):
                _try_target(group, chosen, target)
            return row
        except ConfigError as error:
            refused.append(error)
    raise refused[0]


def _shipped(group: str, name: str) -> tuple[Row, ...]:
    """Return the rows of a plugin from its `rows.py`, which is beside the module of its class or in a folder above.

    A family of plugins keeps its rows in its folder, `plugins/<group>/<family>`. The search ends at the folder that is
    named like the registry, or at the top of a third-party package without such a folder.
    """
    package = load(group, name).__module__.rpartition(".")[0]
    while package:
        if find_spec(f"{package}.rows") is not None:
            rows = import_module(f"{package}.rows").ROWS.get(name, ())
            matching = tuple(row for row in rows if isinstance(row, ROW_OF[group]))
            if matching:
                return matching
        package = package.rpartition(".")[0]
        if package.rpartition(".")[2] == group:
            break
    return ()


def _defaults(group: str, name: str, config: Mapping[str, Any], label: str) -> tuple[Row, ...]:
    """Return rows with the parameters `config`: one for each of TARGETS or SHAPES that the plugin accepts.

    For data sets and renderers, which have neither, it is a single row. `label` describes the configuration in the
    names of the rows.
    """
    resolved = resolve(group, {"name": name, **config})
    if group == "data":
        return (DataRow(label, config, leave_out=NEEDS_ROWS),)
    if group == "renderer":
        return (RendererRow(label, config),)
    accepted: list[Row] = []
    refused: list[str] = []
    for option in SHAPES if group == "encoder" else TARGETS:
        try:
            if isinstance(option, Target):
                _try_target(group, resolved, option)
                row = ROW_OF[group]
                accepted.append(row(f"{label}, {len(option.names)} of kind {option.kind}", option, config))
            else:
                build(group, resolved, input_shape=option)
                accepted.append(EncoderRow(f"{label}, {' × '.join(map(str, option))}", option, config))
        except ConfigError as error:
            refused.append(str(error))
    if not accepted:
        raise ConfigError(
            f"The {group} {name!r} has no rows.py and cannot be checked, because it accepts none of the "
            f"{'input shapes' if group == 'encoder' else 'targets'} that mode=check tries for such plugins: "
            f"{' '.join(dict.fromkeys(refused))} Write a rows.py for the plugin, as framework.testing.rows describes."
        )
    return tuple(accepted)


def _try_target(group: str, resolved: Mapping[str, Any], target: Target) -> None:
    """Build the plugin for a target; a wrapper is also calibrated around a model of that target.

    Raises:
        ConfigError: The plugin does not accept the target.
    """
    if group == "uncertainty":
        import torch

        from framework.testing.head_subject import values
        from framework.testing.plain import Plain, inputs

        wrapper = build(group, resolved, model=lambda: Plain(target), target=target)
        batch = {"input": inputs(8), "target": values(target, (8,)), "index": torch.arange(8)}
        try:  # some wrappers refuse a density only when they get it, such as a power without a known normaliser
            wrapper.eval().calibrate([batch])
            wrapper(batch["input"])
        except UserError as error:
            raise ConfigError(str(error)) from error
    elif group == "objective":
        build(group, resolved)
    else:
        build(group, resolved, target=target)


def _examine_function(group: str) -> Callable[[str, Any], Iterator[Finding]]:
    if group not in CONTRACTS:
        raise ConfigError(
            f"The registry {group!r} has no contract; those with one are {', '.join(CONTRACTS)}."
        )
    return CONTRACTS[group]


def _examine_data(name: str, row: DataRow) -> Iterator[Finding]:
    from framework.testing.data import examine_data

    yield from examine_data(row, lambda config: build("data", resolve("data", {"name": name, **config})))


def _examine_head(name: str, row: HeadRow) -> Iterator[Finding]:
    from framework.testing.densities import examine_densities
    from framework.testing.head_subject import HeadSubject, fit_if_needed
    from framework.testing.heads import examine_head

    config = resolve("density_head", {"name": name, **row.config})

    def build_for(target: Target) -> Any:
        return fit_if_needed(build("density_head", config, target=target), target)

    _require_density(build_for(row.target))
    subject = HeadSubject(row, lambda: build_for(row.target), build_for=build_for)
    yield from examine_head(subject)
    yield from examine_densities(subject)


def _require_density(head: Any) -> None:
    """Require what every check of a density head needs: a number of raw parameters, and a density for them.

    Raises:
        ConfigError: The head has no `size`, or `forward` returns something else than a density.
    """
    import torch
    from torch.distributions import Distribution

    kind = type(head).__name__
    size = getattr(head, "size", None)
    if not isinstance(size, int) or size < 1:
        raise ConfigError(
            f"The constructor of {kind} leaves `size` at {size!r}, but it is the number of raw parameters per sample, "
            "at least 1. Set `self.size`."
        )
    try:
        density = head.eval()(torch.zeros(2, *head.raw_shape))
    except Exception:  # the checks report this error, with its line
        return
    if not isinstance(density, Distribution):
        raise ConfigError(
            f"`forward` of {kind} returns an object of type {type(density).__name__}, but a density, which is a "
            "torch.distributions.Distribution, is required. Return one."
        )


def _examine_encoder(name: str, row: EncoderRow) -> Iterator[Finding]:
    from framework.testing.encoders import examine_encoder

    config = resolve("encoder", {"name": name, **row.config})
    yield from examine_encoder(
        row, lambda shape: build("encoder", config, input_shape=shape, input_columns=row.columns)
    )


def _examine_metric(name: str, row: MetricRow) -> Iterator[Finding]:
    from framework.testing.metrics import examine_metric

    config = resolve("metric", {"name": name, **row.config})
    yield from examine_metric(row, lambda: build("metric", config, target=row.target))


def _examine_wrapper(name: str, row: WrapperRow) -> Iterator[Finding]:
    from framework.model import Predictor
    from framework.testing.plain import Plain
    from framework.testing.wrappers import examine_wrapper

    def wrap(config: Mapping[str, Any], model: Callable[[], Predictor], target: Target) -> Any:
        resolved = resolve("uncertainty", {"name": name, **config})
        return build("uncertainty", resolved, model=model, target=target)

    same_as_model = row.identity
    identity = (
        None
        if same_as_model is None
        else lambda model: wrap({**row.config, **same_as_model}, model, row.target)
    )
    yield from examine_wrapper(row, lambda target: wrap(row.config, lambda: Plain(target), target), identity)


def _examine_objective(name: str, row: ObjectiveRow) -> Iterator[Finding]:
    from framework.testing.objectives import examine_objective

    def build_weighted(factor: float) -> Any:
        chosen = resolve("objective", {"name": name, **row.config})
        return build("objective", resolve("objective", {**chosen, "weight": factor * chosen["weight"]}))

    yield from examine_objective(row, build_weighted)


def _examine_renderer(name: str, row: RendererRow) -> Iterator[Finding]:
    from framework.testing.renderers import examine_renderer

    config = resolve("renderer", {"name": name, **row.config})
    yield from examine_renderer(row, lambda: build("renderer", config))


CONTRACTS: dict[str, Callable[[str, Any], Iterator[Finding]]] = {
    "data": _examine_data,
    "density_head": _examine_head,
    "encoder": _examine_encoder,
    "uncertainty": _examine_wrapper,
    "metric": _examine_metric,
    "objective": _examine_objective,
    "renderer": _examine_renderer,
}
"""Registry → function that checks a plugin, given its name and a row, and yields the findings."""
