"""Several networks of one architecture with stacked parameters, computed in one pass."""

import copy
from collections.abc import Mapping, Sequence
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.func import functional_call, vmap

from framework.model import RawNetwork


class SideBySide(RawNetwork):
    """Module that computes several networks of one architecture in one pass, by batched matrix products.

    The networks are the members of an ensemble; the first dimension of each stacked parameter is the member. An
    optimiser that works element by element (SGD, Adam and similar ones) updates every member as it would alone.

    Args:
        networks: networks of one architecture, without buffers; their parameters are copied.
    """

    _template: ClassVar[nn.Module]

    def __init__(self, networks: Sequence[nn.Module]) -> None:
        super().__init__()
        self.count = len(networks)
        self.stacked = copy.deepcopy(networks[0])
        for name, parameter in self.stacked.named_parameters():
            parts = [network.get_parameter(name).detach() for network in networks]
            parameter.data = torch.stack(parts)
        # not a submodule: it only defines the computation, and its own parameters are never read
        self.__dict__["_template"] = copy.deepcopy(networks[0])

    def forward(self, inputs: Tensor, used: int | None = None) -> Float[Tensor, "batch member size"]:
        """Return the outputs of the first `used` members for the same inputs; None means all members.

        Each member has its own dropout masks.
        """
        return self._computed(inputs, used, None).movedim(0, 1)

    def own(self, inputs: Float[Tensor, "member batch *input"]) -> Float[Tensor, "member batch size"]:
        """Return the outputs of all members, each for its own inputs."""
        return self._computed(inputs, None, 0)

    def _computed(
        self, inputs: Tensor, used: int | None, members: int | None
    ) -> Float[Tensor, "member batch size"]:
        template = self._template
        # module by module: dropout may be active while all other modules evaluate
        for mine, shown in zip(template.modules(), self.stacked.modules(), strict=True):
            mine.training = shown.training
        parameters: dict[str, Tensor] = {**dict(self.stacked.named_parameters())}
        if used is not None and used < self.count:
            parameters = {name: parameter[:used] for name, parameter in parameters.items()}

        def compute_member(parameters: dict[str, Tensor], inputs: Tensor) -> Tensor:
            return functional_call(template, parameters, (inputs,))

        if torch.compiler.is_exporting() and members is None:  # vmap cannot be traced
            each = zip(*(parameter.unbind() for parameter in parameters.values()), strict=True)
            return torch.stack(
                [compute_member(dict(zip(parameters, part, strict=True)), inputs) for part in each]
            )
        return vmap(compute_member, in_dims=(0, members), randomness="different")(parameters, inputs)

    def clip_each(self, most: float, beside: Sequence[nn.Module]) -> None:
        """Scale each member's gradient down to the norm `most` if it is longer, like torch's clip_grad_norm_.

        Args:
            most: largest norm of a member's gradient.
            beside: one further module for each member, whose gradient counts as a part of the member's gradient.
        """
        gradients = [gradient.grad for gradient in self.parameters() if gradient.grad is not None]
        further = [
            [gradient.grad for gradient in module.parameters() if gradient.grad is not None]
            for module in beside
        ]
        norms = [torch.linalg.vector_norm(gradient.reshape(self.count, -1), dim=1) for gradient in gradients]
        norms += [torch.stack([gradient.norm() for gradient in some]) for some in zip(*further, strict=True)]
        factor = (most / (torch.linalg.vector_norm(torch.stack(norms), dim=0) + 1e-6)).clamp(max=1)
        for gradient in gradients:
            gradient.mul_(factor.view(-1, *[1] * (gradient.dim() - 1)))
        for index, some in enumerate(further):
            for gradient in some:
                gradient.mul_(factor[index])

    @torch.no_grad()
    def write(self, index: int, parameters: Mapping[str, Tensor]) -> None:
        """Replace the parameters of member `index`."""
        for name, parameter in self.stacked.named_parameters():
            parameter[index] = parameters[name]

    def read(self, index: int) -> dict[str, Tensor]:
        """Return a copy of the parameters of member `index`."""
        return {
            name: parameter[index].detach().clone() for name, parameter in self.stacked.named_parameters()
        }
