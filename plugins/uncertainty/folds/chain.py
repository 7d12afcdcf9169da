"""Several networks of fully connected layers with stacked weights, computed by batched matrix products."""

from collections.abc import Sequence
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

POINTWISE = (nn.ReLU, nn.ELU, nn.SiLU)
"""Layers that change each number on its own and have no weights."""
ROWS = 64
"""Number of samples that are computed at once without gradient, so that the outputs of a layer stay in the cache."""
NARROW = 16
"""Number of outputs below which a product is computed faster from transposed weights and numbers."""
POOL = 2**20
"""Number of random dropout factors that are kept in addition to the number that one layer needs.

Each step reads a part of the kept factors, from a random position on. Drawing new factors at every step would double
the time of a step.
"""


class Chain(nn.Module):
    """Networks of one architecture: fully connected layers with pointwise functions and dropout.

    The weights of all networks are stacked, (member, inputs, outputs). An optimiser that works element by element
    trains every member as it would train alone.

    Args:
        networks: networks that `layers_of` accepts; their weights are copied. They form groups of equal size, one group
            after another; the networks of a group have the same dropout.
        dropout: for each group, the probability of all dropout layers; None keeps the probabilities of the networks.
    """

    steps: list[nn.Module]

    def __init__(self, networks: Sequence[nn.Module], dropout: Sequence[float | None]) -> None:
        super().__init__()
        self.members = len(networks)
        self.dropout = tuple(dropout)
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        chains = [layers_of(network) or [] for network in networks]
        for layers in zip(*chains, strict=True):
            if isinstance(layers[0], nn.Linear):
                linear = cast(Sequence[nn.Linear], layers)
                self.weights.append(torch.stack([layer.weight.detach().T for layer in linear]))
                self.biases.append(torch.stack([layer.bias.detach() for layer in linear]).unsqueeze(1))
        self.__dict__["steps"] = chains[0]  # not submodules: they only define the computation
        self._pools: dict[float, Tensor] = {}

    def forward(self, inputs: Tensor) -> Float[Tensor, "member batch size"]:
        """Return the outputs of all members.

        `inputs` are (member, batch, length), or (batch, length) if all members read the same inputs.
        """
        dtype = self.weights[0].dtype
        numbers = inputs.to(dtype) / 255 if inputs.dtype == torch.uint8 else inputs.to(dtype)
        numbers = numbers.expand(self.members, *inputs.shape) if inputs.dim() == 2 else numbers
        if torch.is_grad_enabled() or torch.compiler.is_exporting() or numbers.shape[1] <= ROWS:
            return self._compute(numbers)
        return torch.cat([self._compute(part) for part in numbers.split(ROWS, 1)], 1)

    def _compute(self, numbers: Float[Tensor, "member batch length"]) -> Float[Tensor, "member batch size"]:
        layer = 0
        for step in self.steps:
            if isinstance(step, nn.Linear):
                numbers = _affine(numbers, self.weights[layer], self.biases[layer])
                layer += 1
            elif isinstance(step, nn.Dropout):
                numbers = self._drop(numbers, step.p) if self.training else numbers
            else:
                numbers = step(numbers)
        return numbers

    def _drop(self, numbers: Tensor, default: float) -> Tensor:
        """Return the numbers after dropout, for which each group has its own probability.

        `default` is the probability for groups whose `dropout` is None.
        """
        probabilities = [default if chosen is None else chosen for chosen in self.dropout]
        if not any(probabilities):
            return numbers
        shape = (self.members // len(probabilities), *numbers.shape[1:])
        masks = [
            self._mask(probability, numbers[: shape[0]]) if probability else numbers.new_ones(shape)
            for probability in probabilities
        ]
        return numbers * (masks[0] if len(masks) == 1 else torch.cat(masks))

    def _mask(self, probability: float, numbers: Tensor) -> Tensor:
        """Return random factors, 0 or 1/(1 - p) for the dropout probability p, in the shape of `numbers`."""
        count = numbers.numel()
        pool = self._pools.get(probability)
        if pool is None or len(pool) < count + POOL:
            open_gates = torch.rand(count + POOL, device=numbers.device) >= probability
            pool = self._pools[probability] = open_gates.to(numbers.dtype) / (1 - probability)
        start = int(torch.randint(len(pool) - count, ()))
        return pool[start : start + count].view_as(numbers)

    def forget_masks(self) -> None:
        """Free the memory of the random dropout factors."""
        self._pools.clear()


def _affine(
    numbers: Float[Tensor, "member batch length"],
    weight: Float[Tensor, "member length size"],
    bias: Float[Tensor, "member 1 size"],
) -> Float[Tensor, "member batch size"]:
    """Return numbers @ weight + bias."""
    if weight.shape[2] >= NARROW or torch.is_grad_enabled() or torch.compiler.is_exporting():
        return torch.baddbmm(bias, numbers, weight)
    return torch.baddbmm(bias.mT, weight.mT.contiguous(), numbers.mT).mT


@torch.no_grad()
def build_chain(networks: Sequence[nn.Module], dropout: Sequence[float | None]) -> Chain | None:
    """Return the networks as a `Chain`, whose arguments are `networks` and `dropout`.

    The result is None if a network has layers that `Chain` cannot compute. It is also None if the outputs of a network
    differ from those of the chain, because the network's `forward` does more than apply its layers.
    """
    layers = [layers_of(network) for network in networks]
    first = next((layer for layer in layers[0] or () if isinstance(layer, nn.Linear)), None)
    if first is None or any(part is None for part in layers):
        return None
    chain = Chain(networks, dropout).eval()
    bits = torch.randint(256, (3, first.in_features), generator=torch.Generator().manual_seed(0))
    for probe in (bits.to(first.weight.dtype) / 50 - 2.5, bits.to(torch.uint8)):
        try:
            expected = torch.stack([network.eval()(probe) for network in networks])
        except Exception:  # a network that reads other inputs raises errors of many kinds
            if probe.is_floating_point():
                return None
            continue
        finally:
            for network in networks:
                network.train()
        if not torch.allclose(chain(probe), expected, rtol=1e-4, atol=1e-4):
            return None
    return chain.train()


def layers_of(network: nn.Module) -> list[nn.Module] | None:
    """Return the layers of a network in their order if `Chain` can compute them; None otherwise.

    A network is accepted if it consists of linear layers with a bias, pointwise functions, dropout, and layers that
    only flatten or return their input; the latter are left out of the result. These layers may be in nested
    `Sequential`s, and in modules whose only child is a `Sequential` named `layers`, such as the encoder `mlp`.
    """
    if isinstance(network, nn.Sequential):
        parts = [layers_of(part) for part in network]
        if any(part is None for part in parts):
            return None
        return [layer for part in parts for layer in part or ()]
    if isinstance(network, nn.Linear):
        return [network] if network.bias is not None else None
    if isinstance(network, nn.Dropout):
        return [network]
    if type(network) is nn.Flatten or isinstance(network, nn.Identity):
        return []
    return _pointwise(network)


def _pointwise(network: nn.Module) -> list[nn.Module] | None:
    for kind in POINTWISE:
        if type(network) is kind:
            return [kind()]  # not in place, since members share inputs
    layers = getattr(network, "layers", None)
    only = isinstance(layers, nn.Sequential) and list(network.children()) == [layers]
    return layers_of(cast(nn.Module, layers)) if only else None
