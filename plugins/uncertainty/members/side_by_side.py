"""Networks of one architecture with stacked parameters, all computed in one pass."""

import copy
from collections.abc import Mapping, Sequence
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.func import functional_call, vmap


class SideBySide(nn.Module):
    """T networks as one: the first dimension of each parameter is the members, and each layer is one batched product.

    An optimiser that works element by element (SGD, Adam and similar ones) updates every member as it would alone.

    Args:
        networks: of one architecture, without buffers; their parameters are copied.
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
        """Return the output of each of the first `used` members (all by default); each has its own dropout masks."""
        return self._computed(inputs, used, None).movedim(0, 1)

    def own(self, inputs: Float[Tensor, "member batch *input"]) -> Float[Tensor, "member batch size"]:
        """Return the output of each member for its own inputs."""
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

        def one(mine: dict[str, Tensor], given: Tensor) -> Tensor:
            return functional_call(template, mine, (given,))

        return vmap(one, in_dims=(0, members), randomness="different")(parameters, inputs)

    def clip_each(self, most: float, beside: Sequence[nn.Module]) -> None:
        """Shorten each member's gradient to the norm `most`, as torch's clip_grad_norm_ does for one network.

        Args:
            most: largest norm of a member's gradient.
            beside: further modules of each member.
        """
        gradients = [one.grad for one in self.parameters() if one.grad is not None]
        others = [[one.grad for one in module.parameters() if one.grad is not None] for module in beside]
        norms = [torch.linalg.vector_norm(one.reshape(self.count, -1), dim=1) for one in gradients]
        norms += [torch.stack([one.norm() for one in some]) for some in zip(*others, strict=True)]
        factor = (most / (torch.linalg.vector_norm(torch.stack(norms), dim=0) + 1e-6)).clamp(max=1)
        for one in gradients:
            one.mul_(factor.view(-1, *[1] * (one.dim() - 1)))
        for index, some in enumerate(others):
            for one in some:
                one.mul_(factor[index])

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
