"""A declared uniform floor under any bounded density."""

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.distributions import Distribution

from framework.density_head import DensityHead
from framework.distributions.uniform import uniform
from framework.errors import ConfigError
from framework.heads.parameters import require_trained
from framework.target import Target
from plugins.density_head.uniform_floor.density import Floored

COMPONENT = {"name": "von_mises"}


class UniformFloorHead(DensityHead):
    """A declared uniform floor under a component's density: (1 - γ) p + γ u, so that no target is impossible.

    No loss exceeds log(1/(γu)). The authors' original code adds such a floor to its mixtures without saying so. Here it
    is a head of its own: it appears in the config, in the run's parameters and in the method's name, and with γ = 0 it
    equals its component.

    Args:
        weight: γ.
        component: the head whose density the floor is added to.
    """

    knobs: ClassVar[Mapping[str, tuple[int, ...]]] = {}
    bibtex = """@inproceedings{prokudin2018deep,
  author    = {Prokudin, Sergey and Gehler, Peter and Nowozin, Sebastian},
  title     = {Deep Directional Statistics: Pose Estimation with Uncertainty Quantification},
  booktitle = {European Conference on Computer Vision (ECCV)},
  pages     = {534--551},
  year      = {2018}
}"""

    def __init__(
        self,
        target: Target,
        *,
        weight: Annotated[float, Field(ge=0, lt=1)] = 1e-3,
        component: DensityHead = COMPONENT,  # pyright: ignore[reportArgumentType]  # built by the framework
    ) -> None:
        super().__init__()
        if target.kind == "real":
            raise ConfigError(
                "density_head uniform_floor needs a bounded target; no density is uniform over the reals "
                f"({target.listed_names}). Choose the component itself, with its own floor."
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
        # the loss of a variational component is a bound; the floor is added to it as to a density
        above = math.log1p(-self.weight) - self.component.loss(raw, target)
        below = self._law(raw).log_prob(target).double() + math.log(self.weight)
        return -torch.logaddexp(above, below.to(above.dtype))

    def _law(self, raw: Tensor) -> Distribution:
        """Return the uniform density over the component's support; the state of the random generator is kept."""
        with torch.no_grad(), torch.random.fork_rng([raw.device] if raw.is_cuda else []):
            return uniform(self.component(raw))
