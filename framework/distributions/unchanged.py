"""Densities that add something to another density and leave the density itself unchanged, such as an outlier score."""

from functools import singledispatch
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution, constraints

from framework.distributions.affine import AffineDensity
from framework.distributions.batch_shapes import Reshaped
from framework.distributions.density import Mixture
from framework.distributions.protocol import ValueSet, value_set


class Unchanged(Mixture):
    """A mixture of one density, which equals this density to the last bit; a subclass adds further information.

    Args:
        density: any density.
    """

    def __init__(self, density: Distribution) -> None:
        self.density = density
        # The dtype of log_prob: for classes that of one label's, otherwise that of an empty sample.
        if torch.compiler.is_exporting():  # a trace reads the density's parameters alone, and draws nothing
            like = torch.empty(0)
        elif density.has_enumerate_support:
            like = density.log_prob(density.enumerate_support()[0])
        else:
            like = density.sample(torch.Size((0,)))
        shape = (*density.batch_shape, 1)
        super().__init__(torch.zeros(shape, dtype=like.dtype, device=like.device), Reshaped(density, shape))


class ScoredDensity(Unchanged):
    """A density, unchanged, and an outlier score of the input for which it was predicted.

    Args:
        density: any density.
        score: number that is high for inputs unlike the training data, (*batch), float64.
    """

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}

    def __init__(self, density: Distribution, score: Float[Tensor, "*batch"]) -> None:
        super().__init__(density)
        self.score = score


@value_set.register
def _(density: ScoredDensity) -> ValueSet | None:
    return value_set(density.density)


@singledispatch
def outlier_score(density: Distribution) -> Float[Tensor, "*batch"] | None:
    """Return the outlier score of the input of each density, float64 (*batch); None if a density has no score.

    A score is high for inputs unlike the training data. Its unit depends on the wrapper that computes it; only the
    order of scores has a meaning. The default returns None. A mixture, a power or a marginal of a density with a score
    has no score. An affine transform of a density has the score of this density, and so has an `Unchanged` density.
    """
    return None


@outlier_score.register
def _(density: Unchanged) -> Float[Tensor, "*batch"] | None:
    return outlier_score(density.density)


@outlier_score.register
def _(density: ScoredDensity) -> Float[Tensor, "*batch"]:
    return density.score


@outlier_score.register
def _(density: AffineDensity) -> Float[Tensor, "*batch"] | None:
    return outlier_score(density.density)
