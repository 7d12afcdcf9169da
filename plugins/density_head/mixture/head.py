"""The finite mixture head."""

from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from framework.density_head import DensityHead
from framework.distributions.density import Mixture
from framework.heads.parameters import require_finite, require_trained
from framework.target import Target

MODERATE = {"name": "von_mises", "floor": 1.0}
"""Settings of the default component, which cannot become uniform.

Several components together can describe a uniform density, and each still learns a direction.
"""


class MixtureHead(DensityHead):
    """Finite mixture of densities of another head, with weights by softmax (thesis eq. 3.10-3.11).

    The head reads K logits, then the raw parameters of K components, then, if K > 1, one further set of raw parameters
    that is added to each of the K. Through this set all components learn together what they have in common, and none
    falls behind (README). A component that is fitted after training (it has a buffer) is refused, because it is not
    known which samples belong to which component.

    Args:
        components: K. With 1 the density is that of `component`, to the last bit.
        component: the head whose densities are mixed.
    """

    bibtex = "bishop1994mixture"

    def __init__(
        self,
        target: Target,
        *,
        components: Annotated[int, Field(ge=1)] = 5,
        component: DensityHead = MODERATE,  # pyright: ignore[reportArgumentType]  # built by the framework
    ) -> None:
        super().__init__()
        self.components = components
        self.component = require_trained(component)
        self.size = components * (component.size + 1)
        if components > 1:
            # raw parameters that all components share, and offsets that make the components differ from the first step
            self.size += component.size
            self.spread = nn.Parameter(component.component_offsets(components))

    def forward(self, raw: Float[Tensor, "*batch size"]) -> Mixture:
        """Return the density for raw parameters."""
        raw = require_finite(raw, self.size)
        own = self.components * self.component.size
        logits, separate, common = raw.tensor_split([self.components, self.components + own], -1)
        numbers = separate.unflatten(-1, (self.components, self.component.size))
        if self.components > 1:
            most = torch.finfo(raw.dtype).max / 4  # so that the sum does not overflow
            numbers = (
                numbers.clamp(-most, most) + common.clamp(-most, most).unsqueeze(-2) + self.spread.to(raw)
            )
        return Mixture(logits, self.component(numbers))
