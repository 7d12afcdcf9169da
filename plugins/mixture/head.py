"""The finite mixture head."""

from typing import Annotated, cast

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.density import Mixture
from framework.density_head import DensityHead
from framework.errors import ConfigError
from framework.target import Target


class MixtureHead(DensityHead):
    """Finite mixture of any other head's densities, weights by softmax (thesis eq. 3.10-3.11).

    Reads K logits, then K times what the component reads. Every sample has components of its own; a component that
    is fitted after training (it keeps a buffer) is refused, because which data belongs to it is not known.

    Args:
        components: K. With 1 the density is the component, to the last bit.
        component: the head whose densities are mixed.
    """

    knobs = {}
    bibtex = """@techreport{bishop1994mixture,
  title = {Mixture Density Networks},
  author = {Bishop, Christopher M.},
  institution = {Aston University},
  number = {NCRG/94/004},
  year = {1994}
}"""

    def __init__(
        self,
        target: Target,
        *,
        components: Annotated[int, Field(ge=1)] = 5,
        component: DensityHead = cast(DensityHead, "von_mises"),
    ) -> None:
        super().__init__()
        fitted = set(component.state_dict()) - {name for name, _ in component.named_parameters()}
        if fitted:
            raise ConfigError(
                f"density_head.component fits {', '.join(sorted(fitted))} after training, which a component of a "
                "mixture cannot; choose one that predicts it, such as concentration=predicted."
            )
        self.components = components
        self.component = component
        self.size = components * (component.size + 1)

    def forward(self, raw: Float[Tensor, "*batch size"]) -> Mixture:
        if raw.shape[-1] != self.size:
            raise ValueError(
                f"raw numbers of shape {tuple(raw.shape)}; wanted {self.size} in the last dimension."
            )
        bad = ~raw.isfinite().all(-1)
        if bad.any():
            row = tuple(bad.nonzero()[0].tolist())
            raise ValueError(f"raw numbers are not finite in batch row {row[0] if len(row) == 1 else row}.")
        number = raw.float() if raw.dtype in (torch.float16, torch.bfloat16) else raw
        logits, rest = number.tensor_split([self.components], -1)
        return Mixture(logits, self.component(rest.unflatten(-1, (self.components, self.component.size))))

    def loss(self, raw: Float[Tensor, "*batch size"], target: Tensor) -> Float[Tensor, "*batch"]:
        return -self(raw).log_prob(target)

    def calibrate(self, raw: Float[Tensor, "batch size"], target: Tensor) -> None:
        pass  # everything is trained
