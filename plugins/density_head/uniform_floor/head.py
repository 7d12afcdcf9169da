"""A density head that adds a small uniform density to the density of another head."""

import math
from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.distributions import Distribution

from framework.density_head import DensityHead
from framework.distributions.uniform import uniform
from framework.heads.parameters import require_trained
from framework.target import Target
from plugins.density_head.uniform_floor.density import Floored

COMPONENT = {"name": "von_mises"}


class UniformFloorHead(DensityHead):
    """A component's density p with a uniform floor u, (1 - γ) p + γ u, so that no target is impossible.

    No loss exceeds log(1/(γu)). The original code of the method of thesis Chapter 3 silently adds such a floor to its
    mixtures. Here the floor is a head of its own, so that it appears in the config, in the run's parameters and in the
    name of the method. With γ = 0 the head equals its component.

    Args:
        weight: γ.
        component: the head whose density the floor is added to.
    """

    bibtex = "prokudin2018deep"

    def __init__(
        self,
        target: Target,
        *,
        weight: Annotated[float, Field(ge=0, lt=1)] = 1e-3,
        component: DensityHead = COMPONENT,  # pyright: ignore[reportArgumentType]  # built by the framework
    ) -> None:
        super().__init__()
        target.refuse(
            "real",
            "density_head uniform_floor needs a bounded target, since no density is uniform over the reals "
            f"({target.listed_names}). Choose the component alone as density_head, with its own setting `floor`.",
        )
        self.weight = weight
        self.component = require_trained(component)
        self.size = component.size
        self._law(torch.zeros(1, self.size))  # raises here if there is no uniform density

    def forward(self, raw: Float[Tensor, "*batch size"]) -> Distribution:
        """Return the density for raw parameters."""
        density = self.component(raw)
        return Floored(density, self.weight) if self.weight > 0 else density

    def loss(self, raw: Float[Tensor, "*batch size"], target: Tensor) -> Float[Tensor, "*batch"]:
        """Return the component's loss with the floor added, nats."""
        if self.weight == 0:
            return self.component.loss(raw, target)
        # the loss of a variational component is a bound on -log p; the floor is added as if it were -log p
        above = math.log1p(-self.weight) - self.component.loss(raw, target)
        below = self._law(raw).log_prob(target).double() + math.log(self.weight)
        return -torch.logaddexp(above, below.to(above.dtype))

    def _law(self, raw: Tensor) -> Distribution:
        """Return the uniform density over the component's support, without a change of the random generator's state."""
        with torch.no_grad(), torch.random.fork_rng([raw.device] if raw.is_cuda else []):
            return uniform(self.component(raw))
