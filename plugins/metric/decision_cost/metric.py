"""Cost of acting on the predicted densities, with the cost of each mistake stated by the user."""

import math
from itertools import pairwise
from typing import Annotated, ClassVar, Literal

import torch
from pydantic import Field
from torch import Tensor

from framework.configuration.paths import Words
from framework.distributions.class_probabilities import require_labels
from framework.errors import ConfigError, did_you_mean
from framework.metric import Metric
from framework.prediction import Prediction
from framework.target import Target
from plugins.metric.decision_cost.functional import (
    decide,
    expected_costs,
    region_probabilities,
    regions,
)


class DecisionCost(Metric):
    """Mean cost of taking the action of least expected cost under each density (Savage 1954; Berger 1985, §1.3).

    - `decision_cost`: mean cost of these actions under the true target.
    - `decision_cost_fixed`: mean cost of the one action that would have cost least if it had always been taken.
    - `decision_cost_oracle`: mean cost of the best action for each truth.
    - `share_<action>`: share of samples for which the action was taken.

    A cost may be infinite (a forbidden action) or negative (a gain). A truth of probability 0 adds no cost; any higher
    probability forbids an action of infinite cost. The first one of equally good actions is taken.

    Args:
        costs: table truth × action: row i holds the cost of each action where class or region i is true, in any unit;
            by default 0 for the right class or region and 1 for every other.
        actions: names of the columns; by default the names of the classes or regions. There may be more actions than
            truths, for example "ask a person".
        edges: for a real: values that cut the line into regions, ascending; the first region is below the first edge.
        edges_deg: for an angle: angles that cut the circle, degrees, ascending within one turn; the first region begins
            at the first edge, counter-clockwise, and the last ends there.
        number: name of the number of the target that the edges cut, where the target has several.
        samples: draws for a density whose masses are not known.

    Raises:
        ConfigError: the table does not fit the target, its edges or its names; it holds a NaN; or every action is
            forbidden for some truth.
        UserError: densities are NaN; the message says how many.
        DataError: a target is not a class of the data set.
    """

    bibtex = """@book{berger1985statistical,
  author    = {Berger, James O.},
  title     = {Statistical Decision Theory and {B}ayesian Analysis},
  publisher = {Springer},
  edition   = {2},
  year      = {1985}
}"""
    columns: ClassVar[dict[str, str]] = {
        "decision_cost": "cost",
        "decision_cost_fixed": "cost, fixed",
        "decision_cost_oracle": "cost, oracle",
    }
    better: ClassVar[dict[str, Literal["higher", "lower"]]] = {"decision_cost": "lower"}
    costs: Tensor
    edges: Tensor
    count: Tensor
    total: Tensor
    fixed: Tensor
    oracle: Tensor
    taken: Tensor

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
        self.index = _index(target, number)
        cuts = _cuts(target, edges, edges_deg)
        truths = list(target.names) if target.kind == "class" else _names(target.kind, edges, edges_deg)
        table = [[float(i != j) for j in range(len(truths))] for i in range(len(truths))]
        table = table if costs is None else costs
        names = truths if actions is None and costs is None else actions
        self.actions = _check(table, names, truths)
        self.register_buffer("costs", torch.tensor(table, dtype=torch.float64), persistent=False)
        self.register_buffer("edges", torch.tensor(cuts, dtype=torch.float64), persistent=False)
        zero, each = torch.zeros((), dtype=torch.float64), torch.zeros(len(self.actions), dtype=torch.float64)
        self.add_state("count", zero, dist_reduce_fx="sum")
        self.add_state("total", zero.clone(), dist_reduce_fx="sum")
        self.add_state("oracle", zero.clone(), dist_reduce_fx="sum")
        self.add_state("fixed", each, dist_reduce_fx="sum")
        self.add_state("taken", each.clone(), dist_reduce_fx="sum")

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
        self.total += paid.gather(-1, chosen.unsqueeze(-1)).sum()
        self.taken += torch.nn.functional.one_hot(chosen, len(self.actions)).double().sum(0)
        self.fixed += paid.sum(0)
        self.oracle += paid.amin(-1).sum()

    def compute(self) -> dict[str, Tensor]:
        found = {
            "decision_cost": self.total / self.count,
            "decision_cost_fixed": (self.fixed / self.count).amin(),
            "decision_cost_oracle": self.oracle / self.count,
        }
        shares = self.taken / self.count
        return found | {
            f"share_{_key(name)}": share for name, share in zip(self.actions, shares, strict=True)
        }


def _index(target: Target, number: str | None) -> int:
    if target.kind == "class":
        if number is not None:
            raise ConfigError(
                f"decision_cost.number = {number!r}: this data set's target is one class. Leave it out."
            )
        return 0
    if number is None and len(target.names) > 1:
        raise ConfigError(
            f"decision_cost.number is missing: the target has {len(target.names)} numbers, and edges cut one of them. "
            f"Name one of: {target.listed_names}."
        )
    if number is not None and number not in target.names:
        raise ConfigError(
            f"decision_cost.number = {number!r} is no number of the target.{did_you_mean(number, target.names)} "
            f"Known: {target.listed_names}."
        )
    return 0 if number is None else target.names.index(number)


def _cuts(target: Target, edges: list[float] | None, edges_deg: list[float] | None) -> list[float]:
    """Return the edges for the kind of target, in radians for an angle; an empty list for classes."""
    wanted = {"class": None, "real": "edges", "angle": "edges_deg"}[target.kind]
    for name, given in (("edges", edges), ("edges_deg", edges_deg)):
        if given is not None and name != wanted:
            raise ConfigError(
                f"decision_cost.{name} = {given}: targets of kind {target.kind!r} are cut by "
                f"{'nothing: classes are the rows already' if wanted is None else wanted}. Leave it out."
            )
    if wanted is None:
        return []
    cuts = edges if wanted == "edges" else edges_deg
    least = 1 if wanted == "edges" else 2
    if cuts is None or len(cuts) < least:
        raise ConfigError(
            f"decision_cost.{wanted} = {cuts}: costs are of regions of the {target.kind}; wanted {least} or more edges "
            f"between them, such as {'[0.0]' if least == 1 else '[-45, 45, 135, 225] (front, left, back, right)'}."
        )
    ascending = all(low < high for low, high in pairwise(cuts))
    if not ascending or not all(math.isfinite(cut) for cut in cuts):
        raise ConfigError(f"decision_cost.{wanted} = {cuts}: wanted finite numbers in ascending order.")
    if target.kind == "real":
        return cuts
    if cuts[-1] - cuts[0] >= 360:
        raise ConfigError(
            f"decision_cost.edges_deg = {cuts}: wanted all within one turn, the last less than 360° above the first."
        )
    return [math.radians(cut) for cut in cuts]


def _names(kind: str, edges: list[float] | None, edges_deg: list[float] | None) -> list[str]:
    """Return names of the regions, made of their ends."""
    if kind == "angle":
        cuts = edges_deg or []
        ends = zip(cuts, [*cuts[1:], *cuts[:1]], strict=True)
        return [f"{low:g}_to_{high:g}_deg" for low, high in ends]
    cuts = edges or []
    middle = [f"{low:g}_to_{high:g}" for low, high in pairwise(cuts)]
    return [f"below_{cuts[0]:g}", *middle, f"above_{cuts[-1]:g}"]


def _check(table: list[list[float]], actions: list[str] | None, truths: list[str]) -> list[str]:
    """Return the names of the actions, after checking that the table fits them and the truths."""
    if len(table) != len(truths) or not table[0] or len({len(row) for row in table}) > 1:
        raise ConfigError(
            f"decision_cost.costs has rows of {[len(row) for row in table]} numbers; wanted {len(truths)} rows, one "
            f"for each of {', '.join(truths)}, of as many numbers as there are actions."
        )
    count = len(table[0])
    if actions is None and count == len(truths):
        actions = truths
    if actions is None or len(actions) != count:
        raise ConfigError(
            f"decision_cost.actions = {actions}: wanted {count} names, one for each column of decision_cost.costs."
        )
    if len({_key(name) for name in actions}) < count:
        raise ConfigError(f"decision_cost.actions = {actions}: wanted names that differ.")
    for truth, row in zip(truths, table, strict=True):
        if any(math.isnan(cost) or cost == -math.inf for cost in row):
            raise ConfigError(
                f"decision_cost.costs: {row} where {truth} is true; wanted numbers, or .inf for a forbidden action."
            )
        if all(cost == math.inf for cost in row):
            raise ConfigError(
                f"decision_cost.costs: every action is forbidden where {truth} is true; allow one at least, such as "
                "asking a person."
            )
    return actions


def _key(name: str) -> str:
    return "_".join(name.split())
