"""Cost of decisions that follow from the predicted densities, under a cost table of the user."""

import math
from itertools import pairwise
from typing import Annotated, ClassVar

import torch
from pydantic import Field
from torch import Tensor

from framework.configuration.paths import Words
from framework.distributions.class_probabilities import require_labels
from framework.errors import ConfigError, did_you_mean
from framework.metric import Directions, Metric
from framework.prediction import Prediction
from framework.target import Target
from plugins.metric.decision_cost.functional import (
    decide,
    expected_costs,
    region_probabilities,
    regions,
)


class DecisionCost(Metric):
    """Mean cost of the action with the lowest expected cost under each density (Savage 1954; Berger 1985, §1.3).

    - `decision_cost`: mean cost of these actions under the true target, with its standard error.
    - `decision_cost_fixed`: mean cost of the best constant decision, which chooses the same action for all samples.
    - `decision_cost_oracle`: mean cost if the action that is best for the true class or region were always chosen.
    - `share_<action>`: share of samples for which the action was chosen.

    A cost may be infinite (a forbidden action) or negative (a gain). A class or region of probability 0 adds no cost;
    at any higher probability, an action whose cost for this class or region is infinite is not chosen. The first of
    several equally good actions is chosen.

    Args:
        costs: table in which row i holds the cost of each action if class or region i is true, in any unit; by default
            0 for the right class or region and 1 for every other.
        actions: names of the columns; by default the names of the classes or regions. There may be more actions than
            classes or regions, for example "ask a person".
        edges: for a real number, ascending values that divide the line into regions; the first region is below the
            first edge.
        edges_deg: for an angle, ascending angles within one turn that divide the circle, degrees; the first region
            begins counter-clockwise at the first edge, where the last region ends.
        number: name of the number of the target to which the edges apply, if the target has several.
        samples: number of draws for a density whose probabilities are not known.

    Raises:
        ConfigError: the table does not fit the target, the edges or the action names; it contains NaN; or all actions
            are forbidden for some class or region.
        UserError: densities are NaN.
        DataError: a target is not a class of the data set.
    """

    bibtex = "berger1985statistical"
    columns: ClassVar[dict[str, str]] = {
        "decision_cost": "cost",
        "decision_cost_fixed": "cost, fixed",
        "decision_cost_oracle": "cost, oracle",
    }
    better: ClassVar[Directions] = {"decision_cost": "lower"}
    costs: Tensor
    edges: Tensor
    count: Tensor
    total: Tensor
    squares: Tensor
    fixed: Tensor
    oracle: Tensor
    action_counts: Tensor

    def __init__(
        self,
        target: Target,
        *,
        costs: list[list[float]] | None = None,
        actions: list[Words] | None = None,
        edges: list[float] | None = None,
        edges_deg: list[float] | None = None,
        number: Words | None = None,
        samples: Annotated[int, Field(ge=1, le=10**6)] = 1000,
    ) -> None:
        super().__init__()
        self.kind = target.kind
        self.samples = samples
        self.index = _number_index(target, number)
        cuts = _edges(target, edges, edges_deg)
        truths = (
            list(target.names) if target.kind == "class" else _region_names(target.kind, edges, edges_deg)
        )
        table = [[float(i != j) for j in range(len(truths))] for i in range(len(truths))]
        table = table if costs is None else costs
        names = truths if actions is None and costs is None else actions
        self.actions = _check_actions(table, names, truths)
        self.register_buffer("costs", torch.tensor(table, dtype=torch.float64), persistent=False)
        self.register_buffer("edges", torch.tensor(cuts, dtype=torch.float64), persistent=False)
        zero, per_action = (
            torch.zeros((), dtype=torch.float64),
            torch.zeros(len(self.actions), dtype=torch.float64),
        )
        self.add_state("count", zero, dist_reduce_fx="sum")
        self.add_state("total", zero.clone(), dist_reduce_fx="sum")
        self.add_state("squares", zero.clone(), dist_reduce_fx="sum")
        self.add_state("oracle", zero.clone(), dist_reduce_fx="sum")
        self.add_state("fixed", per_action, dist_reduce_fx="sum")
        self.add_state("action_counts", per_action.clone(), dist_reduce_fx="sum")

    def update(self, prediction: Prediction) -> None:
        target = prediction.target
        if len(target) == 0:
            return
        if self.kind == "class":
            truth = require_labels(target, len(self.costs))
            probability = prediction.class_probabilities
        else:
            truth = regions(target[:, self.index], self.edges, around=self.kind == "angle")
            density = prediction.marginal(self.index)
            probability = region_probabilities(density, self.edges, self.samples)
        chosen = decide(expected_costs(probability, self.costs))
        paid = self.costs[truth]  # (batch, action)
        self.count += len(truth)
        cost = paid.gather(-1, chosen.unsqueeze(-1))
        self.total += cost.sum()
        self.squares += cost.square().sum()
        self.action_counts += torch.nn.functional.one_hot(chosen, len(self.actions)).double().sum(0)
        self.fixed += paid.sum(0)
        self.oracle += paid.amin(-1).sum()

    def compute(self) -> dict[str, Tensor]:
        mean = self.total / self.count
        spread = (self.squares / self.count - mean.square()).clamp(min=0)
        results = {
            "decision_cost": mean,
            "decision_cost_sem": (spread / (self.count - 1).clamp(min=0)).sqrt(),
            "decision_cost_fixed": (self.fixed / self.count).amin(),
            "decision_cost_oracle": self.oracle / self.count,
        }
        shares = self.action_counts / self.count
        return results | {
            f"share_{_key(name)}": share for name, share in zip(self.actions, shares, strict=True)
        }


def _number_index(target: Target, number: str | None) -> int:
    if target.kind == "class":
        if number is not None:
            raise ConfigError(
                f"got decision_cost.number = {number!r}, but this data set's target is one class. Remove this setting."
            )
        return 0
    if number is None and len(target.names) > 1:
        raise ConfigError(
            f"decision_cost.number is missing: the target has {len(target.names)} numbers, and edges divide one of "
            "them. "
            f"Set decision_cost.number to one of: {target.listed_names}."
        )
    if number is not None and number not in target.names:
        raise ConfigError(
            f"decision_cost.number = {number!r} is not a number of the target.{did_you_mean(number, target.names)} "
            f"The numbers are: {target.listed_names}."
        )
    return 0 if number is None else target.names.index(number)


def _edges(target: Target, edges: list[float] | None, edges_deg: list[float] | None) -> list[float]:
    """Return the edges for this kind of target, in radians for an angle; an empty list for classes.

    Raises:
        ConfigError: the edges do not suit the kind of target, are too few, not finite, not ascending, or not within one
            turn.
    """
    expected_setting = {"class": None, "real": "edges", "angle": "edges_deg"}[target.kind]
    for name, value in (("edges", edges), ("edges_deg", edges_deg)):
        if value is not None and name != expected_setting:
            raise ConfigError(
                f"got decision_cost.{name} = {value}, but targets of kind {target.kind!r} "
                f"{'need no edges' if expected_setting is None else f'use {expected_setting}'}. Remove this setting."
            )
    if expected_setting is None:
        return []
    cuts = edges if expected_setting == "edges" else edges_deg
    least = 1 if expected_setting == "edges" else 2
    if cuts is None or len(cuts) < least:
        raise ConfigError(
            f"got decision_cost.{expected_setting} = {cuts}, expected {least} or more edges between regions of the "
            f"{target.kind}, such as {'[0.0]' if least == 1 else '[-45, 45, 135, 225] (front, left, back, right)'}."
        )
    ascending = all(low < high for low, high in pairwise(cuts))
    if not ascending or not all(math.isfinite(cut) for cut in cuts):
        raise ConfigError(
            f"got decision_cost.{expected_setting} = {cuts}, expected finite numbers in ascending order."
        )
    if target.kind == "real":
        return cuts
    if cuts[-1] - cuts[0] >= 360:
        raise ConfigError(
            f"got decision_cost.edges_deg = {cuts}, expected edges within one turn: the last less than 360° above the "
            "first."
        )
    return [math.radians(cut) for cut in cuts]


def _region_names(kind: str, edges: list[float] | None, edges_deg: list[float] | None) -> list[str]:
    """Return the names of the regions between the edges, such as "below_0" for a real number or "-45_to_45_deg"."""
    if kind == "angle":
        cuts = edges_deg or []
        ends = zip(cuts, [*cuts[1:], *cuts[:1]], strict=True)
        return [f"{low:g}_to_{high:g}_deg" for low, high in ends]
    cuts = edges or []
    middle = [f"{low:g}_to_{high:g}" for low, high in pairwise(cuts)]
    return [f"below_{cuts[0]:g}", *middle, f"above_{cuts[-1]:g}"]


def _check_actions(table: list[list[float]], actions: list[str] | None, truths: list[str]) -> list[str]:
    """Return the names of the actions, after checking that the cost table fits the actions and the classes or regions.

    Args:
        table: costs, one row for each class or region, and one column for each action.
        actions: names of the actions; None for those of the classes or regions.
        truths: names of the classes or regions.

    Raises:
        ConfigError: table and names do not fit together, or a cost is not allowed.
    """
    if len(table) != len(truths) or not table[0] or len({len(row) for row in table}) > 1:
        raise ConfigError(
            f"decision_cost.costs has rows of {[len(row) for row in table]} numbers, expected {len(truths)} rows (one "
            f"for each of {', '.join(truths)}) with one number per action."
        )
    count = len(table[0])
    if actions is None and count == len(truths):
        actions = truths
    if actions is None or len(actions) != count:
        raise ConfigError(
            f"got decision_cost.actions = {actions}, expected {count} names, one for each column of "
            "decision_cost.costs."
        )
    if len({_key(name) for name in actions}) < count:
        raise ConfigError(
            f"got decision_cost.actions = {actions}, but the names of actions must differ. Give each action a name "
            "of its own."
        )
    for truth, row in zip(truths, table, strict=True):
        if any(math.isnan(cost) or cost == -math.inf for cost in row):
            raise ConfigError(
                f"decision_cost.costs has the row {row} for {truth}, expected numbers, or .inf for a forbidden action."
            )
        if all(cost == math.inf for cost in row):
            raise ConfigError(
                f"decision_cost.costs forbids every action if {truth} is true. Allow at least one action, such as "
                "asking a person."
            )
    return actions


def _key(name: str) -> str:
    return "_".join(name.split())
